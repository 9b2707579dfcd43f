"""Layout of a stream's channels in its CAN messages, out of the DBC or EDS file that
the stream names, and the extraction of channels from many frames at once. No I/O.

Of a DBC it takes what a stream can need: messages, their signals, and which of
these are floats. It passes over comments, value tables and whatever else somebody
put there, so that a vehicle's DBC takes a fraction of a second and a hostile one
no longer.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.can.eds import object_dictionary, value
from triaxcal_drivers.can.model import CanStream, DbcStream, Scaling
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import clipped, nearest

if TYPE_CHECKING:
    from canopen import ObjectDictionary


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
    J1939 may be longer than a frame. One with a ``fault`` cannot be used: it is
    disabled, or its file does not say what it holds."""

    name: str
    identifier: int
    signals: Mapping[str, Signal]
    extended: bool = False
    per_node: bool = False
    length: int = 0
    fault: str = ""

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
        self._unusable = [m for m in messages if m.fault]
        for i, m in enumerate(messages):
            if m.fault:
                continue
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
            known = (s for i in inside for s in self._messages[i].signals if not self._messages[i].fault)
            raise ProfileError(f"{where}: no signal '{name}'{at}{self._why(name) or nearest(name, known)}")
        return found

    def _why(self, name: str) -> str:
        """The fault of a message that holds the signal, else that of one of
        which nobody knows what it holds; empty without one."""
        holding = [m.fault for m in self._unusable if name in m.signals]
        return "".join(f": {fault}" for fault in (holding or [m.fault for m in self._unusable if not m.signals])[:1])

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


# The messages of a stream, out of the DBC or EDS file that it names.

J1939_MOST = 1785  # bytes of a J1939 message in 255 packets of seven
ENTRIES_MOST = 100_000  # messages and signals; a vehicle has tens of thousands
TOKENS_MOST = 1_000_000  # statements and quoted texts; a vehicle's value tables have some hundred thousand

_TOKEN = re.compile(
    rb'"(?:[^"\\]++|\\"?+)*+"?|^[ \t]*(?P<kind>BO_|SG_|SIG_VALTYPE_)[ \t]+(?P<rest>[^"\r\n]{0,1000})'
    rb"|^(?P<word>[A-Za-z]\w*)",
    re.MULTILINE,
)
_KEYWORDS = frozenset(
    b"BA_ BA_DEF_ BA_DEF_DEF_ BA_DEF_DEF_REL_ BA_DEF_REL_ BA_DEF_SGTYPE_ BA_REL_ BA_SGTYPE_ BO_ BO_TX_BU_ BS_ BU_"
    b" BU_BO_REL_ BU_EV_REL_ BU_SG_REL_ CAT_ CAT_DEF_ CM_ ENVVAR_DATA_ EV_ EV_DATA_ FILTER NS_ NS_DESC_ SG_ SG_MUL_VAL_"
    b" SGTYPE_ SGTYPE_VAL_ SIG_GROUP_ SIG_TYPE_REF_ SIG_VALTYPE_ SIGTYPE_VALTYPE_ VAL_ VAL_TABLE_ VERSION".split()
)
_NUMBER = rb"([-+]?(?:\d{1,400}(?:\.\d{0,400})?|\.\d{1,400})(?:[eE][-+]?\d{1,3})?)"
_MESSAGE = re.compile(rb"(\d{1,10})\s+(\w+)\s*:\s*(\d{1,10})\s")
_SIGNAL = re.compile(
    rb"(\w+)\s*(?:\s(M|m\d{1,10}M?)\s*)?:\s*(\d{1,10})\s*\|\s*(\d{1,10})\s*@\s*([01])\s*([-+])"
    rb"\s*\(\s*" + _NUMBER + rb"\s*,\s*" + _NUMBER + rb"\s*\)"
)
_VALUE_TYPE = re.compile(rb"(\d{1,10})\s+(\w+)\s*:?\s*([0-3])\b")
_LONG_NAME = re.compile(
    rb'^[ \t]*BA_\s+"System(?:Signal|Message)LongSymbol"\s+(?:BO_|SG_)\s+(\d{1,10})(?:\s+(\w+))?\s*"(\w+)"',
    re.MULTILINE,
)
_FORMATS = re.compile(
    rb'^[ \t]*BA_DEF_\s+BO_\s+"VFrameFormat"\s+ENUM\s+((?:"[^"\r\n]{0,100}"\s*,?\s*){1,100})', re.MULTILINE
)
_FORMAT = re.compile(
    rb'^[ \t]*BA_(?:DEF_DEF_\s+"VFrameFormat"\s|\s+"VFrameFormat"\s+BO_\s+(\d{1,10})\s)\s*(?:(\d{1,3})|"(\w{1,100})")',
    re.MULTILINE,
)
_DBC_EXTENDED = 1 << 31
_NO_MESSAGE = 0xC0000000  # what Vector's tools keep signals under that belong to no message


@dataclass
class _Described:
    """A message as the file has it."""

    number: int
    name: str
    length: int
    signals: dict[str, Signal] = field(default_factory=dict)


def dbc_messages(data: bytes, *, base_node_id: int | None, where: str) -> list[Message]:
    """Every message of a DBC file; multiplexed signals, which only some frames
    hold, are left out.

    Raises ProfileError.
    """
    found = _File(data, where).messages()
    if not found:
        raise ProfileError(f"{where}: not a DBC file: there is no message in it (BO_)")
    _check_dbc_lengths(found, data, where)
    long = {(int(m[1]), m[2]): m[3].decode() for m in _LONG_NAME.finditer(data)}
    messages = []
    for m in found:
        signals = {}
        for signal in m.signals.values():
            name = long.get((m.number, signal.name.encode()), signal.name)
            signals[name] = replace(signal, name=name) if name != signal.name else signal
            _check(signal, m, where)
        extended = bool(m.number & _DBC_EXTENDED)
        identifier = m.number & ~_DBC_EXTENDED
        if identifier > (0x1FFFFFFF if extended else 0x7FF):
            raise ProfileError(f"{where}: message '{clipped(m.name)}' has the identifier {m.number}, which CAN has not")
        name = long.get((m.number, None), m.name)
        messages.append(
            Message(name, identifier - (base_node_id or 0), signals, extended, base_node_id is not None, m.length)
        )
    return messages


class _File:
    """One reading of one file."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where = data, where

    def messages(self) -> list[_Described]:
        messages: list[_Described] = []
        floats: set[tuple[int, str]] = set()
        entries = 0
        for kind, rest, at in self._statements():
            entries += kind != b"SIG_VALTYPE_"
            if entries > ENTRIES_MOST:
                self._fail(at, f"more than {ENTRIES_MOST} messages and signals")
            if kind == b"BO_":
                messages.append(self._message(rest, at))
            elif kind == b"SIG_VALTYPE_":
                floats |= self._float(rest, at)
            elif not messages:
                self._fail(at, "a signal (SG_) of no message")
            else:
                messages[-1].signals |= self._signal(rest, at)
        for m in messages:
            for name, signal in m.signals.items():
                if (m.number, name) in floats:
                    m.signals[name] = replace(signal, is_float=True)
        return [m for m in messages if m.number != _NO_MESSAGE]

    def _statements(self) -> Iterator[tuple[bytes, bytes, int]]:
        for count, token in enumerate(_TOKEN.finditer(self._data)):
            if count >= TOKENS_MOST:
                self._fail(token.start(), f"more than {TOKENS_MOST} statements and texts")
            if token["word"] and token["word"] not in _KEYWORDS:
                self._fail(token.start(), "expected a keyword of DBC (VERSION, BO_, CM_ …)")
            if token["kind"]:
                yield token["kind"], token["rest"], token.start("kind")

    def _message(self, rest: bytes, at: int) -> _Described:
        m = _MESSAGE.match(rest + b" ")
        if m is None:
            self._fail(at, "expected BO_ identifier name: bytes sender")
        return _Described(int(m[1]), m[2].decode(), int(m[3]))

    def _signal(self, rest: bytes, at: int) -> dict[str, Signal]:
        m = _SIGNAL.match(rest)
        if m is None:
            self._fail(at, "expected SG_ name : start|length@order sign (scale,offset) […")
        name, multiplexed = m[1].decode(), (m[2] or b"").startswith(b"m")
        scale, offset = float(m[7]), float(m[8])
        if not (math.isfinite(scale) and math.isfinite(offset)):
            self._fail(at, f"signal '{clipped(name)}': expected a finite scale and offset")
        signal = Signal(name, int(m[3]), int(m[4]), m[5] == b"0", m[6] == b"-", False, scale, offset)
        return {} if multiplexed else {name: signal}

    def _float(self, rest: bytes, at: int) -> set[tuple[int, str]]:
        m = _VALUE_TYPE.match(rest)
        if m is None:
            self._fail(at, "expected SIG_VALTYPE_ identifier name : type;")
        return {(int(m[1]), m[2].decode())} if m[3] in b"12" else set()

    def _fail(self, at: int, what: str) -> NoReturn:
        line = self._data.count(b"\n", 0, at) + 1
        raise ProfileError(f"{self._where}: not a DBC file: line {line}: {what}")


def _check_dbc_lengths(messages: Sequence[_Described], data: bytes, where: str) -> None:
    """Raises ProfileError where a message is longer than CAN can carry it."""
    longer = [m for m in messages if m.length > FRAME_MOST]
    j1939 = _j1939(data, longer) if longer else frozenset()
    for m in longer:
        most = J1939_MOST if m.number in j1939 else FRAME_MOST
        if m.length > most:
            kind = "a J1939 message" if m.number in j1939 else "a frame of CAN FD"
            raise ProfileError(
                f"{where}: message '{clipped(m.name)}' has {m.length} bytes, expected at most {most} as {kind}"
            )


def _j1939(data: bytes, messages: Sequence[_Described]) -> frozenset[int]:
    """The numbers of those whose attribute ``VFrameFormat`` is ``J1939PG``,
    their own or by default; all of J1939 have identifiers of 29 bits."""
    names = [name for found in _FORMATS.finditer(data) for name in re.findall(rb'"([^"]*)"', found[1])]
    formats: dict[int | None, bytes] = {}
    for m in _FORMAT.finditer(data):
        said = m[3] if m[2] is None else dict(enumerate(names)).get(int(m[2]), b"")
        formats[None if m[1] is None else int(m[1])] = said
    default = formats.get(None, b"")
    return frozenset(
        m.number for m in messages if m.number & _DBC_EXTENDED and formats.get(m.number, default) == b"J1939PG"
    )


def _check(signal: Signal, message: _Described, where: str) -> None:
    if not 1 <= signal.length <= 64:
        raise ProfileError(
            f"{where}: signal '{clipped(signal.name)}' of message '{clipped(message.name)}' has {signal.length} bits,"
            " expected 1 to 64"
        )
    if signal.is_float and signal.length not in (16, 32, 64):
        raise ProfileError(f"{where}: signal '{clipped(signal.name)}' is a float of {signal.length} bits")
    if signal.size > message.length:
        raise ProfileError(
            f"{where}: signal '{clipped(signal.name)}' does not fit the {message.length} bytes of message"
            f" '{clipped(message.name)}'"
        )


_DISABLED, _EXTENDED = 1 << 31, 1 << 29  # bits of a PDO's COB-ID (CiA 301)


def stream_layout(stream: CanStream, files: Mapping[str, bytes], *, where: str) -> Layout:
    """The layout of a stream in the file it names. Raises ProfileError."""
    node_id = stream.base_node_id if isinstance(stream, DbcStream) else None
    messages = _messages(files[stream.file], isinstance(stream, DbcStream), node_id, stream.file)
    return arrange(messages, stream, where=f"{stream.file} ({where})")


@lru_cache(maxsize=4)
def _messages(data: bytes, dbc: bool, base_node_id: int | None, where: str) -> list[Message]:
    """A file is read once for all streams that it lays out, and once for all
    units of a station."""
    if dbc:
        return dbc_messages(data, base_node_id=base_node_id, where=where)
    return pdo_messages(object_dictionary(data, node_id=0, where=where))


def pdo_messages(objects: ObjectDictionary) -> list[Message]:
    """The TPDOs, by their mapping (0x1A00…) and COB-ID (0x1800…); signals are
    named ``0x2300:01``. One that cannot be used says why in its ``fault``."""
    found = (_tpdo(objects, number) for number in range(512) if 0x1800 + number in objects)
    return [message for message in found if message is not None]


def _tpdo(objects: ObjectDictionary, number: int) -> Message | None:
    """None where it maps nothing and has a fault: nobody misses it then."""
    name, cob_id, per_node, fault = f"TPDO{number + 1}", 0, False, ""
    try:
        cob_id, per_node = value(objects, 0x1800 + number, 1)
    except ProfileError as e:
        fault = f"{name}: {e}"
    if cob_id & _DISABLED:
        fault = f"{name} is disabled (bit 31 of its COB-ID, 0x{0x1800 + number:04X}:01 = 0x{cob_id:X})"
    try:
        signals = _mapped(objects, number)
    except ProfileError as e:
        return None if cob_id & _DISABLED else Message(name, 0, {}, fault=str(e))
    if fault and not signals:
        return None
    extended = bool(cob_id & _EXTENDED)
    identifier = cob_id & (0x1FFFFFFF if extended else STANDARD_MOST)
    return Message(name, identifier, signals, extended, per_node, fault=fault)


def _mapped(objects: ObjectDictionary, number: int) -> dict[str, Signal]:
    """Raises ProfileError without the file's name."""
    signals: dict[str, Signal] = {}
    start = 0
    for entry in range(1, value(objects, 0x1A00 + number, 0)[0] + 1):
        word, _ = value(objects, 0x1A00 + number, entry)
        index, subindex, length = word >> 16, word >> 8 & 0xFF, word & 0xFF
        if index >= 0x20:  # below are the data types, mapped as a filler
            signal = _mapped_signal(objects, index, subindex, start, length, f"TPDO{number + 1}")
            signals[signal.name] = signal
        start += length
    if start > 64:
        raise ProfileError(f"TPDO{number + 1} maps {start} bits, which is more than 64")
    return signals


def _mapped_signal(objects: ObjectDictionary, index: int, subindex: int, start: int, length: int, where: str) -> Signal:
    from canopen.objectdictionary import datatypes

    name = f"0x{index:04X}:{subindex:02X}"
    variable = objects.get_variable(index, subindex)
    if variable is None:
        raise ProfileError(f"{where} maps {name}, which is not an object of the file")
    if len(variable) != length or variable.data_type not in datatypes.NUMBER_TYPES:
        raise ProfileError(f"{where} maps {length} bits of {name}, which is not a number of that size")
    signed = variable.data_type in datatypes.SIGNED_TYPES
    is_float = variable.data_type in datatypes.FLOAT_TYPES
    return Signal(name, start, length, False, signed, is_float, float(variable.factor))
