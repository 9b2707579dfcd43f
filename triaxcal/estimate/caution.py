"""Reasons not to trust a result, as values with their figures. `triaxcal.text`
says them in English.

Those of the fit to still poses are here; a fit by another method has its own
beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

from triaxcal.poses.pose import PoseStart


@dataclass(frozen=True)
class Caution:
    """A reason not to trust a result in full."""


@dataclass(frozen=True)
class ExcludedPose:
    """A pose that a fit excludes, when it began and how many standard errors
    off it is."""

    began: PoseStart
    studentized: float


@dataclass(frozen=True)
class FaultyPosesExcluded(Caution):
    """The outputs did not follow the acceleration; ``faults`` by data-quality
    name."""

    faults: tuple[tuple[PoseStart, str], ...]


@dataclass(frozen=True)
class UnknownHistoryExcluded(Caution):
    """An effect goes with the pose before, which nobody knows."""

    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class PosesExcludedByCaller(Caution):
    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class OutliersExcluded(Caution):
    """``doubtful``: the other residuals leave it open whether all poses repeat
    less well than their noise says, and the standard errors allow for that, by
    ``excess`` (in the reference) where it is not 0."""

    poses: tuple[ExcludedPose, ...]
    doubtful: bool
    excess: float


@dataclass(frozen=True)
class OutlierSetsTied(Caution):
    """Any of these sets of poses may be outliers, or something else acts; none
    is excluded."""

    sets: tuple[tuple[PoseStart, ...], ...]


@dataclass(frozen=True)
class PoorSpread(Caution):
    """Some combination of parameters is ``dilution`` times as uncertain as one
    pose; poses ``wanted`` would mend it."""

    dilution: float
    wanted: tuple[str, ...]


@dataclass(frozen=True)
class FewPoses(Caution):
    poses: int
    parameters: int


@dataclass(frozen=True)
class HighLeverage(Caution):
    """One pose alone determines a parameter."""

    began: PoseStart
    leverage: float


@dataclass(frozen=True)
class ExcessVariance(Caution):
    """Residuals show an ``excess`` standard deviation of |a|, in the reference,
    that every pose has beside its noise; the standard errors allow for it."""

    excess: float


@dataclass(frozen=True)
class BirgeRatio(Caution):
    """Residuals are ``ratio`` times what noise explains, which raises the
    standard errors. ``attitudes``: what noise and the error of the attitudes
    explain."""

    ratio: float
    attitudes: bool = False


@dataclass(frozen=True)
class ResidualsTooSmall(Caution):
    """Residuals are smaller than noise and creep explain: the standard errors
    are too large rather than too small."""
