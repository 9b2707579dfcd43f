"""Names of array types, and the root mean square."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
