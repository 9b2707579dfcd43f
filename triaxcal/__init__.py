"""The metrology of three-axis accelerometers: numbers in, numbers out. Needs numpy and scipy alone."""
