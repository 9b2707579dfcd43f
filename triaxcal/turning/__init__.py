"""A unit that turns and never rests: streaming moments, adjusted least squares, the fit."""
