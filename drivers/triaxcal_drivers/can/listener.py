"""All frames of a CAN bus, whosever they are."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from dataclasses import dataclass

from triaxcal_drivers.can.line import MUTE_S, CanLine, join, leave
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.can.receive import FrameQueue
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Gap, RawBatch

LOOK_S = 0.2
"""A quiet bus is told of so often: who counts seconds is no later by more."""
CAPACITY = 1 << 17
"""Frames that wait for the event loop: over ten seconds of a full bus at
1 Mbit/s, as in the receive buffer before them."""
REOPENED = f"the adapter was closed and opened anew, as nobody was heard for {MUTE_S:g} s"


@dataclass(frozen=True)
class _Connection:
    line: CanLine
    frames: FrameQueue
    openings: int  # of the line, by then


class BusListener:
    """Listens to a bus, which it may share with units of this process, and
    sends nothing.

    Nobody has to send on a bus: silence is no fault of it. Frames that this
    program sends are among those that it gives, with RawFlag.SENT.
    """

    def __init__(self, settings: BusSettings) -> None:
        self._settings = settings
        self._connection: _Connection | None = None
        self._first: RawBatch | None = None  # which `settled` has seen

    async def open(self) -> None:
        """What comes from now on is given. Raises BusError."""
        await self.close()
        line = await join(self._settings)
        frames = FrameQueue(line.attention, capacity=CAPACITY)
        frames.open(None)
        self._connection = _Connection(line, frames, line.openings)
        line.hear(frames)

    async def close(self) -> None:
        connection, self._connection, self._first = self._connection, None, None
        if connection is not None:
            connection.line.unhear(connection.frames)
            connection.frames.fail(BusError(f"{self._settings} is closed"))
            await leave(connection.line)

    def _connected(self) -> _Connection:
        if self._connection is None:
            raise BusError(f"{self._settings} is not open")
        return self._connection

    async def settled(self, timeout_s: float) -> None:
        """Waits for a frame, or for so long without a failure: an adapter may
        open and fail at once. Raises BusError."""
        self._first = await self._connected().frames.batch(timeout_s)

    async def stream(self) -> AsyncGenerator[RawBatch, None]:
        """All frames and error frames since it was opened, until the iterator is
        closed; where none come, a batch without any every `LOOK_S`.

        Raises BusError.
        """
        connection = self._connected()
        line, frames = connection.line, connection.frames
        openings, last_ns = connection.openings, None
        while True:
            batch, self._first = self._first, None
            if batch is None:
                batch = await frames.batch(LOOK_S)
            if batch is None:
                now_ns, look = HOST.now_ns(), RawBatch.of([])
                if line.openings != openings:
                    look = look.after(Gap(now_ns if last_ns is None else last_ns, now_ns, REOPENED))
                openings, last_ns = line.openings, now_ns
                yield look
                continue
            if not batch:
                continue
            if line.openings != openings and batch.gap is None:
                first_ns = int(batch.time_ns[0])
                batch = batch.after(Gap(first_ns if last_ns is None else last_ns, first_ns, REOPENED))
            openings, last_ns = line.openings, int(batch.time_ns[-1])
            yield batch
