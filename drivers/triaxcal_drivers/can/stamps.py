"""Times of an adapter's own clock as times of the host."""

from __future__ import annotations

_WINDOW_NS = 10_000_000_000
"""A crystal's 50 ppm drift apart by half a millisecond meanwhile, which is less
than a USB adapter takes to hand a frame on."""
_STEP_NS = 1_000_000_000
"""No adapter keeps a frame so long: one of the two clocks was set."""
_LEARNT_NS = 10_000_000
"""By no more do the delays of an adapter differ; a greater way back is the host
clock's."""


class HardwareClock:
    """Lays the stamps of an adapter's clock, wherever it starts, on the
    kernel's.

    The kernel has a frame some time after the adapter, never before. So the
    least difference of the two clocks in the last 10 to 20 s is taken for the
    difference itself. Times do not go back while that is learnt, but with the
    host's clock they do.
    """

    def __init__(self) -> None:
        self._least: int | None = None
        self._least_now = 0
        self._since_ns = 0
        self._last_ns = 0

    def time_ns(self, hardware_ns: int, kernel_ns: int) -> int:
        """Of the host, of one frame; frames in order."""
        apart = kernel_ns - hardware_ns
        if self._least is None or not -_STEP_NS < apart - self._least < _STEP_NS:
            self._least = self._least_now = apart
            self._since_ns = hardware_ns
        elif hardware_ns - self._since_ns >= _WINDOW_NS:
            self._least, self._least_now = min(self._least_now, apart), apart
            self._since_ns = hardware_ns
        else:
            self._least, self._least_now = min(self._least, apart), min(self._least_now, apart)
        time_ns = hardware_ns + self._least
        self._last_ns = self._last_ns if 0 < self._last_ns - time_ns < _LEARNT_NS else time_ns
        return self._last_ns
