"""All frames of a bus, recorded beside the units on it and by themselves."""

from __future__ import annotations

import asyncio
import os
import shutil
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from tests.daemon.run.test_unit_recording import Bench, Told, recorded
from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.profile import READINGS
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.recording import writer as writer_module
from triaxcald.recording.bus import frame_rows
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import BUS_RECORD
from triaxcald.run import record_only
from triaxcald.run.record_only import BusRecording, State
from triaxcald.station.config import Station, load_station
from triaxcald.station.reconnect import RetryPolicy

Row = tuple[int, int, int, bytes]
FOREIGN = [
    can.Message(arbitration_id=0x18DAF101, is_extended_id=True, data=bytes(range(8))),
    can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=3),
    can.Message(arbitration_id=0x20, is_extended_id=False, is_error_frame=True, data=bytes(8)),
    can.Message(arbitration_id=0x7FF, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(64)),
]


def listening(station: Station, told: Told, path: Path) -> BusRecording:
    return BusRecording(station, station.buses[0], told, lambda: path)


async def until(true: Callable[[], bool]) -> None:
    while not true():
        await asyncio.sleep(0.01)


def frames_of(path: Path) -> list[Row]:
    with Recording.open(path) as recording:
        return [row[:4] for row in frame_rows(recording)]


def records_of(path: Path) -> list[Row]:
    rows: list[Row] = []
    with Recording.open(path) as recording:
        for batch in recording.raw(CALIBRATION):
            ends = np.cumsum(batch.length).tolist()
            data = [batch.payload[end - n : end] for end, n in zip(ends, batch.length.tolist(), strict=True)]
            columns = (batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist())
            rows += zip(*columns, data, strict=True)
    return rows


def samples_of(path: Path) -> list[tuple[float, ...]]:
    """Readings and channels, in order. Their count may differ: where an error frame tells of a loss, it goes on by the
    host's time, and the machine may just then stand still."""
    found: list[tuple[float, ...]] = []
    with Recording.open(path) as recording:
        decoded = DecodedStream(bundle_of(recording), READINGS)
        for batch in recording.raw(CALIBRATION):
            block = decoded.feed(batch)
            columns = [*block.readings.T.tolist(), *(values.tolist() for values in block.channels.values())]
            found += zip(*columns, strict=True)
    return found


@pytest.fixture
def beside(workshop: Any, request: pytest.FixtureRequest) -> tuple[Path, Path]:
    """The recordings of a bus and of the unit on it, made at once, with frames of others among them."""
    channel = request.node.name
    bus = {"interface": "virtual", "channel": channel}
    paths = workshop.folder / "bus.mcap", workshop.folder / "unit0.mcap"

    async def work() -> None:
        bench, told = (
            Bench(workshop, [{"profile": "triax-ref-can", "serial": 12, "bus": {**bus, "node_id": 9}}]),
            Told(),
        )
        where = await bench.put(0)
        units = {"bus": where, "profile": "triax-ref-can"}
        station = load_station(workshop.station(units, buses=[{"name": "bus", "bus": bus}]))
        recording = listening(station, told, paths[0])
        heard = asyncio.ensure_future(recording.run(None, RetryPolicy()))
        await told.until("bus", lambda text: text == "recording")
        unit = recorded(station, workshop.folder, told, seconds=1.0, policy=RetryPolicy())
        await told.until("unit0", lambda text: text == "recording")
        with can.Bus(channel, "virtual", ignore_config=True) as other:
            for message in FOREIGN:
                other.send(message)
        (kept,) = await unit
        assert kept.error is None
        last_ns = max(row[0] for row in records_of(paths[1]))
        await until(lambda: (recording.status.last_ns or 0) > last_ns)
        heard.cancel()
        (of_bus,) = await asyncio.gather(heard)
        assert (of_bus.exit_code, of_bus.error) == (130, "bus bus: interrupted")
        await bench.take(0)

    asyncio.run(work())
    return paths


def frames_of_unit(path: Path) -> list[Row]:
    """Its own, without the error frames of the bus."""
    return [row for row in records_of(path) if not row[2] & RawFlag.ERROR]


def test_a_bus_has_every_frame_of_the_unit_on_it_and_those_of_others(beside: tuple[Path, Path]) -> None:
    bus, unit = beside
    heard = frames_of(bus)
    identifiers = {0x189, 0x289, 0x389, 0x489}
    of_unit = [row for row in heard if row[1] in identifiers]
    first = of_unit.index(frames_of_unit(unit)[0])
    assert of_unit[first : first + len(frames_of_unit(unit))] == frames_of_unit(unit)
    assert set(records_of(unit)) <= set(heard), "error frames too"
    foreign = [row[1:] for row in heard if row[1] in {message.arbitration_id for message in FOREIGN}]
    assert foreign == [
        (0x18DAF101, RawFlag.EXTENDED_ID, bytes(range(8))),
        (0x123, RawFlag.REMOTE, bytes(3)),
        (0x20, RawFlag.ERROR, bytes(8)),
        (0x7FF, RawFlag.FD | RawFlag.BIT_RATE_SWITCH, bytes(64)),
    ]


def test_what_the_station_asked_the_unit_is_in_the_recording_of_the_bus(beside: tuple[Path, Path]) -> None:
    """Network management starts node 9, and SDO reads its identity (CiA 301)."""
    rows = [(source, flags, data) for _, source, flags, data in frames_of(beside[0])]
    assert rows.count((0x000, RawFlag.SENT, bytes.fromhex("0109"))) == 2
    assert (0x609, RawFlag.SENT, bytes.fromhex("4018100100000000")) in rows
    assert {flags for source, flags, _ in rows if source == 0x589} == {0}, "the unit's answers"


def test_the_recording_of_a_bus_says_which_and_who_was_listening(beside: tuple[Path, Path]) -> None:
    with Recording.open(beside[0]) as recording:
        told = recording.metadata[BUS_RECORD]
        assert (told["name"], told["interface"], recording.metadata["station"]) == ("bus", "virtual", {"name": "bench"})
        assert recording.phases() == [f"bus/{told['channel']}"]
        assert "station.toml" in recording.attachments
        assert [(e.kind, e.detail) for e in recording.events()][-1] == ("ended", {"reason": "signal"})


def test_the_import_of_a_bus_has_the_samples_of_the_unit_s_own_recording(
    beside: tuple[Path, Path], triaxcal: Callable[..., Any], tmp_path: Path
) -> None:
    imported = tmp_path / "imported.mcap"
    done = triaxcal("log", "import", beside[0], "--profile", "triax-ref-can", "-o", imported, "--json")
    assert done.code == 0, done.err
    assert done.json["node"] == 9
    own, of_bus = samples_of(beside[1]), samples_of(imported)
    assert len(own) >= 90
    first = of_bus.index(own[0])
    assert of_bus[first : first + len(own)] == own


class Dongle:
    """A USB adapter by the serial protocol of LAWICEL, on a pseudo-terminal: the test is its bus."""

    def __init__(self, port: Path) -> None:
        self._port = port
        self._adapter, self._line = os.openpty()
        tty.setraw(self._line)
        os.set_blocking(self._adapter, False)
        port.symlink_to(os.ttyname(self._line))

    def says(self, *lines: str) -> None:
        os.write(self._adapter, "".join(f"{line}\r" for line in lines).encode())

    def was_told(self) -> list[str]:
        with suppress(BlockingIOError):
            return os.read(self._adapter, 4096).decode().split("\r")[:-1]
        return []

    def unplug(self) -> None:
        self._port.unlink()
        os.close(self._line)
        os.close(self._adapter)


@pytest.fixture
def port(tmp_path: Path) -> Path:
    return tmp_path / "dongle"


async def test_a_bus_that_vanishes_comes_back_in_one_recording_with_the_gap(workshop: Any, port: Path) -> None:
    bus = {"interface": "slcan", "channel": str(port), "bitrate": 500_000, "options": {"sleep_after_open": 0}}
    station = load_station(workshop.station(buses=[{"name": "dongle", "bus": bus}]))
    told, path, dongle = Told(), workshop.folder / "bus.mcap", Dongle(port)
    recording = listening(station, told, path)
    work = asyncio.ensure_future(recording.run(None, RetryPolicy()))
    await told.until("dongle", lambda text: text == "recording")
    told_it = dongle.was_told()
    assert ("L" in told_it, "O" in told_it, "S6" in told_it) == (True, False, True), "opened to listen only"
    dongle.says("t1232AABB", "T18DAF10110C")
    await until(lambda: recording.status.records == 2)
    dongle.unplug()
    await told.until("dongle", lambda text: text.startswith("lost: "))
    assert recording.status.state is State.WAITING
    dongle = Dongle(port)
    await told.until("dongle", lambda text: text == "the bus is back")
    assert (recording.status.state, recording.status.trouble) == (State.RECORDING, None)
    dongle.says("r1233")
    await until(lambda: recording.status.records == 3)
    work.cancel()
    kept = await work
    dongle.unplug()
    assert (kept.counts, kept.gaps) == ({"frames": 3, "identifiers": 2, "errors": 0}, 1)
    heard = frames_of(path)
    assert [row[1:] for row in heard] == [
        (0x123, 0, b"\xaa\xbb"),
        (0x18DAF101, RawFlag.EXTENDED_ID, b"\x0c"),
        (0x123, RawFlag.REMOTE | RawFlag.LOST_BEFORE, bytes(3)),
    ]
    with Recording.open(path) as held:
        _, interrupted, gap, ended = held.events()
    assert [interrupted.kind, gap.kind, ended.kind] == ["interrupted", "gap", "ended"]
    assert interrupted.detail["cause"] == gap.detail["cause"]
    assert heard[1][0] <= gap.detail["from_ns"] < gap.detail["to_ns"] <= heard[2][0]
    assert kept.gaps_s == pytest.approx((gap.detail["to_ns"] - gap.detail["from_ns"]) * 1e-9)


async def test_a_bus_that_does_not_come_back_is_given_up_and_the_recording_says_so(workshop: Any, port: Path) -> None:
    bus = {"interface": "slcan", "channel": str(port)}
    station = load_station(workshop.station(buses=[{"name": "dongle", "bus": bus}]))
    told, path, dongle = Told(), workshop.folder / "bus.mcap", Dongle(port)
    work = asyncio.ensure_future(listening(station, told, path).run(None, RetryPolicy(most_s=0.0)))
    await told.until("dongle", lambda text: text == "recording")
    dongle.unplug()
    kept = await work
    assert kept.exit_code == 4
    with Recording.open(path) as held:
        *_, ended = held.events()
    assert (ended.kind, ended.detail) == ("ended", {"reason": "bus gave up"})


@pytest.mark.parametrize("lost", [False, True], ids=["silent", "lost"])
async def test_a_folder_that_is_removed_ends_the_recording_of_a_bus_that_brings_nothing(
    workshop: Any, port: Path, lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "LOOK_S", 0.01)
    monkeypatch.setattr(record_only, "LOOK_S", 0.01)
    bus = {"interface": "slcan", "channel": str(port)}
    station = load_station(workshop.station(buses=[{"name": "dongle", "bus": bus}]))
    told, folder, dongle = Told(), workshop.folder / "recordings", Dongle(port)
    folder.mkdir()
    work = asyncio.ensure_future(listening(station, told, folder / "bus.mcap").run(None, RetryPolicy()))
    await told.until("dongle", lambda text: text == "recording")
    if lost:
        dongle.unplug()
        await told.until("dongle", lambda text: text.startswith("lost: "))
    shutil.rmtree(folder)
    kept = await work
    if not lost:
        dongle.unplug()
    assert kept.exit_code == 5
    assert kept.error is not None
    assert "the file, or its folder, was removed" in kept.error


@pytest.mark.parametrize("most_s", [None, 60.0], ids=["without end", "a minute"])
async def test_whoever_waits_for_a_bus_without_end_is_told_how_to_set_one(
    workshop: Any, port: Path, most_s: float | None
) -> None:
    station = load_station(
        workshop.station(buses=[{"name": "dongle", "bus": {"interface": "slcan", "channel": str(port)}}])
    )
    told = Told()
    work = asyncio.ensure_future(
        listening(station, told, workshop.folder / "bus.mcap").run(None, RetryPolicy(most_s=most_s))
    )
    await told.until("dongle", lambda text: text.startswith("lost: "))
    work.cancel()
    await work
    assert ("--give-up-after" in told.stages["dongle"][0]) is (most_s is None)


async def test_a_bus_that_is_not_there_is_given_up(workshop: Any, port: Path) -> None:
    bus = {"interface": "slcan", "channel": str(port)}
    station = load_station(workshop.station(buses=[{"name": "dongle", "bus": bus}]))
    told, path = Told(), workshop.folder / "bus.mcap"
    kept = await listening(station, told, path).run(None, RetryPolicy(most_s=0.0))
    assert (kept.exit_code, kept.path) == (4, None)
    assert kept.error is not None
    assert kept.error.startswith(f"bus dongle: cannot open slcan {port}: ")
    assert not told.stages, "what is not waited for is an error alone"
    assert not path.exists()
