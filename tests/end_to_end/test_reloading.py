"""A recorder whose station file is changed while it records."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.recording.reader import Recording


def ended(path: Path) -> tuple[bool, list[Any], list[str]]:
    """Whether the file is whole, why it ended, and the events between."""
    with Recording.open(path) as recording:
        events = [(e.kind, e.detail) for e in recording.events()]
        return recording.finished, events[-1][1]["reason"], [kind for kind, _ in events[1:-1]]


@pytest.mark.slow
def test_at_a_hangup_the_station_file_is_read_again_and_what_it_leaves_alone_goes_on(
    workshop: Any, start: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    folder = workshop.folder / "recordings"
    folder.mkdir()

    def said(event: str) -> list[dict[str, Any]]:
        lines = [json.loads(line) for line in process.err.splitlines()]
        return [line for line in lines if line["event"] == event]

    def recording(unit: str) -> bool:
        return any((line["unit"], line["message"]) == (unit, "recording") for line in said("stage"))

    devices = [workshop.device(f"{name}.toml", serial=i, speed=1.0) for i, name in enumerate("abc", 1)]
    with workshop.serve(devices[0]) as a, workshop.serve(devices[1]) as b, workshop.serve(devices[2]) as c:
        units = {name: {"name": name, "bus": one.bus} for name, one in zip("abc", (a, b, c), strict=True)}
        station = workshop.station(units["a"], units["b"])
        process = start("record", station, "-o", folder, "--log-format", "json")
        wait_until(lambda: (recording("a") and recording("b")) or not process.running)

        station.write_text("format = 'triaxcal.station/1'\nname = 3\n")
        process.send(signal.SIGHUP)
        wait_until(lambda: said("reload") or not process.running)
        (refused,) = said("reload")
        assert (refused["level"], "and what was recorded goes on: " in refused["message"]) == ("error", True)
        assert "station.toml, line 2: name: " in refused["message"]

        workshop.station(units["a"], {**units["b"], "name": "b2"}, units["c"])
        process.send(signal.SIGHUP)
        wait_until(lambda: (recording("b2") and recording("c")) or not process.running)
        assert said("reload")[-1]["message"].endswith("changed: b, b2, c"), process.err
        process.send(signal.SIGTERM)
        assert process.wait() == 130, process.err
        assert {line["level"] for line in said("ended")} == {"info"}, "all of them were asked to end"
    found = {path.name.split("-")[0]: ended(path) for path in folder.iterdir()}
    assert found == {
        "a": (True, "signal", []), "b": (True, "asked", []), "b2": (True, "signal", []), "c": (True, "signal", []),
    }  # fmt: skip
