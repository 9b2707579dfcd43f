"""Layout of a stream's channels in its CAN messages, and their extraction from many
frames at once. No I/O."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.can.model import CanStream, Scaling
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import clipped, nearest

NODES = 127
SHORTEST_COUNTER = 4
FRAME_MOST = 64  # bytes of a CAN FD frame
STANDARD_MOST = 0x7FF  # the highest identifier of 11 bits
_IDENTIFIER = re.compile("0[xX]([0-9A-Fa-f]{1,8})([xX]?)")
_FLOATS = {16: np.uint16, 32: np.uint32, 64: np.uint64}


@dataclass(frozen=True)
class Signal:
    """Up to 64 bits of a message, numbered as in a DBC file.

    Bit k is bit k % 8 (0 the least significant) of byte k // 8. ``start`` is
    the signal's least significant bit where it is little-endian, its most
    significant one where it is big-endian.
    """

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0

    def _place(self) -> tuple[range, int]:
        """The bytes it touches, least significant first, and how far it lies
        above their lowest bit."""
        if not self.big_endian:
            return range(self.start // 8, (self.start + self.length - 1) // 8 + 1), self.start % 8
        last = 8 * (self.start // 8) + 7 - self.start % 8 + self.length - 1  # counted from the first byte's top
        return range(last // 8, self.start // 8 - 1, -1), 7 - last % 8

    @property
    def size(self) -> int:
        """Bytes that a message must have to hold it."""
        return max(self._place()[0]) + 1

    def raw(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """The unscaled numbers (n,) in messages ``data`` (n, bytes): uint64,
        int64 or a float type."""
        places, shift = self._place()
        bits = np.zeros(len(data), dtype=np.uint64)
        for k, place in enumerate(places[:8]):
            bits |= data[:, place].astype(np.uint64) << np.uint64(8 * k)
        bits >>= np.uint64(shift)
        if len(places) == 9:
            bits |= data[:, places[8]].astype(np.uint64) << np.uint64(64 - shift)
        spare = np.uint64(64 - self.length)
        bits <<= spare
        if self.signed and not self.is_float:
            return bits.view(np.int64) >> np.int64(spare)
        bits >>= spare
        if self.is_float:
            narrow = bits.astype(_FLOATS[self.length])
            return narrow.view(f"f{self.length // 8}")
        return bits

    def values(self, data: NDArray[np.uint8]) -> NDArray[np.float64]:
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any
            scaled: NDArray[np.float64] = self.raw(data).astype(np.float64) * self.scale + self.offset
        return scaled


@dataclass(frozen=True)
class Message:
    """A CAN message. Where it is ``per_node``, a unit at node N sends it as
    ``identifier`` + N. ``length`` in bytes, 0 where it is not known; one of
    J1939 may be longer than a frame."""

    name: str
    identifier: int
    signals: Mapping[str, Signal]
    extended: bool = False
    per_node: bool = False
    length: int = 0

    def identifier_of(self, node_id: int) -> int:
        return self.identifier + node_id if self.per_node else self.identifier


@dataclass(frozen=True)
class Layout:
    """A stream: its messages, the (message, signal) of each channel, and the
    counter in each message.

    ``valid`` are the signals, by message, that have to hold one of
    ``valid_values``. Where ``by_time``, messages that come within half a period
    are one sample.
    """

    messages: tuple[Message, ...]
    channels: Mapping[str, tuple[int, Signal]]
    counters: tuple[Signal, ...]
    valid: Mapping[int, Signal] = field(default_factory=dict)
    valid_values: tuple[int, ...] = ()
    by_time: bool = False

    @property
    def counter_bits(self) -> int:
        return self.counters[0].length if self.counters else 0

    def size(self, message: int) -> int:
        """Bytes that a message must have to hold what the stream takes of it."""
        signals = [s for m, s in self.channels.values() if m == message]
        signals += self.counters[message : message + 1]
        signals += [self.valid[message]] if message in self.valid else []
        return max(s.size for s in signals)


def arrange(messages: Sequence[Message], stream: CanStream, *, where: str) -> Layout:
    """The layout of ``stream`` in a file's messages.

    A name that several messages hold is taken from one that another channel
    needs in any case. Raises ProfileError (one line: ``where``, the name, the
    nearest right one).
    """
    wanted = stream.wanted()
    index = _Index(messages, getattr(stream, "base_node_id", None) or 0)
    holders = {name: index.holders(reference, where) for name, (reference, _) in wanted.items()}
    needed = {h[0][0] for h in holders.values() if len(h) == 1}
    chosen: dict[str, tuple[int, Signal]] = {}
    for name, (reference, scaling) in wanted.items():
        found = [h for h in holders[name] if len(holders[name]) == 1 or h[0] in needed]
        if len(found) != 1:
            names = ", ".join(index.place(m) for m, _ in holders[name])
            raise ProfileError(f"{where}: '{reference}' is in several messages ({names}); name one of them")
        chosen[name] = (found[0][0], _scaled(found[0][1], scaling))
    order = sorted(needed)
    used = tuple(messages[m] for m in order)
    channels = {name: (order.index(m), signal) for name, (m, signal) in chosen.items()}
    by_time = stream.together == "time"
    counters = _counters(used, stream.counter, by_time, where)
    valid = _valid(index, order, stream.validity(), where)
    _check_identifiers(used, where)
    _check_lengths(used, where)
    return Layout(used, channels, counters, *valid, by_time)


class _Index:
    """Finds signals by name, in files of thousands of messages too. ``node_id``
    is the one for which the identifiers of the file are written."""

    def __init__(self, messages: Sequence[Message], node_id: int) -> None:
        self._messages, self._node_id = messages, node_id
        self._of: dict[str, list[int]] = {}  # numbers of the messages of that name
        self._with: dict[str, list[int]] = {}  # of those that hold a signal of that name
        for i, m in enumerate(messages):
            self._of.setdefault(m.name, []).append(i)
            for name in m.signals:
                self._with.setdefault(name, []).append(i)

    def holders(self, reference: str, where: str) -> list[tuple[int, Signal]]:
        """Which messages hold the signal: ``Signal``, ``Message.Signal``, or
        ``Message@0x19.Signal`` where several have that name."""
        within, _, name = reference.rpartition(".")
        inside = self._named(within, where) if within else range(len(self._messages))
        found = [(i, self._messages[i].signals[name]) for i in self._with.get(name, []) if i in inside]
        if not found:
            at = f" in message '{within}'" if within else ""
            known = (s for i in inside for s in self._messages[i].signals)
            raise ProfileError(f"{where}: no signal '{name}'{at}{nearest(name, known)}")
        return found

    def _named(self, within: str, where: str) -> Sequence[int]:
        """The messages ``Message`` or ``Message@0x19``."""
        name, at, identifier = within.partition("@")
        if name not in self._of:
            raise ProfileError(f"{where}: no message '{name}'{nearest(name, self._of)}")
        found = self._of[name]
        if not at:
            return found
        if not (wanted := _IDENTIFIER.fullmatch(identifier)):
            raise ProfileError(f"{where}: '{clipped(within)}': expected an identifier as in {name}@0x19")
        value, extended = int(wanted[1], 16), bool(wanted[2])
        held = [
            i
            for i in found
            if self._identifier(i) == value and (value > STANDARD_MOST or self._messages[i].extended == extended)
        ]
        if not held:
            places = ", ".join(map(self.place, found))
            raise ProfileError(f"{where}: no message '{clipped(within)}'; known: {places}")
        return held

    def _identifier(self, i: int) -> int:
        """Identifier of message ``i`` as in the file."""
        m = self._messages[i]
        return m.identifier + (self._node_id if m.per_node else 0)

    def place(self, i: int) -> str:
        """The message's name as a profile has to give it."""
        name = self._messages[i].name
        if len(self._of[name]) == 1:
            return name
        identifier = self._identifier(i)
        short = self._messages[i].extended and identifier <= STANDARD_MOST  # an x tells it from a standard one
        return f"{name}@0x{identifier:X}{'x' if short else ''}"


def _scaled(signal: Signal, scaling: Scaling) -> Signal:
    return Signal(
        signal.name,
        signal.start,
        signal.length,
        signal.big_endian,
        signal.signed,
        signal.is_float,
        signal.scale if scaling.scale is None else scaling.scale,
        signal.offset if scaling.offset is None else scaling.offset,
    )


def _valid(
    index: _Index, order: Sequence[int], validity: tuple[str, tuple[int, ...]] | None, where: str
) -> tuple[dict[int, Signal], tuple[int, ...]]:
    """The signals that say whether a sample is valid, by their message's place
    in ``order``."""
    if validity is None:
        return {}, ()
    name, values = validity
    found = {order.index(m): signal for m, signal in index.holders(name, where) if m in order}
    if not found:
        names = ", ".join(map(index.place, order))
        raise ProfileError(f"{where}: valid: '{name}' is in no message of the sample ({names})")
    for signal in found.values():
        if signal.is_float:
            raise ProfileError(f"{where}: valid: '{name}' is a float, expected a whole number")
    return found, values


def _counters(used: Sequence[Message], counter: str | None, by_time: bool, where: str) -> tuple[Signal, ...]:
    if counter is None:
        if len(used) > 1 and not by_time:
            names = ", ".join(m.name for m in used)
            raise ProfileError(
                f'{where}: a sample made of several messages ({names}) needs a counter, or together = "time"'
            )
        return ()
    for message in used:
        if counter not in message.signals:
            hint = nearest(counter, message.signals)
            raise ProfileError(f"{where}: no signal '{counter}' (the counter) in message '{message.name}'{hint}")
    found = tuple(m.signals[counter] for m in used)
    widths = sorted({s.length for s in found})
    if len(widths) > 1 or widths[0] < SHORTEST_COUNTER or widths[0] > 32 or any(s.is_float for s in found):
        raise ProfileError(
            f"{where}: counter '{counter}' is {' and '.join(map(str, widths))} bits wide, "
            f"expected an integer of the same {SHORTEST_COUNTER} to 32 bits in every message"
        )
    return found


def _check_lengths(used: Sequence[Message], where: str) -> None:
    for message in used:
        if message.length > FRAME_MOST:
            raise ProfileError(
                f"{where}: message '{clipped(message.name)}' has {message.length} bytes, which J1939 sends in several "
                f"frames; expected one of a single frame, at most {FRAME_MOST} bytes"
            )


def _check_identifiers(used: Sequence[Message], where: str) -> None:
    """Identifiers that shift with the node must tell messages apart whichever
    node sends them."""
    for a, b in combinations([m for m in used if m.per_node], 2):
        if a.extended == b.extended and abs(a.identifier - b.identifier) < NODES:
            raise ProfileError(
                f"{where}: messages '{a.name}' and '{b.name}' are less than {NODES} identifiers apart; "
                "they cannot shift with the node"
            )
