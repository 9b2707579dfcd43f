"""One device has one claim, however its place is spelled; two devices have two."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.claim import Claim, canonical_host, canonical_port, claim_of, is_name
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.profile import Strict


def of_modbus(**settings: Any) -> Claim:
    return claim_of(ModbusBus(**settings))


def of_can(interface: str, channel: str | int, node_id: int = 5, **settings: Any) -> Claim:
    return claim_of(CanBus(interface=interface, channel=channel, node_id=node_id, **settings))


@pytest.mark.parametrize(
    ("spelled", "canonical", "looked_up"),
    [
        ("localhost", "localhost", False),
        ("LocalHost.", "localhost", False),
        ("127.0.0.1", "localhost", False),
        ("::1", "localhost", False),
        ("[::1]", "localhost", False),
        ("::ffff:127.0.0.1", "localhost", False),
        ("127.0.0.2", "127.0.0.2", False),
        ("::ffff:10.0.0.7", "10.0.0.7", False),
        ("2001:DB8:0:0::7", "2001:db8::7", False),
        ("Gateway.Plant", "gateway.plant", True),
        ("", "", True),
    ],
)
def test_a_host_has_one_spelling(spelled: str, canonical: str, looked_up: bool) -> None:
    assert canonical_host(spelled) == canonical
    assert is_name(canonical) == looked_up
    assert Claim("x", host=spelled) == Claim("x", host=canonical)


def test_a_port_is_the_one_behind_its_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port, link = tmp_path / "ttyUSB0", tmp_path / "by-id"
    port.touch()
    link.symlink_to("ttyUSB0")
    monkeypatch.chdir(tmp_path)
    assert canonical_port(str(link)) == canonical_port("by-id") == canonical_port("./ttyUSB0") == os.path.realpath(port)
    assert canonical_port("socket://10.0.0.7:4001") == "socket://10.0.0.7:4001"
    assert canonical_port("/dev/none") == "/dev/none"
    assert canonical_port("a\0b") == "a\0b"  # which no port has, as opening it will tell


def test_a_modbus_unit_is_its_host_its_port_and_its_unit_id() -> None:
    unit = of_modbus(host="127.0.0.1")
    assert unit == of_modbus(host="LOCALHOST", port=502, unit_id=1, baudrate=9600)
    assert unit.serial_port is None
    others = [of_modbus(host="127.0.0.1", **other) for other in ({"unit_id": 2}, {"port": 503})]
    assert len({unit, of_modbus(host="10.0.0.7"), *others}) == 4


def test_on_a_serial_line_the_port_is_claimed_and_the_unit_of_it(tmp_path: Path) -> None:
    (tmp_path / "line").symlink_to("/dev/ttyUSB0")
    one = of_modbus(serial_port="/dev/ttyUSB0", baudrate=9600)
    assert one == of_modbus(serial_port=str(tmp_path / "line"), parity="N")
    other = of_modbus(serial_port="/dev/ttyUSB0", unit_id=2)
    assert one.serial_port == other.serial_port == "/dev/ttyUSB0"
    assert one.device != other.device


@pytest.mark.parametrize(
    ("one", "same"),
    [
        (of_can("socketcan", "can0"), of_can("socketcan", "can0", bitrate=500_000, options={"fd": True})),
        (of_can("kvaser", 0), of_can("kvaser", "0")),
        (of_can("udp_multicast", "239.0.0.1"), of_can("udp_multicast", "239.0.0.1", options={"port": 43113})),
        (of_can("udp_multicast", "FF15::1"), of_can("udp_multicast", "ff15:0:0::1", options={"hop_limit": 2})),
        (of_can("slcan", "/dev/ttyACM0"), of_can("slcan", "/dev/ttyACM0@115200")),
        (of_can("vector", 0), of_can("vector", 0, options={"app_name": "CANalyzer"})),
        (
            of_can("socketcand", "can0", options={"host": "localhost", "port": 29536}),
            of_can("socketcand", "can0", options={"host": "127.0.0.1", "port": 29536, "tcp_tune": True}),
        ),
        (of_can("virtual", "v"), of_can("virtual", "v", options={"receive_own_messages": True})),
    ],
)
def test_a_node_on_a_can_bus_is_the_same_however_its_bus_is_driven(one: Claim, same: Claim) -> None:
    assert one == same


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (of_can("socketcan", "can0"), of_can("socketcan", "can0", 6)),
        (of_can("socketcan", "can0"), of_can("socketcan", "can1")),
        (of_can("socketcan", "can0"), of_can("virtual", "can0")),
        (of_can("udp_multicast", "239.0.0.1"), of_can("udp_multicast", "239.0.0.1", options={"port": 43114})),
        (of_can("vector", 0, options={"serial": 1}), of_can("vector", 0, options={"serial": 2})),
        (of_can("socketcand", "can0", options={"host": "a"}), of_can("socketcand", "can0", options={"host": "b"})),
        (of_can("somebody's", 0, options={"box": 1}), of_can("somebody's", 0, options={"box": 2})),
    ],
)
def test_nodes_buses_and_adapters_are_told_apart(one: Claim, other: Claim) -> None:
    assert one != other


def test_a_can_adapter_on_a_serial_port_is_one_process_as_a_whole() -> None:
    assert of_can("slcan", "/dev/ttyACM0@1000000").serial_port == "/dev/ttyACM0"
    assert of_can("socketcan", "can0").serial_port is None


def test_a_virtual_bus_lives_in_one_process() -> None:
    assert str(os.getpid()) in of_can("virtual", "v").device


def test_all_settings_tell_the_devices_of_a_driver_that_does_not_say() -> None:
    class Lines(Strict):
        host: str
        port: int

    assert claim_of(Lines(host="a", port=1)) == Claim("Lines host=a, port=1")
    assert claim_of(Lines(host="a", port=1)) != claim_of(Lines(host="a", port=2))
