"""Where to point the unit: directions, their order, designs for suspected
effects, and what a set still lacks."""

from triaxcal.model.directions import dilution, directions, in_order, most_wanted

__all__ = ["dilution", "directions", "in_order", "most_wanted"]
