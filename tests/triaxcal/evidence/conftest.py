"""What the tests of the posterior share: poses of one unit, with whatever effects it has."""

from __future__ import annotations

from collections.abc import Sequence

from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.poses.pose import Pose

SIGMA_G = 2e-5
MINUS = (-1.0, -1.0, -1.0)
"""Signs of the paper's unit."""


FEW = tuple(
    effect_named(name)
    for name in (
        "second_order_nonlinearity", "third_order_nonlinearity", "scale_factor_asymmetry", "temperature_bias",
        "hysteresis", "bias_drift", "warm_up",
    )
)  # fmt: skip
"""What is looked for where the subject is another: half of the time goes into the moments of a step."""


def rows_of(poses: Sequence[Pose], signs: Sequence[float]) -> LinearisedData:
    return LinearisedData.of(poses, fit(poses, signs=signs), signs)
