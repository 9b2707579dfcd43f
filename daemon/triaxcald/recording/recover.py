"""Recovers a recording that was cut short or damaged: keeps every whole record and
counts the lost ones."""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, Message, Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer as McapWriter

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import DiskError, RecordingError
from triaxcald.files import exists_already, is_of_the_disk, new_file
from triaxcald.recording import schema
from triaxcald.recording.manifest import End, Inventory, SealedContents, SignatureMade, is_manifest
from triaxcald.recording.mcap_records import (
    CHUNK_LIMIT,
    HEAD,
    MAGIC,
    CutShort,
    Damage,
    Unpacked,
    UnparsedRecord,
    check_magic,
    chunk_data,
    chunk_head,
    chunk_records,
    footer_fits,
    parse,
    size_of,
    unpack,
    unpack_part,
    unparsed_at,
    whole_chunk_head,
)
from triaxcald.recording.schema import decode_raw

# A damaged file as its readable records in order and the unreadable stretches between
# them.

_SEARCH_BLOCK = 2**20
_TRIED_MOST, _TRIED_LEAST, _TRY = 8, 16 * 2**20, 256
"""Limit of the search for records: it may try `_TRIED_MOST` times the file's size plus
`_TRIED_LEAST` bytes. A try counts for the record's length plus `_TRY` bytes. In a
recording of triaxcal, hardly any other bytes look like a record."""
# The start of a chunk, attachment, metadata or end of data shorter than 4 GiB: its
# type and, four bytes later, the upper half of its length.
_RECORD_START = re.compile(rb"[\x06\x09\x0c\x0f](?=[\s\S]{4}\x00\x00\x00\x00)")


@dataclass(frozen=True)
class Stretch:
    """Bytes that are no whole record. ``at_end``: nothing readable follows."""

    offset: int
    length: int
    at_end: bool


class DamagedFile:
    """The constructor raises RecordingError if the file is no recording of triaxcal."""

    def __init__(self, source: BinaryIO, name: str) -> None:
        self.name = name
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._source = source
        self._bytes_tried = 0
        self.size = size_of(source)
        try:
            check_magic(source, name)
        except CutShort:
            self.size = 0
        self._unpacked = Unpacked(name, self.size)
        self._look_ahead()

    def pieces(self) -> Iterator[UnparsedRecord | Stretch]:
        """Records and stretches up to and with the end of the data, or up to the end
        of the file if that record is missing.

        The CRC of a chunk or attachment is not checked here.
        """
        offset = len(MAGIC)
        while offset < self.size:
            try:
                unparsed = unparsed_at(self._source, self.name, offset, self.size)
                self._check_length(unparsed)
            except Damage:
                # Skip to the next record that is whole.
                following = self._search(offset + 1)
                yield Stretch(offset, following - offset, following >= self.size)
                offset = following
                continue
            yield unparsed
            offset = unparsed.end
            if unparsed.opcode == Opcode.DATA_END:
                return

    def read(self, offset: int, length: int) -> bytes:
        self._source.seek(offset)
        return self._source.read(length)

    def declare(self, record: object) -> None:
        """Stores a schema or channel."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)

    def _check_length(self, unparsed: UnparsedRecord) -> None:
        """Raises Damage if the record's length cannot be right."""
        if unparsed.opcode == Opcode.CHUNK:
            whole_chunk_head(unparsed, self.name)
        elif unparsed.opcode != Opcode.ATTACHMENT:
            parse(unparsed, self.name)

    def _search(self, offset: int) -> int:
        """Offset of the next valid record from ``offset`` on; the file's size if there
        is none."""
        while offset < self.size:
            # Blocks overlap by a record's head, so that no start is missed.
            block = self.read(offset, _SEARCH_BLOCK + HEAD.size)
            for found in _RECORD_START.finditer(block):
                if found.start() < _SEARCH_BLOCK and self._is_record(offset + found.start()):
                    return offset + found.start()
            offset += _SEARCH_BLOCK
        return self.size

    def _is_record(self, offset: int) -> bool:
        """Whether a valid record begins there. Raises RecordingError beyond the limit
        of the search."""
        self._bytes_tried += _TRY
        if self._bytes_tried > _TRIED_MOST * self.size + _TRIED_LEAST:
            raise RecordingError(f"{self.name}: too much of it looks like records and is none")
        try:
            unparsed = unparsed_at(self._source, self.name, offset, self.size)
            self._bytes_tried += len(unparsed.body)
            if unparsed.opcode == Opcode.CHUNK:
                chunk_data(unparsed, self.name)
            else:
                parse(unparsed, self.name)
        except Damage:
            return False
        return True

    def _look_ahead(self) -> None:
        """Reads the whole file once: checks that triaxcal wrote it, and takes from the
        summary the schemas and channels that a lost first chunk declared."""
        profile: str | None = None
        ours = False
        for piece in self.pieces():
            if not isinstance(piece, UnparsedRecord):
                continue
            if piece.opcode == Opcode.CHUNK:
                self._unpacked.chunk(piece)
            record = parse(piece, self.name) if piece.opcode in (Opcode.HEADER, Opcode.METADATA) else None
            if isinstance(record, Header):
                profile = record.profile
            elif isinstance(record, Metadata):
                ours = ours or record.name == schema.FORMAT_RECORD
            elif piece.opcode == Opcode.DATA_END:
                self._read_summary(piece.end)
        if profile is not None and profile != schema.PROFILE and not ours:
            raise RecordingError(
                f"{self.name}: an MCAP file, but not a recording of triaxcal: its header says profile"
                f" '{profile}', expected '{schema.PROFILE}'"
            )

    def _read_summary(self, offset: int) -> None:
        """Takes the schemas and channels of the summary if its CRC is right. They only
        repeat those of the chunks."""
        records, crc = [], 0
        try:
            unparsed = unparsed_at(self._source, self.name, offset, self.size)
            while unparsed.opcode != Opcode.FOOTER:
                records.append(parse(unparsed, self.name))
                crc = zlib.crc32(unparsed.body, zlib.crc32(unparsed.head, crc))
                unparsed = unparsed_at(self._source, self.name, unparsed.end, self.size)
            parse(unparsed, self.name)
        except Damage:
            return
        if footer_fits(unparsed, crc):
            for record in records:
                self.declare(record)


@dataclass
class Recovery:
    """Counts of kept and lost records.

    ``raw_records`` were kept. ``raw_missing`` were lost from the file, by their
    running index; a lower limit if ``cut_short``, as nothing tells how many were to
    follow the last one. ``raw_dropped`` never reached the file, by its own loss
    records. ``chunks_failed`` and ``attachments_failed`` fail their CRC and were
    dropped. ``unverified_messages`` were kept from a chunk that was cut off, so no
    CRC confirms them. ``undeclared_messages`` were dropped because the chunk that
    declares their type is lost. ``bytes_dropped`` belong to no kept record.
    ``unlocated_damage``: the CRC of the whole file is wrong though every chunk's and
    attachment's is right, so header or metadata may have a wrong byte.
    """

    raw_records: int = 0
    raw_missing: int = 0
    raw_dropped: int = 0
    messages: int = 0
    attachments: int = 0
    chunks_failed: int = 0
    attachments_failed: int = 0
    unverified_messages: int = 0
    undeclared_messages: int = 0
    bytes_dropped: int = 0
    cut_short: bool = False
    unlocated_damage: bool = False

    @property
    def lossless(self) -> bool:
        """Whether only the end of the file and its indexes were missing."""
        return not (self.raw_missing or self.bytes_dropped or self.undeclared_messages or self.unlocated_damage)


class Sealed(NamedTuple):
    """The document that a mended recording ends with, as its last attachment.
    ``later``: it was not in the recording, which ends before the run did. ``sign``
    makes the signature that follows it."""

    name: str
    media_type: str
    time_ns: int
    data: bytes
    later: bool = False
    sign: Callable[[SealedContents], SignatureMade] | None = None


def recover(path: Path, out: Path, *, without: Collection[str] = (), sealed: Sealed | None = None) -> Recovery:
    """Writes all readable records of ``path`` to ``out``, a finished recording, but for
    the attachments ``without``. ``path`` is only read. ``sealed`` becomes the end of
    ``out``.

    Raises RecordingError if ``path`` is no recording of triaxcal or cannot be read,
    or if ``out`` exists or cannot be written; DiskError if the disk fails. Raises
    Refused if ``path`` has neither a whole message nor an attachment. An error leaves
    no ``out`` behind.
    """
    if is_manifest(path):
        raise RecordingError(f"{path}: is a manifest; mend each segment that it says is cut short or damaged")
    try:
        with td.files.open_file(path) as source:
            damaged = DamagedFile(source, str(path))
            return _write(damaged, path.name, out, without, sealed)
    except FileExistsError:
        raise exists_already(out) from None
    except OSError as e:
        kind = DiskError if is_of_the_disk(e) else RecordingError
        raise kind(f"{e.filename or out}: {e.strerror}") from e


def _write(damaged: DamagedFile, name: str, out: Path, without: Collection[str], sealed: Sealed | None) -> Recovery:
    with new_file(out) as sink:
        recovery = _Recoverer(damaged, McapWriter(sink, enable_data_crcs=True), without, sealed).run(name)
        if not (recovery.messages or recovery.attachments):
            raise tc.Refused(f"{damaged.name}: nothing to recover, as there is no whole message or attachment in it")
        return recovery


class _Recoverer:
    """Copies the records of the damaged file to the new one and counts them."""

    def __init__(self, damaged: DamagedFile, mcap: McapWriter, without: Collection[str], sealed: Sealed | None) -> None:
        self._damaged, self._without, self._sealed = damaged, without, sealed
        self._mcap = mcap
        self._recovery = Recovery(cut_short=True)
        self._channel_ids: dict[int, int] = {}  # from those of the damaged file to those of the new one
        self._digest = schema.RawDigest()
        self._inventory = Inventory()  # of the new file
        self._first = 0  # running index of the first record
        self._raw_end = 0  # running index after the last known record
        self._written: dict[str, str] = {}  # the metadata record `raw`, if the writer finished the file
        self._located = False  # whether damage was found at a known place
        self._unpacked = Unpacked(damaged.name, damaged.size)

    def run(self, name: str) -> Recovery:
        self._mcap.start(profile=schema.PROFILE)
        # Copy every piece, with the CRC of the data section up to it.
        crc = zlib.crc32(MAGIC)
        for piece in self._damaged.pieces():
            if isinstance(piece, Stretch):
                self._stretch(piece)
            elif piece.opcode == Opcode.DATA_END:
                self._data_end(piece, crc)
            else:
                crc = zlib.crc32(piece.body, zlib.crc32(piece.head, crc))
                self._unparsed(piece)
        # Count the missing records and finish the new file.
        self._count_missing()
        self._write_end(name)
        return self._recovery

    def _unparsed(self, unparsed: UnparsedRecord) -> None:
        try:
            if unparsed.opcode == Opcode.CHUNK:
                self._records(chunk_data(unparsed, self._damaged.name))
                return
            record = parse(unparsed, self._damaged.name)
        except Damage:
            self._located = True
            self._recovery.bytes_dropped += unparsed.end - unparsed.offset
            if unparsed.opcode == Opcode.CHUNK:
                self._recovery.chunks_failed += 1
            else:
                self._recovery.attachments_failed += 1
            return
        if isinstance(record, Attachment):
            if record.name in self._without or record.name == schema.SIGNATURE_FILE:
                return  # no signature is of a recording that was mended later
            self._recovery.attachments += 1
            self._inventory.attachment(record.name, record.media_type, record.log_time, record.data)
            self._mcap.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            self._metadata(record)

    def _metadata(self, record: Metadata) -> None:
        if record.name == schema.RAW_RECORD:
            self._written = record.metadata
            return
        if record.name == schema.END_RECORD and self._sealed is not None:
            return  # the new file has its own
        if record.name != schema.FORMAT_RECORD:  # a wrong byte in it would make the new file unreadable
            self._mcap.add_metadata(record.name, record.metadata)
            if record.name != schema.RECOVERY_RECORD:
                self._inventory.metadata(record.name, record.metadata)
        elif record.metadata.get(schema.ENDS_WITH):
            self._digest.ends_with = record.metadata[schema.ENDS_WITH]
        self._first = self._first or schema.first_index({record.name: record.metadata})

    def _stretch(self, stretch: Stretch) -> None:
        """Keeps the records of a chunk that has the wrong length or was cut off."""
        self._located = True
        body = self._damaged.read(stretch.offset, min(stretch.length, CHUNK_LIMIT))
        found = chunk_head(body[HEAD.size :]) if body[:1] == bytes([Opcode.CHUNK]) else None
        if found is None:
            self._recovery.bytes_dropped += stretch.length
            return
        # A complete chunk in a record of the wrong length: its own CRC confirms it.
        chunk, length = found
        if len(chunk.data) == length and (data := unpack(chunk)) is not None:
            self._records(data)
            return
        # A damaged chunk is dropped; of one that the end of the file cuts off, the
        # first records are kept.
        self._recovery.bytes_dropped += stretch.length
        if len(chunk.data) == length:
            self._recovery.chunks_failed += 1
        elif stretch.at_end:
            self._recovery.unverified_messages += self._records(unpack_part(chunk))

    def _records(self, data: bytes) -> int:
        """Copies a chunk's records. Returns the number of messages kept."""
        kept = 0
        try:
            for record in chunk_records(data):
                self._unpacked.record()
                if isinstance(record, Message):
                    kept += self._message(record)
                else:
                    self._damaged.declare(record)
        except Damage:  # no record follows; a right CRC means that the writer wrote it so
            self._recovery.chunks_failed += 1
        self._recovery.messages += kept
        return kept

    def _message(self, message: Message) -> bool:
        channel, kind = self._declaration(message.channel_id)
        if channel is None or kind is None:
            self._recovery.undeclared_messages += 1
            return False
        try:
            self._count(channel.topic, message.data)
        except ValueError:
            return False  # from a chunk without a CRC
        if message.channel_id not in self._channel_ids:
            schema_id = self._mcap.register_schema(kind.name, kind.encoding, kind.data)
            self._channel_ids[message.channel_id] = self._mcap.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
            self._inventory.channel(
                channel.topic, channel.message_encoding, channel.metadata, (kind.name, kind.encoding, kind.data)
            )
        self._inventory.message(channel.topic, message.log_time, message.publish_time, message.data)
        self._mcap.add_message(
            self._channel_ids[message.channel_id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        return True

    def _declaration(self, channel_id: int) -> tuple[Channel | None, Schema | None]:
        """The channel and its schema by the file, else by the format's fixed ids."""
        channel = self._damaged.channels.get(channel_id)
        if channel is not None:
            return channel, self._damaged.schemas.get(channel.schema_id)
        if not 1 <= channel_id <= len(schema.CHANNELS):
            return None, None
        topic, name = schema.CHANNELS[channel_id - 1]
        kind = schema.SCHEMAS[name]
        return (
            Channel(channel_id, topic, MessageEncoding.Protobuf, {}, channel_id),
            Schema(channel_id, kind.data, SchemaEncoding.Protobuf, kind.name),
        )

    def _count(self, topic: str, data: bytes) -> None:
        """Counts raw records and losses. Raises ValueError if ``data`` is no message of
        the topic."""
        if topic == schema.RAW:
            first, phase, batch = decode_raw(data)
            self._digest.update(phase, batch)
            self._raw_end = max(self._raw_end, first + len(batch))
        elif topic == schema.LOSS:
            loss = schema.decode_loss(data)
            if loss.where == schema.RAW:
                self._recovery.raw_dropped += loss.records
                self._raw_end = max(self._raw_end, loss.first + loss.records)

    def _data_end(self, unparsed: UnparsedRecord, crc: int) -> None:
        self._recovery.cut_short = False
        record = parse(unparsed, self._damaged.name)
        assert isinstance(record, DataEnd)
        wrong = record.data_section_crc not in (0, crc)
        self._recovery.unlocated_damage = wrong and not self._located

    def _count_missing(self) -> None:
        recovery = self._recovery
        recovery.raw_records = self._digest.records
        by_index = self._raw_end - self._first - recovery.raw_records - recovery.raw_dropped
        written = self._written.get("records", "")
        # Only the CRC of the whole file covers metadata.
        by_metadata = int(written) if written.isdecimal() and not recovery.unlocated_damage else 0
        recovery.raw_missing = max(by_index, by_metadata - recovery.raw_records, 0)

    def _write_end(self, name: str) -> None:
        ends_with = {schema.ENDS_WITH: self._digest.ends_with} if self._digest.ends_with else {}
        own = {"format": schema.FORMAT} | ends_with
        self._mcap.add_metadata(schema.FORMAT_RECORD, own)
        self._inventory.metadata(schema.FORMAT_RECORD, own)
        closing = {schema.RAW_RECORD: self._digest.record()}
        if self._sealed is not None:
            digest = hashlib.sha256(self._sealed.data).hexdigest()
            closing[schema.END_RECORD] = {"name": self._sealed.name, "sha256": digest}
        closing[schema.RECOVERY_RECORD] = self._summary(name)
        if self._sealed is not None:
            end = End(*self._sealed[:4])
            self._mcap.add_attachment(end.time_ns, end.time_ns, end.name, end.media_type, end.data)
            if self._sealed.sign is not None:
                made = self._sealed.sign(self._inventory.sealed(end, closing))
                self._mcap.add_attachment(end.time_ns, end.time_ns, made.name, made.media_type, made.data)
        for record, values in closing.items():
            self._mcap.add_metadata(record, values)
        self._mcap.finish()  # type: ignore[no-untyped-call]

    def _summary(self, name: str) -> dict[str, str]:
        """The record of the recovery."""
        summary = {"of": name, **{key: str(value).lower() for key, value in asdict(self._recovery).items()}}
        if "sha256" in self._written:
            summary["sha256_when_written"] = self._written["sha256"]
        if self._sealed is not None and self._sealed.later:
            summary[schema.SEALED_LATER] = self._sealed.name
        return summary
