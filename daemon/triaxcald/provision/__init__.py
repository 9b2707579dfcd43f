"""Provisioning: a calibration into a device's registers, verified, or the old
one put back."""
