"""The host's time as a line that runs on, whatever is done to its clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

STEP_NS = 100_000_000
"""Smallest change between the clocks that counts as a step: slewing moves both, and
reading them takes microseconds, on a busy machine some milliseconds."""

STEPS_MOST = 30
"""Steps that are remembered; a clock that makes more has other troubles."""


def _running_ns() -> int:
    """Time since the start of the machine, while it slept too where the system
    counts that."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def slept_ns() -> int:
    """Time that this machine has slept since its start [ns]; 0 if the system does not
    count it."""
    return _running_ns() - time.monotonic_ns() if hasattr(time, "CLOCK_BOOTTIME") else 0


class SteadyClock:
    """Host time since the epoch, by the clock as it was set when this was made:
    a step of it later on (set by hand, a first contact with a time server) does
    not move the line.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns, running_ns: Callable[[], int] = _running_ns) -> None:
        self._now_ns, self._running = now_ns, running_ns
        self._begun_ns = now_ns() - running_ns()
        self._lock = threading.Lock()
        self._steps_ns = [0]  # sums of the steps so far, the last by now

    def now_ns(self) -> int:
        return self._running() + self._begun_ns

    @property
    def stepped(self) -> bool:
        """Whether it ever did, though it may be back."""
        return len(self._steps_ns) > 1

    def steps_ns(self) -> int:
        """All steps that the clock has made by now, as far as anybody
        looked."""
        with self._lock:
            sums = self._steps_ns
            step_ns = self._now_ns() - self.now_ns() - sums[-1]
            if abs(step_ns) >= STEP_NS:
                self._steps_ns = [0, *sums[-STEPS_MOST:], sums[-1] + step_ns]
            return self._steps_ns[-1]

    def steady_ns(self, stamp_ns: int) -> int:
        """The stamp of a record that has just been received on the steady line.

        A stamp by the host's clock was made before the last step or after it,
        one by an adapter's own clock knows of none, or of those before it was
        laid on the host's: what is nearest to now is meant. Call `steps_ns`
        first.
        """
        sums = self._steps_ns
        if len(sums) == 1:
            return stamp_ns
        now_ns = self.now_ns()
        return min((stamp_ns - steps for steps in sums), key=lambda t: abs(t - now_ns))


HOST = SteadyClock()
"""The clock of this process: its time continues when a device is opened anew after a
step."""
