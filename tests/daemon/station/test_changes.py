"""What of a station is another, once its file has been written anew."""

from __future__ import annotations

from typing import Any

import pytest

from triaxcald.station.config import changed, load_station, names_in

LEFT, RIGHT = ({"name": name, "bus": {"host": "127.0.0.1", "port": port}} for name, port in (("left", 1), ("right", 2)))
ALL = {"name": "all", "bus": {"interface": "virtual", "channel": "a"}}


@pytest.mark.parametrize(
    ("units", "settings", "other"),
    [
        ([LEFT, RIGHT], {}, set()),
        ([RIGHT, LEFT], {}, set()),
        ([LEFT], {}, {"right"}),
        ([LEFT, {**RIGHT, "serial": "12"}], {}, {"right"}),
        ([LEFT, {**RIGHT, "name": "new"}], {}, {"right", "new"}),
        ([LEFT, RIGHT], {"buses": []}, {"all"}),
        ([LEFT, RIGHT], {"buses": [{**ALL, "bus": {**ALL["bus"], "channel": "b"}}]}, {"all"}),
        ([LEFT, RIGHT], {"reference": 1.001}, {"left", "right", "all"}),
    ],
)
def test_what_is_as_it_was_is_not_named(workshop: Any, units: Any, settings: Any, other: set[str]) -> None:
    before = load_station(workshop.station(LEFT, RIGHT, buses=[ALL]))
    after = load_station(workshop.station(*units, **{"buses": [ALL], **settings}))
    assert changed(before, after) == changed(after, before) == other
    assert names_in(before) == {"left", "right", "all"}


def test_a_unit_whose_profile_was_edited_is_another(workshop: Any) -> None:
    profile = workshop.impatient_profile()
    station = workshop.station({**LEFT, "profile": profile}, RIGHT)
    before = load_station(station)
    path = workshop.folder / profile
    path.write_text(path.read_text() + "\n# edited\n")
    assert changed(before, load_station(station)) == {"left"}
