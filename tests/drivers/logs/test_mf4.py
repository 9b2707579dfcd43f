"""What is looked at in an MF4 before asammdf gets it."""

from __future__ import annotations

import io
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from triaxcal_drivers.errors import LogError
from triaxcal_drivers.logs.can_frames import LoggedFrame, Remark
from triaxcal_drivers.logs.mf4 import check_blocks, frames

Read = Callable[..., tuple[list[LoggedFrame], Any]]
ID = b"MDF     4.11    " + bytes(12) + struct.pack("<H", 411) + bytes(34)


def block(kind: bytes, links: list[int], body: bytes = b"") -> bytes:
    return (
        b"##"
        + kind
        + bytes(4)
        + struct.pack("<QQ", 24 + 8 * len(links) + len(body), len(links))
        + (struct.pack(f"<{len(links)}Q", *links) + body)
    )


def group(cycles: int, record: int) -> bytes:
    return struct.pack("<QQHHIII", 0, cycles, 0, 0, 0, record, 0)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"MDF     3.30    " + bytes(12) + struct.pack("<H", 330) + bytes(34), "MDF before version 4"),
        (ID, "byte 64: the file ends before a block that it names"),
        (ID + block(b"HD", [10**9]), "byte 1000000000: the file ends before a block that it names"),
        (ID + block(b"HD", [2]) + bytes(40), "byte 2: expected a block (##)"),
        (ID + b"##HD" + bytes(4) + struct.pack("<QQ", 10**9, 0), "byte 64: the file ends in a block"),
        (ID + b"##HD" + bytes(4) + struct.pack("<QQ", 24, 2**40), "byte 64: a block of 24 bytes with 1099511627776"),
        (ID + block(b"HD", [96]) + block(b"DG", [96]), "byte 96: blocks that lead back to themselves"),
        (ID + block(b"HD", [96]) + block(b"CG", [0], group(10**12, 22)), "byte 96: a group of 22000000000000 bytes"),
        (ID + block(b"HD", [96]) + block(b"DZ", [], struct.pack("<2sBxIQQ", b"DT", 0, 0, 2**40, 8)),
         "unpack to more than 64 times the file"),
    ],
)  # fmt: skip
def test_a_file_that_says_more_than_it_can_hold_is_refused_with_its_place(data: bytes, words: str) -> None:
    with pytest.raises(LogError) as caught:
        check_blocks(io.BytesIO(data))
    assert words in str(caught.value)


@pytest.fixture(scope="module")
def written(messages: list[can.Message], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    pytest.importorskip("asammdf")
    path: Path = tmp_path_factory.mktemp("mf4") / "log.mf4"
    with can.MF4Writer(path) as log:
        for message in messages[:100]:
            log.on_message_received(message)
    return path.read_bytes()


@pytest.mark.parametrize(("flags", "remarks"), [(0, set()), (1, {Remark.DATE_WITHOUT_ZONE}), (2, set())])
def test_local_time_tells_no_zone(read: Read, written: bytes, flags: int, remarks: set[Remark]) -> None:
    header = 64
    links = struct.unpack_from("<Q", written, header + 16)[0]
    at = header + 24 + 8 * links + 12  # behind the time and the two offsets from UTC
    found, account = read(frames, written[:at] + bytes([flags]) + written[at + 1 :])
    assert len(found) == 100
    assert account.remarks == remarks


def test_a_file_cut_short_is_refused(read: Read, written: bytes) -> None:
    with pytest.raises(LogError, match="the file ends"):
        read(frames, written[: len(written) * 2 // 3])


def test_damage_anywhere_is_a_refusal_of_one_line_or_harmless(
    read: Read, written: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    dice = random.Random(5)
    for _ in range(60):
        damaged = bytearray(written)
        for _ in range(8):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        try:
            read(frames, bytes(damaged))
        except LogError as e:
            assert "\n" not in str(e)  # noqa: PT017
    assert capsys.readouterr() == ("", "")
