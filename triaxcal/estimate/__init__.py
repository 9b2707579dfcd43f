"""From poses to a calibration: closed form, maximum likelihood, outliers,
cross-validation."""
