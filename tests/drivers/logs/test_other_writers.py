"""What python-can's own writers write is read back as it was."""

from __future__ import annotations

import gzip
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from tests.drivers.logs.conftest import as_logged
from triaxcal_drivers.logs.can_frames import Account, LoggedFrame, Remark
from triaxcal_drivers.logs.kinds import Kind, opened

Write = Callable[[Path, list[can.Message]], None]


def written(writer: Any) -> Write:
    def write(path: Path, messages: list[can.Message]) -> None:
        with writer(path) as log:
            for message in messages:
                log.on_message_received(message)

    return write


def from_file(path: Path) -> tuple[str, list[LoggedFrame], Account]:
    account = Account()
    with opened(path) as log:
        assert isinstance(log.kind, Kind)
        return log.kind.name, list(log.frames(account)), account


def alike(frames: list[LoggedFrame], messages: list[can.Message]) -> None:
    found = [(0, f.flags, b"") if f.flags & 4 else (f.source, f.flags, f.data) for f in frames]
    assert found == [as_logged(m) for m in messages]
    assert all(f.time_ns is not None for f in frames)
    start_ns = frames[0].time_ns or 0
    for f, m in zip(frames, messages, strict=True):
        assert (f.time_ns or 0) - start_ns == pytest.approx((m.timestamp - messages[0].timestamp) * 1e9, abs=2000)


@pytest.mark.parametrize(
    ("kind", "suffix", "writer"),
    [("BLF", ".blf", can.BLFWriter), ("ASC", ".asc", can.ASCWriter), ("candump", ".log", can.CanutilsLogWriter)],
)
def test_frames_of_every_sort_are_read_as_they_were_written(
    messages: list[can.Message], tmp_path: Path, kind: str, suffix: str, writer: Any
) -> None:
    path = tmp_path / f"log{suffix}"
    written(writer)(path, messages)
    found, frames, account = from_file(path)
    assert found == kind
    assert account.damaged == 0
    assert account.others == {}
    alike(frames, messages)
    channels = {f.channel for f in frames}
    assert channels == ({"can0", "can1"} if kind == "candump" else {"1", "2"})


def test_trc_holds_classic_data_frames(messages: list[can.Message], tmp_path: Path) -> None:
    classic = [m for m in messages if not (m.is_fd or m.is_remote_frame or m.is_error_frame)]
    path = tmp_path / "log.trc"
    written(can.TRCWriter)(path, classic)
    kind, frames, account = from_file(path)
    assert (kind, account.damaged, account.remarks) == ("TRC", 0, {Remark.DATE_WITHOUT_ZONE})
    alike(frames, classic)


def test_mf4_is_read_through_asammdf(messages: list[can.Message], tmp_path: Path) -> None:
    pytest.importorskip("asammdf")
    path = tmp_path / "log.mf4"
    written(can.MF4Writer)(path, messages)
    kind, frames, account = from_file(path)
    assert (kind, account.damaged) == ("MF4", 0)
    alike(frames, messages)


def test_times_since_the_epoch_come_through(messages: list[can.Message], tmp_path: Path) -> None:
    for suffix, writer, remarks in (
        (".blf", can.BLFWriter, {Remark.DATE_WITHOUT_ZONE}),
        (".log", can.CanutilsLogWriter, set()),
    ):
        path = tmp_path / f"log{suffix}"
        written(writer)(path, messages[:10])
        _, frames, account = from_file(path)
        assert frames[0].time_ns == pytest.approx(messages[0].timestamp * 1e9, abs=1000)
        assert account.remarks == remarks


@pytest.mark.parametrize(("suffix", "writer"), [(".blf", can.BLFWriter), (".log", can.CanutilsLogWriter)])
def test_a_log_may_be_packed_and_have_any_name(
    messages: list[can.Message], tmp_path: Path, suffix: str, writer: Any
) -> None:
    written(writer)(tmp_path / f"log{suffix}", messages)
    path = tmp_path / "measurement.bin"
    path.write_bytes(gzip.compress((tmp_path / f"log{suffix}").read_bytes()))
    alike(from_file(path)[1], messages)


@pytest.mark.parametrize(
    ("suffix", "writer"),
    [(".blf", can.BLFWriter), (".asc", can.ASCWriter), (".log", can.CanutilsLogWriter), (".trc", can.TRCWriter)],
)
def test_what_is_whole_of_a_log_cut_short_or_damaged_is_read(
    messages: list[can.Message], tmp_path: Path, suffix: str, writer: Any
) -> None:
    classic = [m for m in messages if not (m.is_fd or m.is_remote_frame or m.is_error_frame)]
    path = tmp_path / f"log{suffix}"
    written(writer)(path, classic)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    _, frames, account = from_file(path)
    assert len(classic) // 2 < len(frames) < len(classic)
    alike(frames, classic[: len(frames)])
    assert account.damaged <= 1 or suffix == ".blf"
    dice = random.Random(2)
    damaged = bytearray(whole)
    for _ in range(20):
        damaged[dice.randrange(len(whole) // 2, len(whole))] ^= 0x41
    path.write_bytes(damaged)
    _, frames, account = from_file(path)
    assert account.damaged
    assert account.damage.startswith(("byte ", "line "))
    if suffix != ".blf":  # of which a container is lost
        assert len(frames) > len(classic) - 25
