"""Messages out of DBC and EDS files: the only place that reads either."""

from __future__ import annotations

import configparser
import io
import logging
from collections.abc import Mapping

import cantools
import cantools.database
from canopen import ObjectDictionary
from canopen.objectdictionary import datatypes
from canopen.objectdictionary.eds import import_eds
from cantools.database.can import Database

from triaxcal_drivers.can.layout import Layout, Message, Signal, arrange
from triaxcal_drivers.can.model import CanStream, DbcStream
from triaxcal_drivers.errors import ProfileError

logging.getLogger("canopen").addHandler(logging.NullHandler())  # what it logs comes back as exceptions too

_EXTENDED, _UNUSED = 1 << 29, 1 << 31  # bits of a PDO's COB-ID (CiA 301)


def stream_layout(stream: CanStream, files: Mapping[str, bytes], *, where: str) -> Layout:
    """The layout of a stream in the file it names. Raises ProfileError."""
    data = files[stream.file]
    place = f"{stream.file} ({where})"
    if isinstance(stream, DbcStream):
        messages = dbc_messages(data, base_node_id=stream.base_node_id, where=stream.file)
    else:
        messages = pdo_messages(object_dictionary(data, node_id=0, where=stream.file), where=stream.file)
    return arrange(messages, stream, where=place)


def dbc_messages(data: bytes, *, base_node_id: int | None, where: str) -> list[Message]:
    """Every message of a DBC file; multiplexed signals, which only some frames hold, are left out."""
    try:
        # Overlapping signals elsewhere in a vehicle's DBC are none of our business: strict is off.
        database = cantools.database.load_string(data.decode("cp1252", "replace"), "dbc", strict=False)
    except cantools.Error as e:
        raise ProfileError(f"{where}: not a DBC file: {' '.join(str(e).split())}") from e
    assert isinstance(database, Database)  # the other kind is for CDD files
    messages = []
    for m in database.messages:
        signals = {
            s.name: Signal(
                s.name, s.start, s.length, s.byte_order == "big_endian", s.is_signed, s.conversion.is_float,
                float(s.conversion.scale), float(s.conversion.offset),
            )
            for s in m.signals
            if not s.multiplexer_ids
        }  # fmt: skip
        for signal in signals.values():
            _check(signal, m.name, m.length, where)
        identifier = m.frame_id - (base_node_id or 0)
        messages.append(Message(m.name, identifier, signals, m.is_extended_frame, base_node_id is not None))
    return messages


def _check(signal: Signal, message: str, length: int, where: str) -> None:
    if signal.is_float and signal.length not in (16, 32, 64):
        raise ProfileError(f"{where}: signal '{signal.name}' is a float of {signal.length} bits")
    if not 1 <= signal.length <= 64 or signal.size > length:
        raise ProfileError(f"{where}: signal '{signal.name}' does not fit the {length} bytes of message '{message}'")


def object_dictionary(data: bytes, *, node_id: int, where: str) -> ObjectDictionary:
    """An EDS file's objects; ``$NODEID`` in it becomes ``node_id``. Raises ProfileError."""
    text = io.StringIO(data.decode("utf-8", "replace"))
    try:
        objects: ObjectDictionary = import_eds(text, node_id)  # type: ignore[no-untyped-call]
    except (configparser.Error, ValueError, KeyError, TypeError, AttributeError) as e:
        raise ProfileError(f"{where}: not an EDS file: {' '.join(str(e).split())}") from e
    return objects


def pdo_messages(objects: ObjectDictionary, *, where: str) -> list[Message]:
    """The TPDOs in use, by their mapping (0x1A00…) and COB-ID (0x1800…); signals are named ``0x2300:01``."""
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
    name = f"0x{index:04X}:{subindex:02X}"
    variable = objects.get_variable(index, subindex)
    if variable is None:
        raise ProfileError(f"{where} maps {name}, which is not an object of the file")
    if len(variable) != length or variable.data_type not in datatypes.NUMBER_TYPES:
        raise ProfileError(f"{where} maps {length} bits of {name}, which is not a number of that size")
    signed = variable.data_type in datatypes.SIGNED_TYPES
    is_float = variable.data_type in datatypes.FLOAT_TYPES
    return Signal(name, start, length, False, signed, is_float, float(variable.factor))
