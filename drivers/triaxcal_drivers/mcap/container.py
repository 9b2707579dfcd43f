"""Messages in an MCAP file of another program, with lengths checked before reading.

The readers of the mcap library trust the lengths in a file, and those of
`triaxcald.recording` expect files of triaxcal.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import zstandard

from triaxcal_drivers.logs.can_frames import Account

MAGIC = b"\x89MCAP0\r\n"
RECORD_MOST = 64 * 2**20
"""Most bytes of a record. A chunk has 4 MiB by most writers' settings, and more if one
image is larger."""
UNPACKED_MOST = 64 * 2**20  # of a chunk
EXPANSION_MOST, ROOM = 64, 64 * 2**20
"""A file may unpack to `EXPANSION_MOST` times its size plus `ROOM` bytes."""
NAMED_MOST = 10_000  # schemas and channels, each; a robot has some hundred topics

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, bytes unpacked, CRC, length of the compression's name
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_SCHEMA, _CHANNEL, _MESSAGE_CODE, _CHUNK_CODE = 3, 4, 5, 6
_ENDS = (0x0F, 0x02)  # end of data, footer


class Schema(NamedTuple):
    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """``metadata`` are the publisher's own names and values."""

    schema: Schema | None
    topic: str
    encoding: str
    number: int
    metadata: tuple[tuple[str, str], ...] = ()


class LoggedMessage(NamedTuple):
    channel: Channel
    log_time_ns: int
    data: bytes


@dataclass
class McapFile:
    """``topics`` are the topics declared so far."""

    stream: BinaryIO
    account: Account
    topics: dict[str, None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._size = self.stream.seek(0, 2)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._unpacked = 0

    def messages(self) -> Iterator[LoggedMessage]:
        """All messages from the file's start. Counts unreadable places in the
        account."""
        at = len(MAGIC)
        while at < self._size:
            where = f"byte {at}"
            self.stream.seek(at)
            head = self.stream.read(_HEAD.size)
            if len(head) < _HEAD.size:
                self.account.note(where, "the file ends in a record")
                return
            code, length = _HEAD.unpack(head)
            if code in _ENDS:
                return
            # The record must end within the file.
            at += _HEAD.size + length
            if at > self._size:
                self.account.note(where, "the file ends in a record")
                return
            if code in (_SCHEMA, _CHANNEL, _MESSAGE_CODE, _CHUNK_CODE):
                if length > RECORD_MOST:
                    self.account.note(where, f"a record of {length} bytes, expected at most {RECORD_MOST}")
                    continue
                yield from self._record(code, self.stream.read(length), where)
        self.account.note(f"byte {at}", "the file ends without its end")

    def _record(self, code: int, body: bytes, where: str) -> Generator[LoggedMessage, None, bool]:
        """Messages of one record, of the file or of a chunk; ``where`` is its place, or
        that of the chunk. Returns whether the record is valid."""
        try:
            if code == _CHUNK_CODE:
                yield from self._chunk(body, where)
                return True
            if code == _MESSAGE_CODE:
                return (yield from self._message(body, where))
            return self._declare(code, body, where)
        except (struct.error, UnicodeDecodeError, IndexError):
            self.account.note(where, "a record that is too short")
            return False

    def _chunk(self, body: bytes, where: str) -> Iterator[LoggedMessage]:
        # Check the size before unpacking.
        _, _, size, crc, length = _CHUNK.unpack_from(body)
        compression = body[_CHUNK.size : _CHUNK.size + length].decode()
        self._unpacked += size
        if size > UNPACKED_MOST or self._unpacked > EXPANSION_MOST * self._size + ROOM:
            self.account.note(where, f"a chunk that unpacks to {size} bytes, which is more than there may be")
            return
        # Unpack and check size and CRC.
        data = _unpack(body[_CHUNK.size + length + 8 :], compression, size)
        if data is None or len(data) != size or crc not in (0, zlib.crc32(data)):
            self.account.note(where, f"a chunk ({compression or 'not compressed'}) that cannot be unpacked")
            return
        # Read the records in the chunk.
        at = 0
        while at + _HEAD.size <= len(data):
            code, count = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            if at + count > len(data) or code not in (_SCHEMA, _CHANNEL, _MESSAGE_CODE):
                self.account.note(where, "a chunk with a record that is none")
                return
            if not (yield from self._record(code, data[at : at + count], where)):
                return  # a chunk of a million bad records counts once
            at += count

    def _message(self, body: bytes, where: str) -> Generator[LoggedMessage, None, bool]:
        number, _, log_time_ns, _ = _MESSAGE.unpack_from(body)
        if number not in self._channels:
            self.account.note(where, f"a message of channel {number}, which is not declared")
            return False
        yield LoggedMessage(self._channels[number], log_time_ns, body[_MESSAGE.size :])
        return True

    def _declare(self, code: int, body: bytes, where: str) -> bool:
        """Stores a schema or channel; whether there was room for it. Raises
        struct.error, UnicodeDecodeError."""
        known: dict[int, Schema] | dict[int, Channel] = self._schemas if code == _SCHEMA else self._channels
        if len(known) >= NAMED_MOST:
            self.account.note(where, f"more than {NAMED_MOST} schemas or channels")
            return False
        (number,) = struct.unpack_from("<H", body)
        if code == _SCHEMA:
            name, at = _text(body, 2)
            encoding, at = _text(body, at)
            (length,) = struct.unpack_from("<I", body, at)
            self._schemas[number] = Schema(name, encoding, body[at + 4 : at + 4 + length])
        else:
            (schema,) = struct.unpack_from("<H", body, 2)
            topic, at = _text(body, 4)
            encoding, at = _text(body, at)
            self._channels[number] = Channel(self._schemas.get(schema), topic, encoding, number, _pairs(body, at))
            self.topics[topic] = None
        return True


def _pairs(body: bytes, at: int) -> tuple[tuple[str, str], ...]:
    """A map of texts; empty if it is damaged, as no sample depends on it."""
    found = []
    try:
        (length,) = struct.unpack_from("<I", body, at)
        at, end = at + 4, at + 4 + length
        while at < end:
            name, at = _text(body, at)
            value, at = _text(body, at)
            found.append((name, value))
    except (struct.error, UnicodeDecodeError):
        return ()
    return tuple(found)


def _text(body: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    end = at + 4 + length
    if end > len(body):
        raise struct.error("a text that ends beyond its record")
    return body[at + 4 : end].decode(), end


def _unpack(data: bytes, compression: str, size: int) -> bytes | None:
    """The unpacked data; None if they cannot be unpacked."""
    if compression == "":
        return data
    if compression == "zstd":
        try:
            if zstandard.frame_content_size(data) not in (size, -1):
                return None
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError:
            return None
    return _lz4(data, size) if compression == "lz4" else None


def _lz4(data: bytes, size: int) -> bytes | None:
    """Raises ModuleNotFoundError without lz4, which the extra ``logs`` installs."""
    from lz4.frame import LZ4FrameDecompressor

    try:
        return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except RuntimeError:
        return None
