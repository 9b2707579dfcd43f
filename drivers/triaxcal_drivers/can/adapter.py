"""The adapter of a CAN bus: an open socket or device that sends and receives frames;
and its error frames, decoded by SocketCAN's classes (linux/can/error.h). No I/O."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Protocol

Identifier = tuple[int, bool]
"""A CAN identifier and whether it is an extended one."""


class Frame(NamedTuple):
    """A received frame. ``time_ns`` is host time of its reception, ``source``
    its identifier (of an error frame its class, as SocketCAN has them),
    ``flags`` of `RawFlag`; ``lost`` frames are known to have been lost just
    before it. A remote frame has as many zero bytes as it asks for."""

    time_ns: int
    source: int
    flags: int
    data: bytes
    lost: int = 0


class Adapter(Protocol):
    """One open bus. Its calls block: one thread receives, any may send, and
    `close` ends both."""

    @property
    def echoes(self) -> bool:
        """Whether `receive` gives what `send` sends too, once all frames are
        asked for."""

    @property
    def socketcan_errors(self) -> bool:
        """Whether the identifiers and data of error frames are SocketCAN's; else
        they are of a layout of the adapter's own."""

    def receive(self, timeout_s: float) -> list[Frame]:
        """Received frames in order; none if none comes within ``timeout_s``. Raises
        BusError if the bus has failed: interface gone or down, adapter unplugged."""

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """Frames of these identifiers and error frames are enough from now on;
        None for all, those that it sends among them where it `echoes`. An
        adapter that cannot filter gives more."""

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """Raises BusError."""

    def missed(self) -> int:
        """Frames that are known to be lost, and that no received frame has told
        of yet."""

    def close(self) -> None:
        """Raises nothing."""


# Error frames.


class ControllerState(StrEnum):
    """State of a CAN controller by its error counters."""

    ACTIVE = "error active"
    WARNING = "error warning"
    PASSIVE = "error passive"
    BUS_OFF = "bus-off"
    STOPPED = "stopped"
    SLEEPING = "sleeping"


class ErrorClass(StrEnum):
    """Errors in an error frame; it may report several."""

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
"""Errors by bit of the identifier; those of the controller (0x04) are in byte 1."""

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
    """Decode the 29-bit identifier and the data of a frame with RawFlag.ERROR; missing
    bytes count as zero."""
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
