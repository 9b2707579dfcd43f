"""The unit: sensor, gravity, samples, and the moment for which effects of time
hold."""
