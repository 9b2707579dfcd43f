"""What `recvmsg` on a raw CAN socket gave, as a frame: its bytes, its time, and
the kernel's count of what it lost."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence

from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.raw_frame import frame_of
from triaxcal_drivers.can.raw_socket import DROPS, HARDWARE, HARDWARE_OLD, STAMPS, STAMPS_OLD
from triaxcal_drivers.can.stamps import HardwareClock
from triaxcal_drivers.interface import RawFlag

_NS = 1_000_000_000
_COUNT = struct.Struct("=I")
_COUNTED = 1 << 32  # the count begins anew
_TIME, _TIME_OLD = struct.Struct("=qq"), struct.Struct("@ll")
_LOST_BEFORE = int(RawFlag.LOST_BEFORE)


class Reception:
    """Of one socket, its frames in order. The host's time is taken for a frame
    that comes without any."""

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns = now_ns
        self._told = 0  # of the kernel's count, with a frame
        self._hardware = HardwareClock()

    def frame(self, raw: bytes, ancillary: Sequence[tuple[int, int, bytes]], message_flags: int) -> Frame:
        """The kernel counts at a frame's arrival all that it had lost by then;
        the difference to the frame before was lost between the two."""
        source, flags, data = frame_of(raw, message_flags)
        time_ns, lost = self.stamped(ancillary)
        if lost:
            flags |= _LOST_BEFORE
        return Frame(time_ns, source, flags, data, lost)

    def stamped(self, ancillary: Sequence[tuple[int, int, bytes]]) -> tuple[int, int]:
        """The host's time, and how many were lost since the one before."""
        time_ns = lost = 0
        for _, kind, value in ancillary:
            if kind == STAMPS:
                seconds, rest = _TIME.unpack(value)
                time_ns = seconds * _NS + rest
            elif kind == DROPS:
                (count,) = _COUNT.unpack(value)
                lost = (count - self._told) % _COUNTED
                self._told = count
            else:
                time_ns = self._time_ns(kind, value)
        return time_ns or self._now_ns(), lost

    def missed(self, count: int) -> int:
        """Frames of the kernel's ``count`` that no frame has told."""
        return (count - self._told) % _COUNTED

    def _time_ns(self, kind: int, value: bytes) -> int:
        """Of the stamps that only some have; 0 where it is none."""
        if kind == STAMPS_OLD:
            seconds, rest = _TIME_OLD.unpack(value)
            return int(seconds * _NS + rest)
        if kind in (HARDWARE, HARDWARE_OLD):  # the kernel's, nothing, the adapter's
            layout = _TIME if kind == HARDWARE else _TIME_OLD
            kernel_ns, _, hardware_ns = (seconds * _NS + rest for seconds, rest in layout.iter_unpack(value))
            return self._hardware.time_ns(hardware_ns, kernel_ns) if hardware_ns and kernel_ns else kernel_ns
        return 0
