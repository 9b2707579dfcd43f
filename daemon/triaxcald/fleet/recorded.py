"""What only the recording beside a certificate tells of its run: the step of the
converter, and how the unit was mounted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.decoded import DecodedStream
from triaxcald.errors import DaemonError
from triaxcald.inputs import bundle_of
from triaxcald.mounting import rotation
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import CALIBRATION, STATION_FILE
from triaxcald.station.config import parse_station

SAMPLES: Final = 5000
"""Samples from which a step is told: the noise of a pose or two visits neighbouring
codes many times."""
CODES_LEAST: Final = 8
"""Steps between codes that have to agree: fewer may be multiples of one by chance."""
CODES_MOST: Final = 2**24
"""Steps across the readings: floating-point outputs have more, and no converter."""
WHOLE: Final = 1e-3
"""How far from a whole number of steps codes may be, in steps."""
DIGITS: Final = 10
"""Significant digits of a step: units with one kind of converter have the same."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """``mounting`` (3,3) turns directions along the unit's axes to those of the
    fixture. ``resolution`` is one step of the converter in output units. None of what
    is not known."""

    mounting: tc.Floats | None = None
    resolution: float | None = None


def recorded_in(path: Path, slot: str | None) -> Recorded:
    """Of the unit in ``slot``. A recording that cannot be read tells nothing: what is
    wrong with it is the concern of `audit`."""
    try:
        with Recording.open(path) as recording:
            return Recorded(_mounting(recording, slot), _resolution(recording))
    except (DaemonError, td.DriverError, OSError):
        return Recorded()


def _mounting(recording: Recording, slot: str | None) -> tc.Floats | None:
    if STATION_FILE not in recording.attachments:
        return None
    known = _mountings(recording.attachments[STATION_FILE])
    return known.get(recording.metadata.get("unit", {}).get("name") or slot or "")


@lru_cache(maxsize=64)
def _mountings(station: bytes) -> dict[str, tc.Floats]:
    return {unit.name: rotation(unit.mounting) for unit in parse_station(station, where=STATION_FILE).units}


def _resolution(recording: Recording) -> float | None:
    stream = DecodedStream(bundle_of(recording), td.READINGS)
    blocks: list[tc.Floats] = []
    for batch in recording.raw(CALIBRATION):
        blocks.append(stream.rising(batch).readings)
        if stream.counts["samples"] >= SAMPLES:
            break
    return step_of(np.concatenate(blocks)) if blocks else None


def step_of(readings: tc.Floats) -> float | None:
    """The step of the converter behind ``readings`` (n,3): all differences between
    codes of an axis are whole multiples of it. None if there is no such step."""
    codes = [np.unique(axis) for axis in readings.T]
    between = np.concatenate([np.diff(of) for of in codes])
    if len(between) < CODES_LEAST:
        return None
    # The smallest difference has the rounding of two codes; the widest span has little.
    step, span = float(between.min()), max(float(of[-1] - of[0]) for of in codes)
    if np.abs(readings).max() >= CODES_MOST * step:
        return None
    step = span / np.rint(span / step)
    steps = between / step
    return float(f"{step:.{DIGITS}g}") if np.abs(steps - np.rint(steps)).max() <= WHOLE else None
