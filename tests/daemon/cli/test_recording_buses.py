"""record, of buses that a station listens to."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.recording.bus import frame_rows
from triaxcald.recording.reader import Recording

Run = Callable[..., Any]
GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return str(request.node.name)


@pytest.fixture
def bus(channel: str) -> dict[str, Any]:
    return {"name": "all", "bus": {"interface": "virtual", "channel": channel}}


@pytest.fixture
def unit(channel: str) -> dict[str, Any]:
    bus = {"interface": "virtual", "channel": channel, "node_id": 9}
    return {"name": "left", "profile": "triax-ref-can", "bus": bus}


@pytest.fixture
def device(workshop: Any, unit: dict[str, Any]) -> Path:
    return workshop.device(profile="triax-ref-can", serial=12, bus=unit["bus"], speed=1.0)


def test_a_unit_and_its_bus_are_recorded_side_by_side_into_a_folder(
    workshop: Any, triaxcal: Run, unit: Any, bus: Any, device: Path
) -> None:
    station = workshop.station(unit, buses=[bus])
    folder = workshop.folder / "recordings"
    folder.mkdir()
    with workshop.serve(device):
        done = triaxcal("record", station, "-o", folder, "--seconds", "2")
    assert done.code == 0, done.err
    of_bus, of_unit = sorted(folder.iterdir())
    assert re.fullmatch(r"all-\d{8}T\d{6}Z\.mcap", of_bus.name)
    assert of_unit.name.startswith("left-0012-")
    (summary,) = [line for line in done.err.splitlines() if line.startswith("all: ") and "frames" in line]
    told = re.fullmatch(rf"all: (\d+) frames of (\d+) identifiers in 2\.\d s, {re.escape(str(of_bus))}", summary)
    assert told is not None, summary
    info = triaxcal("log", "info", of_bus, "--json").json
    (found,) = info["bus"]["channels"].values()
    assert (found["frames"], found["identifiers"]) == (int(told[1]), int(told[2]))
    assert {0x189, 0x289, 0x389, 0x489, 0x589} <= identifiers(of_bus)
    assert (info["finished"], info["ended"]) == (True, {"reason": "asked"})


def identifiers(path: Path) -> set[int]:
    with Recording.open(path) as recording:
        return {row[1] for row in frame_rows(recording)}


def test_a_bus_alone_goes_into_a_file_and_may_be_silent(workshop: Any, triaxcal: Run, bus: Any) -> None:
    station, rec = workshop.station(buses=[bus]), workshop.folder / "rec.mcap"
    done = triaxcal("record", station, "-o", rec, "--seconds", "0.5")
    assert done.code == 0, done.err
    assert re.fullmatch(rf"all: 0 frames of 0 identifiers in 0\.\d s, {re.escape(str(rec))}", done.err.splitlines()[-1])
    assert triaxcal("log", "info", rec, "--json").json["bus"]["channels"] == {}
    triaxcal("record", station, "-o", rec, "--seconds", "1").failed(2, f"{rec}: exists already")


def test_one_of_units_and_buses_is_named_by_the_option_of_units(
    workshop: Any, triaxcal: Run, unit: Any, bus: Any
) -> None:
    station, rec = workshop.station(unit, buses=[bus]), workshop.folder / "rec.mcap"
    triaxcal("record", station, "-o", rec).failed(
        2, f"{station}: there are 1 unit and 1 bus; name one of left, all with --unit, or record all of them into"
    )
    triaxcal("record", station, "-o", rec, "--unit", "al").failed(
        2, f"{station}: units and buses: name one of left, all with --unit"
    )
    done = triaxcal("record", station, "-o", rec, "--unit", "all", "--seconds", "0.5")
    assert done.code == 0, done.err
    with Recording.open(rec) as recording:
        assert recording.metadata["bus"]["name"] == "all"


def test_a_bus_in_segments_goes_on_behind_its_manifest(workshop: Any, triaxcal: Run, bus: Any) -> None:
    station, folder = workshop.station(buses=[bus]), workshop.folder / "recordings"
    folder.mkdir()
    for _ in range(2):
        assert triaxcal("record", station, "-o", folder, "--seconds", "0.3", "--segment-time", "1h").code == 0
    info = triaxcal("log", "info", folder / "all.segments.json", "--json").json
    assert [s["file"] for s in info["segments"]] == ["all-000001.mcap", "all-000002.mcap"]
    assert info["bus"]["name"] == "all"
    assert [e["detail"] for e in info["events"] if e["kind"] == "ended"] == [{"reason": "asked"}] * 2


def test_lines_for_programs_say_that_it_is_a_bus(workshop: Any, triaxcal: Run, bus: Any) -> None:
    station, rec = workshop.station(buses=[bus]), workshop.folder / "rec.mcap"
    options = ["--seconds", "0.3", "--log-format", "json", "--metrics", "0"]
    done = triaxcal("record", station, "-o", rec, *options)
    assert done.code == 0
    lines = [json.loads(line) for line in done.err.splitlines()]
    assert [(line["event"], line["unit"], line["message"]) for line in lines[1:-1]] == [("stage", "all", "recording")]
    ended = lines[-1]
    assert (ended["event"], ended["unit"], ended["kind"], ended["recording"]) == ("ended", "all", "bus", str(rec))


def test_a_bus_that_a_unit_is_on_is_driven_as_the_unit_drives_it(
    workshop: Any, triaxcal: Run, unit: Any, channel: str
) -> None:
    other = {"name": "all", "bus": {"interface": "virtual", "channel": channel, "bitrate": 250_000}}
    station = workshop.station(unit, buses=[other])
    triaxcal("record", station, "-o", workshop.folder).failed(
        2, f"{station}: bus all asks for bitrate 250000 on virtual {channel}", ", unit left for no options"
    )


@pytest.mark.parametrize(
    "command", [["run"], ["registers"], ["provision", "cal.json"], ["restore", "rec.mcap"]], ids=lambda c: c[0]
)
def test_what_needs_a_unit_says_that_there_is_none(workshop: Any, triaxcal: Run, bus: Any, command: list[str]) -> None:
    station = workshop.station(buses=[bus])
    workshop.write("cal.json", '{"format": "triaxcal.calibration/1"}')
    given = {"cal.json": workshop.folder / "cal.json", "rec.mcap": GOLDEN}
    triaxcal(*(given.get(word, word) for word in command), station).failed(
        2, f"{station}: no units: only `triaxcal record` listens to its buses"
    )
