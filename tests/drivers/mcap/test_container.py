"""MCAP by literal bytes, by its specification: what is there is read, and no length is believed."""

from __future__ import annotations

import io
import struct
import zlib

import pytest
import zstandard

from triaxcal_drivers.logs.can_frames import Account
from triaxcal_drivers.mcap.container import MAGIC, LoggedMessage, McapFile


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


SCHEMA = record(3, struct.pack("<H", 1) + text("pkg/Imu") + text("ros2msg") + text("float64 x"))
CHANNEL = record(4, struct.pack("<HH", 7, 1) + text("/imu") + text("cdr") + bytes(4))
MESSAGE = record(5, struct.pack("<HIQQ", 7, 0, 123, 456) + b"data")
END = record(0x0F, bytes(4))


def chunk(data: bytes, *, compression: str = "", crc: int | None = None, size: int | None = None) -> bytes:
    packed = zstandard.compress(data) if compression == "zstd" else data
    said = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data) if crc is None else crc)
    return record(6, said + text(compression) + struct.pack("<Q", len(packed)) + packed)


def read(*records: bytes) -> tuple[list[LoggedMessage], Account]:
    account = Account()
    return list(McapFile(io.BytesIO(MAGIC + b"".join(records)), account).messages()), account


@pytest.mark.parametrize("compression", ["", "zstd"])
def test_messages_in_chunks_and_without(compression: str) -> None:
    for parts in ((SCHEMA, CHANNEL, MESSAGE), (chunk(SCHEMA + CHANNEL + MESSAGE, compression=compression),)):
        (message,), account = read(record(1, text("ros2") + text("")), *parts, END)
        assert (message.log_time_ns, message.data) == (123, b"data")
        assert (message.channel.topic, message.channel.encoding) == ("/imu", "cdr")
        assert message.channel.schema == ("pkg/Imu", "ros2msg", b"float64 x")
        assert account.damaged == 0


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (chunk(MESSAGE, crc=1), "a chunk (not compressed) that cannot be unpacked"),
        (chunk(MESSAGE, compression="lzma"), "a chunk (lzma) that cannot be unpacked"),
        (chunk(MESSAGE, compression="zstd", size=2**40), "a chunk that unpacks to 1099511627776 bytes"),
        (chunk(MESSAGE, size=99), "a chunk (not compressed) that cannot be unpacked"),
        (chunk(bytes(900)), "a chunk with a record that is none"),
        (record(6, b"short"), "a record that is too short"),
        (record(4, struct.pack("<HHI", 8, 1, 2**31)), "a record that is too short"),
        (record(5, struct.pack("<HIQQ", 9, 0, 1, 1)), "a message of channel 9, which is not declared"),
    ],
)
def test_a_bad_record_is_counted_and_hides_no_other(bad: bytes, words: str) -> None:
    found, account = read(SCHEMA, CHANNEL, bad, MESSAGE, END)
    assert len(found) == 1
    assert account.damaged == 1
    assert account.damage == f"byte {len(MAGIC + SCHEMA + CHANNEL)}: {words}" or words in account.damage


def test_a_file_that_ends_early_says_so() -> None:
    found, account = read(SCHEMA, CHANNEL, MESSAGE)
    assert (len(found), account.damaged) == (1, 1)
    assert "the file ends without its end" in account.damage
    found, account = read(SCHEMA, CHANNEL, MESSAGE, struct.pack("<BQ", 5, 2**40))
    assert (len(found), account.damaged) == (1, 1)
    assert "the file ends in a record" in account.damage
