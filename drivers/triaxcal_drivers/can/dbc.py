"""The messages of a DBC file. No I/O.

It takes what a stream can need: messages, their signals, and which of these are
floats. It passes over comments, value tables and whatever else somebody put there, so
that a vehicle's DBC takes a fraction of a second and a hostile one no longer.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NoReturn

from triaxcal_drivers.can.message import Message, Selection, Signal
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import clipped

FRAME_MOST = 64  # bytes of a CAN FD frame
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
