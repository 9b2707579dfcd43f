"""Inventory of a finished recording's file, record by record, and the contradictions
between its parts."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from triaxcald.recording import schema
from triaxcald.recording.manifest import End, Inventory, SealedContents
from triaxcald.recording.mcap_records import HEAD, UnparsedRecord, chunk_data, chunk_records, parse, whole_chunk_head
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import decode_raw

Kind = Literal["twice", "times", "sequence", "running_index", "topic", "undecodable", "index"]
AFTER_THE_END = (schema.RAW_RECORD, schema.END_RECORD, schema.RECOVERY_RECORD)
"""Metadata records that follow the recording's last document. No inventory has
them."""
_TOPICS = frozenset([*(topic for topic, _ in schema.CHANNELS), *schema.PREVIEWS])
_INDEX_HEAD, _INDEX_ENTRY = struct.Struct("<HI"), struct.Struct("<QQ")
_CHANNEL_AND_TIME = struct.Struct("<HIQ")


@dataclass(frozen=True)
class Fault:
    """A contradiction in the file: its ``kind``, the ``part`` (a topic, a name or an
    index), and the number of records."""

    kind: Kind
    part: str
    count: int = 1


@dataclass
class Survey:
    """``inventory`` of everything before the recording's last document. In a correct
    file that document is ``last`` among the attachments. ``faults`` are those of the
    file itself."""

    inventory: Inventory = field(default_factory=Inventory)
    attachments: list[str] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    end: End | None = None
    """The last document itself."""
    signature: End | None = None
    """The signature, which no inventory has."""
    closing: dict[str, Mapping[str, str]] = field(default_factory=dict)
    """The metadata records that follow it."""
    last_ns: int | None = None
    """The latest time of a message."""

    @property
    def last(self) -> str | None:
        """The last attachment but for a signature, which has its place after it."""
        return next((name for name in reversed(self.attachments) if name != schema.SIGNATURE_FILE), None)

    @property
    def signature_is_last(self) -> bool:
        return self.attachments[-1:] == [schema.SIGNATURE_FILE]

    @property
    def sealed(self) -> SealedContents | None:
        """What a signature is of; None without a last document."""
        return None if self.end is None else self.inventory.sealed(self.end, self.closing)


def survey(recording: Recording, end: str) -> Survey:
    """``end`` is the name of the recording's last document, an attachment. Raises
    RecordingError."""
    return _Surveyor(recording, end).run()


class _Surveyor:
    def __init__(self, recording: Recording, end: str) -> None:
        self._recording, self._end = recording, end
        self._found = Survey()
        self._counts: Counter[tuple[Kind, str]] = Counter()
        self._metadata: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._messages: Counter[int] = Counter()
        self._times_ns: tuple[int, int] | None = None
        self._raw_end = schema.first_index(recording.metadata)
        self._gaps: list[tuple[int, int]] = []  # in the running index of raw records: first, end
        self._lost: list[tuple[int, int]] = []  # running indices recorded as lost: first, end
        self._indices: list[Any] = []  # records that the summary must have
        self._expected: dict[int, bytes] = {}  # by channel, the message index of the latest chunk
        self._chunk: ChunkIndex | None = None

    def run(self) -> Survey:
        # Survey the data section; collect the summary behind it.
        summary: list[tuple[UnparsedRecord, Any]] = []
        ended = False
        for unparsed in self._recording.unparsed_records():
            if ended:
                summary.append((unparsed, parse(unparsed, self._recording.name)))
            elif unparsed.opcode == Opcode.DATA_END:
                self._close_chunk()
                ended = True
            else:
                self._data(unparsed)
        self._check_summary(summary)
        # A name may occur once.
        for names in (self._found.attachments, self._metadata):
            for name, count in Counter(names).items():
                self._counts["twice", name] += count - 1
        self._found.faults += [Fault(kind, part, n) for (kind, part), n in self._counts.items() if n]
        return self._found

    def _data(self, unparsed: UnparsedRecord) -> None:
        if unparsed.opcode == Opcode.MESSAGE_INDEX:
            self._message_index(unparsed)
            return
        self._close_chunk()
        if unparsed.opcode == Opcode.CHUNK:
            self._records(unparsed)
            return
        record = parse(unparsed, self._recording.name)
        length = unparsed.end - unparsed.offset
        if isinstance(record, Attachment):
            self._attachment(record)
            self._indices.append(
                AttachmentIndex(
                    offset=unparsed.offset, length=length, create_time=record.create_time, log_time=record.log_time,
                    data_size=len(record.data), name=record.name, media_type=record.media_type,
                )
            )  # fmt: skip
        elif isinstance(record, Metadata):
            self._metadata.append(record.name)
            self._indices.append(MetadataIndex(offset=unparsed.offset, length=length, name=record.name))
            if record.name in AFTER_THE_END:
                self._found.closing[record.name] = record.metadata
            else:
                self._found.inventory.metadata(record.name, record.metadata)

    def _attachment(self, record: Attachment) -> None:
        self._found.attachments.append(record.name)
        if record.create_time != record.log_time:
            self._counts["times", record.name] += 1
        if record.name == self._end:
            self._found.end = End(record.name, record.media_type, record.log_time, record.data)
        elif record.name == schema.SIGNATURE_FILE:
            self._found.signature = End(record.name, record.media_type, record.log_time, record.data)
        else:
            self._found.inventory.attachment(record.name, record.media_type, record.log_time, record.data)

    # Chunks and their records.

    def _records(self, unparsed: UnparsedRecord) -> None:
        name, head = self._recording.name, whole_chunk_head(unparsed, self._recording.name)
        data = chunk_data(unparsed, name)
        self._chunk = ChunkIndex(
            chunk_length=unparsed.end - unparsed.offset, chunk_start_offset=unparsed.offset,
            compression=head.compression,
            compressed_size=len(head.data), message_end_time=head.message_end_time, message_index_length=0,
            message_index_offsets={}, message_start_time=head.message_start_time,
            uncompressed_size=head.uncompressed_size,
        )  # fmt: skip
        # The message index that must follow the chunk.
        entries: dict[int, list[bytes]] = {}
        for at, channel_id, time_ns in _messages_in(data):
            entries.setdefault(channel_id, []).append(_INDEX_ENTRY.pack(time_ns, at))
        self._expected = {channel_id: b"".join(sorted(held)) for channel_id, held in entries.items()}
        # Declarations and messages.
        times: list[int] = []
        for record in chunk_records(data):
            if isinstance(record, Schema):
                self._declare(self._schemas, record.id, record)
            elif isinstance(record, Channel):
                self._declare(self._channels, record.id, record)
                self._channel(record)
            else:
                times.append(record.log_time)
                self._message(record)
        # The chunk's own record of its time span.
        if times and (min(times), max(times)) != (head.message_start_time, head.message_end_time):
            self._counts["index", "chunk"] += 1
        if times:
            first, last = self._times_ns or (times[0], times[0])
            self._times_ns = min(first, *times), max(last, *times)
            self._found.last_ns = self._times_ns[1]

    def _declare(self, known: dict[int, Any], number: int, record: Any) -> None:
        if known.setdefault(number, record) != record:
            self._counts["index", "declaration"] += 1

    def _channel(self, channel: Channel) -> None:
        if channel.topic not in _TOPICS:
            self._counts["topic", channel.topic] += 1
        kind = self._schemas.get(channel.schema_id) or Schema(id=0, data=b"", encoding="", name="")
        self._found.inventory.channel(
            channel.topic, channel.message_encoding, channel.metadata, (kind.name, kind.encoding, kind.data)
        )

    def _message(self, message: Message) -> None:
        self._messages[message.channel_id] += 1
        channel = self._channels.get(message.channel_id)
        topic = channel.topic if channel else f"channel {message.channel_id}"
        self._found.inventory.message(topic, message.log_time, message.publish_time, message.data)
        if message.sequence:
            self._counts["sequence", topic] += 1
        # A message carries its own time, which both MCAP times repeat.
        try:
            own_ns = self._raw(message) if topic == schema.RAW else schema.decode_time(message.data)
            if topic == schema.LOSS:
                loss = schema.decode_loss(message.data)
                self._lost += [(loss.first, loss.first + loss.records)] if loss.where == schema.RAW else []
        except ValueError:
            self._counts["undecodable", topic] += 1
            return
        if (message.log_time, message.publish_time) != (own_ns, own_ns):
            self._counts["times", topic] += 1

    def _raw(self, message: Message) -> int:
        """Checks the running index. Returns the time of the last record [ns]."""
        first, _, batch = decode_raw(message.data)
        if first != self._raw_end:
            self._gaps.append((self._raw_end, first))
        self._raw_end = first + len(batch)
        return int(batch.time_ns[-1]) if len(batch) else message.log_time

    # Indices.

    def _message_index(self, unparsed: UnparsedRecord) -> None:
        channel_id, length = _INDEX_HEAD.unpack_from(unparsed.body)
        held = unparsed.body[_INDEX_HEAD.size :]
        size = _INDEX_ENTRY.size
        entries = b"".join(sorted(held[i : i + size] for i in range(0, len(held), size)))
        if len(held) != length or self._chunk is None or self._expected.pop(channel_id, None) != entries:
            self._counts["index", "messages"] += 1
        if self._chunk is not None:
            self._chunk.message_index_offsets[channel_id] = unparsed.offset
            self._chunk.message_index_length += unparsed.end - unparsed.offset

    def _close_chunk(self) -> None:
        if self._chunk is not None:
            self._counts["index", "messages"] += len(self._expected)
            self._indices.append(self._chunk)
        self._chunk, self._expected = None, {}

    def _check_summary(self, summary: list[tuple[UnparsedRecord, Any]]) -> None:
        # Sort the summary into its records, its groups and the offsets of the groups.
        wanted = [*self._schemas.values(), *self._channels.values(), self._statistics(), *self._indices]
        groups: dict[int, tuple[int, int]] = {}
        offsets: list[tuple[int, int, int]] = []
        found = []
        for unparsed, record in summary:
            if isinstance(record, SummaryOffset):
                offsets.append((record.group_opcode, record.group_start, record.group_length))
            elif not isinstance(record, Footer):
                start, length = groups.get(unparsed.opcode, (unparsed.offset, 0))
                groups[unparsed.opcode] = start, length + unparsed.end - unparsed.offset
                found.append(record)
        # Compare records by kind, and groups by offset.
        for kind in (Schema, Channel, Statistics, ChunkIndex, AttachmentIndex, MetadataIndex):
            has, should = ([r for r in some if isinstance(r, kind)] for some in (found, wanted))
            if has != should:
                self._counts["index", _NAMES[kind]] += 1
        if {o for o in offsets if o[2]} != {(code, *place) for code, place in groups.items()}:
            self._counts["index", "groups"] += 1
        # A gap in the running index must be recorded as a loss.
        self._counts["running_index", schema.RAW] += sum(not self._is_recorded_as_lost(*gap) for gap in self._gaps)

    def _is_recorded_as_lost(self, first: int, end: int) -> bool:
        """Whether the loss records cover the raw records between two running
        indices."""
        if end < first:
            return False
        for begin, until in sorted(self._lost):
            if begin <= first:
                first = max(first, until)
        return first >= end

    def _statistics(self) -> Statistics:
        first, last = self._times_ns or (0, 0)
        of = Counter(type(index) for index in self._indices)
        return Statistics(
            attachment_count=of[AttachmentIndex], channel_count=len(self._channels),
            channel_message_counts=dict(self._messages), chunk_count=of[ChunkIndex],
            message_count=self._messages.total(), message_end_time=last, message_start_time=first,
            metadata_count=of[MetadataIndex], schema_count=len(self._schemas),
        )  # fmt: skip


_NAMES: dict[type, str] = {
    Schema: "schemas",
    Channel: "channels",
    Statistics: "statistics",
    ChunkIndex: "chunks",
    AttachmentIndex: "attachments",
    MetadataIndex: "metadata",
}


def _messages_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Offset, channel and log time [ns] of each message in a chunk."""
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        if opcode == Opcode.MESSAGE and length >= _CHANNEL_AND_TIME.size:
            channel_id, _, time_ns = _CHANNEL_AND_TIME.unpack_from(data, at + HEAD.size)
            yield at, channel_id, time_ns
        at += HEAD.size + length
