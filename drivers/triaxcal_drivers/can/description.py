"""The messages of a stream, out of the DBC or EDS file that it names: the only
place that reads these files.

Of a DBC it takes what a stream can need: messages, their signals, and which of
these are floats. Comments, value tables and whatever else somebody put there
are passed over unread, so that a vehicle's DBC takes a fraction of a second and
a hostile one no longer.
"""

from __future__ import annotations

import configparser
import io
import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NoReturn

from triaxcal_drivers.can.layout import FRAME_MOST, Layout, Message, Signal, arrange
from triaxcal_drivers.can.model import CanStream, DbcStream
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.files import size
from triaxcal_drivers.hints import clipped

if TYPE_CHECKING:
    from canopen import ObjectDictionary

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
    _check_lengths(found, data, where)
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


def _check_lengths(messages: Sequence[_Described], data: bytes, where: str) -> None:
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


logging.getLogger("canopen").addHandler(logging.NullHandler())  # what it logs comes back as exceptions too

EDS_MOST, LINES_MOST = 2**20, 30_000
"""Bytes and lines; a drive of three thousand objects comes near. canopen takes
a second for so many."""
_COMMENT = re.compile(r"(?:^|\s)[;#].*")
_BLANKS = re.compile(r"\s+")
_ENTRY = re.compile(r"\[[^\]]+\]$|[^=:\[][^=:]*[=:]")
_EXTENDED, _UNUSED = 1 << 29, 1 << 31  # bits of a PDO's COB-ID (CiA 301)


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
    return pdo_messages(object_dictionary(data, node_id=0, where=where), where=where)


def object_dictionary(data: bytes, *, node_id: int, where: str) -> ObjectDictionary:
    """An EDS file's objects; ``$NODEID`` in it becomes ``node_id``. Raises
    ProfileError; ModuleNotFoundError without canopen."""
    from canopen.objectdictionary.eds import import_eds  # half a second, and only an EDS needs it

    text = _entries(data, where)
    try:
        objects: ObjectDictionary = import_eds(io.StringIO(text), node_id)  # type: ignore[no-untyped-call]
    except configparser.MissingSectionHeaderError as e:  # its message shows what is there instead
        raise ProfileError(f"{where}: not an EDS file: line {e.lineno}: expected [section]") from e
    except (configparser.Error, ValueError, KeyError, TypeError, AttributeError) as e:
        raise ProfileError(f"{where}: not an EDS file: {clipped(' '.join(str(e).split()), 200)}") from e
    return objects


def _entries(data: bytes, where: str) -> str:
    """The file's text without comments, blanks single. Raises ProfileError
    where a line is none of an EDS.

    Of such lines, and of long runs of blanks, configparser takes their square,
    and its message shows what they hold.
    """
    if len(data) > EDS_MOST:
        raise ProfileError(f"{where}: larger than the {size(EDS_MOST)} that an EDS file may have")
    if data.count(b"\n") > LINES_MOST:
        raise ProfileError(f"{where}: more than the {LINES_MOST} lines that an EDS file may have")
    lines = []
    for number, line in enumerate(data.decode("utf-8", "replace").split("\n"), 1):
        bare = _BLANKS.sub(" ", _COMMENT.sub("", line)).strip()
        if bare and not _ENTRY.match(bare):
            raise ProfileError(f"{where}: not an EDS file: line {number}: expected [section] or key=value")
        lines.append(bare)
    return "\n".join(lines)


def pdo_messages(objects: ObjectDictionary, *, where: str) -> list[Message]:
    """The TPDOs in use, by their mapping (0x1A00…) and COB-ID (0x1800…);
    signals are named ``0x2300:01``."""
    messages = []
    for number in range(512):
        if 0x1800 + number not in objects:
            continue
        cob_id = _default(objects, 0x1800 + number, 1, where)
        if cob_id & _UNUSED:
            continue
        extended = bool(cob_id & _EXTENDED)
        identifier = cob_id & (0x1FFFFFFF if extended else 0x7FF)
        relative = getattr(objects.get_variable(0x1800 + number, 1), "relative", False)  # it says $NODEID
        signals = _mapped(objects, number, where)
        messages.append(Message(f"TPDO{number + 1}", identifier, signals, extended, relative))
    return messages


def _default(objects: ObjectDictionary, index: int, subindex: int, where: str) -> int:
    variable = objects.get_variable(index, subindex)
    if variable is None or not isinstance(variable.default, int):
        raise ProfileError(f"{where}: object 0x{index:04X}:{subindex:02X} has no default value")
    return variable.default


def _mapped(objects: ObjectDictionary, number: int, where: str) -> dict[str, Signal]:
    signals: dict[str, Signal] = {}
    start = 0
    for entry in range(1, _default(objects, 0x1A00 + number, 0, where) + 1):
        word = _default(objects, 0x1A00 + number, entry, where)
        index, subindex, length = word >> 16, word >> 8 & 0xFF, word & 0xFF
        if index >= 0x20:  # below are the data types, mapped as a filler
            signal = _mapped_signal(objects, index, subindex, start, length, f"{where}: TPDO{number + 1}")
            signals[signal.name] = signal
        start += length
    if start > 64:
        raise ProfileError(f"{where}: TPDO{number + 1} maps {start} bits, which is more than 64")
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
