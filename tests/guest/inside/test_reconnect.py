"""Recordings over faults of a real CAN interface: what is lost is counted where it is, and the recording goes on."""

from __future__ import annotations

import asyncio
import signal
import struct
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from tests.guest.inside.conftest import ip
from tests.guest.inside.program import Command, events
from tests.guest.inside.witness import Sender, listeners
from triaxcal_drivers.can.line import OVERFLOW
from triaxcal_drivers.catalogue import BUILT_IN
from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.profile import READINGS
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.recording.reader import Recording
from triaxcald.run.record_only import State, UnitRecording
from triaxcald.run.session import UnitSession
from triaxcald.schema.codes import Stage
from triaxcald.station.config import load_station
from triaxcald.station.lock import FOLDER_VARIABLE
from triaxcald.station.reconnect import RetryPolicy
from triaxcald.text import IS_BACK, STAGES

STATION = """\
format = "triaxcal.station/1"
name = "bench"
[[units]]
name = "unit"
profile = "lonely.toml"
bus = {{ interface = "socketcan", channel = "{0}", node_id = 5, options = {{ {1} }} }}
"""


def station_file(folder: Path, vcan: str, options: str = "") -> Path:
    """Of a unit that streams, and has no registers: the test sends its frames."""
    text = (BUILT_IN / "triax-ref-can.toml").read_text()
    lonely = text[: text.index("[registers]")]
    lonely = "\n".join(li for li in lonely.splitlines() if not li.startswith(("serial_register", "expect")))
    (folder / "lonely.toml").write_text(lonely)
    (folder / "triax-ref-can.dbc").write_bytes((BUILT_IN / "triax-ref-can.dbc").read_bytes())
    (folder / "station.toml").write_text(STATION.format(vcan, options))
    return folder / "station.toml"


def send(sender: Sender, counters: Iterable[int]) -> None:
    for counter in counters:
        sender.send(0x185, bytes(6) + struct.pack("<H", counter))
        sender.send(0x285, bytes(3) + struct.pack("<hH", 2500, counter) + bytes(1))


class Told:
    def __init__(self) -> None:
        self.said: list[str] = []

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def note(self, unit: str, text: str) -> None:
        self.said.append(text)

    def lost(self, unit: str, code: object, trouble: str) -> None:
        self.said.append(f"lost: {trouble}")

    def poses(self, *_: object) -> None: ...


async def until(true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < deadline_s, "it did not happen"
        await asyncio.sleep(0.01)


def decoded(path: Path) -> tuple[DecodedStream, np.ndarray]:
    with Recording.open(path) as recording:
        stream = DecodedStream(bundle_of(recording), READINGS)
        return stream, np.concatenate([stream.feed(batch).counter for batch in recording.raw(CALIBRATION)])


def test_an_interface_that_is_removed_and_added_leaves_a_gap_in_one_recording(
    vcan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    station, told, path = load_station(station_file(tmp_path, vcan)), Told(), tmp_path / "rec.mcap"
    recording = UnitRecording(UnitSession(station, station.places[0], told), lambda _: path)

    async def work() -> None:
        running = asyncio.ensure_future(recording.run(None, RetryPolicy()))
        await until(lambda: recording.status.path is not None and listeners(vcan) > 0)
        sender = Sender(vcan)
        send(sender, range(50))
        await until(lambda: recording.status.records == 100)
        ip("link", "del", vcan)
        await until(lambda: recording.status.state is State.WAITING)
        sender.close()
        await until(lambda: any(said.startswith("lost: cannot open socketcan") for said in told.said))
        ip("link", "add", "dev", vcan, "up", "type", "vcan")
        sender, counter = Sender(vcan), 200
        while recording.status.state is State.WAITING:
            send(sender, [counter])
            counter += 1
            await asyncio.sleep(0.01)
        send(sender, range(counter, counter + 20))
        await until(lambda: recording.status.records >= 130)
        sender.close()
        running.cancel()
        await running

    asyncio.run(work())
    assert [kind for kind, _ in events(path)] == ["recording_started", "interrupted", "gap", "ended"]
    stream, counters = decoded(path)
    assert counters[:42].tolist() == list(range(42)), "the last of them wait for those after them"
    assert stream.counts["receiver_overflows"] == 1
    assert (np.diff(counters) >= 1).all()


def test_what_a_stopped_process_does_not_fetch_is_counted_with_its_place(
    vcan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    station = station_file(tmp_path, vcan, "receive_buffer = 65536")
    path = tmp_path / "rec.mcap"
    command = Command(tmp_path, "record", station, "-o", path)
    command.says("recording")
    sender = Sender(vcan)
    for counter in range(100):
        send(sender, [counter])
        time.sleep(0.01)
    command.signal(signal.SIGSTOP)
    send(sender, range(100, 2100))
    time.sleep(3.0)  # longer than the unit may be silent
    command.signal(signal.SIGCONT)
    for counter in range(2100, 2300):
        send(sender, [counter])
        time.sleep(0.002)
    time.sleep(1.0)
    command.signal(signal.SIGINT)
    assert command.ends() == 130, command.said.read_text()
    told = events(path)
    gaps = [detail for kind, detail in told if kind == "gap"]
    assert "interrupted" not in [kind for kind, _ in told], "the unit was not silent"
    assert {gap["cause"] for gap in gaps} == {OVERFLOW}
    with Recording.open(path) as recording:
        batches = [batch for _, batch in recording.raw_batches()]
    lost = sum(gap["lost"] for gap in gaps)
    assert lost > 0
    first = int.from_bytes(batches[0].payload[6:8], "little")  # before it the stream was not open yet
    assert first < 100
    assert sum(map(len, batches)) + lost == 2 * (2300 - first)
    marked = sum(int(np.count_nonzero(batch.flags & RawFlag.LOST_BEFORE)) for batch in batches)
    assert marked == len(gaps)
    sender.close()
