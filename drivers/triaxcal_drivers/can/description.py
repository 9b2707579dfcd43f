"""The messages of a stream, out of the DBC or EDS file that it names: the only
place that reads an EDS."""

from __future__ import annotations

import configparser
import io
import logging
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING

from triaxcal_drivers.can.dbc import dbc_messages
from triaxcal_drivers.can.layout import Layout, Message, Signal, arrange
from triaxcal_drivers.can.model import CanStream, DbcStream
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.files import size
from triaxcal_drivers.nearest import clipped

if TYPE_CHECKING:
    from canopen import ObjectDictionary

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
