"""An error about a wrong unit names the simulator that is behind it, where there is one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcald.station.lock import FOLDER_VARIABLE, folder
from triaxcald.station.simulators import PREFIX, SUFFIX, Simulator, announced, others_at

CAN = CanBus(interface="udp_multicast", channel="239.74.163.2", node_id=5)
TCP = ModbusBus(host="127.0.0.1", port=15020)
FILE = Path("/bench b/can.toml")


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))


def told(bus: Any, expected: str | None = "1042") -> list[str]:
    return [str(s) for s in others_at(bus, expected)]


def test_a_simulator_at_the_place_is_told_with_its_file_and_its_port_while_it_lives() -> None:
    with announced([Simulator.of(FILE, "1099", CAN)]):
        (line,) = told(CAN)
        for word in (str(FILE), "port 43113", "1099", f"pid {os.getpid()}"):
            assert word in line
        assert told(CAN, None) == [line]
    assert told(CAN) == []
    assert list(folder().iterdir()) == []


@pytest.mark.parametrize("serial", ["1042", "01042"])
def test_the_simulator_that_is_expected_is_not_told(serial: str) -> None:
    with announced([Simulator.of(FILE, serial, CAN), Simulator.of(FILE, "7", TCP)]):
        assert told(CAN) == []
        assert len(told(TCP)) == 1


@pytest.mark.parametrize(
    ("served", "asked", "is_it"),
    [
        (CAN, CAN.model_copy(update={"options": {"port": 43113}}), True),
        (CAN, CAN.model_copy(update={"options": {"port": 43114}}), False),
        (CAN, CAN.model_copy(update={"node_id": 6}), False),
        (CAN, CAN.model_copy(update={"channel": "239.74.163.3"}), False),
        (TCP, ModbusBus(host="localhost", port=15020), True),
        (ModbusBus(host="0.0.0.0", port=15020), TCP, True),
        (TCP, ModbusBus(host="192.0.2.7", port=15020), False),
        (TCP, ModbusBus(host="127.0.0.1", port=15021), False),
        (TCP, ModbusBus(host="127.0.0.1", port=15020, unit_id=2), False),
    ],
)
def test_a_simulator_at_another_place_is_not_told(served: Any, asked: Any, is_it: bool) -> None:
    with announced([Simulator.of(FILE, "1099", served)]):
        assert bool(told(asked)) is is_it


def test_the_simulator_of_a_killed_process_is_not_told_and_its_file_is_in_nobodys_way() -> None:
    left = folder() / f"{PREFIX}{os.getpid()}{SUFFIX}"
    with announced([Simulator.of(FILE, "1099", CAN)]):
        content = left.read_bytes()
    left.write_bytes(content)
    assert told(CAN) == []
    with announced([Simulator.of(FILE, "1098", CAN)]):
        assert "1098" in told(CAN)[0]


@pytest.mark.parametrize(
    "content", [b"", b"junk", b"[1]", b"[{}]", b"[" * 100_000, b'[{"file": 1, "serial": 2, "device": 3, "host": 4}]']
)
def test_what_another_user_wrote_there_does_no_harm(content: bytes) -> None:
    import fcntl

    path = folder() / f"{PREFIX}1{SUFFIX}"
    path.write_bytes(content)
    (folder() / f"{PREFIX}2{SUFFIX}").symlink_to("/dev/zero")
    os.mkfifo(folder() / f"{PREFIX}3{SUFFIX}")
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert told(CAN) == []


def test_a_name_that_would_steer_the_terminal_is_escaped() -> None:
    with announced([Simulator("/b\x1b[2J", "9", Simulator.of(FILE, "9", CAN).device, None, 1)]):
        assert "\x1b" not in told(CAN)[0]


@pytest.mark.parametrize("missing", ["no folder", "a file"])
def test_without_the_folder_nothing_is_told_and_nothing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    there = tmp_path / "there"
    if missing == "a file":
        there.write_bytes(b"")
    monkeypatch.setenv(FOLDER_VARIABLE, str(there))
    with announced([Simulator.of(FILE, "1099", CAN)]):
        assert told(CAN) == []


def test_the_error_of_a_command_names_it(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    with workshop.serve(workshop.device(serial=1099)) as served:
        station = workshop.station({"serial": "1042", "bus": served.bus})
        with announced([Simulator.of(FILE, "1099", ModbusBus(**served.bus))]):
            triaxcal("registers", station).failed(4, "serial 1099, expected 1042", str(FILE), str(served.bus["port"]))
        other = triaxcal("registers", station)
        other.failed(4, "serial 1099, expected 1042")
        assert "simulated" not in other.err
