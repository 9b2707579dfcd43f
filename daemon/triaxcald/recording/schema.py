"""Format of a recording: its topics, its protobuf messages, which are built at run
time, and the digest of its raw records.

Only this module is common to reader and writer. Ids of schemas and channels are
fixed, so `recover` can read a recording whose first chunk, which declares them, is
lost.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from numpy.typing import NDArray

import triaxcal_drivers as td

FORMAT = "triaxcal.recording/1"
FORMAT_RECORD = "recording"  # the metadata record with FORMAT, and with ENDS_WITH in a recording of a run
ENDS_WITH = "ends_with"  # its key for the name of the document that ends a complete recording
RAW_RECORD = "raw"  # the metadata record with count and digest, written at the end
PHASE_KEY = "phase "  # prefix of its keys with the counts of a phase, which follows
END_RECORD = "end"  # the metadata record with the digest of the document that the recording ends with
SIGNATURE_FILE = "manifest.dsse.json"  # the attachment with the signature, after the document that ends a recording
SENT = "sent"  # the kind of the event about a frame that a sequence of the profile sent
IMPORTED = "imported"  # the kind of the event about the log that a recording was imported from
RECOVERY_RECORD = "recovery"  # the metadata record of a recovered recording
SEALED_LATER = "sealed_later"  # its key with the name of a document that was not in the recording
BUS_RECORD = "bus"  # the metadata record of a recording of all frames of a bus, in place of `unit`
SEGMENT_RECORD = "segment"  # the metadata record with the place of a segment in its recording
UNCONFIRMED = "unconfirmed"  # the metadata record, and event, about records of an unknown sender
STATION_FILE = "station.toml"  # the attachment with the station file
ODDS_FILE = "odds.json"  # the attachment with learned odds
PROFILE_FILE = "profile.toml"
"""The attachment with the profile; the files that it names are attachments under
``profile/``."""
PROFILE = "triaxcal"  # in the header of the MCAP file

Phase = Literal["calibration", "verification"]
CALIBRATION: Phase = "calibration"
VERIFICATION: Phase = "verification"
BUS_PHASE = "bus/"  # prefix of the phases of a bus recording, one for each channel
PreviewTopic = Literal["/preview/readings", "/preview/corrected"]
Operation = Literal["read", "write"]

RAW, REGISTERS, EVENTS, LOSS = "/raw", "/registers", "/events", "/loss"
PREVIEWS: tuple[PreviewTopic, PreviewTopic] = ("/preview/readings", "/preview/corrected")
PREVIEW_HZ = 20.0  # enough to see a pose, and few beside the raw records
_U64_DIGITS = 20
MAX_RECORDS = 8192  # raw records in one message; a longer batch is divided, so that reading needs little memory

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
    "Timed": (("time_ns", _F.TYPE_FIXED64, False),),  # the common start of all messages except a raw batch
}


@dataclass(frozen=True)
class RegisterAccess:
    """``raw`` are the bytes on the wire, most significant first. ``error`` is empty
    after success. ``unanswered``: no reply came, not even a refusal."""

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
    """``records`` of the topic ``where`` that were dropped before they reached the
    file.

    ``first`` is the running index of the first one; only the raw topic has it.
    """

    time_ns: int
    where: str
    first: int
    records: int
    reason: str


@dataclass(frozen=True)
class Schema:
    """One message type: its declaration for MCAP, and its class."""

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

# RawBatch with its packed columns and its phase as bytes, which are the same on the
# wire. Recordings declare the message with numbers.
RAW_COLUMNS: Any = _schema(
    "RawBatch",
    [
        (name, _F.TYPE_BYTES if repeated or kind == _F.TYPE_STRING else kind, False)
        for name, kind, repeated in _MESSAGES["RawBatch"]
    ],
).message

# (topic, message) in the order of their ids, which start at 1. The schema of the
# previews differs between recordings.
CHANNELS: Sequence[tuple[str, str]] = (
    (RAW, "RawBatch"),
    (REGISTERS, "RegisterAccess"),
    (EVENTS, "Event"),
    (LOSS, "Loss"),
)


def preview_schema(channels: Sequence[str]) -> Schema:
    """The preview message, with one double field for each auxiliary channel, so that
    Foxglove can plot it."""
    vector = [("time_ns", _F.TYPE_FIXED64, False)] + [(axis, _F.TYPE_DOUBLE, False) for axis in "xyz"]
    named = [(field, _F.TYPE_DOUBLE, False) for field in preview_fields(channels)]
    return _schema("Preview", vector + named)


def preview_channels(profile: td.Profile) -> list[str]:
    """Auxiliary channels in the previews of a recording, beside the three outputs."""
    names: dict[str, None] = {}
    for stream in profile.streams.values():
        names |= dict.fromkeys(n for n in getattr(stream, "channels", {}) if n not in ("ux", "uy", "uz"))
    return list(names)


def preview_fields(channels: Sequence[str]) -> list[str]:
    """The channels' field names, of letters, digits and underscores. All differ from
    each other and from the time and the axes."""
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
    """Raises ValueError if ``data`` is no message ``name``."""
    try:
        return SCHEMAS[name].message.FromString(data)
    except DecodeError as e:
        raise ValueError(f"not a message {name}") from e


def cut(batch: td.RawBatch, records: int = MAX_RECORDS) -> Iterator[td.RawBatch]:
    """The batch in pieces of at most ``records``."""
    for start in range(0, max(len(batch), 1), records):
        yield batch.part(start, min(start + records, len(batch)))


@dataclass
class PhaseCount:
    """Raw records of a phase, the bytes of their payloads, and the earliest and latest
    host time."""

    records: int
    bytes: int
    start_ns: int
    end_ns: int

    @classmethod
    def of(cls, batch: td.RawBatch) -> PhaseCount:
        """``batch`` is not empty."""
        return cls(len(batch), len(batch.payload), int(batch.time_ns.min()), int(batch.time_ns.max()))

    @classmethod
    def read(cls, text: str) -> PhaseCount:
        """As `RawDigest.record` writes it. Raises ValueError."""
        counts = json.loads(text)
        if not isinstance(counts, list) or len(counts) != 4 or not all(type(n) is int for n in counts):
            raise ValueError("not the counts of a phase")
        return cls(*counts)

    def add(self, other: PhaseCount) -> None:
        self.records, self.bytes = self.records + other.records, self.bytes + other.bytes
        self.start_ns, self.end_ns = min(self.start_ns, other.start_ns), max(self.end_ns, other.end_ns)


class RawDigest:
    """SHA-256 over raw records. It does not depend on how they are divided into
    batches, nor on how the phases are interleaved.

    Each phase has two running hashes, one over the records' fixed-width columns and
    one over their payloads. ``ends_with`` is the name of the document that ends the
    recording. The digest covers it, so nobody can remove the end and leave a
    recording that looks like an older one.
    """

    _RECORD = np.dtype([("time_ns", "<i8"), ("source", "<u4"), ("flags", "u1"), ("length", "<u2")])

    def __init__(self, ends_with: str = "") -> None:
        self.records = 0
        self.ends_with = ends_with
        self.phases: dict[str, PhaseCount] = {}
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
        count = PhaseCount.of(batch)
        if phase in self.phases:
            self.phases[phase].add(count)
        else:
            self.phases[phase] = count

    def record(self) -> dict[str, str]:
        """The metadata record: number and digest of the records, and the counts of each
        phase, which `log info` takes from there."""
        counts = {PHASE_KEY + phase: json.dumps(list(vars(c).values())) for phase, c in self.phases.items()}
        return {"records": str(self.records), "sha256": self.hexdigest(), **counts}

    def hexdigest(self) -> str:
        whole = hashlib.sha256(self.ends_with.encode())
        for phase in sorted(self._phases):
            columns, payloads = self._phases[phase]
            whole.update(hashlib.sha256(phase.encode()).digest() + columns.digest() + payloads.digest())
        return whole.hexdigest()


def first_index(metadata: Mapping[str, Mapping[str, str]]) -> int:
    """Running index of a recording's first raw record. A segment continues the index of
    the previous one."""
    text = metadata.get(SEGMENT_RECORD, {}).get("first", "")
    return int(text) if text.isdecimal() and len(text) < _U64_DIGITS else 0


def unconfirmed_from(metadata: Mapping[str, Mapping[str, str]]) -> int | None:
    """Running index of the first unconfirmed raw record, in this file or in an earlier
    segment; None if all are confirmed. All records from there to the end of the file
    are unconfirmed."""
    text = metadata.get(UNCONFIRMED, {}).get("first", "")
    return int(text) if text.isdecimal() and len(text) < _U64_DIGITS else None


class PreviewEncoder:
    """Encodes single samples as messages, with a field for each of ``channels``."""

    def __init__(self, channels: Sequence[str]) -> None:
        self.kind = preview_schema(channels)
        self._fields = dict(zip(channels, preview_fields(channels), strict=True))

    def encode(self, block: td.SampleBlock, i: int) -> bytes:
        x, y, z = block.readings[i].tolist()
        named = {f: float(block.channels[c][i]) for c, f in self._fields.items() if c in block.channels}
        return bytes(self.kind.message(time_ns=int(block.time_ns[i]), x=x, y=y, z=z, **named).SerializeToString())


class Decimator:
    """Picks at most one sample of each period of the samples' own time. The choice does
    not depend on how they are divided into blocks."""

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


# A batch of raw records as a message, column by column. The declared message makes
# every number a Python object, which takes longer than all other work on a record. A
# batch is therefore written and read by `RAW_COLUMNS`, in which a column is bytes.

_STEP_MOST_NS = 2**31 - 1


class Fields(NamedTuple):
    """Fields of a raw batch, its columns as bytes. A missing field is empty."""

    first: int = 0
    phase: bytes = b""
    time_ns: bytes = b""
    source: bytes = b""
    flags: bytes = b""
    length: bytes = b""
    payload: bytes = b""
    start_ns: int = 0
    step_ns: bytes = b""


_values = attrgetter(*Fields._fields)
_COLUMNS: Mapping[str, str] = {"time_ns": "<u8", "source": "<u4", "length": "<u4", "step_ns": "<i4"}
_WIDTHS = {name: np.dtype(kind).itemsize for name, kind in _COLUMNS.items()}


def encode_raw(first: int, phase: str, batch: td.RawBatch) -> bytes:
    """``first`` is the running index of the batch's first record among all records
    that came.

    Frames of a bus have the first time and the steps between them, which takes a
    quarter of the room, if all steps are below 2.1 s. Records of a unit always have
    their times.
    """
    start_ns, time_ns, step_ns = 0, b"", b""
    step = np.diff(batch.time_ns) if phase.startswith(BUS_PHASE) else None
    if step is not None and len(batch) and batch.time_ns[0] > 0 and np.all(np.abs(step) <= _STEP_MOST_NS):
        start_ns, step_ns = int(batch.time_ns[0]), step.astype("<i4").tobytes()
    else:
        time_ns = batch.time_ns.astype("<u8").tobytes()
    message = RAW_COLUMNS(
        first=first,
        phase=phase.encode(),
        time_ns=time_ns,
        source=batch.source.astype("<u4").tobytes(),
        flags=batch.flags.tobytes(),
        length=batch.length.astype("<u4").tobytes(),
        payload=batch.payload,
        start_ns=start_ns,
        step_ns=step_ns,
    )
    return bytes(message.SerializeToString())


def decode_raw(data: bytes) -> tuple[int, str, td.RawBatch]:
    """(running index of the first record, phase, batch). Raises ValueError if ``data``
    is no raw batch."""
    fields = fields_of(data)
    return fields.first, fields.phase.decode(), batch_of([fields])


def fields_of(data: bytes) -> Fields:
    """Raises ValueError if ``data`` is no message."""
    try:
        message = RAW_COLUMNS.FromString(data)
    except DecodeError as e:
        raise ValueError("not a message RawBatch") from e
    message.DiscardUnknownFields()
    fields = Fields._make(_values(message))
    # Another writer's message has another size than its canonical form if a field
    # occurs twice or is empty, a column is not packed, or a field is of a later
    # version.
    canonical = message.ByteSize() == len(data)
    if canonical and not any(len(getattr(fields, name)) % width for name, width in _WIDTHS.items()):
        return fields
    return _of_another_writer(data)


def batch_of(messages: Sequence[Fields]) -> td.RawBatch:
    """The records of all messages in one batch. Raises ValueError if a message is
    invalid."""
    time_ns = _times_ns(messages[0]) if len(messages) == 1 else _all_times_ns(messages)
    counts = np.array([len(m.flags) for m in messages])
    most = max(max(len(m.flags), len(m.time_ns) // 8, len(m.step_ns) // 4) for m in messages)
    if most > MAX_RECORDS:
        raise ValueError(f"{most} records in one message, expected at most {MAX_RECORDS}")
    length = np.frombuffer(b"".join(m.length for m in messages), dtype="<u4")
    if np.any(length > np.iinfo(np.uint16).max):
        raise ValueError(f"a record of {length.max()} bytes, expected at most {np.iinfo(np.uint16).max}")
    batch = td.RawBatch(
        time_ns,
        np.frombuffer(b"".join(m.source for m in messages), dtype="<u4").astype(np.uint32),
        np.frombuffer(b"".join(m.flags for m in messages), dtype=np.uint8),
        length.astype(np.uint16),
        b"".join(m.payload for m in messages),
    )
    if not _each_is_whole(messages, counts, length):
        raise ValueError("columns of a message differ in length")
    return batch


def _each_is_whole(messages: Sequence[Fields], counts: NDArray[np.int64], length: NDArray[np.uint32]) -> bool:
    """Whether the columns of each message agree in length. The sums over all messages
    do not show it: one may lack what another has too much."""
    whole = all(len(m.source) == len(m.length) == 4 * len(m.flags) for m in messages)
    ends = np.concatenate([[0], np.cumsum(length, dtype=np.int64)])[np.concatenate([[0], np.cumsum(counts)])]
    return whole and np.array_equal(np.diff(ends), [len(m.payload) for m in messages])


def _all_times_ns(messages: Sequence[Fields]) -> NDArray[np.int64]:
    """Raises ValueError if a message has more or fewer times than records."""
    if all(not m.start_ns and len(m.time_ns) == 8 * len(m.flags) for m in messages):
        return np.frombuffer(b"".join(m.time_ns for m in messages), dtype="<u8").astype(np.int64)
    each = [_times_ns(m) for m in messages]
    if any(len(times) != len(m.flags) for times, m in zip(each, messages, strict=True)):
        raise ValueError("columns of a message differ in length")
    return np.concatenate(each)


def _times_ns(fields: Fields) -> NDArray[np.int64]:
    if not fields.start_ns:
        return np.frombuffer(fields.time_ns, dtype="<u8").astype(np.int64)
    if fields.time_ns:
        raise ValueError("times in two ways, expected one of them")
    steps = np.frombuffer(fields.step_ns, dtype="<i4").astype(np.int64)
    # A start beyond int64 wraps, as such a time in the column does.
    start = np.array([fields.start_ns], dtype=np.uint64).astype(np.int64)
    return np.cumsum(np.concatenate((start, steps)))


def _of_another_writer(data: bytes) -> Fields:
    """Decodes by the declared message. Raises ValueError."""
    message = parse("RawBatch", data)
    columns = {name: np.array(getattr(message, name), dtype=kind).tobytes() for name, kind in _COLUMNS.items()}
    return Fields(
        first=message.first,
        phase=message.phase.encode(),
        flags=message.flags,
        payload=message.payload,
        start_ns=message.start_ns,
        **columns,
    )
