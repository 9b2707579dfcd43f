"""The program's commands, end to end, on devices on a bus."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.devices.bench import TRANSPORTS, Bench, Transport
from tests.devices.habits import Habits
from tests.devices.memory import Electronics, Silent
from tests.devices.place import Trouble
from tests.devices.profiles import Timing, Wording
from tests.devices.table import OLD

PATIENT = Timing(reply_s=10.0, silence_s=20.0, store_poll_s=20.0, reconnect_s=20.0)
"""A device that behaves makes nobody wait; a machine that is busy otherwise may."""
every_transport = pytest.mark.parametrize("transport", TRANSPORTS)


@every_transport
def test_a_calibration_is_provisioned_and_kept(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        done = bench.provision("--json")
        assert done.code == 0, done.err
        assert bench.unit.eeprom == bench.new
        assert bench.holds_new()
        assert not bench.holds_mixture()
        assert (bench.unit.stores, bench.unit.needless_stores) == (1, 0)
        bench.power_cycle()
        assert bench.unit.in_use == bench.new


@every_transport
def test_the_registers_are_shown(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        done = bench.registers("--json")
        assert done.code == 0, done.err
        rows = {row["register"]: row for row in done.json["registers"]}
        assert rows["scale_factor_x"]["value"] == pytest.approx(-2.4)
        assert rows["calibration_crc"]["crc_ok"]
        assert bench.holds_old()


@pytest.mark.parametrize(
    "habits",
    [
        Habits(store_command=False, reset_command=False, unlock=False, status=False, checksum=False),
        Habits(number="int32", date=True, counter=True, mirror=True, word_order="little"),
    ],
)
def test_a_device_of_another_make_is_provisioned(tmp_path: Path, triaxcal, habits: Habits) -> None:
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT) as bench:
        done = bench.provision()
        assert done.code == 0, done.err
        assert bench.holds_new()


def test_a_node_that_beats_and_sends_in_segments_is_provisioned(tmp_path: Path, triaxcal) -> None:
    node = {"heartbeat_s": 0.01, "node_id": 77}
    with Bench(tmp_path, triaxcal, "canopen", segmented=True, node=node, timing=PATIENT) as bench:
        done = bench.provision()
        assert done.code == 0, done.err
        assert bench.holds_new()


def test_a_device_that_holds_the_calibration_gets_only_a_mark(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, wanted=OLD, timing=PATIENT) as bench:
        done = bench.provision("--json")
        assert done.code == 0
        registers = json.loads(done.out)["outcome"]["registers"]
        assert (registers["written"], registers["marked"]) == ([], ["scale_factor_x"])
        assert (bench.unit.written, bench.unit.memory.bytes_written) == (["scale_factor_x"], 0)
        assert bench.unit.in_use == bench.old


def test_a_torn_store_leaves_a_mixture_that_shows(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, timing=PATIENT) as bench:
        for register, raw in [("unlock_key", b"\xc0\xde"), *bench.new.items()]:
            bench.unit.write(register, raw, bench.server.now())
        assert bench.holds_old()
        bench.unit.arm(7)
        with pytest.raises(Silent):
            bench.unit.write("store", b"\x65\x76\x61\x73", bench.server.now())
        assert bench.holds_mixture()
        bench.power_on()
        shown = {r["register"]: r["raw_hex"] for r in bench.registers("--json").json["registers"]}
        assert shown["scale_factor_x"] == bench.new["scale_factor_x"].hex()
        assert shown["bias_x"] == bench.old["bias_x"].hex()


def test_another_unit_is_not_written(tmp_path: Path, triaxcal) -> None:
    other = Electronics(serial_number=4712)
    with Bench(tmp_path, triaxcal, swapped=(1, other), timing=PATIENT) as bench:
        assert bench.provision().code == 4
        assert other.written == []


def test_a_profile_that_is_wrong_about_the_words_finds_another_device(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, wording=Wording(word_order="little"), timing=PATIENT) as bench:
        assert bench.provision().code == 4
        assert bench.holds_old()


def test_a_damaged_reply_harms_nothing(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, trouble=Trouble(garble=frozenset({5}), garbage=("function",))) as bench:
        bench.provision()
        assert not bench.holds_mixture()


@every_transport
def test_samples_are_recorded(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        done = triaxcal("record", bench.station, "-o", tmp_path / "a.mcap", "--seconds", "0.3")
        assert done.code == 0, done.err
        exported = triaxcal("log", "export", tmp_path / "a.mcap", "--stream", "corrected")
        assert exported.code == 0, exported.err
