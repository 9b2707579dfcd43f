"""All frames of a bus, recorded by `record`: every one that candump saw."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.guest.inside.conftest import ip
from tests.guest.inside.program import events, records, simulated_unit
from tests.guest.inside.test_reconnect import Told, until
from tests.guest.inside.witness import ERROR, EXTENDED, REMOTE, Seen, Sender, listeners, words_of
from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.interface import RawFlag
from triaxcald.run.record_only import BusRecording, State, UnitRecording
from triaxcald.run.session import UnitSession
from triaxcald.station.config import load_station
from triaxcald.station.lock import FOLDER_VARIABLE
from triaxcald.station.reconnect import RetryPolicy

BUS = """\
format = "triaxcal.station/1"
name = "bench"
[[buses]]
name = "all"
bus = {{ interface = "socketcan", channel = "{0}" }}
"""
UNIT = """\
[[units]]
name = "unit"
profile = "triax-ref-can"
bus = {{ interface = "socketcan", channel = "{0}", node_id = 5 }}
"""


def station_file(folder: Path, name: str, *more: str) -> Path:
    (folder / "station.toml").write_text("".join((BUS, *more)).format(name))
    return folder / "station.toml"


def heard(path: Path) -> list[Seen]:
    """As candump would have it."""
    return [words_of(Frame(time_us * 1000, source, flags, data)) for time_us, source, flags, data in records(path)]


def recording_of(folder: Path, vcan: str, told: Told) -> BusRecording:
    station = load_station(station_file(folder, vcan))
    return BusRecording(station, station.buses[0], told, lambda: folder / "bus.mcap")


def sent(vcan: str, count: int, kinds: list[str]) -> None:
    subprocess.run(["cangen", vcan, "-g", "0", "-n", str(count), *kinds], check=True)


def test_a_bus_is_recorded_frame_by_frame_as_candump_saw_it(
    vcan: str, sender: Sender, candump: Callable[..., Any], tmp_path: Path
) -> None:
    recording = recording_of(tmp_path, vcan, Told())
    witness = candump(vcan, 604)

    async def work() -> None:
        running = asyncio.ensure_future(recording.run(None, RetryPolicy()))
        await until(lambda: recording.status.state is State.RECORDING)
        for i, kinds in enumerate((["-e"], ["-f", "-b"], ["-m"]), 1):
            await asyncio.to_thread(sent, vcan, 200, kinds)
            sender.send(ERROR | 0x04, b"\0\x10\0\0\0\0\0\0")
            await until(lambda: recording.status.records == 201 * i)  # noqa: B023 - it is called at once
        sender.send(0x1ABCDEF | EXTENDED | REMOTE, bytes(5))
        await until(lambda: recording.status.records == 604)
        running.cancel()
        await running

    asyncio.run(work())
    frames, seen = heard(tmp_path / "bus.mcap"), witness.frames()
    assert frames == seen
    assert {frame.fd for frame in seen} >= {None, 0, 1}
    assert {bool(frame.word & bit) for frame in seen for bit in (EXTENDED, ERROR, REMOTE)} == {False, True}
    assert sum(bool(frame.word & ERROR) for frame in frames) == 3
    assert recording.status.counts["errors"] == 3
    assert recording.status.gaps == 0


def test_a_unit_and_its_bus_share_a_socket_and_the_bus_has_what_was_asked_too(
    vcan: str, witness: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    dumped = witness(vcan)
    simulated = simulated_unit(tmp_path, vcan)
    station, told = load_station(station_file(tmp_path, vcan, UNIT)), Told()
    paths = tmp_path / "bus.mcap", tmp_path / "unit.mcap"
    bus = BusRecording(station, station.buses[0], told, lambda: paths[0])
    unit = UnitRecording(UnitSession(station, station.places[0], told), lambda _: paths[1])
    before = listeners(vcan)

    async def work() -> None:
        running = [asyncio.ensure_future(recording.run(None, RetryPolicy())) for recording in (bus, unit)]
        for recording in bus, unit:
            await until(lambda: recording.status.state is State.RECORDING)  # noqa: B023 - it is called at once
        assert listeners(vcan) == before + 1, "one that takes all"
        await until(lambda: unit.status.records >= 200)
        running[1].cancel()
        await running[1]
        assert listeners(vcan) == before + 1
        running[0].cancel()
        await running[0]

    asyncio.run(work())
    simulated.stop()
    frames, seen = heard(paths[0]), dumped()
    first = seen.index(frames[0])
    assert frames == seen[first : first + len(frames)]
    asked = [(source, flags) for _, source, flags, _ in records(paths[0]) if source in (0x000, 0x605)]
    assert {source for source, _ in asked} == {0x000, 0x605}
    assert {flags for _, flags in asked} == {RawFlag.SENT}
    own = [row for row in records(paths[0]) if row[1] in (0x185, 0x285, 0x385, 0x485)]
    both = len(own) - own.index(records(paths[1])[0])
    assert both > 100
    assert records(paths[1])[:both] == own[-both:][: len(records(paths[1]))]


def test_an_interface_that_is_removed_and_added_leaves_a_gap(
    vcan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    told = Told()
    recording = recording_of(tmp_path, vcan, told)

    async def work() -> None:
        running = asyncio.ensure_future(recording.run(None, RetryPolicy()))
        await until(lambda: recording.status.state is State.RECORDING)
        sender = Sender(vcan)
        sender.count(0x123, range(10))
        await until(lambda: recording.status.records == 10)
        ip("link", "del", vcan)
        sender.close()
        await until(lambda: any(said.startswith("lost: cannot open socketcan") for said in told.said))
        ip("link", "add", "dev", vcan, "up", "type", "vcan")
        await until(lambda: "the bus is back" in told.said)
        sender = Sender(vcan)
        sender.count(0x123, range(10, 20))
        await until(lambda: recording.status.records == 20)
        sender.close()
        running.cancel()
        await running

    asyncio.run(work())
    rows = records(tmp_path / "bus.mcap")
    assert [int.from_bytes(data, "little") for _, _, _, data in rows] == list(range(20))
    assert [i for i, (_, _, flags, _) in enumerate(rows) if flags & RawFlag.LOST_BEFORE] == [10]
    found = dict(events(tmp_path / "bus.mcap"))
    assert rows[9][0] <= found["gap"]["from_ns"] // 1000 <= found["gap"]["to_ns"] // 1000 <= rows[10][0]
