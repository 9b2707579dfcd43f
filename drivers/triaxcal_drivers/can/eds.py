"""Objects and PDOs of a CANopen device, from its EDS or DCF (CiA 306). No I/O.

People write these files by hand and by many tools. This file reads what the
standard leaves open or tools leave out (letter case, order, sections and keys
that no PDO needs), names what has two meanings, and hands canopen the rest.
"""

from __future__ import annotations

import configparser
import io
import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from triaxcal_drivers.can.message import Message, Signal
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.files import size
from triaxcal_drivers.hints import clipped

if TYPE_CHECKING:
    from canopen import ObjectDictionary

logging.getLogger("canopen").addHandler(logging.NullHandler())  # what it logs comes back as exceptions too

EDS_MOST, LINES_MOST = 2**20, 30_000
"""Bytes and lines; a drive of three thousand objects comes near. canopen takes
a second for so many."""
STANDARD_MOST = 0x7FF  # the highest identifier of 11 bits
_DISABLED, _EXTENDED = 1 << 31, 1 << 29  # bits of a PDO's COB-ID (CiA 301)
MAPPED_MOST = 64  # objects in a PDO (CiA 301)
COMPACT_MOST = 5000  # members that compact storage stands for; 512 PDOs of eight bytes map 4096
_COMMENT = re.compile(r"(?:^|\s)[;#].*")
_BLANKS = re.compile(r"\s+")
_SECTION = re.compile(r"\[([^\]]+)\]$")
_ENTRY = re.compile(r"([^=:\[][^=:]*)[=:](.*)")
_OBJECT = re.compile(r"([0-9A-F]{1,4})(?:SUB([0-9A-F]{1,2})|(VALUE))?", re.IGNORECASE)
_NODE_ID = re.compile(r"\$NODEID", re.IGNORECASE)
_INTEGER = re.compile(r"0X[0-9A-F]{1,16}|[0-9]{1,20}")
_COUNTS = ("lines", "nrofentries", "subnumber", "compactsubobj")
_VALUES = ("ParameterValue", "DefaultValue")  # the configured one of a DCF first
_VAR, _ARRAY, _RECORD = 0x7, 0x8, 0x9  # object types
_OCTETS = 0xF  # data type of what has none: DOMAIN
_UNSIGNED8 = 0x5
_COMMUNICATION = 0x1000  # below are data types
_PDOS = range(0x1800, 0x1C00)  # communication and mapping of the TPDOs
_Keys = dict[str, str]
"""Values of a section by key in lower case."""


def number(text: str) -> tuple[int, bool] | None:
    """A number as in a file (decimal, 0x…, octal with a leading 0; terms are
    added), and whether ``$NODEID`` is one of the terms; None where it is none."""
    terms = [term.strip() for term in text.upper().split("+")]
    plain = [term for term in terms if term != "$NODEID"]
    if len(terms) - len(plain) > 1 or not all(map(_INTEGER.fullmatch, plain)):
        return None
    return sum(map(_integer, plain)), len(plain) < len(terms)


def _integer(text: str) -> int:
    if text.startswith("0X"):
        return int(text, 16)
    octal = text.startswith("0") and not set(text) & set("89")
    return int(text, 8 if octal else 10)


def value(objects: ObjectDictionary, index: int, subindex: int) -> tuple[int, bool]:
    """The number that an object holds: its ``ParameterValue``, else its
    ``DefaultValue``; and whether the node's number comes on top.

    Raises ProfileError without the file's name.
    """
    variable = objects.get_variable(index, subindex)
    raw = next(filter(None, (getattr(variable, name, "") for name in ("value_raw", "default_raw"))), "")
    place = f"object 0x{index:04X}:{subindex:02X}"
    if not raw:
        raise ProfileError(f"{place} has no default value and no ParameterValue")
    found = number(raw)
    if found is None:
        raise ProfileError(f"{place} holds '{clipped(raw)}', expected a number, or $NODEID+number")
    return found


def object_dictionary(data: bytes, *, node_id: int, where: str) -> ObjectDictionary:
    """The objects of an EDS or DCF; ``$NODEID`` in it becomes ``node_id``.
    Raises ProfileError; ModuleNotFoundError without canopen."""
    from canopen.objectdictionary.eds import import_eds  # half a second, and only an EDS needs it

    objects = _objects(_sections(data, where), where)
    if not objects:
        raise ProfileError(f"{where}: not an EDS file: there is no object in it, as [1000]")
    text = "\n".join(_written(objects))
    try:
        found: ObjectDictionary = import_eds(io.StringIO(text), node_id)  # type: ignore[no-untyped-call]
    except (configparser.Error, ValueError, KeyError, TypeError, AttributeError) as e:
        raise ProfileError(f"{where}: not an EDS file: {clipped(' '.join(str(e).split()), 200)}") from e
    return found


# From text to sections.


def _sections(data: bytes, where: str) -> dict[str, _Keys]:
    """Sections by name in lower case. Raises ProfileError with the line."""
    if len(data) > EDS_MOST:
        raise ProfileError(f"{where}: larger than the {size(EDS_MOST)} that an EDS file may have")
    if data.count(b"\n") > LINES_MOST:
        raise ProfileError(f"{where}: more than the {LINES_MOST} lines that an EDS file may have")
    sections: dict[str, _Keys] = {}
    first: dict[tuple[str, str], int] = {}  # line of each section, and of each of its keys
    name, shown = None, ""
    for at, line in enumerate(data.decode("utf-8-sig", "replace").split("\n"), 1):
        bare = _BLANKS.sub(" ", _COMMENT.sub("", line)).strip()
        lead = f"{where}: not an EDS file: line {at}: "
        section, entry = _SECTION.match(bare), _ENTRY.match(bare)
        if not bare:
            continue
        if section:
            name, key, shown = section[1].strip().lower(), "", clipped(bare)
        elif entry and name is not None:
            key = entry[1].strip().lower()
        else:
            raise ProfileError(f"{lead}expected [section]{'' if name is None else ' or key=value'}")
        if (name, key) in first:
            what = f"{clipped(entry[1].strip())} of {shown}" if entry else shown
            raise ProfileError(f"{lead}{what} a second time, first in line {first[name, key]}; delete one")
        first[name, key] = at
        if section:
            sections[name] = {}
        elif entry:
            sections[name][key] = entry[2].strip()
            _check_count(key, entry[2].strip(), f"{lead}{shown} {clipped(entry[1].strip())}")
    return sections


def _check_count(key: str, text: str, lead: str) -> None:
    """Raises ProfileError where the file says that it has more of something than
    it can have."""
    found = number(text) if key in _COUNTS else None
    if found is not None and found[0] > LINES_MOST:
        raise ProfileError(f"{lead}={clipped(text)}, expected at most {LINES_MOST}")


# From sections to objects as canopen reads them.


@dataclass
class _Object:
    keys: _Keys = field(default_factory=dict)
    members: dict[int, _Keys] = field(default_factory=dict)  # by sub-index

    def count(self, key: str) -> int:
        found = number(self.keys.get(key.lower(), ""))
        return found[0] if found else 0


def _objects(sections: Mapping[str, _Keys], where: str) -> dict[int, _Object]:
    """Objects by index; sections of anything else are passed over. Raises
    ProfileError where two are of one object."""
    objects: dict[int, _Object] = {}
    values: dict[int, _Keys] = {}
    for name, keys in sections.items():
        found = _OBJECT.fullmatch(name)
        if found is None:
            continue
        index = int(found[1], 16)
        if found[3]:
            values[index] = keys
        elif found[2]:
            members, subindex = objects.setdefault(index, _Object()).members, int(found[2], 16)
            if subindex in members:
                raise ProfileError(f"{where}: not an EDS file: [{name}] is 0x{index:04X}:{subindex:02X} a second time")
            members[subindex] = keys
        else:
            objects.setdefault(index, _Object()).keys = keys
    pdos = [index for index in _PDOS if index in objects]
    if sum(min(objects[index].count("CompactSubObj"), MAPPED_MOST) for index in pdos) > COMPACT_MOST:
        raise ProfileError(f"{where}: not an EDS file: CompactSubObj of PDOs: more than {COMPACT_MOST} in all")
    for index in pdos:
        _expand(objects[index], values.get(index, {}))
    return objects


def _expand(described: _Object, values: _Keys) -> None:
    """Gives a PDO the members that compact storage (CiA 306) leaves out:
    ``CompactSubObj``, and the section [1A00Value] of a DCF."""
    count = min(described.count("CompactSubObj"), MAPPED_MOST)
    if count:
        described.members.setdefault(0, {"datatype": str(_UNSIGNED8), "defaultvalue": str(count)})
        for subindex in range(1, count + 1):
            described.members.setdefault(subindex, dict(described.keys))
        described.keys = {key: text for key, text in described.keys.items() if key != "compactsubobj"}
    for key, text in values.items():
        place = number(key)
        if place is not None and place[0] in described.members:
            described.members[place[0]] = {**described.members[place[0]], "parametervalue": text}


def _written(objects: Mapping[int, _Object]) -> Iterator[str]:
    yield "[DeviceInfo]"  # canopen warns where there is none
    for index, described in sorted(objects.items()):
        if index < _COMMUNICATION:  # of the data types canopen takes number alone
            yield from _data_type(index, described)
            continue
        compact = described.count("CompactSubObj")
        default = _RECORD if described.members else _VAR
        kind = _ARRAY if compact else described.count("ObjectType") or default
        extra = [f"CompactSubObj={compact}"] if compact else []
        yield from _section(f"{index:04X}", described.keys, kind, extra)
        for subindex, keys in sorted(described.members.items()):
            yield from _section(f"{index:04X}sub{subindex:X}", keys, _VAR)


def _section(name: str, keys: _Keys, kind: int, extra: list[str] | None = None) -> Iterator[str]:
    yield f"[{name}]"
    yield f"ParameterName={keys.get('parametername') or name}"
    yield f"ObjectType=0x{kind:X}"
    found = number(keys.get("datatype", ""))
    yield f"DataType=0x{found[0] if found else _OCTETS:04X}"
    yield f"AccessType={keys.get('accesstype') or 'rw'}"
    for key in _VALUES:
        if text := keys.get(key.lower()):
            yield f"{key}={_NODE_ID.sub('$NODEID', text)}"
    if factor := keys.get("factor"):
        yield f"Factor={factor}"
    yield from extra or ()


def _data_type(index: int, described: _Object) -> Iterator[str]:
    """A data type of its own, whose member 1 names the type that it is made of."""
    found = number(described.members.get(1, {}).get("defaultvalue", ""))
    if found:
        yield f"[{index:X}sub1]"
        yield f"DefaultValue=0x{found[0]:X}"


# PDOs.


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
