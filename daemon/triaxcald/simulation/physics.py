"""What the simulated unit's sensor sees: voltages and a temperature as
functions of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Physics(Protocol):
    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The sensor's output (n, 3) in V before the converter, and its
        temperature (n,) in °C.

        Times are in the unit's time base, ascending, each asked for once.
        """

    def restarted(self, unit_time_s: float) -> None:
        """The unit starts again, as after its registers were written."""


@dataclass(frozen=True)
class ConstantPhysics:
    """The same voltages [V] and temperature [°C] for ever."""

    volts: tuple[float, float, float] = (0.0, 0.0, -2.4)
    temperature_c: float = 25.0

    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = len(unit_time_s)
        return np.tile(np.array(self.volts, dtype=np.float64), (n, 1)), np.full(n, self.temperature_c)

    def restarted(self, unit_time_s: float) -> None:
        """It stands where it stood."""
