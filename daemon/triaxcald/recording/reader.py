"""Reads a recording, be it one file or segments read as one, in bounded memory: one
chunk at a time. Data that fails its CRC is rejected."""

from __future__ import annotations

import hashlib
import sys
import tomllib
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, NamedTuple, Self, TypeVar

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, Message, Metadata, Schema

import triaxcal_drivers as td
from triaxcald.errors import DiskError, RecordingError
from triaxcald.files import is_of_the_disk
from triaxcald.recording import schema
from triaxcald.recording.manifest import Manifest, Segment, is_manifest, load_manifest, segments_listed
from triaxcald.recording.mcap_records import (
    HEAD,
    MAGIC,
    CutShort,
    Damage,
    Unpacked,
    UnparsedRecord,
    check_magic,
    chunk_data,
    chunk_records,
    footer_fits,
    indexed_times_ns,
    parse,
    size_of,
    summary_of,
    unparsed_at,
    walk,
    written_to,
)
from triaxcald.recording.schema import Fields, batch_of, decode_raw, fields_of

# The contents of a recording, be it one file or segments.

T = TypeVar("T")
JOINED = 1 << 15
"""Raw records that are decoded at once: so many that the cost of a call no
longer counts, and less than a MiB."""
JOINED_BYTES = 8 * 2**20
"""So much is held at most, whatever the messages say of their records: those of
64 bytes, twice over."""


class TopicMessage(NamedTuple):
    topic: str
    message: Message


@dataclass
class Messages:
    """Number of messages of a topic, their earliest and latest log time."""

    messages: int
    start_ns: int
    end_ns: int

    def add(self, other: Messages) -> None:
        self.messages += other.messages
        self.start_ns, self.end_ns = min(self.start_ns, other.start_ns), max(self.end_ns, other.end_ns)


@dataclass(frozen=True)
class Index:
    """The messages by topic, and the raw records by phase."""

    topics: dict[str, Messages] = field(default_factory=dict)
    phases: dict[str, schema.PhaseCount] = field(default_factory=dict)

    def add(self, other: Index) -> None:
        for topic, messages in other.topics.items():
            if topic in self.topics:
                self.topics[topic].add(messages)
            else:
                self.topics[topic] = messages
        for phase, count in other.phases.items():
            if phase in self.phases:
                self.phases[phase].add(count)
            else:
                self.phases[phase] = count


class Contents(ABC):
    """A context manager. ``metadata`` by record, ``attachments`` by name.

    Every iterator raises RecordingError.
    """

    name: str
    metadata: dict[str, dict[str, str]]
    attachments: Mapping[str, bytes]

    @abstractmethod
    def is_confirmed(self, first: int) -> bool:
        """Whether the raw records of the message that begins with this running
        index are the unit's for all that is known."""

    @property
    @abstractmethod
    def any_unconfirmed(self) -> bool: ...

    def unconfirmed_records(self) -> int:
        """How many raw records are unconfirmed."""
        if not self.any_unconfirmed:
            return 0
        return sum(len(batch) for _, batch in self.joined_batches() if batch.unconfirmed)

    @abstractmethod
    def messages(self, topic: str | None = None) -> Iterator[TopicMessage]:
        """Every message with its topic, undecoded, in the order of the file;
        those of one ``topic`` where it is given."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def phases(self) -> list[str]:
        """In the order in which they began."""
        return list(dict.fromkeys(phase for phase, _ in self.joined_batches()))

    def raw(self, phase: str) -> Iterator[td.RawBatch]:
        """The phase's raw records in the order in which they came, some
        `JOINED` at a time: a live bus hands out few. Without those that are
        unconfirmed: nothing is computed from them."""
        return (batch for _, batch in self._raw(phase.encode()) if not batch.unconfirmed)

    def joined_batches(self) -> Iterator[tuple[str, td.RawBatch]]:
        """All raw records with their phase, likewise, but also those that are
        unconfirmed; the batch says so."""
        return self._raw()

    def raw_batches(self) -> Iterator[tuple[str, td.RawBatch]]:
        """The same in the batches in which they were recorded, of which the
        phases take turns."""
        for first, phase, batch in self._decoded(schema.RAW, decode_raw):
            yield phase, batch if self.is_confirmed(first) else replace(batch, unconfirmed=True)

    def _raw(self, phase: bytes | None = None) -> Iterator[tuple[str, td.RawBatch]]:
        waiting, records, size = list[tuple[int, Fields]](), 0, 0
        for message, fields in self._read(schema.RAW, fields_of):
            if phase is not None and fields.phase != phase:
                continue
            if waiting and not self._belong_together(waiting[0][1], fields):
                yield self._joined(waiting)
                waiting, records, size = [], 0, 0
            waiting.append((message.log_time, fields))
            records, size = records + len(fields.flags), size + len(message.data)
            if records >= JOINED or size >= JOINED_BYTES:
                yield self._joined(waiting)
                waiting, records, size = [], 0, 0
        if waiting:
            yield self._joined(waiting)

    def _belong_together(self, one: Fields, other: Fields) -> bool:
        return one.phase == other.phase and self.is_confirmed(one.first) == self.is_confirmed(other.first)

    def _joined(self, waiting: Sequence[tuple[int, Fields]]) -> tuple[str, td.RawBatch]:
        """Of messages of one phase that are all confirmed, or none of them.
        Raises RecordingError, which names the message at fault."""
        time_ns, first = waiting[0]
        phase = self._decode(schema.RAW, time_ns, first.phase.decode)
        try:
            batch = batch_of([fields for _, fields in waiting])
            return phase, batch if self.is_confirmed(first.first) else replace(batch, unconfirmed=True)
        except ValueError:
            for time_ns, fields in waiting:
                self._decode(schema.RAW, time_ns, partial(batch_of, [fields]))
            raise

    @property
    def ends_with(self) -> str:
        """The format of the document that the whole recording ends with; empty
        where it ends with none."""
        return self.metadata[schema.FORMAT_RECORD].get(schema.ENDS_WITH, "")

    def raw_digest(self) -> schema.RawDigest:
        """Of all raw records; the metadata record ``raw`` says what it was when
        they were written."""
        digest = schema.RawDigest(self.ends_with)
        for phase, batch in self.joined_batches():
            digest.update(phase, batch)
        return digest

    def index(self) -> Index | None:
        """What the file's own index and metadata say of its messages; None where they
        do not list all of them. Every message then has to be read."""
        return None

    def register_accesses(self) -> Iterator[schema.RegisterAccess]:
        return self._decoded(schema.REGISTERS, schema.decode_register_access)

    def events(self) -> Iterator[schema.Event]:
        return self._decoded(schema.EVENTS, schema.decode_event)

    def losses(self) -> Iterator[schema.Loss]:
        return self._decoded(schema.LOSS, schema.decode_loss)

    def _decoded(self, topic: str, decode: Callable[[bytes], T]) -> Iterator[T]:
        return (value for _, value in self._read(topic, decode))

    def _read(self, topic: str, decode: Callable[[bytes], T]) -> Iterator[tuple[Message, T]]:
        for _, message in self.messages(topic):
            yield message, self._decode(topic, message.log_time, partial(decode, message.data))

    def _decode(self, topic: str, time_ns: int, decode: Callable[[], T]) -> T:
        """Raises RecordingError."""
        try:
            return decode()
        except ValueError as e:
            raise RecordingError(f"{self.name}: {topic} at {time_ns} ns: {e}") from e


# A recording in one file.

METADATA_MOST = 2**20  # bytes; ours has some hundred
ATTACHMENTS_MOST = 1000  # a run leaves a dozen


class Attachments(Mapping[str, bytes]):
    """Attachments by name; each is read from the file on access."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._offsets: dict[str, int] = {}
        self.media_types: dict[str, str] = {}
        self.sizes: dict[str, int] = {}

    def add(self, offset: int, attachment: Attachment) -> None:
        self._offsets[attachment.name] = offset
        self.media_types[attachment.name] = attachment.media_type
        self.sizes[attachment.name] = len(attachment.data)

    def __getitem__(self, name: str) -> bytes:
        record = parse(self._recording.unparsed(self._offsets[name]), self._recording.name)
        assert isinstance(record, Attachment)
        return record.data

    def __iter__(self) -> Iterator[str]:
        return iter(self._offsets)

    def __len__(self) -> int:
        return len(self._offsets)


@dataclass(frozen=True)
class Learned:
    """By the offset of a chunk the topics of its messages and the channels that it
    declares; and all channels that are declared, with their topics."""

    known: Mapping[int, tuple[frozenset[str], dict[int, str]]]
    topics: Mapping[int, str]


class Recording(Contents):
    """One recording's file, opened.

    Opening reads the whole file once and checks it: every byte of a finished
    recording is under a CRC. ``unfinished`` also takes one that is still being
    written or was cut short, up to its last whole record; what would come after
    it may be zeros, as power failures leave them. Raises RecordingError, from
    opening and from every iterator.
    """

    def __init__(self, stream: BinaryIO, name: str, *, unfinished: bool = False) -> None:
        self.name = name
        self.finished = True
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: Attachments = Attachments(self)
        self._stream = stream
        self._chunks: list[int] = []
        self._known: dict[int, tuple[frozenset[str], dict[int, str]]] = {}
        """By chunk that was read to its end: topics of its messages, and channels that
        it declares."""
        self._topics: dict[int, str] = {}
        self._said = 0  # bytes of metadata
        self._unconfirmed: int | None = None  # running index of the first unconfirmed raw record
        self.size = size_of(stream)
        if not self.size:
            raise RecordingError(f"{name}: the file is empty; nothing was recorded")
        self._written = written_to(stream, self.size) if unfinished else self.size
        check_magic(stream, name)
        try:
            self._survey()
        except Damage as e:
            if not unfinished or not (isinstance(e, CutShort) or self._reaches_zeros(e.offset)):
                raise
            self.finished = False
        found = self.metadata.get(schema.FORMAT_RECORD, {}).get("format")
        if found != schema.FORMAT:
            raise RecordingError(f"{name}: recording format {found!r}, expected '{schema.FORMAT}'")
        self._unconfirmed = schema.unconfirmed_from(self.metadata)

    @classmethod
    def open(cls, path: td.files.AnyPath, *, unfinished: bool = False) -> Recording:
        try:
            stream = td.files.open_file(path)
        except OSError as e:
            raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e
        try:
            recording = cls(stream, str(path), unfinished=unfinished)
        except OSError as e:
            stream.close()
            kind = DiskError if is_of_the_disk(e) else RecordingError
            raise kind(f"{path}: reading failed: {e.strerror or e}") from e
        except BaseException:
            stream.close()
            raise
        recording._heed_manifest(path)
        return recording

    def _heed_manifest(self, path: td.files.AnyPath) -> None:
        """Take the unconfirmed records from the manifest beside the segment, which may
        have been closed before an exchange of the unit was noticed."""
        own = self.metadata.get(schema.SEGMENT_RECORD, {})
        of = own.get("of", "")
        if not is_manifest(of) or Path(of).name != of:
            return
        with suppress(RecordingError):  # a segment can be read alone
            for segment in segments_listed(path.with_name(of)):  # by number: a mended file has another name
                if str(segment.number) == own.get("number") and segment.unconfirmed is not None:
                    known = segment.unconfirmed if self._unconfirmed is None else self._unconfirmed
                    self._unconfirmed = min(known, segment.unconfirmed)

    @property
    def any_unconfirmed(self) -> bool:
        return self._unconfirmed is not None

    def is_confirmed(self, first: int) -> bool:
        return self._unconfirmed is None or first < self._unconfirmed

    def close(self) -> None:
        self._stream.close()

    @property
    def chunks(self) -> int:
        return len(self._chunks)

    def messages(self, topic: str | None = None) -> Iterator[TopicMessage]:
        topics = dict(self._topics)
        unpacked = Unpacked(self.name, self.size)
        for offset in self._chunks:
            held, declared = self._known.get(offset, (None, {}))
            if topic is not None and held is not None and topic not in held:
                topics |= declared
                continue
            seen, channels = set[str](), dict[int, str]()
            for record in self._records(offset):
                unpacked.record()
                if isinstance(record, Channel):
                    topics[record.id] = channels[record.id] = record.topic
                elif isinstance(record, Message):
                    if record.channel_id not in topics:
                        raise Damage(self.name, offset, f"message on unknown channel {record.channel_id}")
                    found = topics[record.channel_id]
                    seen.add(found)
                    if topic is None or found == topic:
                        yield TopicMessage(found, record)
            self._known[offset] = frozenset(seen), channels

    def index(self) -> Index | None:
        """Chunks without messages of a topic are not unpacked for it afterwards."""
        summary = summary_of(self._stream, self.name, self.size) if self.finished else None
        phases = self._counted_phases()
        if summary is None or phases is None or [c.chunk_start_offset for c in summary.chunks] != self._chunks:
            return None
        topics: dict[str, Messages] = {}
        alike: dict[frozenset[str], frozenset[str]] = {}
        known: dict[int, tuple[frozenset[str], dict[int, str]]] = {}
        for chunk in summary.chunks:
            here = set[str]()
            for channel_id, offset in chunk.message_index_offsets.items():
                unparsed = self.unparsed(offset)
                topic = summary.channels.get(channel_id)
                if topic is None or unparsed.opcode != Opcode.MESSAGE_INDEX:
                    return None
                said, times_ns = indexed_times_ns(unparsed)
                if said != channel_id or not len(times_ns):
                    return None
                found = Messages(len(times_ns), int(times_ns.min()), int(times_ns.max()))
                if topic in topics:
                    topics[topic].add(found)
                else:
                    topics[topic] = found
                here.add(topic)
            known[chunk.chunk_start_offset] = alike.setdefault(frozenset(here), frozenset(here)), {}
        if sum(m.messages for m in topics.values()) != summary.statistics.message_count:
            return None
        self._topics |= summary.channels
        self._known |= known
        return Index(topics, phases)

    @property
    def learned(self) -> Learned:
        """What is known of its chunks so far."""
        return Learned(dict(self._known), dict(self._topics))

    def learn(self, learned: Learned) -> None:
        """What was known of the same file when it was opened before."""
        self._known |= learned.known
        self._topics |= learned.topics

    def _counted_phases(self) -> dict[str, schema.PhaseCount] | None:
        """As they were counted when the file was closed; None where they were not, or
        where records are unconfirmed."""
        said = self.metadata.get(schema.RAW_RECORD, {})
        try:
            phases = {
                key.removeprefix(schema.PHASE_KEY): schema.PhaseCount.read(text)
                for key, text in said.items()
                if key.startswith(schema.PHASE_KEY)
            }
        except (ValueError, RecursionError):
            return None
        whole = str(sum(count.records for count in phases.values())) == said.get("records")
        return phases if whole and not self.any_unconfirmed else None

    def unparsed_records(self) -> Iterator[UnparsedRecord]:
        """Every record of the file in order, unparsed."""
        return walk(self._stream, self.name, self.size)

    def _records(self, offset: int) -> Iterator[Schema | Channel | Message]:
        """Records of the chunk at ``offset``."""
        data = chunk_data(self.unparsed(offset), self.name)
        try:
            yield from chunk_records(data)
        except Damage as e:
            raise Damage(self.name, offset, e.what) from e

    def unparsed(self, offset: int) -> UnparsedRecord:
        try:
            return unparsed_at(self._stream, self.name, offset, self.size)
        except OSError as e:
            kind = DiskError if is_of_the_disk(e) else RecordingError
            raise kind(f"{self.name}: reading failed at byte {offset}: {e.strerror}") from e

    def _survey(self) -> None:
        """Index the file, and check the two CRCs that together cover every byte."""
        crc = zlib.crc32(MAGIC)
        unpacked = Unpacked(self.name, self.size)
        for unparsed in walk(self._stream, self.name, self.size):
            if unparsed.opcode == Opcode.CHUNK:
                unpacked.chunk(unparsed)
                if unparsed.end > self._written:
                    chunk_data(unparsed, self.name)
            self._note(unparsed)
            if unparsed.opcode == Opcode.DATA_END:
                self._check_data(unparsed, crc)
                crc = 0
            elif unparsed.opcode == Opcode.FOOTER:
                self._check_end(unparsed, crc)
            else:
                crc = zlib.crc32(unparsed.body, zlib.crc32(unparsed.head, crc))

    def _reaches_zeros(self, offset: int) -> bool:
        """Whether the record at ``offset`` reaches into the zeros at the end."""
        if self._written == self.size:
            return False
        return offset + HEAD.size > self._written or self.unparsed(offset).end > self._written

    def _note(self, unparsed: UnparsedRecord) -> None:
        if unparsed.opcode == Opcode.CHUNK:
            self._chunks.append(unparsed.offset)
            return
        record = parse(unparsed, self.name)
        if isinstance(record, Header) and record.profile != schema.PROFILE:
            raise RecordingError(
                f"{self.name}: an MCAP file, but not a recording of triaxcal: its header says profile"
                f" '{record.profile}', expected '{schema.PROFILE}'"
            )
        if isinstance(record, Metadata):
            self._said += len(unparsed.body)
            if self._said > METADATA_MOST:
                raise RecordingError(f"{self.name}: more than {METADATA_MOST} bytes of metadata")
            self.metadata.setdefault(record.name, {}).update(record.metadata)
        elif isinstance(record, Attachment):
            if len(self.attachments) >= ATTACHMENTS_MOST:
                raise RecordingError(f"{self.name}: more than {ATTACHMENTS_MOST} attachments")
            self.attachments.add(unparsed.offset, record)
        elif isinstance(record, Channel):
            self._topics[record.id] = record.topic

    def _check_data(self, unparsed: UnparsedRecord, crc: int) -> None:
        record = parse(unparsed, self.name)
        assert isinstance(record, DataEnd)
        if record.data_section_crc in (0, crc):
            return
        for number, offset in enumerate(self._chunks, start=1):
            try:
                chunk_data(self.unparsed(offset), self.name)
            except Damage as e:
                raise Damage(self.name, offset, f"chunk {number} of {self.chunks}: {e.what}") from e
        raise Damage(self.name, unparsed.offset, "header, metadata or index records fail the CRC checked")

    def _check_end(self, unparsed: UnparsedRecord, crc: int) -> None:
        if not footer_fits(unparsed, crc):
            raise Damage(self.name, unparsed.offset, "the summary fails its CRC checked")
        self._stream.seek(unparsed.end)
        tail = self._stream.read(len(MAGIC) + 1)
        if tail != MAGIC:
            kind = CutShort if MAGIC.startswith(tail) else Damage
            raise kind(self.name, unparsed.end, "the file does not end as it should")


# A recording in segments, read as one.

_BLOCK = 2**20
_MEANT_BY = {"unit": ("name", "serial", "signs"), schema.BUS_RECORD: ("name", "channel")}
"""What of the metadata says whose records they are, and how they are read."""


class Series(Contents):
    """All segments that are there, one open at a time. Metadata and attachments
    are those of the first.

    Each segment is compared with the manifest when it is read, and with the
    first unless they need not be ``alike``: records mean the same in all of
    them. Raises RecordingError: one is missing, or is not as it was.
    """

    def __init__(self, path: Path, *, alike: bool = True) -> None:
        self.name = str(path)
        self._alike = alike
        self.manifest: Manifest = load_manifest(path)
        if not self.manifest.segments:
            raise RecordingError(f"{path}: no segment is left of this recording")
        for segment in self.manifest.segments:
            self._require_there(segment)
        self._unconfirmed = [
            range(s.unconfirmed, s.end if s.state != "open" else sys.maxsize)
            for s in self.manifest.segments
            if s.unconfirmed is not None
        ]
        self._learned: dict[str, Learned] = {}
        """Of the index of each segment, for when it is opened again."""
        self._first = self._opened(self.manifest.segments[0])
        own = (schema.SEGMENT_RECORD, schema.RAW_RECORD)
        self.metadata = {name: record for name, record in self._first.metadata.items() if name not in own}
        self.attachments: Attachments = self._first.attachments

    def close(self) -> None:
        self._first.close()

    @property
    def size(self) -> int:
        return sum(segment.bytes for segment in self.manifest.segments)

    @property
    def any_unconfirmed(self) -> bool:
        return bool(self._unconfirmed)

    def is_confirmed(self, first: int) -> bool:
        return not any(first in indices for indices in self._unconfirmed)

    def messages(self, topic: str | None = None) -> Iterator[TopicMessage]:
        yield from self._first.messages(topic)
        for segment in self.manifest.segments[1:]:
            with self._opened(segment) as recording:
                if self._alike:
                    self._require_alike(recording, segment)
                yield from recording.messages(topic)

    def index(self) -> Index | None:
        if self.any_unconfirmed:
            return None
        whole = Index()
        for segment in self.manifest.segments:
            with self._opened(segment) as recording:
                if (found := recording.index()) is None:
                    return None
                whole.add(found)
                self._learned[segment.file] = recording.learned
        self._first.learn(self._learned[self.manifest.segments[0].file])
        return whole

    def _require_there(self, segment: Segment) -> None:
        path = self.manifest.path_of(segment)
        try:
            size = path.stat().st_size
        except OSError as e:
            raise RecordingError(f"{self.name}: segment {segment.file}: {e.strerror}") from e
        if segment.state != "open" and size != segment.bytes:
            raise RecordingError(
                f"{self.name}: segment {segment.file}: {size} bytes, expected {segment.bytes}; it was changed since"
            )

    def _require_alike(self, recording: Recording, segment: Segment) -> None:
        """What is in a segment means what it does in the first: the station
        file may have changed in between, and with it profile, signs or bus. One
        that ended before its first record may lack attachments."""
        first, ours, theirs = self.manifest.segments[0].file, self.metadata, recording.metadata
        named = [
            f"{key} of the {record}"
            for record, keys in _MEANT_BY.items()
            for key in keys
            if theirs.get(record, {}).get(key) != ours.get(record, {}).get(key)
        ]
        there = set(self.attachments) & set(recording.attachments) - {schema.STATION_FILE}
        named += [name for name in sorted(there) if not _alike(recording.attachments[name], self.attachments[name])]
        if named:
            raise RecordingError(
                f"{self.name}: segment {segment.file}: {', '.join(named)}: not as in {first}; "
                "read the segments before and after such a change one by one"
            )

    def _opened(self, segment: Segment) -> Recording:
        path = self.manifest.path_of(segment)
        if segment.state != "open" and digest_of(path) != segment.sha256:
            raise RecordingError(f"{self.name}: segment {segment.file}: was changed since it was recorded")
        recording = Recording.open(path, unfinished=segment.state != "closed")
        if segment.file in self._learned:
            recording.learn(self._learned[segment.file])
        return recording


def _alike(one: bytes, other: bytes) -> bool:
    """Of two files of a profile: comments and blanks of TOML mean nothing."""
    try:
        return one == other or tomllib.loads(one.decode()) == tomllib.loads(other.decode())
    except (ValueError, RecursionError):
        return False


def digest_of(path: td.files.AnyPath) -> str:
    """SHA-256 of the whole file. Raises RecordingError."""
    try:
        digest = hashlib.sha256()
        with td.files.open_file(path) as file:
            while block := file.read(_BLOCK):
                digest.update(block)
        return digest.hexdigest()
    except OSError as e:
        raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e


def indexed_attachments(path: Path, *names: str) -> dict[str, bytes]:
    """Attachments of a finished file, found by its index: nothing else of it is read or
    checked. None of any other file. Raises nothing."""
    found: dict[str, bytes] = {}
    with suppress(OSError, RecordingError), td.files.open_file(path) as stream:
        size = size_of(stream)
        summary = summary_of(stream, str(path), size) if size > 2 * len(MAGIC) else None
        for name in names:
            if summary is not None and name in summary.attachments:
                record = parse(unparsed_at(stream, str(path), summary.attachments[name], size), str(path))
                if isinstance(record, Attachment) and record.name == name:
                    found[name] = record.data
    return found


def open_recording(path: td.files.AnyPath, *, unfinished: bool = False, alike: bool = True) -> Recording | Series:
    """One file, or all that a manifest names, as `Recording` and `Series` have
    them. Raises RecordingError."""
    if not is_manifest(path):
        return Recording.open(path, unfinished=unfinished)
    if not isinstance(path, Path):
        raise RecordingError(f"{path}: a recording in segments is read from a folder; copy it to one")
    return Series(path, alike=alike)


def is_recording(name: str) -> bool:
    """Whether a file of that name is a recording of ours, and not a table."""
    return name.endswith(".mcap") or is_manifest(name)
