"""Reads a recording in bounded memory, one chunk at a time, and rejects data that
fails its CRC."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, Message, Metadata, Schema

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording import schema
from triaxcald.recording.contents import Contents, TopicMessage
from triaxcald.recording.manifest import is_manifest, load_manifest
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
    parse,
    size_of,
    unparsed_at,
    walk,
    written_to,
)

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
    def open(cls, path: Path, *, unfinished: bool = False) -> Recording:
        try:
            stream = td.files.open_file(path)
        except OSError as e:
            raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e
        try:
            recording = cls(stream, str(path), unfinished=unfinished)
        except BaseException:
            stream.close()
            raise
        recording._heed_manifest(path)
        return recording

    def _heed_manifest(self, path: Path) -> None:
        """Take the unconfirmed records from the manifest beside the segment, which may
        have been closed before an exchange of the unit was noticed."""
        own = self.metadata.get(schema.SEGMENT_RECORD, {})
        of = own.get("of", "")
        if not is_manifest(of) or Path(of).name != of:
            return
        with suppress(RecordingError):  # a segment can be read alone
            for segment in load_manifest(path.with_name(of)).segments:  # by number: a mended file has another name
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
            raise RecordingError(f"{self.name}: reading failed at byte {offset}: {e.strerror}") from e

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
