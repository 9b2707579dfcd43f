"""The way of frames from a bus's receive thread to asyncio: bounded, in
batches, with what was lost counted."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag

# What a CAN error frame says, by SocketCAN's classes (linux/can/error.h). A pure
# function: bytes in, a value out.


class ControllerState(StrEnum):
    """Of a CAN controller, by its error counters."""

    ACTIVE = "error active"
    WARNING = "error warning"
    PASSIVE = "error passive"
    BUS_OFF = "bus-off"
    STOPPED = "stopped"
    SLEEPING = "sleeping"


class ErrorClass(StrEnum):
    """What an error frame may report; several at a time."""

    TRANSMIT_TIMEOUT = "transmit timeout"
    ARBITRATION_LOST = "arbitration lost"
    RECEIVE_OVERFLOW = "receive overflow of the controller"
    TRANSMIT_OVERFLOW = "transmit overflow of the controller"
    STATE = "change of state"
    PROTOCOL = "protocol violation"
    TRANSCEIVER = "transceiver fault"
    NO_ACKNOWLEDGEMENT = "no acknowledgement"
    BUS_OFF = "bus-off"
    BUS_ERROR = "bus error"
    RESTARTED = "restarted"


@dataclass(frozen=True)
class ErrorFrame:
    """``state`` is what the controller has come to, None where the frame does
    not say; ``arbitration_bit`` where in the frame arbitration was lost, 0
    where unknown; ``violations`` the kinds of protocol violations and
    ``violation_place`` the field of the frame, None where unknown;
    ``transmitting`` whether it happened while sending; ``transceiver`` what is
    wrong with the wires. The error counters are None where the frame does not
    give them."""

    classes: frozenset[ErrorClass]
    state: ControllerState | None = None
    arbitration_bit: int | None = None
    violations: tuple[str, ...] = ()
    violation_place: str | None = None
    transmitting: bool = False
    transceiver: tuple[str, ...] = ()
    transmit_errors: int | None = None
    receive_errors: int | None = None

    def __str__(self) -> str:
        words = [str(self.state)] if self.state is not None else []
        words += [str(c) for c in ErrorClass if c in self.classes and c not in _SAID_BY_THE_STATE]
        words += [*self.violations, *self.transceiver]
        if self.violation_place is not None:
            words.append(f"in the {self.violation_place}")
        if self.arbitration_bit:
            words.append(f"at bit {self.arbitration_bit}")
        if self.transmit_errors is not None:
            words.append(f"error counters {self.transmit_errors} transmitting, {self.receive_errors} receiving")
        return ", ".join(words) or "error frame that says nothing"


_SAID_BY_THE_STATE = (ErrorClass.STATE, ErrorClass.BUS_OFF)

BUS_OFF = 0x40
_LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER, _RESTARTED, _COUNTERS = 0x02, 0x04, 0x08, 0x10, 0x100, 0x200
_CLASSES = {
    0x01: ErrorClass.TRANSMIT_TIMEOUT,
    _LOST_ARBITRATION: ErrorClass.ARBITRATION_LOST,
    _PROTOCOL: ErrorClass.PROTOCOL,
    _TRANSCEIVER: ErrorClass.TRANSCEIVER,
    0x20: ErrorClass.NO_ACKNOWLEDGEMENT,
    BUS_OFF: ErrorClass.BUS_OFF,
    0x80: ErrorClass.BUS_ERROR,
    _RESTARTED: ErrorClass.RESTARTED,
}
"""By the bits of the frame's identifier; the controller's (0x04) are in byte 1."""

_RECEIVE_OVERFLOW, _TRANSMIT_OVERFLOW, _WARNING, _PASSIVE, _ACTIVE = 0x01, 0x02, 0x0C, 0x30, 0x40
_SENDING = 0x80
_VIOLATIONS = {
    0x01: "single bit error",
    0x02: "frame format error",
    0x04: "bit stuffing error",
    0x08: "could not send a dominant bit",
    0x10: "could not send a recessive bit",
    0x20: "bus overload",
    0x40: "active error announced",
}
_PLACES = {
    0x03: "start of frame",
    0x02: "identifier bits 28 to 21",
    0x06: "identifier bits 20 to 18",
    0x04: "substitute remote bit",
    0x05: "identifier extension bit",
    0x07: "identifier bits 17 to 13",
    0x0F: "identifier bits 12 to 5",
    0x0E: "identifier bits 4 to 0",
    0x0C: "remote bit",
    0x0D: "reserved bit 1",
    0x09: "reserved bit 0",
    0x0B: "data length code",
    0x0A: "data",
    0x08: "CRC sequence",
    0x18: "CRC delimiter",
    0x19: "acknowledge slot",
    0x1B: "acknowledge delimiter",
    0x1A: "end of frame",
    0x12: "intermission",
}
_WIRES = {
    0x04: "CANH has no wire",
    0x05: "CANH shorted to the battery",
    0x06: "CANH shorted to the supply",
    0x07: "CANH shorted to ground",
    0x40: "CANL has no wire",
    0x50: "CANL shorted to the battery",
    0x60: "CANL shorted to the supply",
    0x70: "CANL shorted to ground",
    0x80: "CANL shorted to CANH",
}


def error_frame(identifier: int, data: bytes) -> ErrorFrame:
    """Of the identifier's 29 bits and the data of a frame with RawFlag.ERROR;
    bytes that are not there count as zero."""
    field = data.ljust(8, b"\0")
    classes = {named for bit, named in _CLASSES.items() if identifier & bit}
    state = _state(identifier, field[1])
    if identifier & _CONTROLLER:
        if field[1] & _RECEIVE_OVERFLOW:
            classes.add(ErrorClass.RECEIVE_OVERFLOW)
        if field[1] & _TRANSMIT_OVERFLOW:
            classes.add(ErrorClass.TRANSMIT_OVERFLOW)
        if field[1] & (_WARNING | _PASSIVE | _ACTIVE):
            classes.add(ErrorClass.STATE)
    violated, counted = identifier & _PROTOCOL, identifier & _COUNTERS
    wires = (field[4] & 0x0F, field[4] & 0xF0) if identifier & _TRANSCEIVER else ()
    return ErrorFrame(
        frozenset(classes),
        state,
        field[0] if identifier & _LOST_ARBITRATION else None,
        tuple(words for bit, words in _VIOLATIONS.items() if field[2] & bit) if violated else (),
        _PLACES.get(field[3]) if violated else None,
        bool(violated and field[2] & _SENDING),
        tuple(_WIRES[half] for half in wires if half in _WIRES),
        field[6] if counted else None,
        field[7] if counted else None,
    )


def _state(identifier: int, controller: int) -> ControllerState | None:
    """The worst that is said: sending and receiving have one each."""
    if identifier & BUS_OFF:
        return ControllerState.BUS_OFF
    if identifier & _CONTROLLER and controller & _PASSIVE:
        return ControllerState.PASSIVE
    if identifier & _CONTROLLER and controller & _WARNING:
        return ControllerState.WARNING
    if identifier & _RESTARTED or (identifier & _CONTROLLER and controller & _ACTIVE):
        return ControllerState.ACTIVE
    return None


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
