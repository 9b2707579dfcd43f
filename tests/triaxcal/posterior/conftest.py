"""What the tests of the posterior share: poses of one unit, with whatever effects it has."""

from __future__ import annotations

from collections.abc import Sequence

from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.posterior.rows import Rows

SIGMA_G = 2e-5
MINUS = (-1.0, -1.0, -1.0)
"""Signs of the paper's unit."""


def rows_of(poses: Sequence[Pose], signs: Sequence[float]) -> Rows:
    return Rows.of(poses, fit(poses, signs=signs), signs)
