"""The whole way: a simulated unit on a CAN bus, recorded across a link that goes down, with candump beside it."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.guest.inside.program import events, recorder, records, simulated_unit
from tests.guest.inside.witness import listeners, wait_until
from triaxcal_drivers.interface import RawFlag

SECONDS = 4  # of the samples' time, in which the gap is


@pytest.fixture
def pair() -> Iterator[tuple[str, str]]:
    """Two interfaces that are one bus, of which each can go down alone."""
    names = ("vxcan0", "vxcan1")
    subprocess.run(["ip", "link", "add", names[0], "type", "vxcan", "peer", "name", names[1]], check=True)
    for name in names:
        subprocess.run(["ip", "link", "set", name, "up"], check=True)
    yield names
    subprocess.run(["ip", "link", "del", names[0]], check=True)


def test_a_recording_has_every_frame_that_candump_saw_before_and_after_its_gap(
    pair: tuple[str, str], tmp_path: Path, witness: Any
) -> None:
    unit_side, station_side = pair
    path, dumped = tmp_path / "recording.mcap", witness(station_side)
    unit = simulated_unit(tmp_path, unit_side)
    before = listeners(station_side)
    record = recorder(tmp_path, station_side, path, "--seconds", SECONDS)
    record.says("recording")
    wait_until(lambda: listeners(station_side) > before)
    subprocess.run(["ip", "link", "set", station_side, "down"], check=True)
    record.says("the link is down")
    subprocess.run(["ip", "link", "set", station_side, "up"], check=True)
    assert record.ends() == 0, record.said.read_text()
    unit.stop()

    recorded, watched = records(path), dumped()
    (after,) = (i for i, (_, _, flags, _) in enumerate(recorded) if flags & RawFlag.LOST_BEFORE)
    identifiers = {source for _, source, _, _ in recorded}
    seen_there = [(frame.time_us, frame.word, frame.data) for frame in watched if frame.word in identifiers]
    for part in recorded[:after], recorded[after:]:
        frames = [(time_us, source, data) for time_us, source, _, data in part]
        first = seen_there.index(frames[0])
        assert frames == seen_there[first : first + len(frames)]
    told = {kind: detail for kind, detail in events(path) if kind in ("interrupted", "gap")}
    for kind in ("interrupted", "gap"):
        down = f"socketcan {station_side}: the link is down: `ip link set {station_side} up`"
        assert down in json.dumps(told[kind]), kind
    assert told["gap"]["to_ns"] // 1000 == recorded[after][0]
    assert told["gap"]["from_ns"] // 1000 == recorded[after - 1][0]
    assert after > 0
    assert len(recorded) > after + 1
