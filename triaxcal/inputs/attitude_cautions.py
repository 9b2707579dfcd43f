"""What speaks against a fit to poses of known attitude."""

from __future__ import annotations

from dataclasses import dataclass

from triaxcal.estimate.caution import Caution
from triaxcal.poses.pose import PoseStart


@dataclass(frozen=True)
class Row:
    """One of the attitudes that were given, by its name, and when its pose
    began."""

    name: str
    began: PoseStart


@dataclass(frozen=True)
class AttitudesTied(Caution):
    """One of these attitudes is wrong; none is excluded."""

    rows: tuple[Row, ...]


@dataclass(frozen=True)
class AttitudeExcluded(Caution):
    """It is wrong by ``off_rad``; the pose was measured with ``up`` in the
    table's frame."""

    row: Row
    off_rad: float
    up: tuple[float, float, float]


@dataclass(frozen=True)
class AttitudesContradict(Caution):
    """Each other, by more than noise; ``error_rad`` by axis is estimated from
    that."""

    error_rad: float


@dataclass(frozen=True)
class DeclaredErrorContradicted(Caution):
    """By the residuals, which say ``error_rad`` ± ``uncertainty_rad``;
    ``declared_rad`` stays in force.

    With it the standard errors are up to ``raised`` times what they are with
    the estimate.
    """

    declared_rad: float
    error_rad: float
    uncertainty_rad: float
    raised: float


@dataclass(frozen=True)
class MagnitudeContradicts(Caution):
    """Under the fit |a| is off by ``ratio`` times its noise, most in the
    ``worst`` row."""

    ratio: float
    worst: Row
