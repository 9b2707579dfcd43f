"""Which messages are one sample where no counter says so."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


class TogetherInTime:
    """Messages that come within half a period of a sample's first one are that
    sample, each once; the next one begins another. ``messages`` is how many a
    whole sample has."""

    def __init__(self, messages: int, period_ns: float) -> None:
        self._messages = messages
        self._half_ns = period_ns / 2
        self._had: set[int] = set()  # messages of the sample that is not whole yet
        self._start_ns = 0  # of its first one

    def samples_of(self, time_ns: Ints, message: Ints) -> Ints:
        """The sample of each record, in the order in which they came: 0 is the
        one that was left open by the records before, where there was one."""
        sample = np.zeros(len(time_ns), dtype=np.int64)
        number = 0
        for i, (at_ns, which) in enumerate(zip(time_ns.tolist(), message.tolist(), strict=True)):
            if self._had and (which in self._had or abs(at_ns - self._start_ns) > self._half_ns):
                self._had.clear()
                number += 1
            elif not self._had and i:
                number += 1
            if not self._had:
                self._start_ns = at_ns
            self._had.add(which)
            sample[i] = number
            if len(self._had) == self._messages:
                self._had.clear()
        return sample

    @property
    def open(self) -> bool:
        """Whether the last sample still lacks messages."""
        return bool(self._had)
