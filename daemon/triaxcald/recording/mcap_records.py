"""The records of an MCAP file with their offsets, checked strictly enough to detect
all damage.

The library's own readers give no offsets, do not check attachments, and trust the
lengths that they read.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length
CHUNK_LIMIT = 16 * 2**20
"""Bytes, before and after compression. Ours are about 1 MiB, those of other
tools 4; 8192 of the longest records, the most that one message of ours has, are
2."""
ATTACHMENT_LIMIT = 32 * 2**20  # a report is some MiB, the DBC of a whole vehicle ten
INDEX_LIMIT = 8 * 2**20  # of the messages in one chunk
RECORD_LIMIT = 2**20  # of all others; the longest of ours is the index of a chunk
EXPANSION_MOST = 64
"""Largest ratio of unpacked to stored bytes of a file, plus one chunk; raw records have
5 to 10."""
INDEX_ENTRY, UNINDEXED_MOST = 16, 4096
"""Bytes of each message in the uncompressed index of the file; number of messages that
may lack an index, those of a last chunk."""
_BLOCK = 2**16  # bytes read at once
_FOOTER_BYTES = 20  # of the body of a footer record
_INDEX_HEAD = struct.Struct("<HI")  # channel, bytes of the entries
_CHUNK_HEAD = struct.Struct("<QQQI")  # start, end, uncompressed size, uncompressed CRC
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_KNOWN = frozenset(int(code) for code in Opcode)
_LIMITS: Mapping[int, int] = {
    Opcode.CHUNK: CHUNK_LIMIT,
    Opcode.ATTACHMENT: ATTACHMENT_LIMIT,
    Opcode.MESSAGE_INDEX: INDEX_LIMIT,
}


class Damage(RecordingError):
    """The bytes at ``offset`` are not valid MCAP."""

    def __init__(self, name: str, offset: int, what: str) -> None:
        super().__init__(f"{name}: {what} at byte {offset}; mend it with `triaxcal log recover`")
        self.offset = offset
        self.what = what


class CutShort(Damage):
    """The file ends before or inside the record at ``offset``."""


@dataclass(frozen=True)
class UnparsedRecord:
    """One MCAP record, not yet parsed: ``body`` follows its opcode and length."""

    offset: int
    opcode: int
    body: bytes

    @property
    def head(self) -> bytes:
        return HEAD.pack(self.opcode, len(self.body))

    @property
    def end(self) -> int:
        return self.offset + HEAD.size + len(self.body)


def check_magic(stream: BinaryIO, name: str) -> None:
    """Check the magic. Raises CutShort if the file ends inside it, RecordingError if it
    is another file."""
    stream.seek(0)
    head = stream.read(td.files.HEAD)
    magic = head[: len(MAGIC)]
    if magic == MAGIC:
        return
    if MAGIC.startswith(magic):
        raise CutShort(name, 0, "the file ends")
    raise RecordingError(f"{name}: not an MCAP file but {td.files.kind(head)}, expected a recording (.mcap)")


def size_of(stream: BinaryIO) -> int:
    return stream.seek(0, os.SEEK_END)


def written_to(stream: BinaryIO, size: int) -> int:
    """Offset of the trailing zeros of a file of ``size`` bytes. After a power failure a
    file may be longer than its data that reached the disk."""
    end = size
    while end:
        begin = max(0, end - _BLOCK)
        stream.seek(begin)
        if kept := stream.read(end - begin).rstrip(b"\0"):
            return begin + len(kept)
        end = begin
    return 0


def unparsed_at(stream: BinaryIO, name: str, offset: int, size: int) -> UnparsedRecord:
    """The record at ``offset`` of a file of ``size`` bytes. Raises CutShort,
    Damage."""
    stream.seek(offset)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        raise CutShort(name, offset, "the file ends, not finished,")
    opcode, length = HEAD.unpack(head)
    if opcode not in _KNOWN:
        raise Damage(name, offset, f"unknown record type 0x{opcode:02x}")
    if length > size - offset - HEAD.size:
        raise CutShort(name, offset, "the file ends, not finished, in the record")
    limit = _LIMITS.get(opcode, RECORD_LIMIT)
    if length > limit:
        raise Damage(name, offset, f"{_kind(opcode)} record of {length} bytes, expected at most {limit},")
    return UnparsedRecord(offset, opcode, stream.read(length))


def _kind(opcode: int) -> str:
    return Opcode(opcode).name.lower().replace("_", " ")


def walk(stream: BinaryIO, name: str, size: int) -> Iterator[UnparsedRecord]:
    """All records in order, from the header to the footer. Raises CutShort,
    Damage."""
    offset = len(MAGIC)
    while True:
        unparsed = unparsed_at(stream, name, offset, size)
        yield unparsed
        offset = unparsed.end
        if unparsed.opcode == Opcode.FOOTER:
            return


def _index(stream: ReadDataStream) -> MessageIndex:
    """A message index without its unused entries, which as numbers would take ten times
    the memory."""
    channel_id = stream.read2()
    stream.read(stream.read4())
    return MessageIndex(channel_id, [])


_READERS: Mapping[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.MESSAGE_INDEX: _index,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read,
}


def parse(unparsed: UnparsedRecord, name: str) -> McapRecord:
    """Parse a record whose length must be exact; `chunk_data` reads chunks. Raises
    Damage."""
    kind = _kind(unparsed.opcode)
    read = _READERS.get(unparsed.opcode)
    if read is None:
        raise Damage(name, unparsed.offset, f"a {kind} record out of place")
    stream = ReadDataStream(io.BytesIO(unparsed.body))
    try:
        record = read(stream)
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as e:
        raise Damage(name, unparsed.offset, f"unreadable {kind} record") from e
    if stream.count != len(unparsed.body):
        raise Damage(name, unparsed.offset, f"{kind} record of the wrong length")
    if isinstance(record, Attachment):
        (crc,) = struct.unpack("<I", unparsed.body[-4:])
        if crc not in (0, zlib.crc32(memoryview(unparsed.body)[:-4])):
            raise Damage(name, unparsed.offset, f"attachment '{record.name}' fails its CRC")
    return record


def footer_fits(unparsed: UnparsedRecord, crc: int) -> bool:
    """Whether the footer's CRC matches the summary before it, whose running CRC is
    ``crc``."""
    (expected,) = struct.unpack("<I", unparsed.body[-4:])
    return expected in (0, zlib.crc32(unparsed.body[:-4], zlib.crc32(unparsed.head, crc)))


class Summary(NamedTuple):
    """The summary of a finished file."""

    statistics: Statistics
    channels: dict[int, str]
    chunks: list[ChunkIndex]
    metadata: dict[str, int]  # by name, the offset of the record
    attachments: dict[str, int]  # likewise


_SUMMARIZED: Final = frozenset((
    Opcode.STATISTICS, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX,
))  # fmt: skip


def summary_of(stream: BinaryIO, name: str, size: int) -> Summary | None:
    """None if the file has no valid summary, as an unfinished one. Raises
    RecordingError."""
    # The footer precedes the magic bytes at the end of the file.
    footer_at = size - len(MAGIC) - HEAD.size - _FOOTER_BYTES
    stream.seek(size - len(MAGIC))
    if footer_at < len(MAGIC) or stream.read(len(MAGIC)) != MAGIC:
        return None
    footer = unparsed_at(stream, name, footer_at, size)
    if footer.opcode != Opcode.FOOTER or footer.end != size - len(MAGIC):
        return None
    # It tells where the summary begins.
    end = parse(footer, name)
    assert isinstance(end, Footer)
    offset, crc, records = end.summary_start, 0, list[McapRecord]()
    if not len(MAGIC) <= offset < footer_at:
        return None
    # Read the summary's records up to the footer, with their CRC.
    while offset < footer_at:
        unparsed = unparsed_at(stream, name, offset, size)
        crc = zlib.crc32(unparsed.body, zlib.crc32(unparsed.head, crc))
        if unparsed.opcode in _SUMMARIZED:
            records.append(parse(unparsed, name))
        offset = unparsed.end
    statistics = [r for r in records if isinstance(r, Statistics)]
    if offset != footer_at or not footer_fits(footer, crc) or not statistics:
        return None
    return Summary(
        statistics[0],
        {r.id: r.topic for r in records if isinstance(r, Channel)},
        [r for r in records if isinstance(r, ChunkIndex)],
        {r.name: r.offset for r in records if isinstance(r, MetadataIndex)},
        {r.name: r.offset for r in records if isinstance(r, AttachmentIndex)},
    )


def indexed_times_ns(unparsed: UnparsedRecord) -> tuple[int, NDArray[np.int64]]:
    """Channel and log times (n,) of the messages that a message index lists."""
    channel_id, length = _INDEX_HEAD.unpack_from(unparsed.body)
    entries = np.frombuffer(unparsed.body, dtype="<u8", offset=_INDEX_HEAD.size, count=length // 8)
    return channel_id, entries[::2].astype(np.int64)


def chunk_head(body: bytes) -> tuple[Chunk, int] | None:
    """A chunk with the available part of its data, and their stated length; None if the
    bytes are no chunk."""
    try:
        start, end, uncompressed_size, crc = _CHUNK_HEAD.unpack_from(body)
        (name_length,) = struct.unpack_from("<I", body, _CHUNK_HEAD.size)
        at = _CHUNK_HEAD.size + 4 + name_length
        compression = body[at - name_length : at].decode()
        (length,) = struct.unpack_from("<Q", body, at)
    except (struct.error, UnicodeDecodeError):
        return None
    if uncompressed_size > CHUNK_LIMIT or compression not in ("", "zstd"):
        return None
    data = body[at + 8 : at + 8 + length]
    return Chunk(compression, data, end, start, crc, uncompressed_size), length


def whole_chunk_head(unparsed: UnparsedRecord, name: str) -> Chunk:
    """The chunk in ``unparsed``, still compressed. Raises Damage where its lengths
    do not agree."""
    found = chunk_head(unparsed.body)
    if found is None:
        raise Damage(name, unparsed.offset, "unreadable chunk (expected zstd or no compression)")
    chunk, length = found
    size = _CHUNK_HEAD.size + 4 + len(chunk.compression) + 8 + length
    if size != len(unparsed.body):
        raise Damage(name, unparsed.offset, "chunk of the wrong length")
    return chunk


def chunk_data(unparsed: UnparsedRecord, name: str) -> bytes:
    """The records inside the chunk, decompressed, their CRC checked. Raises
    Damage."""
    data = unpack(whole_chunk_head(unparsed, name))
    if data is None:
        raise Damage(name, unparsed.offset, "a chunk fails its CRC")
    return data


def unpack(chunk: Chunk) -> bytes | None:
    """A whole chunk's records; None where they fail their CRC."""
    data = chunk.data
    if chunk.compression == "zstd":
        try:
            # The zstd frame's own size decides how much memory is taken: check it
            # first.
            if zstandard.frame_content_size(data) != chunk.uncompressed_size:
                return None
            data = zstandard.decompress(data)
        except zstandard.ZstdError:
            return None
    if len(data) != chunk.uncompressed_size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        return None
    return data


def unpack_part(chunk: Chunk) -> bytes:
    """The records of a truncated chunk, as far as its bytes go, without a check of
    their CRC."""
    if chunk.compression != "zstd":
        return chunk.data
    source = zstandard.ZstdDecompressor(max_window_size=CHUNK_LIMIT).stream_reader(io.BytesIO(chunk.data))
    try:
        return source.read(chunk.uncompressed_size)
    except zstandard.ZstdError:
        return b""


class Unpacked:
    """Limits the unpacked size of a file's chunks to a multiple of the file: a few
    compressed bytes could keep a reader busy without end. Raises RecordingError above
    the limit."""

    def __init__(self, name: str, size: int) -> None:
        self._name = name
        self._bytes = EXPANSION_MOST * size + CHUNK_LIMIT
        self._records = size // INDEX_ENTRY + UNINDEXED_MOST

    def chunk(self, unparsed: UnparsedRecord) -> None:
        found = chunk_head(unparsed.body)
        self._bytes -= found[0].uncompressed_size if found else 0
        if self._bytes < 0:
            raise RecordingError(f"{self._name}: its chunks unpack to more than {EXPANSION_MOST} times the file")

    def record(self) -> None:
        self._records -= 1
        if self._records < 0:
            raise RecordingError(f"{self._name}: more messages than a file of its size has")


def chunk_records(data: bytes) -> Iterator[Schema | Channel | Message]:
    """The complete records in ``data``, without a truncated last one. Raises Damage
    with its offset in ``data``.

    A chunk holds nothing but schemas, channels and messages.
    """
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        start = at + HEAD.size
        end = start + length
        if end > len(data):
            return
        if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size:
            channel_id, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data, start)
            yield Message(channel_id, log_time, data[start + _MESSAGE_HEAD.size : end], publish_time, sequence)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = parse(UnparsedRecord(at, opcode, data[start:end]), "chunk")
            assert isinstance(record, Schema | Channel)
            yield record
        else:
            raise Damage("chunk", at, f"a record of type 0x{opcode:02x} and {length} bytes, in a chunk")
        at = end
