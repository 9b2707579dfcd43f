"""Recordings byte by byte, so that they can say what no writer would."""

from __future__ import annotations

import struct

import zstandard
from mcap.opcode import Opcode

from triaxcald.recording import schema
from triaxcald.recording.mcap_records import MAGIC
from triaxcald.recording.schema import SCHEMAS


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(data: bytes, *, says: int | None = None, compression: str = "zstd") -> bytes:
    packed = zstandard.compress(data, 19 if len(data) < 10**6 else 1) if compression == "zstd" else data
    size = len(data) if says is None else says
    return record(
        Opcode.CHUNK, struct.pack("<QQQI", 0, 0, size, 0) + text(compression) + struct.pack("<Q", len(packed)) + packed
    )


def channel(topic: str, number: int = 1) -> bytes:
    kind = SCHEMAS["RawBatch"]
    declared = record(Opcode.SCHEMA, struct.pack("<H", number) + text(kind.name) + text("protobuf") + text("")[:4])
    return declared + record(
        Opcode.CHANNEL, struct.pack("<HH", number, number) + text(topic) + text("protobuf") + bytes(4)
    )


def message(data: bytes, number: int = 1) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, 0, 0) + data)


def metadata(name: str, **values: str) -> bytes:
    pairs = b"".join(text(key) + text(value) for key, value in values.items())
    return record(Opcode.METADATA, text(name) + struct.pack("<I", len(pairs)) + pairs)


def attachment(name: str, data: bytes) -> bytes:
    return record(Opcode.ATTACHMENT, bytes(16) + text(name) + text("") + struct.pack("<Q", len(data)) + data + bytes(4))


def raw(**values: object) -> bytes:
    return bytes(SCHEMAS["RawBatch"].message(**values).SerializeToString())


def whole(*records: bytes) -> bytes:
    """A file that a reader takes for whole: no CRC in it is given."""
    head = record(Opcode.HEADER, text("triaxcal") + text(""))
    end = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20))
    own = metadata(schema.FORMAT_RECORD, format=schema.FORMAT)
    return MAGIC + head + own + b"".join(records) + end + MAGIC
