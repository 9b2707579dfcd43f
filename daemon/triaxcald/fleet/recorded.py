"""What only the recording beside a certificate tells of its run: the step of the
converter, and how the unit was mounted."""

from __future__ import annotations

from contextlib import suppress
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
"""Samples from which a step is told, and the rest of their batch: the noise of a pose
or two visits neighbouring codes many times."""
CODES_LEAST: Final = 8
"""Differences between codes that have to agree: fewer may be multiples by chance."""
CODES_MOST: Final = 2**23
"""Steps from zero to the largest reading: those of a signed converter of 24 bits.
Floating-point outputs without a converter's step have more."""
WHOLE: Final = 0.05
"""How far from a whole number of steps codes may be, in steps: single precision rounds
them."""
UNREADABLE: Final = (DaemonError, td.DriverError, OSError)


@dataclass(frozen=True, eq=False)
class Recorded:
    """``mounting`` (3,3) turns directions along the unit's axes to those of the
    fixture. ``resolution`` is one step of the readings in output units: of the
    converter if the unit does not round coarser. None of what is not known."""

    mounting: tc.Floats | None = None
    resolution: float | None = None


def recorded_in(path: Path, slot: str | None) -> Recorded:
    """Of the unit in ``slot``. A recording that cannot be read tells nothing: what is
    wrong with it is the concern of `audit`."""
    mounting, resolution = None, None
    with suppress(*UNREADABLE), Recording.open(path) as recording:
        with suppress(*UNREADABLE):
            mounting = _mounting(recording, slot)
        with suppress(*UNREADABLE):
            resolution = _resolution(recording)
    return Recorded(mounting, resolution)


def _mounting(recording: Recording, slot: str | None) -> tc.Floats | None:
    if STATION_FILE not in recording.attachments:
        return None
    known = _mountings(recording.attachments[STATION_FILE])
    return known.get(recording.metadata.get("unit", {}).get("name") or slot or "")


@lru_cache(maxsize=64)
def _mountings(station: bytes) -> dict[str, tc.Floats]:
    return {unit.name: rotation(unit.mounting) for unit in parse_station(station, where=STATION_FILE).units}


def _resolution(recording: Recording) -> float | None:
    bundle = bundle_of(recording)
    if bundle.profile.reads_corrected:  # the correction spreads the codes
        return None
    stream = DecodedStream(bundle, td.READINGS)
    blocks: list[tc.Floats] = []
    for batch in recording.raw(CALIBRATION):
        blocks.append(stream.rising(batch).readings)
        if stream.counts["samples"] >= SAMPLES:
            break
    return step_of(np.concatenate(blocks)) if blocks else None


def step_of(readings: tc.Floats) -> float | None:
    """The step behind ``readings`` (n,3): all differences between codes of an axis are
    whole multiples of it. None if there is no such step."""
    codes = [np.unique(axis) for axis in readings.T]
    between = np.sort(np.concatenate([np.diff(of) for of in codes]))
    if len(between) < CODES_LEAST or np.abs(readings).max() > 2 * CODES_MOST * between[0]:
        return None
    # Each difference, the smallest first, makes the step more precise for the next.
    total = count = 0.0
    step = float(between[0])
    for difference in between.tolist():
        total += difference
        count += round(difference / step)
        step = total / count
    # The widest span of all has the least rounding.
    span = max(float(of[-1] - of[0]) for of in codes)
    step = span / round(span / step)
    steps = between / step
    if np.abs(readings).max() > CODES_MOST * step or np.abs(steps - np.rint(steps)).max() > WHOLE:
        return None
    return step
