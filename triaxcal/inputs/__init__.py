"""Other ways in: a turning unit, known attitudes, datasheet values."""
