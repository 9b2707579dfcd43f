"""The way of frames from python-can's receive thread to asyncio: bounded, in
batches, with host time."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Collection

import can

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawBatch, RawFlag

BATCH_FRAMES, BATCH_S = 256, 0.05
CAPACITY = 1 << 16
_OFF_CLOCK_NS = 10_000_000_000

Identifier = tuple[int, bool]
"""A CAN identifier and whether it is an extended one."""


class HostClock:
    """Message time stamps as nanoseconds of the host's epoch.

    python-can gives seconds as a float, good to about 0.2 µs at today's date.
    Interfaces differ in where they start from: socketcan and udp_multicast have
    the kernel's time of reception, virtual the time of sending, kvaser, vector
    and pcan an adapter's clock laid on the epoch; gs_usb, serial and some
    others an adapter's clock that starts at 0 and may wrap. A stamp more than
    10 s off the host's clock is therefore read as the adapter's: from there on
    its differences count, starting from the host's time. Where there is no
    stamp, the host's time is taken.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns = now_ns
        self._offset_ns = 0

    def time_ns(self, timestamp_s: float) -> int:
        now_ns = self._now_ns()
        if timestamp_s <= 0:
            return now_ns
        stamp_ns = round(timestamp_s * 1e9)
        if abs(stamp_ns + self._offset_ns - now_ns) > _OFF_CLOCK_NS:
            self._offset_ns = now_ns - stamp_ns
        return stamp_ns + self._offset_ns


class FrameQueue(can.Listener):
    """Takes the frames of the given identifiers, and error frames, while a
    stream is open.

    When asyncio does not keep up, ``capacity`` bounds what is held: further
    frames are dropped and counted in ``dropped``, and the next one kept carries
    RawFlag.LOST_BEFORE.
    """

    def __init__(self, attention: Attention, *, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self._attention = attention
        self._capacity = capacity
        self._clock = HostClock()
        self._lock = threading.Lock()
        self._frames: deque[tuple[int, int, int, bytes]] = deque()
        self._identifiers: frozenset[Identifier] | None = None
        self._lossy = False
        self._failure: Exception | None = None
        self._some, self._enough = asyncio.Event(), asyncio.Event()

    def open(self, identifiers: Collection[Identifier]) -> object:
        """Take these from now on; returns what `close` wants."""
        with self._lock:
            self._frames.clear()
            self._lossy = False
            self._identifiers = opened = frozenset(identifiers)
        self._some.clear()
        self._enough.clear()
        return opened

    def close(self, opened: object) -> None:
        """Nothing happens where another stream has been opened since."""
        with self._lock:
            if self._identifiers is opened:
                self._identifiers = None

    def on_message_received(self, msg: can.Message) -> None:
        """Called in python-can's thread."""
        wanted = self._identifiers
        if wanted is None:
            return
        if not msg.is_error_frame and (msg.arbitration_id, msg.is_extended_id) not in wanted:
            return
        flags = (
            RawFlag.EXTENDED_ID * msg.is_extended_id
            | RawFlag.REMOTE * msg.is_remote_frame
            | RawFlag.ERROR * msg.is_error_frame
            | RawFlag.FD * msg.is_fd
        )
        time_ns = self._clock.time_ns(msg.timestamp)
        data = b"" if msg.is_remote_frame else bytes(msg.data)
        with self._lock:
            if len(self._frames) >= self._capacity:
                self.dropped += 1
                self._lossy = True
                return
            flags |= RawFlag.LOST_BEFORE * self._lossy
            self._lossy = False
            self._frames.append((time_ns, msg.arbitration_id, flags, data))
            waiting = len(self._frames)
        if waiting in (1, BATCH_FRAMES):
            self._tell(self._some if waiting == 1 else self._enough)

    def on_error(self, exc: Exception) -> None:
        """Called in python-can's thread when receiving fails, which ends the
        thread: it would try for ever."""
        self._failure = exc
        self._tell(self._some)
        raise SystemExit  # which a thread ends by without a trace back

    def _tell(self, event: asyncio.Event) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and nobody is left to be told
            self._attention.loop.call_soon_threadsafe(event.set)

    def check(self) -> None:
        """Raises BusError when receiving has failed."""
        if self._failure is not None:
            raise BusError(f"receiving failed: {self._failure}") from self._failure

    async def batch(self, timeout_s: float) -> RawBatch | None:
        """The next frames: up to 256, or those of 50 ms. None when nothing
        comes for ``timeout_s`` of attention.

        Raises BusError when receiving has failed.
        """
        try:
            async with self._attention.timeout(timeout_s):
                await self._some.wait()
        except TimeoutError:
            if not self._frames:
                return None
        if not self._frames:
            self.check()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(BATCH_S):
                await self._enough.wait()
        with self._lock:
            taken = [self._frames.popleft() for _ in range(min(BATCH_FRAMES, len(self._frames)))]
            left = len(self._frames)
        if left == 0 and self._failure is None:
            self._some.clear()
        if left < BATCH_FRAMES:
            self._enough.clear()
        return RawBatch.of(taken)
