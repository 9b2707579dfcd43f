"""The way of frames from a bus's receive thread to asyncio: bounded, in
batches, with what was lost counted."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.can.error_frame import ErrorClass, error_frame
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag

BATCH_FRAMES, BATCH_S = 256, 0.2
CAPACITY = 1 << 16
"""Frames of a unit that wait for the event loop: a whole minute of the fastest
one."""
OVERRUN = "this program did not keep up with the bus"
OVERFLOW = "the receive buffer of the bus overflowed; frames of all its units count"
CONTROLLER_OVERFLOW = "the receive buffer of the CAN controller overflowed, which counts no frames"
# Plain numbers: an operation on an enumeration takes longer than all else that is
# done to a frame.
_ERROR, _EXTENDED, _LOST_BEFORE = int(RawFlag.ERROR), int(RawFlag.EXTENDED_ID), int(RawFlag.LOST_BEFORE)


class _Loss(NamedTuple):
    """``frames`` is None where nobody counted them."""

    frames: int | None
    cause: str

    def and_before(self, earlier: _Loss | None) -> _Loss:
        before = 0 if earlier is None else earlier.frames
        return self._replace(frames=None if self.frames is None or before is None else before + self.frames)


class _Every(frozenset[Identifier]):
    """All identifiers that there are."""

    def __contains__(self, _: object) -> bool:
        return True


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
        self._frames: deque[tuple[Frame, _Loss | None]] = deque()  # and what was lost just before
        self._identifiers: frozenset[Identifier] | None = None
        self._loss: _Loss | None = None
        self._failure: Exception | None = None
        self._some, self._enough = asyncio.Event(), asyncio.Event()
        self._last_ns: int | None = None
        self._at_loss = False  # the next frame waits already, for a batch of its own
        self._flows = False  # the last batch had frames: nobody waits for the first of the next

    @property
    def identifiers(self) -> frozenset[Identifier] | None:
        """None for all."""
        if isinstance(self._identifiers, _Every):
            return None
        return self._identifiers or frozenset()

    def open(self, identifiers: Collection[Identifier] | None) -> object:
        """Take these from now on, None for all; returns what `close` wants."""
        with self._lock:
            self._frames.clear()
            self._loss, self._failure, self._last_ns = None, None, None
            self._flows = self._at_loss = False
            self._identifiers = opened = _Every() if identifiers is None else frozenset(identifiers)
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

    def put(self, frames: Sequence[Frame], socketcan_errors: bool = True) -> None:
        """From the receive thread. What error frames say is read where they are
        SocketCAN's."""
        wanted = self._identifiers
        if wanted is None or self._failure is not None:
            return
        with self._lock:
            before = len(self._frames)
            for frame in frames:
                if frame.lost:
                    self._lose(_Loss(frame.lost, OVERFLOW))
                if frame.flags & _ERROR:
                    self._keep(frame)
                    if (
                        socketcan_errors
                        and ErrorClass.RECEIVE_OVERFLOW in error_frame(frame.source, frame.data).classes
                    ):
                        self._lose(_Loss(None, CONTROLLER_OVERFLOW))
                elif (frame.source, frame.flags & _EXTENDED != 0) in wanted:
                    self._keep(frame)
            waiting = len(self._frames)
        if waiting > before == 0 and not self._flows:
            self._tell(self._some)
        if waiting >= BATCH_FRAMES > before:
            self._tell(self._enough)

    def _keep(self, frame: Frame) -> None:
        if len(self._frames) >= self._capacity:
            self.dropped += 1
            self._lose(_Loss(1, OVERRUN))
            return
        loss, self._loss = self._loss, None
        if loss is not None:
            frame = frame._replace(flags=frame.flags | _LOST_BEFORE)
        self._frames.append((frame, loss))

    def _lose(self, loss: _Loss) -> None:
        self._loss = loss.and_before(self._loss)

    def fail(self, failure: Exception) -> None:
        """From the receive thread, when receiving has failed."""
        self._failure = failure
        self._tell(self._some)
        self._tell(self._enough)

    def _tell(self, event: asyncio.Event) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and nobody is left to be told
            self._attention.loop.call_soon_threadsafe(event.set)

    async def batch(self, timeout_s: float) -> RawBatch | None:
        """The next frames: up to 256, or those of 0.2 s, and none beyond the
        next loss. None when nothing comes for ``timeout_s`` of attention.

        Raises BusError when receiving has failed.
        """
        flowed, self._flows = self._flows, False
        if flowed and not self._at_loss:  # so that one batch after the other is one wake-up each
            await self._gathered(min(BATCH_S, timeout_s))
        with self._lock:  # whoever puts some in from now on tells
            nothing = not self._frames
        if nothing:
            try:
                async with self._attention.timeout(timeout_s):
                    await self._some.wait()
            except TimeoutError:
                if not self._frames:
                    return None
            if not self._frames and self._failure is not None:
                raise BusError(str(self._failure)) from self._failure
            await self._gathered(BATCH_S)
        elif not flowed:
            await self._gathered(BATCH_S)
        self._flows = True
        with self._lock:
            taken = self._take()
            left = len(self._frames)
            self._at_loss = left > 0 and self._frames[0][1] is not None
        if left == 0 and self._failure is None:
            self._some.clear()
        if left < BATCH_FRAMES:
            self._enough.clear()
        return self._batch(taken)

    async def _gathered(self, seconds: float) -> None:
        """A whole batch, or so long; no longer where receiving has failed."""
        if self._failure is None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._enough.wait()

    def _take(self) -> list[tuple[Frame, _Loss | None]]:
        taken: list[tuple[Frame, _Loss | None]] = []
        while self._frames and len(taken) < BATCH_FRAMES and not (taken and self._frames[0][1]):
            taken.append(self._frames.popleft())
        return taken

    def _batch(self, taken: Sequence[tuple[Frame, _Loss | None]]) -> RawBatch:
        batch = RawBatch.of([frame[:4] for frame, _ in taken])
        if taken:
            first, loss = taken[0]
            if loss is not None:
                from_ns = first.time_ns if self._last_ns is None else self._last_ns
                batch = replace(batch, gap=Gap(from_ns, first.time_ns, loss.cause, loss.frames))
            self._last_ns = taken[-1][0].time_ns
        return batch
