"""The raw stream of a triad, and the moment of a recording for which a calibration
holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData


class Moment(StrEnum):
    """A moment of a recording by name; `SECONDS` for a number."""

    END = "end"
    MEAN = "mean"
    SECONDS = "seconds"


@dataclass(frozen=True)
class Samples:
    """The raw stream of one triad: ``time_ns`` (n,) strictly increasing; ``readings``
    (n,3) in output units; ``channels`` name → (n,). Raises InvalidData."""

    time_ns: Ints
    readings: Floats
    channels: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        if self.readings.shape != (n, 3):
            raise InvalidData(f"readings: expected shape ({n}, 3), not {self.readings.shape}")
        for name, values in self.channels.items():
            if values.shape != (n,):
                raise InvalidData(f"channel {name}: expected {n} values, not {values.shape}")
        backwards = np.flatnonzero(np.diff(self.time_ns) <= 0)
        if len(backwards):
            raise InvalidData(f"time does not increase at sample {int(backwards[0]) + 1}")
        bad = np.flatnonzero(~np.isfinite(self.readings).all(axis=1))
        if len(bad):
            axis = "xyz"[int(np.argmin(np.isfinite(self.readings[bad[0]])))]
            more = f" ({len(bad)} such readings)" if len(bad) > 1 else ""
            raise InvalidData(f"reading {int(bad[0])}: {axis} is not a finite number{more}; leave such rows out first")

    def __len__(self) -> int:
        return len(self.time_ns)
