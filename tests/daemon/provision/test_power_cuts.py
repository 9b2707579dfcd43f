"""Whatever is cut off in the middle, the supply or the process, the device ends with the new calibration or the old."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon.provision.host import Host
from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.table import FACTORY

MAKES = {
    "stores by command": Habits(),
    "writes straight to the EEPROM": Habits(store_command=False),
    "stores by command, has no restart": Habits(reset_command=False),
    "writes straight to the EEPROM, has no restart": Habits(store_command=False, reset_command=False, unlock=False),
    "has no checksum": Habits(checksum=False),
    "writes straight, has no checksum": Habits(store_command=False, checksum=False),
    "starts from the factory's values where the checksum is wrong": Habits(on_wrong_checksum="factory"),
    "replaces the stored copy as a whole": Habits(atomic_store=True),
    "takes a while to store": Habits(store_seconds=0.5, while_storing="busy"),
}
every_make = pytest.mark.parametrize("habits", MAKES.values(), ids=MAKES)
finished = pytest.mark.parametrize("finish", ["resume", "restore"])
SAID = {"untouched": "old", "old": "old", "new_verified": "new"}
WANTED = {"resume": "new", "restore": "old"}


@pytest.fixture(autouse=True)
def _a_disk_that_forgets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of journals are written here; what a host keeps over a loss of power is tested elsewhere."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


def eeprom_bytes(habits: Habits, folder: Path) -> int:
    return sum(map(len, Host(folder, habits).old.values()))


def assert_true(host: Host) -> None:
    """What is said is what the device starts with."""
    assert host.provisioning is not None
    said = SAID.get(host.provisioning.held.state)
    assert said in (None, host.starts_with()), host.provisioning.held


@pytest.mark.slow
@every_make
@finished
async def test_the_supply_fails_at_any_byte_of_any_write(tmp_path: Path, habits: Habits, finish: str) -> None:
    for byte in range(eeprom_bytes(habits, tmp_path)):
        host = Host(tmp_path / str(byte), habits)
        host.unit.arm(byte)
        await host.provision()
        assert_true(host)
        host.power_on()
        assert len(host.journals) == 1, byte
        assert await getattr(host, finish)(), byte
        assert host.starts_with() == WANTED[finish], byte
        assert_true(host)


@every_make
async def test_the_supply_fails_for_a_moment_at_any_byte(tmp_path: Path, habits: Habits) -> None:
    for byte in range(eeprom_bytes(habits, tmp_path)):
        host = Host(tmp_path / str(byte), replace(habits, power_back_s=0.3))
        host.unit.arm(byte)
        await host.provision()
        assert host.starts_with() in ("old", "new"), byte
        assert_true(host)


@pytest.mark.slow
@every_make
@finished
async def test_the_supply_fails_again_while_that_is_mended(tmp_path: Path, habits: Habits, finish: str) -> None:
    bytes_in_all = eeprom_bytes(habits, tmp_path)
    for byte in range(0, bytes_in_all, 5):
        for again in range(0, bytes_in_all, 7):
            host = Host(tmp_path / f"{byte}-{again}", habits)
            host.unit.arm(byte)
            await host.provision()
            host.power_on()
            host.unit.arm(again)
            await getattr(host, finish)()
            assert_true(host)
            host.unit.arm(None)
            host.power_on()
            if host.journals:
                assert await getattr(host, finish)(), (byte, again)
            assert host.starts_with() == WANTED[finish], (byte, again)


@pytest.mark.slow
@every_make
@finished
@pytest.mark.parametrize("answered", [False, True])
async def test_the_process_is_killed_at_any_request(
    tmp_path: Path, habits: Habits, finish: str, answered: bool
) -> None:
    whole = Host(tmp_path / "whole", habits)
    assert await whole.provision()
    for request in range(1, whole.requests + 1):
        host = Host(tmp_path / str(request), habits)
        assert not await host.provision(request, kill_after=answered)
        if host.journals:
            assert await getattr(host, finish)(), request
            assert host.starts_with() == WANTED[finish], request
            assert_true(host)
        else:
            assert host.starts_with() == "old", request


@pytest.mark.parametrize("make", ["stores by command", "writes straight to the EEPROM"])
async def test_a_unit_that_takes_the_place_of_another_at_any_request_is_not_given_its_calibration(
    tmp_path: Path, make: str
) -> None:
    """What it stores stays as it was, but for one register where every write lasts; the state is then said to be
    unknown."""
    habits = MAKES[make]
    whole = Host(tmp_path / "whole", habits)
    assert await whole.provision()
    for request in range(3, whole.requests + 1):  # the second asks for the serial number for the first time
        host = Host(tmp_path / str(request), habits)
        other = Electronics(habits, FACTORY.image(habits), serial_number=4712)
        kept = other.eeprom
        host.place.swap_at(request, other)
        ended_well = await host.provision()
        assert host.provisioning is not None
        state = host.provisioning.held.state
        assert not ended_well or other.written == [], request
        lost = [name for name, raw in other.starts_with().items() if kept[name] != raw]
        assert len(lost) <= (0 if habits.store_command else 1), request
        if other.written:
            assert not ended_well, request
            # The other's register in use may be off by a bit until it restarts.
            assert state in ("unknown", "untouched", "new_unverified"), request
            assert state != "new_unverified" or host.starts_with() == "new", request
        if state in ("old", "untouched"):
            assert host.starts_with() == "old", request


@pytest.mark.parametrize("kill_after", [False, True])
async def test_a_probe_that_a_killed_process_leaves_in_use_is_in_a_journal(tmp_path: Path, kill_after: bool) -> None:
    """The device holds the calibration already, so that nothing but a probe is written."""
    held = 0
    for request in range(1, 500):
        host = Host(tmp_path / str(request), Habits())
        assert await host.provision()
        assert host.journals == []
        if await host.provision(request, kill_after=kill_after):
            assert host.journals == []
            break
        probed = host.unit.in_use != host.unit.eeprom
        held += probed
        steps = [json.loads(path.read_text())["step"] for path in host.journals]
        assert steps == ["probing"] or not (probed or steps), (request, steps)
        assert host.starts_with() == "new"
        if steps:
            assert await getattr(host, ["resume", "provision", "restore"][request % 3])(), request
        assert host.unit.in_use == host.unit.eeprom == host.new
        assert host.journals == []
    else:
        pytest.fail("no process came to its end")
    assert held > 1
