"""What a recording holds: topics, protobuf messages built at run time, and the
digest of the raw records.

Reader and writer meet only here. Ids of schemas and channels are fixed, so that
a recording whose first chunk (the one that declares them) is lost can still be
read by `recover`.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

import triaxcal_drivers as td

FORMAT = "triaxcal.recording/1"
FORMAT_RECORD = "recording"  # the metadata record that holds FORMAT, and ENDS_WITH where it is of a run
ENDS_WITH = "ends_with"  # the key there that says in which document a whole recording ends
RAW_RECORD = "raw"  # the metadata record with count and digest, written at the end
END_RECORD = "end"  # the metadata record with the digest of the document that the recording ends with
IMPORTED = "imported"  # the kind of the event that says of which log a recording was made
RECOVERY_RECORD = "recovery"  # the metadata record of a mended recording
BUS_RECORD = "bus"  # the metadata record that takes the place of `unit` where all frames of a bus were recorded
SEGMENT_RECORD = "segment"  # the metadata record that says which part of a longer recording this is
UNCONFIRMED = "unconfirmed"  # the metadata record, and event, that says which records are of nobody known
STATION_FILE = "station.toml"  # the attachment with the station file
PROFILE_FILE = "profile.toml"
"""Name under which a recording carries the profile; the files it names stand
beside it under ``profile/``."""
PROFILE = "triaxcal"  # in the header of the MCAP file

Phase = Literal["calibration", "verification"]
CALIBRATION: Phase = "calibration"
VERIFICATION: Phase = "verification"
BUS_PHASE = "bus/"  # begins the phases of a bus recording, one for each channel
PreviewTopic = Literal["/preview/readings", "/preview/corrected"]
Operation = Literal["read", "write"]

RAW, REGISTERS, EVENTS, LOSS = "/raw", "/registers", "/events", "/loss"
PREVIEWS: tuple[PreviewTopic, PreviewTopic] = ("/preview/readings", "/preview/corrected")
PREVIEW_HZ = 20.0  # enough to see a pose by, and little beside the raw records
_U64_DIGITS = 20
MAX_RECORDS = 8192  # raw records in one message; a longer batch is cut, so that reading needs little memory

_PACKAGE = "triaxcal.recording.v1"
_F = FieldDescriptorProto
_Field = tuple[str, "FieldDescriptorProto.Type.ValueType", bool]  # name, type, repeated

_MESSAGES: Mapping[str, Sequence[_Field]] = {
    "RawBatch": (
        ("first", _F.TYPE_FIXED64, False),
        ("phase", _F.TYPE_STRING, False),
        ("time_ns", _F.TYPE_FIXED64, True),
        ("source", _F.TYPE_FIXED32, True),
        ("flags", _F.TYPE_BYTES, False),
        ("length", _F.TYPE_FIXED32, True),
        ("payload", _F.TYPE_BYTES, False),
        ("start_ns", _F.TYPE_FIXED64, False),
        ("step_ns", _F.TYPE_SFIXED32, True),
    ),
    "RegisterAccess": (
        ("time_ns", _F.TYPE_FIXED64, False),
        ("register", _F.TYPE_STRING, False),
        ("operation", _F.TYPE_STRING, False),
        ("raw", _F.TYPE_BYTES, False),
        ("error", _F.TYPE_STRING, False),
        ("unanswered", _F.TYPE_BOOL, False),
    ),
    "Event": (
        ("time_ns", _F.TYPE_FIXED64, False),
        ("kind", _F.TYPE_STRING, False),
        ("text", _F.TYPE_STRING, False),
    ),
    "Loss": (
        ("time_ns", _F.TYPE_FIXED64, False),
        ("where", _F.TYPE_STRING, False),
        ("first", _F.TYPE_FIXED64, False),
        ("records", _F.TYPE_FIXED64, False),
        ("reason", _F.TYPE_STRING, False),
    ),
    "Timed": (("time_ns", _F.TYPE_FIXED64, False),),  # what begins every message but a raw batch
}


@dataclass(frozen=True)
class RegisterAccess:
    """``raw`` is what went over the wire, most significant byte first;
    ``error`` is empty where it worked. ``unanswered``: nothing came back, not
    even a refusal."""

    time_ns: int
    register: str
    operation: Operation
    raw: bytes
    error: str = ""
    unanswered: bool = False


@dataclass(frozen=True)
class Event:
    """``text`` is a JSON object."""

    time_ns: int
    kind: str
    text: str

    @property
    def detail(self) -> Any:
        return json.loads(self.text)


@dataclass(frozen=True)
class Loss:
    """``records`` dropped before they reached the file; ``where`` is the topic
    they were meant for.

    ``first`` is the running index of the first of them, for the raw topic
    alone.
    """

    time_ns: int
    where: str
    first: int
    records: int
    reason: str


@dataclass(frozen=True)
class Schema:
    """One message type as MCAP wants it declared, and its class."""

    name: str
    data: bytes
    message: Any


def _schema(name: str, fields: Sequence[_Field]) -> Schema:
    file = FileDescriptorProto(name=f"triaxcal/recording/v1/{name.lower()}.proto", package=_PACKAGE, syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (field, kind, repeated) in enumerate(fields, start=1):
        label = _F.LABEL_REPEATED if repeated else _F.LABEL_OPTIONAL
        message.field.add(name=field, number=number, type=kind, label=label)
    pool = DescriptorPool()
    pool.Add(file)
    full_name = f"{_PACKAGE}.{name}"
    data = FileDescriptorSet(file=[file]).SerializeToString()
    return Schema(full_name, data, GetMessageClass(pool.FindMessageTypeByName(full_name)))


SCHEMAS: Mapping[str, Schema] = {name: _schema(name, fields) for name, fields in _MESSAGES.items()}

# The class of RawBatch in which packed columns, and the phase, are bytes: these
# are the same on the wire. Recordings declare the other.
RAW_COLUMNS: Any = _schema(
    "RawBatch",
    [
        (name, _F.TYPE_BYTES if repeated or kind == _F.TYPE_STRING else kind, False)
        for name, kind, repeated in _MESSAGES["RawBatch"]
    ],
).message

# (topic, message) in the order of their ids, which start at 1; the preview's
# schema differs per recording.
CHANNELS: Sequence[tuple[str, str]] = (
    (RAW, "RawBatch"),
    (REGISTERS, "RegisterAccess"),
    (EVENTS, "Event"),
    (LOSS, "Loss"),
)


def preview_schema(channels: Sequence[str]) -> Schema:
    """The preview message with one plain double field for each auxiliary
    channel, for Foxglove to plot."""
    vector = [("time_ns", _F.TYPE_FIXED64, False)] + [(axis, _F.TYPE_DOUBLE, False) for axis in "xyz"]
    named = [(field, _F.TYPE_DOUBLE, False) for field in preview_fields(channels)]
    return _schema("Preview", vector + named)


def preview_channels(profile: td.Profile) -> list[str]:
    """Auxiliary channels that the previews of a recording have beside the three
    outputs."""
    names: dict[str, None] = {}
    for stream in profile.streams.values():
        names |= dict.fromkeys(n for n in getattr(stream, "channels", {}) if n not in ("ux", "uy", "uz"))
    return list(names)


def preview_fields(channels: Sequence[str]) -> list[str]:
    """The channels' field names: letters, digits and underscores, none twice,
    none hiding time or an axis."""
    taken = {"time_ns", "x", "y", "z"}
    fields = []
    for channel in channels:
        field = re.sub(r"\W", "_", channel, flags=re.ASCII)
        if not re.match(r"[A-Za-z_]", field):
            field = f"_{field}"
        while field in taken:
            field += "_"
        taken.add(field)
        fields.append(field)
    return fields


def encode(value: RegisterAccess | Event | Loss) -> bytes:
    message = SCHEMAS[type(value).__name__].message(**vars(value))
    return bytes(message.SerializeToString())


def decode_register_access(data: bytes) -> RegisterAccess:
    m = parse("RegisterAccess", data)
    return RegisterAccess(m.time_ns, m.register, m.operation, m.raw, m.error, m.unanswered)


def decode_event(data: bytes) -> Event:
    m = parse("Event", data)
    return Event(m.time_ns, m.kind, m.text)


def decode_loss(data: bytes) -> Loss:
    m = parse("Loss", data)
    return Loss(m.time_ns, m.where, m.first, m.records, m.reason)


def decode_time(data: bytes) -> int:
    """The time of any message but a raw batch. Raises ValueError."""
    return int(parse("Timed", data).time_ns)


def parse(name: str, data: bytes) -> Any:
    """Raises ValueError where ``data`` is no message ``name``."""
    try:
        return SCHEMAS[name].message.FromString(data)
    except DecodeError as e:
        raise ValueError(f"not a message {name}") from e


def cut(batch: td.RawBatch, records: int = MAX_RECORDS) -> Iterator[td.RawBatch]:
    """The batch in pieces of at most ``records``."""
    for start in range(0, max(len(batch), 1), records):
        yield batch.part(start, min(start + records, len(batch)))


class RawDigest:
    """SHA-256 over raw records, the same however they are cut into batches and
    the phases interleaved.

    Each phase has two running hashes, over the records' fixed-width columns and
    over their payloads. ``ends_with`` is what the recording says that it ends
    with: the digest is of it too, so that nobody can take the end away and
    leave a recording that looks like an older one.
    """

    _RECORD = np.dtype([("time_ns", "<i8"), ("source", "<u4"), ("flags", "u1"), ("length", "<u2")])

    def __init__(self, ends_with: str = "") -> None:
        self.records = 0
        self.ends_with = ends_with
        self._phases: dict[str, tuple[hashlib._Hash, hashlib._Hash]] = {}

    def update(self, phase: str, batch: td.RawBatch) -> None:
        if not len(batch):
            return
        columns, payloads = self._phases.setdefault(phase, (hashlib.sha256(), hashlib.sha256()))
        table = np.empty(len(batch), dtype=self._RECORD)
        for name in ("time_ns", "source", "flags", "length"):
            table[name] = getattr(batch, name)
        columns.update(table.tobytes())
        payloads.update(batch.payload)
        self.records += len(batch)

    def hexdigest(self) -> str:
        whole = hashlib.sha256(self.ends_with.encode())
        for phase in sorted(self._phases):
            columns, payloads = self._phases[phase]
            whole.update(hashlib.sha256(phase.encode()).digest() + columns.digest() + payloads.digest())
        return whole.hexdigest()


def first_index(metadata: Mapping[str, Mapping[str, str]]) -> int:
    """The running index of a recording's first raw record; a segment begins
    where the one before it ended."""
    told = metadata.get(SEGMENT_RECORD, {}).get("first", "")
    return int(told) if told.isdecimal() and len(told) < _U64_DIGITS else 0


def unconfirmed_from(metadata: Mapping[str, Mapping[str, str]]) -> int | None:
    """The running index of the first raw record that is unconfirmed, of this
    file or of an earlier segment; None where all are confirmed. All records
    from there to the end of the file are unconfirmed."""
    told = metadata.get(UNCONFIRMED, {}).get("first", "")
    return int(told) if told.isdecimal() and len(told) < _U64_DIGITS else None


class PreviewEncoder:
    """Single samples as messages, with a field for each of ``channels``."""

    def __init__(self, channels: Sequence[str]) -> None:
        self.kind = preview_schema(channels)
        self._fields = dict(zip(channels, preview_fields(channels), strict=True))

    def encode(self, block: td.SampleBlock, i: int) -> bytes:
        x, y, z = block.readings[i].tolist()
        named = {f: float(block.channels[c][i]) for c, f in self._fields.items() if c in block.channels}
        return bytes(self.kind.message(time_ns=int(block.time_ns[i]), x=x, y=y, z=z, **named).SerializeToString())


class Decimator:
    """Picks at most one sample of each period of the samples' own time, however
    they are cut into blocks."""

    def __init__(self, rate_hz: float = PREVIEW_HZ) -> None:
        self._period_ns = max(1, round(1e9 / rate_hz))
        self._last_slot = -1

    def pick(self, block: td.SampleBlock) -> list[int]:
        """Indices into ``block`` of the samples to keep."""
        if not len(block):
            return []
        slot = block.time_ns // self._period_ns
        before = np.concatenate(([self._last_slot], slot[:-1]))
        self._last_slot = int(slot[-1])
        return [int(i) for i in np.flatnonzero(slot != before)]
