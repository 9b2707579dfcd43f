"""What can still be found in a damaged file: its readable records in order and
the stretches between them."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from triaxcald.errors import RecordingError
from triaxcald.recording import schema
from triaxcald.recording.frames import (
    HEAD,
    MAGIC,
    CutShort,
    Damage,
    Frame,
    Unpacked,
    check_magic,
    chunk_data,
    footer_fits,
    frame_at,
    parse,
    size_of,
    whole_chunk_head,
)

_SEARCH_BLOCK = 2**20
_TRIED_MOST, _TRIED_LEAST, _TRY = 8, 16 * 2**20, 256
"""What looks like a record may be tried for so many times the file, and for so
many bytes in any case, each try counting for its length and so many bytes more.
In a file of ours, hardly any of its bytes look like one."""
# Chunk, attachment, metadata or end of data, shorter than 4 GiB: its type and
# the upper half of its length.
_RECORD_START = re.compile(rb"[\x06\x09\x0c\x0f](?=[\s\S]{4}\x00\x00\x00\x00)")


@dataclass(frozen=True)
class Stretch:
    """Bytes that are no whole record; ``at_end`` where nothing readable
    follows."""

    offset: int
    length: int
    at_end: bool


class DamagedFile:
    """Raises RecordingError at birth where the file is no recording of ours."""

    def __init__(self, source: BinaryIO, name: str) -> None:
        self.name = name
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._source = source
        self._tried = 0
        self.size = size_of(source)
        try:
            check_magic(source, name)
        except CutShort:
            self.size = 0
        self._unpacked = Unpacked(name, self.size)
        self._look_ahead()

    def pieces(self) -> Iterator[Frame | Stretch]:
        """Up to the end of the data and with it, or to the end of the file
        where that is missing.

        A chunk or attachment among them may still fail its CRC.
        """
        offset = len(MAGIC)
        while offset < self.size:
            try:
                frame = frame_at(self._source, self.name, offset, self.size)
                self._vet(frame)
            except Damage:
                following = self._search(offset + 1)
                yield Stretch(offset, following - offset, following >= self.size)
                offset = following
                continue
            yield frame
            offset = frame.end
            if frame.opcode == Opcode.DATA_END:
                return

    def read(self, offset: int, length: int) -> bytes:
        self._source.seek(offset)
        return self._source.read(length)

    def declare(self, record: object) -> None:
        """Notes a schema or channel."""
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)

    def _vet(self, frame: Frame) -> None:
        """Raises Damage where the record's length cannot be right."""
        if frame.opcode == Opcode.CHUNK:
            whole_chunk_head(frame, self.name)
        elif frame.opcode != Opcode.ATTACHMENT:
            parse(frame, self.name)

    def _search(self, offset: int) -> int:
        """Where the next record begins that proves itself, from ``offset`` on;
        the file's size if none."""
        while offset < self.size:
            block = self.read(offset, _SEARCH_BLOCK + HEAD.size)
            for found in _RECORD_START.finditer(block):
                if found.start() < _SEARCH_BLOCK and self._proves_itself(offset + found.start()):
                    return offset + found.start()
            offset += _SEARCH_BLOCK
        return self.size

    def _proves_itself(self, offset: int) -> bool:
        self._tried += _TRY
        if self._tried > _TRIED_MOST * self.size + _TRIED_LEAST:
            raise RecordingError(f"{self.name}: too much of it looks like records and is none")
        try:
            frame = frame_at(self._source, self.name, offset, self.size)
            self._tried += len(frame.body)
            if frame.opcode == Opcode.CHUNK:
                chunk_data(frame, self.name)
            else:
                parse(frame, self.name)
        except Damage:
            return False
        return True

    def _look_ahead(self) -> None:
        """Looks for what says whose file it is, and in the summary for what the
        first chunk declared."""
        profile: str | None = None
        ours = False
        for piece in self.pieces():
            if not isinstance(piece, Frame):
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
        """Takes what it declares, if its CRC vouches for it; it only repeats
        what the chunks say."""
        records, crc = [], 0
        try:
            frame = frame_at(self._source, self.name, offset, self.size)
            while frame.opcode != Opcode.FOOTER:
                records.append(parse(frame, self.name))
                crc = zlib.crc32(frame.body, zlib.crc32(frame.head, crc))
                frame = frame_at(self._source, self.name, frame.end, self.size)
            parse(frame, self.name)
        except Damage:
            return
        if footer_fits(frame, crc):
            for record in records:
                self.declare(record)
