"""Calibrations of many units, each with the place and time of its run: the data of
the population's models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData

COEFFICIENTS = (
    "scale_factor.x", "scale_factor.y", "scale_factor.z",
    "misalignment.x", "misalignment.y", "misalignment.z",
    "bias.x", "bias.y", "bias.z",
)  # fmt: skip
"""The nine of the linear model, in the order of `UnitRun.coefficients`."""


class PlaceKind(StrEnum):
    """What several runs have in common besides the unit."""

    BATCH = "batch"
    STATION = "station"
    FIXTURE = "fixture"
    SLOT = "slot"
    """A slot of a fixture, or of a station if the fixture is unknown."""
    OPERATOR = "operator"
    HOUR = "hour"
    """A span of hours of the day, UTC, such as 14-18."""
    EVERYWHERE = "everywhere"
    """All runs, for some time."""


@dataclass(frozen=True)
class SeenEffect:
    """An effect in one run. ``probability`` is None if it is not calibrated
    (`triaxcal.diagnosis.Loop.stated`). ``coefficients`` maps each name to value and
    standard error. ``prior_odds`` are the odds before the run, NaN for those of the
    catalogue."""

    probability: float | None
    coefficients: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    prior_odds: float = float("nan")


@dataclass(frozen=True, eq=False)
class SeenPoses:
    """The poses of a run.

    ``readings`` (n,3) are means in output units, ``residual`` (n,) those of |a| in g,
    ``standard_error`` (n,) from noise in g. ``measured`` (n,3) are directions of the
    calibrated vector in the unit's frame, ``planned`` (n,3) those that the plan asked
    for; both along the axes of the fixture, so that what the fixture does is the same
    for units that stand in it differently. ``mounting`` (3,3) has turned them there
    from the unit's axes; without it they are along those. Raises InvalidData for other
    shapes."""

    readings: Floats
    residual: Floats
    standard_error: Floats
    measured: Floats | None = None
    planned: Floats | None = None
    mounting: Floats | None = None

    def __post_init__(self) -> None:
        n = len(self.residual)
        for name, shape in (
            ("readings", (n, 3)), ("standard_error", (n,)), ("measured", (n, 3)), ("planned", (n, 3)),
            ("mounting", (3, 3)),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise InvalidData(f"{name} of poses: expected shape {shape}, not {np.shape(value)}")


@dataclass(frozen=True, eq=False)
class UnitRun:
    """One calibration of one unit.

    ``time_s`` is in seconds since any epoch, ``hour`` of the day 0 to 24, UTC. A place
    that is not known is None. ``coefficients`` (9,) are `COEFFICIENTS` [output/g, rad,
    g], ``standard_errors`` (9,) theirs. ``resolution`` is one step of the converter in
    output units, None if unknown. ``figures`` are any further ones, with standard
    errors: a temperature, a noise floor. Raises InvalidData.
    """

    serial: str
    time_s: float
    coefficients: Floats
    standard_errors: Floats
    part_number: str | None = None
    batch: str | None = None
    station: str | None = None
    fixture: str | None = None
    slot: str | None = None
    operator: str | None = None
    hour: float | None = None
    effects: Mapping[str, SeenEffect] = field(default_factory=dict)
    poses: SeenPoses | None = None
    resolution: float | None = None
    figures: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("coefficients", "standard_errors"):
            if np.shape(getattr(self, name)) != (len(COEFFICIENTS),):
                raise InvalidData(f"{name} of unit {self.serial}: expected nine numbers")
        if not np.isfinite(self.time_s):
            raise InvalidData(f"time of unit {self.serial}: expected seconds, not {self.time_s}")

    def place(self, kind: PlaceKind) -> str | None:
        """The label of its place; of a slot with that of its fixture or station."""
        if kind is PlaceKind.SLOT:
            inside = self.fixture if self.fixture is not None else self.station
            return self.slot if self.slot is None or inside is None else f"{inside}/{self.slot}"
        found = {
            PlaceKind.BATCH: self.batch,
            PlaceKind.STATION: self.station,
            PlaceKind.FIXTURE: self.fixture,
            PlaceKind.OPERATOR: self.operator,
            PlaceKind.EVERYWHERE: "",
        }
        return found.get(kind)
