"""Where to point the unit: directions, their order, designs for suspected
effects, and what a set still lacks."""

from triaxcal.model.directions import (
    FULL,
    LEAST,
    PAPER,
    Direction,
    bias_directions,
    closed,
    cube_directions,
    dilution,
    directions,
    elsewhere,
    in_order,
    linear_design,
    most_wanted,
    worst_error,
)
from triaxcal.planning.addition import Addition, MissingPoses, missing_poses
from triaxcal.planning.design import (
    Observability,
    OptimalPlan,
    TargetEffects,
    in_plan,
    needs_time,
    observability,
    optimal,
    target_effects,
    unseen_effects,
)
from triaxcal.planning.sequential import best_first, magnitude_error

__all__ = [
    "FULL",
    "LEAST",
    "PAPER",
    "Addition",
    "Direction",
    "MissingPoses",
    "Observability",
    "OptimalPlan",
    "TargetEffects",
    "best_first",
    "bias_directions",
    "closed",
    "cube_directions",
    "dilution",
    "directions",
    "elsewhere",
    "in_order",
    "in_plan",
    "linear_design",
    "magnitude_error",
    "missing_poses",
    "most_wanted",
    "needs_time",
    "observability",
    "optimal",
    "target_effects",
    "unseen_effects",
    "worst_error",
]
