"""Buses of a station file that are listened to."""

from __future__ import annotations

import re
from typing import Any

import pytest

from triaxcal_drivers.errors import DriverError
from triaxcald.errors import InputError
from triaxcald.station.config import Station, check_lines, load_station

CAN0 = {"interface": "socketcan", "channel": "can0"}
UNIT = {"name": "left", "profile": "triax-ref-can", "bus": {**CAN0, "node_id": 5, "bitrate": 500_000}}


def bus(name: str = "all", **settings: Any) -> dict[str, Any]:
    return {"name": name, "bus": {**CAN0, **settings}}


def loaded(workshop: Any, *units: dict[str, Any], buses: list[dict[str, Any]]) -> Station:
    return load_station(workshop.station(*units, buses=buses))


def test_a_station_of_buses_alone_has_no_units(workshop: Any) -> None:
    station = loaded(workshop, buses=[bus(), bus("other", channel="can1", bitrate=250_000)])
    assert station.places == ()
    assert [(b.name, b.address) for b in station.buses] == [
        ("all", "interface=socketcan, channel=can0"),
        ("other", "interface=socketcan, channel=can1, bitrate=250000"),
    ]
    check_lines(station.places, station.buses, where="a.toml")


def test_an_adapter_is_asked_to_listen_only_where_no_unit_is_on_its_bus(workshop: Any) -> None:
    station = loaded(workshop, UNIT, buses=[bus(bitrate=500_000), bus("other", channel="can1")])
    assert [b.settings.driven for b in station.buses] == ["bitrate 500000", "listen_only True"]
    check_lines(station.places, station.buses, where="a.toml")


def test_listening_only_may_be_declined(workshop: Any) -> None:
    (listened,) = loaded(workshop, buses=[bus(options={"listen_only": False})]).buses
    assert listened.settings.driven == "listen_only False"


@pytest.mark.parametrize(
    ("units", "buses", "line"),
    [
        ([], [], "units: expected at least 1, or a bus that is listened to"),
        ([], [bus("a b")],
         "line 4: buses.0.name: string should match pattern '^[A-Za-z0-9][A-Za-z0-9._-]*$', not 'a b'"),
        ([], [{"name": "all"}], "line 4: buses.0.bus: missing"),
        ([], [bus(node_id=5)], "buses.0.bus: node_id: unknown key; known: bitrate, channel, interface, options"),
        ([], [bus(bitrat=5)], "buses.0.bus: bitrat: unknown key; did you mean 'bitrate'?"),
        ([], [{"name": "all", "bus": {"channel": 0}}], "buses.0.bus: interface: missing"),
        ([], [bus(options={"listen": True})],
         "buses.0.bus: options of socketcan: listen: unknown key; did you mean 'listen_only'?"),
        ([], [bus(), bus(channel="can1")], "buses: the name 'all' is given twice"),
        ([UNIT], [bus("left", channel="can1")], "buses: the name 'left' is given twice"),
        ([UNIT], [bus("left-4711", channel="can1")], "buses: recordings of unit left may be called 'left-4711'"),
        ([], [bus(), bus("twin", bitrate=500_000)],
         "buses.1.bus: twin is the bus that all is already (interface=socketcan, channel=can0)"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(workshop: Any, units: Any, buses: Any, line: str) -> None:
    path = workshop.station(*units, buses=buses)
    with pytest.raises((InputError, DriverError)) as caught:
        load_station(path)
    assert re.sub(r"^, (?=line)|^: ", "", str(caught.value).removeprefix(str(path))) == line


def test_who_listens_drives_the_bus_as_the_units_on_it_do(workshop: Any) -> None:
    station = loaded(workshop, UNIT, buses=[bus(bitrate=250_000)])
    words = "a.toml: bus all asks for bitrate 250000 on socketcan can0, unit left for bitrate 500000"
    with pytest.raises(InputError, match=f"^{re.escape(words)}$"):
        check_lines(station.places, station.buses, where="a.toml")
    check_lines([], station.buses, where="a.toml")  # without the unit


def test_units_on_one_can_bus_drive_it_alike(workshop: Any) -> None:
    other = {**UNIT, "name": "right", "bus": {**CAN0, "node_id": 6}}
    station = loaded(workshop, UNIT, other, buses=[])
    words = "a.toml: unit right asks for no options on socketcan can0, unit left for bitrate 500000"
    with pytest.raises(InputError, match=f"^{re.escape(words)}$"):
        check_lines(station.places, where="a.toml")


def test_an_adapter_behind_a_serial_port_is_one_process_s_and_other_buses_are_not(workshop: Any) -> None:
    serial = {"name": "dongle", "bus": {"interface": "slcan", "channel": "/dev/ttyUSB0@115200"}}
    plain, dongle = loaded(workshop, buses=[bus(), serial]).buses
    assert plain.settings.claim_to_listen() is None
    claim = dongle.settings.claim_to_listen()
    assert claim is not None
    assert (claim.device, claim.serial_port) == ("listening on slcan /dev/ttyUSB0", "/dev/ttyUSB0")
