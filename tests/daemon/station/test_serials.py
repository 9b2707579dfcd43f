"""A unit that answers in two places of a station is refused before anything is recorded of it there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from triaxcald.errors import StationError
from triaxcald.station.config import SerialsSeen


def test_a_serial_number_is_of_one_place() -> None:
    seen = SerialsSeen()
    seen.add("4711", "left", "port=1")
    seen.add("4712", "right", "port=2")
    seen.add("4711", "left", "port=1")
    with pytest.raises(StationError, match=r"^serial 4711 answers in two places: unit left \(port=1\), and unit "):
        seen.add("4711", "right", "port=2")


def test_the_serial_number_of_a_unit_that_has_left_is_free() -> None:
    seen = SerialsSeen()
    seen.add("4711", "left", "port=1")
    seen.discard("left")
    seen.add("4711", "right", "port=2")


def test_a_serial_number_that_cannot_be_read_is_nobodys() -> None:
    seen = SerialsSeen()
    seen.add(None, "left", "port=1")
    seen.add(None, "right", "port=2")


def test_of_two_places_with_one_serial_number_the_second_is_refused_in_a_run(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    with workshop.serve(workshop.device("a.toml")) as one, workshop.serve(workshop.device("b.toml")) as two:
        station = workshop.station(
            {"name": "a", "bus": one.bus}, {"name": "b", "bus": two.bus}, plan={"poses": 14, "patience_s": 0.1}
        )
        done = triaxcal("run", station, "--json")
    assert done.code == 4
    refused, other = sorted(done.json["units"], key=lambda unit: unit["exit_code"], reverse=True)
    assert (refused["exit_code"], refused["recording"]) == (4, None)
    assert other["exit_code"] == 3  # it runs, and has no poses in so short a time
    (recording,) = workshop.folder.glob("*.mcap")
    assert str(recording) == other["recording"]
    for bus in (one.bus, two.bus):
        assert f"(host=127.0.0.1, port={bus['port']})" in refused["error"]
