"""The way of frames from a bus's receive thread to asyncio: bounded, in
batches, with what was lost counted."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag

BATCH_FRAMES, BATCH_S = 256, 0.05
CAPACITY = 1 << 16
"""Frames of a unit that wait for the event loop: a whole minute of the fastest
one."""
OVERRUN = "this program did not keep up with the bus"
OVERFLOW = "the receive buffer of the bus overflowed; frames of all its units count"


class FrameQueue:
    """Takes the frames of the given identifiers, and error frames, while a
    stream is open.

    When asyncio does not keep up, ``capacity`` bounds what is held: further
    frames are dropped and counted in ``dropped``. The frame after a loss, here
    or on the bus, carries RawFlag.LOST_BEFORE.
    """

    def __init__(self, attention: Attention, *, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self._attention = attention
        self._capacity = capacity
        self._lock = threading.Lock()
        self._frames: deque[tuple[Frame, str]] = deque()  # and why those before it were lost
        self._identifiers: frozenset[Identifier] | None = None
        self._lost, self._cause = 0, ""
        self._failure: Exception | None = None
        self._some, self._enough = asyncio.Event(), asyncio.Event()
        self._last_ns: int | None = None

    @property
    def identifiers(self) -> frozenset[Identifier]:
        return self._identifiers or frozenset()

    def open(self, identifiers: Collection[Identifier]) -> object:
        """Take these from now on; returns what `close` wants."""
        with self._lock:
            self._frames.clear()
            self._lost, self._failure, self._last_ns = 0, None, None
            self._identifiers = opened = frozenset(identifiers)
        self._some.clear()
        self._enough.clear()
        return opened

    def close(self, opened: object) -> bool:
        """Whether it was the stream that is open; nothing happens where another
        has been opened since."""
        with self._lock:
            if self._identifiers is opened:
                self._identifiers = None
                return True
        return False

    def put(self, frames: Sequence[Frame]) -> None:
        """From the receive thread."""
        wanted = self._identifiers
        if wanted is None:
            return
        with self._lock:
            before = len(self._frames)
            for frame in frames:
                if frame.lost:
                    self._lost, self._cause = self._lost + frame.lost, OVERFLOW
                mine = frame.flags & RawFlag.ERROR or (
                    (frame.source, bool(frame.flags & RawFlag.EXTENDED_ID)) in wanted
                )
                if mine:
                    self._keep(frame)
            waiting = len(self._frames)
        if waiting > before == 0:
            self._tell(self._some)
        if waiting >= BATCH_FRAMES > before:
            self._tell(self._enough)

    def _keep(self, frame: Frame) -> None:
        if len(self._frames) >= self._capacity:
            self.dropped += 1
            self._lost, self._cause = self._lost + 1, OVERRUN
            return
        if self._lost:
            frame = frame._replace(flags=frame.flags | RawFlag.LOST_BEFORE, lost=self._lost)
            self._lost = 0
        self._frames.append((frame, self._cause))

    def fail(self, failure: Exception) -> None:
        """From the receive thread, when receiving has failed."""
        self._failure = failure
        self._tell(self._some)

    def _tell(self, event: asyncio.Event) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and nobody is left to be told
            self._attention.loop.call_soon_threadsafe(event.set)

    async def batch(self, timeout_s: float) -> RawBatch | None:
        """The next frames: up to 256, or those of 50 ms, and none beyond the
        next loss. None when nothing comes for ``timeout_s`` of attention.

        Raises BusError when receiving has failed.
        """
        try:
            async with self._attention.timeout(timeout_s):
                await self._some.wait()
        except TimeoutError:
            if not self._frames:
                return None
        if not self._frames and self._failure is not None:
            raise BusError(str(self._failure)) from self._failure
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(BATCH_S):
                await self._enough.wait()
        with self._lock:
            taken = self._take()
            left = len(self._frames)
        if left == 0 and self._failure is None:
            self._some.clear()
        if left < BATCH_FRAMES:
            self._enough.clear()
        return self._batch(taken)

    def _take(self) -> list[tuple[Frame, str]]:
        taken: list[tuple[Frame, str]] = []
        while self._frames and len(taken) < BATCH_FRAMES and not (taken and self._frames[0][0].lost):
            taken.append(self._frames.popleft())
        return taken

    def _batch(self, taken: Sequence[tuple[Frame, str]]) -> RawBatch:
        batch = RawBatch.of([frame[:4] for frame, _ in taken])
        if taken:
            first, cause = taken[0]
            if first.lost:
                from_ns = first.time_ns if self._last_ns is None else self._last_ns
                batch = replace(batch, gap=Gap(from_ns, first.time_ns, cause, first.lost))
            self._last_ns = taken[-1][0].time_ns
        return batch
