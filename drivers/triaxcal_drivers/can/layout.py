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
SHORTEST_STAMP = 8  # bits; a shorter one wraps within a few samples
FRAME_MOST = 64  # bytes of a CAN FD frame
FIRST_BROADCAST = 240  # PDU format from which on a group has no destination (SAE J1939-21)
STANDARD_MOST = 0x7FF  # the highest identifier of 11 bits
_IDENTIFIER = re.compile("0[xX]([0-9A-Fa-f]{1,8})([xX]?)")
_FLOATS = {16: np.uint16, 32: np.uint32, 64: np.uint64}


@dataclass(frozen=True)
class Signal:
    """Up to 64 bits of a message, numbered as in a DBC file.

    Bit k is bit k % 8 (0 the least significant) of byte k // 8. ``start`` is
    the signal's least significant bit where it is little-endian, its most
    significant one where it is big-endian. ``selected`` says which frames of
    the message hold it; all of them where it is empty.
    """

    name: str
    start: int
    length: int
    big_endian: bool = False
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0
    selected: tuple[Selection, ...] = ()

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
class Selection:
    """Frames whose ``selector``, unscaled, is in one of the ``ranges`` (first,
    last)."""

    selector: Signal
    ranges: tuple[tuple[int, int], ...]

    def holds(self, data: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which of the frames ``data`` (n, bytes) are selected."""
        found = self.selector.raw(data).astype(np.int64)
        held = np.zeros(len(data), dtype=bool)
        for first, last in self.ranges:
            held |= (first <= found) & (found <= last)
        return held

    def within(self, other: Selection) -> bool:
        """Whether ``other`` selects every frame that this one selects."""
        return self.selector.name == other.selector.name and all(
            any(low <= first and last <= high for low, high in other.ranges) for first, last in self.ranges
        )

    def apart_from(self, other: Selection) -> bool:
        return self.selector.name == other.selector.name and all(
            last < low or high < first for first, last in self.ranges for low, high in other.ranges
        )

    def __str__(self) -> str:
        ranges = (str(first) if first == last else f"{first}-{last}" for first, last in self.ranges)
        return f"{self.selector.name} = {', '.join(ranges)}"


def _implied(signal: Signal, selected: Sequence[Selection]) -> bool:
    """Whether frames that are so ``selected`` hold the signal."""
    return all(any(given.within(needed) for given in selected) for needed in signal.selected)


@dataclass(frozen=True)
class Message:
    """A CAN message, or those of its frames that are ``selected``. Where it is
    ``per_node``, a unit at node N sends it as ``identifier`` + N; one of ``j1939``
    has its priority, its source and its destination in the identifier too.
    ``length`` in bytes, 0 where it is not known. One with a ``fault`` cannot be
    used: it is disabled, or its file does not say what it holds."""

    name: str
    identifier: int
    signals: Mapping[str, Signal]
    extended: bool = False
    per_node: bool = False
    length: int = 0
    fault: str = ""
    selected: tuple[Selection, ...] = ()
    j1939: bool = False

    @property
    def group(self) -> tuple[int, int]:
        """The bits of an identifier that say the parameter group (SAE J1939-21), and
        what they are here: without a destination, which some groups have in it."""
        bits = 0x3FFFF00 if self.identifier >> 16 & 0xFF >= FIRST_BROADCAST else 0x3FF0000
        return bits, self.identifier & bits

    @property
    def title(self) -> str:
        return f"{self.name} ({', '.join(map(str, self.selected))})" if self.selected else self.name

    def identifier_of(self, node_id: int) -> int:
        if self.j1939:
            return self.identifier & ~0xFF | node_id
        return self.identifier + node_id if self.per_node else self.identifier


@dataclass(frozen=True)
class Layout:
    """A stream: its messages, the (message, signal) of each channel, and the
    counter in each message.

    The first ``sample`` messages make a sample, all where it is 0; channels of
    the others take the newest value that is no older than ``latest_s``, by
    channel. ``valid`` are (message, signal, values): the signals that have to
    hold one of the values. Where ``by_time``, messages that come within half a
    period are one sample; where there is a message ``begins``, those from one
    such message to the next. There a counter is in one message: ``count``.
    ``stamp`` is (message, signal, seconds of a count).
    """

    messages: tuple[Message, ...]
    channels: Mapping[str, tuple[int, Signal]]
    counters: tuple[Signal, ...] = ()
    valid: tuple[tuple[int, Signal, tuple[int, ...]], ...] = ()
    by_time: bool = False
    begins: int | None = None
    count: tuple[int, Signal] | None = None
    stamp: tuple[int, Signal, float] | None = None
    sample: int = 0
    latest_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample", self.sample or len(self.messages))

    @property
    def counter_bits(self) -> int:
        return self.counters[0].length if self.counters else 0

    def size(self, message: int) -> int:
        """Bytes that a message must have to hold what the stream takes of it."""
        signals = [s for m, s in self.channels.values() if m == message]
        signals += self.counters[message : message + 1]
        signals += [s for m, s, _ in self.valid if m == message]
        signals += [m_s[1] for m_s in (self.count, self.stamp) if m_s is not None and m_s[0] == message]
        signals += [selection.selector for selection in self.messages[message].selected]
        return max((s.size for s in signals), default=0)


def arrange(messages: Sequence[Message], stream: CanStream, *, where: str) -> Layout:
    """The layout of ``stream`` in a file's messages.

    A name that several messages hold is taken from one that another channel
    needs in any case. Raises ProfileError (one line: ``where``, the name, the
    nearest right one).
    """
    index = _Index(messages, getattr(stream, "base_node_id", None) or 0)
    wanted = stream.wanted()
    holders = {name: index.holders(w.reference, where) for name, w in wanted.items()}
    needed = {h[0][0] for name, h in holders.items() if len(h) == 1 and wanted[name].latest_s is None}
    chosen: dict[str, tuple[int, Signal]] = {}
    for name, w in wanted.items():
        m, signal = index.one_of(holders[name], needed, w.reference, where)
        chosen[name] = m, _scaled(signal, w.channel)
    # Frames of a sample: of its channels, its begin, its counter and its time stamp.
    parts = _Frames(messages)
    for name, (m, signal) in chosen.items():
        if wanted[name].latest_s is None:
            parts.need(m, signal)
    begins = index.message(stream.begins, where) if stream.begins else None
    if begins is not None:
        parts.need(begins)
    together = stream.together is not None
    once = {"counter": stream.counter} if together and stream.counter else {}
    if (stamp := stream.stamp()) is not None:
        once["time_stamp"] = stamp[0]
    found = {key: index.first_of(index.holders(name, where), parts.used, name, where) for key, name in once.items()}
    for m, signal in found.values():
        parts.need(m, signal)
    sample = parts.settle(where)
    if begins is not None and len(parts.places(begins)) > 1:
        names = ", ".join(f"'{sample[i].title}'" for i in parts.places(begins))
        raise ProfileError(f"{where}: together: which of {names} begins a sample cannot be told; name another message")
    # Frames beside it, which have the newest value of some channels.
    for m, signal in chosen.values():
        if parts.place(m, signal) is None:
            parts.need(m, signal)
    used = parts.settle(where)
    _check_identifiers([messages[m] for m in sorted(parts.used)], where)
    _check_lengths(used, where)
    channels = {name: (parts.place_of(m, signal), signal) for name, (m, signal) in chosen.items()}
    single = {key: (parts.place_of(m, signal), signal) for key, (m, signal) in found.items()}
    for key, (_, signal) in single.items():
        _check_count(signal, key, where)
    return Layout(
        used,
        channels,
        _counters(sample, None if together else stream.counter, together, where),
        _valid(index, parts, sample, stream.validity(), where),
        by_time=stream.together == "time",
        begins=None if begins is None else parts.place_of(begins),
        count=single.get("counter"),
        stamp=(*single["time_stamp"], stamp[1]) if stamp else None,
        sample=len(sample),
        latest_s={name: w.latest_s for name, w in wanted.items() if w.latest_s and channels[name][0] >= len(sample)},
    )


class _Frames:
    """Kinds of frames that a stream takes: messages, of a multiplexed one the frames
    that are selected. A signal that every frame has is taken from those that
    another signal needs in any case."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self._messages = messages
        self._kinds: list[tuple[int, tuple[Selection, ...]]] = []  # number of the message, and which frames of it
        self._settled = 0

    @property
    def used(self) -> set[int]:
        """Numbers of the messages."""
        return {m for m, _ in self._kinds}

    def place(self, m: int, signal: Signal | None = None) -> int | None:
        """The first kind of frame with message ``m`` that holds the signal."""
        return next(iter(self.places(m, signal)), None)

    def places(self, m: int, signal: Signal | None = None) -> list[int]:
        """All such kinds of frame."""
        kinds = enumerate(self._kinds)
        return [i for i, (n, selected) in kinds if n == m and (signal is None or _implied(signal, selected))]

    def place_of(self, m: int, signal: Signal | None = None) -> int:
        """The same where it has been needed."""
        found = self.place(m, signal)
        assert found is not None
        return found

    def need(self, m: int, signal: Signal | None = None) -> None:
        if self.place(m, signal) is not None:
            return
        selected = signal.selected if signal else ()
        for i, (n, wider) in enumerate(self._kinds[self._settled :], self._settled):
            if n == m and all(any(each.within(w) for each in selected) for w in wider):
                self._kinds[i] = m, selected
                return
        self._kinds.append((m, selected))

    def settle(self, where: str) -> tuple[Message, ...]:
        """All that were needed; those since the last call in the order of the file."""
        self._kinds[self._settled :] = sorted(self._kinds[self._settled :], key=lambda kind: kind[0])
        self._settled = len(self._kinds)
        used = tuple(replace(self._messages[m], selected=selected) for m, selected in self._kinds)
        for (a, (m, one)), (b, (n, other)) in combinations(enumerate(self._kinds), 2):
            if m == n and not any(x.apart_from(y) for x in one for y in other):
                names = " and ".join(f"'{used[i].title}'" for i in (a, b))
                raise ProfileError(f"{where}: {names} can be the same frame; take the channels from one of them")
        return used


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

    def one_of(
        self, holders: Sequence[tuple[int, Signal]], preferred: set[int], reference: str, where: str
    ) -> tuple[int, Signal]:
        """The only holder, or the only one among the ``preferred`` messages."""
        found = [h for h in holders if len(holders) == 1 or h[0] in preferred]
        if len(found) != 1:
            names = ", ".join(self.place(m) for m, _ in holders)
            raise ProfileError(f"{where}: '{reference}' is in several messages ({names}); name one of them")
        return found[0]

    def first_of(
        self, holders: Sequence[tuple[int, Signal]], preferred: set[int], reference: str, where: str
    ) -> tuple[int, Signal]:
        """The first holder among the ``preferred`` messages, or the only one."""
        found = [h for h in holders if h[0] in preferred]
        return found[0] if found else self.one_of(holders, preferred, reference, where)

    def message(self, name: str, where: str) -> int:
        """The message ``Message`` or ``Message@0x19``."""
        found = self._named(name, where)
        if len(found) != 1:
            raise ProfileError(
                f"{where}: there are several messages '{name}' ({', '.join(map(self.place, found))}); name one of them"
            )
        return found[0]

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
    return replace(
        signal,
        scale=signal.scale if scaling.scale is None else scaling.scale,
        offset=signal.offset if scaling.offset is None else scaling.offset,
    )


def _valid(
    index: _Index,
    frames: _Frames,
    sample: Sequence[Message],
    validity: Sequence[tuple[str, tuple[int, ...]]],
    where: str,
) -> tuple[tuple[int, Signal, tuple[int, ...]], ...]:
    """The signals that say whether a sample is valid, by their message's place
    in the sample."""
    entries = []
    for name, values in validity:
        held = [(place, signal) for m, signal in index.holders(name, where) for place in frames.places(m, signal)]
        found = [(place, signal) for place, signal in held if place < len(sample)]
        if not found:
            names = ", ".join(m.title for m in sample)
            raise ProfileError(f"{where}: valid: '{name}' is in no message of the sample ({names})")
        for place, signal in found:
            if signal.is_float:
                raise ProfileError(f"{where}: valid: '{name}' is a float, expected a whole number")
            entries.append((place, signal, values))
    return tuple(entries)


def _counters(used: Sequence[Message], counter: str | None, together: bool, where: str) -> tuple[Signal, ...]:
    """The counter in each message of the sample."""
    if counter is None:
        if len(used) > 1 and not together:
            names = ", ".join(m.title for m in used)
            raise ProfileError(
                f"{where}: a sample made of several messages ({names}) needs a counter, together = "
                '{ begins = "…" } or together = "time"'
            )
        return ()
    for message in used:
        if counter not in message.signals or not _implied(message.signals[counter], message.selected):
            hint = nearest(counter, message.signals)
            raise ProfileError(f"{where}: no signal '{counter}' (the counter) in message '{message.title}'{hint}")
    found = tuple(m.signals[counter] for m in used)
    widths = sorted({s.length for s in found})
    if len(widths) > 1 or widths[0] < SHORTEST_COUNTER or widths[0] > 32 or any(s.is_float for s in found):
        raise ProfileError(
            f"{where}: counter '{counter}' is {' and '.join(map(str, widths))} bits wide, "
            f"expected an integer of the same {SHORTEST_COUNTER} to 32 bits in every message"
        )
    return found


def _check_count(signal: Signal, key: str, where: str) -> None:
    """Of a counter or time stamp that one message of a sample bears."""
    most = 32 if key == "counter" else 64
    least = SHORTEST_COUNTER if key == "counter" else SHORTEST_STAMP
    if signal.is_float or not least <= signal.length <= most:
        kind = "float" if signal.is_float else "whole number"
        raise ProfileError(
            f"{where}: {key} '{signal.name}' is a {kind} of {signal.length} bits, expected an integer of {least} to "
            f"{most} bits"
        )


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
SELECTORS_MOST = 8  # one above the other; files have two at most
TOKENS_MOST = 1_000_000  # statements and quoted texts; a vehicle's value tables have some hundred thousand

_TOKEN = re.compile(
    rb'"(?:[^"\\]++|\\"?+)*+"?|^[ \t]*(?P<kind>BO_|SG_|SIG_VALTYPE_)[ \t]+(?P<rest>[^"\r\n]{0,1000})'
    rb'|^[ \t]*SG_MUL_VAL_\s+(?P<selected>\d[^";]{0,20000};?)'
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
    rb"(\w+)\s*(?:\s(?:(M)|m(\d{1,10})(M?))\s*)?:\s*(\d{1,10})\s*\|\s*(\d{1,10})\s*@\s*([01])\s*([-+])"
    rb"\s*\(\s*" + _NUMBER + rb"\s*,\s*" + _NUMBER + rb"\s*\)"
)
_SELECTED = re.compile(rb"(\d{1,10})\s+(\w+)\s+(\w+)\s+(\d[^;]*);")
_RANGE = re.compile(rb"\s*(\d{1,20})\s*-\s*(\d{1,20})\s*")
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


_By = tuple[str, tuple[tuple[int, int], ...]]
"""Name of a signal that selects others, and the ranges (first, last) for one."""


@dataclass
class _Described:
    """A message as the file has it."""

    number: int
    name: str
    length: int
    signals: dict[str, Signal] = field(default_factory=dict)
    selectors: list[str] = field(default_factory=list)  # signals that select others
    numbers: dict[str, int] = field(default_factory=dict)  # by which a signal says that it is selected

    def settle(self, said: Mapping[str, _By]) -> None:
        """Says of each multiplexed signal which frames hold it: ``said`` are the
        selectors and ranges that the file lists, which the short form gives way
        to. One whose selector is not in the message is dropped."""
        plain = [name for name in self.selectors if name not in self.numbers]
        of: dict[str, _By] = {}
        if len(plain) == 1:
            of |= {name: (plain[0], ((number, number),)) for name, number in self.numbers.items()}
        of |= {name: by for name, by in said.items() if name in self.signals and by[0] in self.signals}
        bare = dict(self.signals)
        for name in {*self.numbers, *of}:
            chain = self._chain(name, of, bare)
            if chain is None:
                del self.signals[name]
            else:
                self.signals[name] = replace(bare[name], selected=chain)

    def _chain(self, name: str, of: Mapping[str, _By], bare: Mapping[str, Signal]) -> tuple[Selection, ...] | None:
        """What selects the signal, what selects that, and so on."""
        chain: list[Selection] = []
        while name in of or name in self.numbers:
            if name not in of or len(chain) > SELECTORS_MOST:
                return None
            name, ranges = of[name]
            chain.append(Selection(bare[name], ranges))
        return tuple(chain)


def dbc_messages(data: bytes, *, base_node_id: int | None, where: str) -> list[Message]:
    """Every message of a DBC file. Raises ProfileError."""
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
            for each in (signal, *(s.selector for s in signal.selected)):
                _check(each, m, where)
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
        selected: dict[int, dict[str, _By]] = {}
        entries = 0
        for kind, rest, at in self._statements():
            entries += kind in (b"BO_", b"SG_")
            if entries > ENTRIES_MOST:
                self._fail(at, f"more than {ENTRIES_MOST} messages and signals")
            if kind == b"BO_":
                messages.append(self._message(rest, at))
            elif kind == b"SIG_VALTYPE_":
                floats |= self._float(rest, at)
            elif kind == b"SG_MUL_VAL_":
                number, name, by = self._selection(rest, at)
                earlier = selected.setdefault(number, {}).get(name)
                if earlier is not None and earlier[0] == by[0]:
                    by = (by[0], earlier[1] + by[1])
                selected[number][name] = by
            elif not messages:
                self._fail(at, "a signal (SG_) of no message")
            else:
                self._add_signal(messages[-1], rest, at)
        for m in messages:
            for name, signal in m.signals.items():
                if (m.number, name) in floats:
                    m.signals[name] = replace(signal, is_float=True)
            if m.numbers or m.number in selected:
                m.settle(selected.get(m.number, {}))
        return [m for m in messages if m.number != _NO_MESSAGE]

    def _statements(self) -> Iterator[tuple[bytes, bytes, int]]:
        for count, token in enumerate(_TOKEN.finditer(self._data)):
            if count >= TOKENS_MOST:
                self._fail(token.start(), f"more than {TOKENS_MOST} statements and texts")
            if token["word"] and token["word"] not in _KEYWORDS:
                self._fail(token.start(), "expected a keyword of DBC (VERSION, BO_, CM_ …)")
            if token["selected"] is not None:
                yield b"SG_MUL_VAL_", token["selected"], token.start("selected")
            if token["kind"]:
                yield token["kind"], token["rest"], token.start("kind")

    def _message(self, rest: bytes, at: int) -> _Described:
        m = _MESSAGE.match(rest + b" ")
        if m is None:
            self._fail(at, "expected BO_ identifier name: bytes sender")
        return _Described(int(m[1]), m[2].decode(), int(m[3]))

    def _add_signal(self, message: _Described, rest: bytes, at: int) -> None:
        m = _SIGNAL.match(rest)
        if m is None:
            self._fail(at, "expected SG_ name : start|length@order sign (scale,offset) […")
        name, selects, number, selects_too, start, length, order, sign = (each or b"" for each in m.groups()[:8])
        scale, offset = float(m[9]), float(m[10])
        title = name.decode()
        if not (math.isfinite(scale) and math.isfinite(offset)):
            self._fail(at, f"signal '{clipped(title)}': expected a finite scale and offset")
        message.signals[title] = Signal(
            title, int(start), int(length), order == b"0", sign == b"-", False, scale, offset
        )
        if selects or selects_too:
            message.selectors.append(title)
        if number:
            message.numbers[title] = int(number)

    def _selection(self, rest: bytes, at: int) -> tuple[int, str, _By]:
        m = _SELECTED.fullmatch(rest)
        found = [_RANGE.fullmatch(part) for part in m[4].split(b",")] if m else []
        ranges = tuple((int(one[1]), int(one[2])) for one in found if one)
        if m is None or len(ranges) < len(found):
            self._fail(at, "expected SG_MUL_VAL_ identifier name selector first-last, …;")
        return int(m[1]), m[2].decode(), (m[3].decode(), ranges)

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
    layout = arrange(messages, stream, where=f"{stream.file} ({where})")
    if isinstance(stream, DbcStream) and stream.j1939:
        for message in layout.messages:
            if not message.extended:
                raise ProfileError(
                    f"{stream.file} ({where}): message '{clipped(message.name)}' has an identifier of 11 bits, and "
                    "those of J1939 have 29"
                )
        groups = tuple(replace(m, j1939=True) for m in layout.messages)
        for a, b in combinations(groups, 2):
            if a.group == b.group and not any(x.apart_from(y) for x in a.selected for y in b.selected):
                raise ProfileError(
                    f"{stream.file} ({where}): messages '{clipped(a.name)}' and '{clipped(b.name)}' are of one PGN, "
                    "which J1939 does not tell apart; take the channels from one of them"
                )
        return replace(layout, messages=groups)
    return layout


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
