"""Where to point the unit: directions, their order, designs for suspected effects, and what a set still lacks."""
