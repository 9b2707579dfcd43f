"""record, registers, provision, devices, sim: what they do to a unit, and how they end where there is none."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.cli.record import JsonLines
from triaxcald.recording import disk
from triaxcald.recording.reader import Recording
from triaxcald.simulation.unit import CALIBRATION, TABLE, Faults, Stored, factory_calibration
from triaxcald.station.collection import Recorded

Run = Callable[..., Any]
OLD = Stored(factory_calibration())
NOBODY = {"host": "127.0.0.1", "port": 1}
CAL = {
    "format": "triaxcal.calibration/1",
    "scale_factor": [-2.41, -2.405, -2.37],
    "misalignment": [0.006, 0.004, -0.001],
    "bias": [0.005, -0.003, 0.004],
    "effects": {},
}


def _value(served: Any, name: str) -> float:
    return TABLE[name].decode(Stored.from_image(served.unit.eeprom).calibration[name])


def test_registers_are_read_and_explained(workshop: Any, triaxcal: Run) -> None:
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus, "serial": "4711"})
        done = triaxcal("registers", station, "--json")
        shown = triaxcal("registers", station)
        assert served.unit.eeprom == OLD.image()
    assert (done.code, shown.code) == (0, 0)
    assert set(done.json) == {"format", "unit", "serial", "registers"}
    assert (done.json["format"], done.json["unit"], done.json["serial"]) == ("triaxcal.registers/1", "unit0", "4711")
    rows = {r["register"]: r for r in done.json["registers"]}
    assert set(rows) == set(CALIBRATION)
    assert rows["scale_factor_x"] == {
        "register": "scale_factor_x", "role": "scale_factor.x", "raw_hex": "c019999a", "value": -2.40000009537,
        "unit": "V/g", "description": "", "within_limits": True, "crc_ok": None,
    }  # fmt: skip
    assert rows["calibration_crc"]["crc_ok"] is True
    assert "c019999a" in shown.out
    assert "checksum right" in shown.out


@pytest.mark.slow
def test_a_dry_run_shows_what_would_be_written_and_writes_nothing(workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        done = triaxcal("provision", cal, station, "--dry-run", "--json")
        shown = triaxcal("provision", cal, station, "--dry-run")
        assert served.unit.eeprom == OLD.image()
    assert (done.code, done.err) == (0, "")
    assert set(done.json) >= {"format", "unit", "serial", "dry_run", "written", "differing", "stored", "words"}
    assert done.json["outcome"]["device_state"] == "untouched"
    assert list(workshop.folder.glob("*.outcome.json")) == []
    assert done.json["format"] == "triaxcal.provisioning/1"
    assert done.json["dry_run"] is True
    assert (done.json["written"], done.json["stored"]) == ([], False)
    assert done.json["differing"][:3] == ["scale_factor_x", "scale_factor_y", "scale_factor_z"]
    assert done.json["differing"][-2:] == ["calibration_date", "calibration_crc"]
    words = {w["register"]: w for w in done.json["words"]}
    assert set(words["bias_x"]) == {"register", "before", "wanted", "after", "value", "held"}
    assert (words["bias_x"]["before"], words["bias_x"]["wanted"]) == ("00000000", "3ba3d70a")
    assert words["bias_x"]["after"] == "00000000"
    assert f"dry run: {len(done.json['differing'])} registers would be written, nothing was" in shown.out
    assert "wanted" in shown.out
    assert "after" not in shown.out


@pytest.mark.slow
def test_a_calibration_is_written_and_read_back_and_a_second_time_nothing_differs(workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps({"format": "triaxcal.loop/1", "calibration": CAL}))
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        done = triaxcal("provision", cal, station, "--json")
        rows = {r["register"]: r for r in triaxcal("registers", station, "--json").json["registers"]}
        again = triaxcal("provision", cal, station)
        held = Stored.from_image(served.unit.eeprom)
    assert (done.code, done.err, again.code) == (0, "", 0)
    assert done.json["written"] == done.json["differing"]
    assert done.json["stored"] is True
    for word in done.json["words"]:
        assert word["after"] == word["wanted"] == held.calibration[word["register"]].hex()
    assert rows["scale_factor_x"]["value"] == pytest.approx(-2.41, rel=1e-7)
    assert rows["bias_y"]["value"] == pytest.approx(-0.003, rel=1e-7)
    assert rows["calibration_crc"]["crc_ok"] is True
    assert held.write_counter == 1
    assert "held these values already; only scale_factor_x was written, to show a restart" in " ".join(
        again.out.split()
    )
    first, second = sorted(workshop.folder.glob("4711-*.outcome.json"), key=lambda path: path.stat().st_mtime_ns)
    assert json.loads(first.read_text()) == done.json["outcome"]
    assert json.loads(second.read_text())["supersedes"] == hashlib.sha256(first.read_bytes()).hexdigest()
    assert done.json["outcome"]["device_state"] == "new_verified"


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"bias": [0.6, 0, 0]}, 3, "bias_x"),
        ({"scale_factor": [-2.4, -2.4, -11]}, 3, "scale_factor_z"),
        ({"effects": {"third_order_nonlinearity": {a: {"value": 1e-4} for a in "xyz"}}}, 3,
         "triax-ref-modbus has no registers for third_order_nonlinearity; the best that it can hold is off by "),
        ({"effects": {"temperature_bias": {a: {"value": 1e-4} for a in "xyz"}}}, 2,
         "channel_reference.temp_c: missing"),
    ],
)  # fmt: skip
def test_what_the_registers_cannot_hold_is_refused_before_the_bus_is_opened(
    workshop: Any, triaxcal: Run, change: dict[str, Any], code: int, words: str
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, **change}))
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}})
    triaxcal("provision", cal, station, "--json").failed(code, words)


@pytest.mark.parametrize("faults", [Faults(refuse_registers=frozenset({"bias_z"})), Faults(forget_store=True)])
def test_a_failure_in_writing_is_4_and_leaves_the_old_calibration(workshop: Any, triaxcal: Run, faults: Faults) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    with workshop.serve(workshop.device(), faults) as served:
        done = triaxcal("provision", cal, workshop.station({"bus": served.bus}), "--json")
        assert served.unit.eeprom == OLD.image()
    assert done.code == 4
    assert "provisioning failed at " in done.err
    ended = done.json["outcome"]
    assert (ended["verdict"], ended["device_state"]) == ("aborted", "old")
    assert json.loads(Path(done.json["outcome_file"]).read_text()) == ended
    assert not list((workshop.folder / "journal").iterdir())


def test_the_wrong_unit_is_4_for_every_command(workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    rec = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus, "serial": "0815"})
        for command in (["provision", cal, station], ["registers", station], ["run", station],
                        ["record", station, "-o", rec]):  # fmt: skip
            triaxcal(*command).failed(4, "host=127.0.0.1, port=", "is serial 4711, expected 0815")
        assert served.unit.eeprom == OLD.image()
    assert list(workshop.folder.glob("*.mcap")) == []


@pytest.fixture
def deaf_port() -> Any:
    """A server that takes connections and never says a word."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


@pytest.fixture
def closed_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


def _each_is_absent(workshop: Any, triaxcal: Run, station: Path, *words: str) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    rec = workshop.folder / "rec.mcap"
    before = sorted(workshop.folder.iterdir())
    for command in (
        ["run", station],
        ["record", station, "-o", rec, "--give-up-after", "0"],
        ["registers", station],
        ["provision", cal, station],
    ):
        triaxcal(*command).failed(4, *words)
    (outcome,) = set(workshop.folder.iterdir()) - set(before)  # of the attempt that `run` was
    held = json.loads(outcome.read_bytes())
    assert (held["verdict"], held["code"], held["exit_code"]) == ("aborted", "absent", 4)
    assert (held["device_state"], held["recording"], held["contents"]) == ("untouched", None, None)


@pytest.mark.slow
def test_nobody_on_the_can_bus(workshop: Any, triaxcal: Run) -> None:
    bus = {"interface": "virtual", "channel": "nobody-here", "node_id": 9}
    station = workshop.station({"profile": workshop.impatient_profile("triax-ref-can"), "bus": bus})
    _each_is_absent(workshop, triaxcal, station, "nothing answers at node 9 on virtual nobody-here")


def test_a_connection_that_is_refused(workshop: Any, triaxcal: Run, closed_port: int) -> None:
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": closed_port}})
    _each_is_absent(workshop, triaxcal, station, f"127.0.0.1:{closed_port}", "refused")


@pytest.mark.slow
def test_a_server_that_says_nothing(workshop: Any, triaxcal: Run, deaf_port: int) -> None:
    profile = workshop.impatient_profile()
    station = workshop.station({"profile": profile, "bus": {"host": "127.0.0.1", "port": deaf_port}})
    _each_is_absent(workshop, triaxcal, station, "nothing answers at ", f"127.0.0.1:{deaf_port}")


def test_another_unit_id_on_the_same_line(workshop: Any, triaxcal: Run) -> None:
    with workshop.serve(workshop.device()) as served:
        profile = workshop.impatient_profile()
        station = workshop.station({"profile": profile, "bus": {**served.bus, "unit_id": 7}})
        done = triaxcal("registers", station)
    done.failed(4, "unit 7")


def test_a_serial_port_that_is_not_there(workshop: Any, triaxcal: Run) -> None:
    station = workshop.station({"bus": {"serial_port": "/dev/none"}})
    _each_is_absent(workshop, triaxcal, station, "cannot open /dev/none: ")


@pytest.mark.parametrize(
    ("bus", "words"),
    [
        ({"interface": "nosuch", "channel": 0, "node_id": 5}, "nosuch"),
        ({"interface": "socketcan", "channel": "can77", "node_id": 5}, "can77"),
    ],
)
def test_a_can_interface_that_is_not_there(workshop: Any, triaxcal: Run, bus: dict[str, Any], words: str) -> None:
    _each_is_absent(workshop, triaxcal, workshop.station({"profile": "triax-ref-can", "bus": bus}), words)


@pytest.mark.slow
def test_a_recording_of_so_many_seconds(workshop: Any, triaxcal: Run) -> None:
    rec = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device(speed=5.0)) as served:  # so that the end comes in time
        station = workshop.station({"bus": served.bus})
        done = triaxcal("record", station, "-o", rec, "--seconds", "10")
        assert done.code == 0
        assert done.out == ""
        assert done.err.splitlines()[-1].startswith(f"{rec}: ")
        triaxcal("record", station, "-o", rec, "--seconds", "1").failed(2, f"{rec}: exists already")
    info = triaxcal("log", "info", rec, "--json").json
    assert info["finished"] is True
    assert set(info["attachments"]) == {"station.toml", "profile.toml"}
    poses = triaxcal("poses", rec, "--json").json["poses"]
    assert 3 <= len(poses) <= 5
    with Recording.open(rec) as recording:
        assert recording.raw_digest().hexdigest() == recording.metadata["raw"]["sha256"]


def test_a_recording_goes_to_no_folder_that_is_not_there(workshop: Any, triaxcal: Run) -> None:
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}})
    rec = workshop.folder / "missing" / "rec.mcap"
    triaxcal("record", station, "-o", rec).failed(2, f"{rec}: there is no folder ")


@pytest.mark.slow
def test_all_units_of_a_station_are_recorded_at_once_into_a_folder(workshop: Any, triaxcal: Run) -> None:
    channel = {"interface": "virtual", "channel": f"recorded-{id(workshop)}", "node_id": 9}
    can = workshop.device("can.toml", profile="triax-ref-can", serial=12, bus=channel)
    with workshop.serve(workshop.device()) as modbus, workshop.serve(can):
        units = {"bus": modbus.bus}, {"bus": channel, "profile": "triax-ref-can"}
        station = workshop.station(*units)
        folder = workshop.folder / "recordings"
        triaxcal("record", station, "-o", folder, "--seconds", "5").failed(
            2,
            f"{station}: there are 2 units; name one of unit0, unit1 with --unit, or record all of them into a folder",
        )
        folder.mkdir()
        done = triaxcal("record", station, "-o", folder, "--seconds", "5")
    assert done.code == 0, done.err
    one, other = sorted(folder.iterdir())
    assert (one.name[:11], other.name[:11]) == ("unit0-4711-", "unit1-0012-")
    for path in (one, other):
        info = triaxcal("log", "info", path, "--json").json
        assert info["finished"] is True
        assert str(path) in done.err
        assert info["events"][-1]["kind"] == "ended"


@pytest.mark.slow
def test_a_recording_in_segments_goes_on_with_the_next_start_and_is_read_by_its_manifest(
    workshop: Any, triaxcal: Run
) -> None:
    folder = workshop.folder / "recordings"
    folder.mkdir()
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        recording = ["record", station, "-o", folder, "--seconds", "10", "--segment-time", "1h"]
        for _ in range(2):
            assert triaxcal(*recording).code == 0
    manifest = folder / "unit0-4711.segments.json"
    info = triaxcal("log", "info", manifest, "--json").json
    assert info["finished"] is True
    assert [s["number"] for s in info["segments"]] == [1, 2]
    assert [e["detail"] for e in info["events"] if e["kind"] == "ended"] == [{"reason": "asked"}] * 2
    poses = triaxcal("poses", manifest, "--json").json["poses"]
    assert len(poses) >= 6
    for segment in info["segments"]:
        assert triaxcal("log", "info", folder / segment["file"], "--json").json["finished"] is True


@pytest.mark.slow
def test_what_a_full_disk_ended_begins_again_while_another_unit_goes_on(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter([0])  # as the first segment is to begin
    monkeypatch.setattr(disk, "free_bytes", lambda _: next(free, 2**40))
    monkeypatch.setattr("triaxcald.cli.record.AGAIN_S", 0.05)
    folder = workshop.folder / "recordings"
    folder.mkdir()
    again = threading.Event()
    told = JsonLines.say

    def said(self: JsonLines, level: str, event: str, **more: Any) -> None:
        told(self, level, event, **more)
        if event == "ended" and not again.is_set():
            again.set()
        elif again.is_set() and more.get("message") == "recording":
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(JsonLines, "say", said)
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus}, {"bus": NOBODY})
        done = triaxcal("record", station, "-o", folder, "--segment-time", "1h", "--log-format", "json")
    assert done.code == 130
    lines = [json.loads(line) for line in done.err.splitlines()]
    (first, last) = [line for line in lines if line["event"] == "ended" and line["unit"] == "unit0"]
    assert first["message"].endswith(
        "unit0-4711.segments.json: cannot be created: 0 bytes are free on the disk, 4194304 are needed"
    )
    assert last["recording"] == str(folder / "unit0-4711.segments.json")
    assert triaxcal("log", "info", folder / "unit0-4711.segments.json", "--json").json["finished"] is True


def test_progress_may_be_json_and_the_numbers_are_served(workshop: Any, triaxcal: Run) -> None:
    rec = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        done = triaxcal("record", station, "-o", rec, "--seconds", "5", "--log-format", "json", "--metrics", "0")
    assert done.code == 0
    lines = [json.loads(line) for line in done.err.splitlines()]
    assert "http://127.0.0.1:" in lines[0]["message"]
    assert (lines[-1]["event"], lines[-1]["recording"]) == ("ended", str(rec))
    assert lines[-1]["level"] in ("info", "warning")  # of a rate that a busy machine changes
    assert lines[-1]["samples"] >= 500


@pytest.mark.parametrize("form", ["json", "text"])
def test_a_fault_of_the_program_is_told_with_its_trace(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("a fault of the program")

    monkeypatch.setattr(Recorded, "for_seconds", broken)
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus})
        done = triaxcal("record", station, "-o", workshop.folder / "rec.mcap", "--log-format", form)
    assert done.code == 4
    error = "unit unit0: internal error: ValueError('a fault of the program')"
    if form == "json":
        *_, last = [json.loads(line) for line in done.err.splitlines()]
        assert (last["event"], last["message"]) == ("ended", error)
        assert "in broken" in last["trace"]
    else:
        *trace, last_line = done.err.splitlines()
        assert last_line == f"triaxcal: {error}"
        assert any(line.endswith("in broken") for line in trace), "a line of its own"


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--keep", "30 days", "expected a time as 90s, 15m, 12h or 30d, not '30 days'"),
        ("--segment-time", "0h", "expected a time as 90s"),
        ("--segment-size", "1T", "expected a size as 500k, 256M or 2G, not '1T'"),
        ("--metrics", "70000", "expected a port between 0 and 65535"),
    ],
)
def test_options_of_a_recording_say_what_they_take(triaxcal: Run, option: str, value: str, words: str) -> None:
    triaxcal("record", "station.toml", "-o", "rec.mcap", option, value).failed(2, option, words)


@pytest.mark.slow
def test_a_unit_that_stops_in_the_middle_of_a_recording_leaves_a_finished_file(workshop: Any, triaxcal: Run) -> None:
    rec = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device(speed=10.0), Faults(die_at_s=22.0)) as served:
        station = workshop.station({"bus": served.bus, "profile": workshop.impatient_profile()})
        triaxcal("record", station, "-o", rec, "--give-up-after", "0").failed(4, "127.0.0.1", "nothing answers")
    assert len(triaxcal("poses", rec, "--json").json["poses"]) >= 5


def test_one_of_two_units_has_to_be_named(workshop: Any, triaxcal: Run) -> None:
    with workshop.serve(workshop.device()) as served:
        absent = {"host": "127.0.0.1", "port": 1}
        station = workshop.station({"name": "a", "bus": absent}, {"name": "b", "bus": served.bus})
        triaxcal("registers", station).failed(2, f"{station}: units: name one of a, b with --unit")
        triaxcal("registers", station, "--unit", "c").failed(2, "name one of a, b with --unit")
        assert triaxcal("registers", station, "--unit", "b", "--json").json["unit"] == "b"


def test_devices_lists_drivers_and_profiles(triaxcal: Run) -> None:
    done = triaxcal("devices", "--json")
    assert (done.code, done.err) == (0, "")
    assert set(done.json) == {"format", "drivers", "profiles", "effects"}
    drivers = {d["name"]: d for d in done.json["drivers"]}
    assert {"can", "modbus"} <= set(drivers)
    assert drivers["can"] == {
        "name": "can", "target": "triaxcal_drivers.can.driver:CanDriver", "distribution": "triaxcal", "fault": None
    }  # fmt: skip
    profiles = {p["name"]: p for p in done.json["profiles"]}
    assert {"triax-ref-can", "triax-ref-modbus"} <= set(profiles)
    assert all(p["fault"] is None for p in profiles.values())


@pytest.mark.slow
def test_devices_says_what_is_wrong_with_somebody_elses_broken_driver(tmp_path: Path) -> None:
    (tmp_path / "theirs.py").write_text("import no_such_module\n")
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[triaxcal.drivers]\nspi = theirs:SpiDriver\n")
    program = Path(sys.executable).with_name("triaxcal")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([program, *arguments], env=environment, capture_output=True, text=True, timeout=180)

    listed = run("devices", "--json")
    drivers = {d["name"]: d for d in json.loads(listed.stdout)["drivers"]}
    assert listed.returncode == 0
    assert drivers["spi"]["distribution"] == "theirs"
    assert "no_such_module" in drivers["spi"]["fault"]
    assert drivers["can"]["fault"] is None
    shown = run("devices")
    assert shown.returncode == 0
    assert shown.stderr.startswith("warning: spi: ")
    assert "usable" in shown.stdout


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"profil": "x"}, "line 8: profil: unknown key; did you mean 'profile'?"),
        ({"serial": -1}, "serial: input should be greater than or equal to 0, not -1"),
        ({"speed": 0}, "speed: input should be greater than 0"),
        ({"profile": "generic-modbus-poll"}, "only triax-ref-can and triax-ref-modbus are simulated"),
        ({"profile": "none"}, "none: No such file or directory; built-in profiles: "),
        ({"bus": {"hots": "127.0.0.1"}}, "bus: hots: unknown key; did you mean 'host'?"),
        (
            {"sensor": {"effects": {"flat_earth": {"x": 1}}}},
            "sensor.effects.flat_earth: no effect of that name is known",
        ),
        (
            {"sensor": {"effects": {"temperature_bias": {"w": 1}}}},
            "sensor.effects.temperature_bias.w: known coefficients",
        ),
        (
            {"sensor": {"effects": {"warm_up": {"x": 1e-3, "time_constant": 0.0}}}},
            "sensor.effects.warm_up.time_constant: has to be above 0",
        ),
        (
            {"sensor": {"effects": {"hysteresis": {"x": 1e-3, "sign_x": 1e-3}}}},
            "sensor.effects.hysteresis: x, sign_x are not of one form of it",
        ),
        (
            {"sensor": {"effects": {"vibration_rectification": {"x": 1.0}}}},
            "sensor.effects.vibration_rectification: a simulated unit has no scatter_x, scatter_y, scatter_z, which",
        ),
        (
            {"sensor": {"effects": {'"channel_bias:supply_v"': {"x": 1e-3}}}},
            "sensor.effects.channel_bias:supply_v: a simulated unit has no supply_v, which it goes with",
        ),
        ({"fixture": {"poses": 8}}, "fixture.poses: input should be greater than or equal to 9"),
        ({"seed": -1}, "seed: input should be greater than or equal to 0, not -1"),
        ({"profile": "a\0b"}, r"'a\x00b': no file has such a name"),
        ({"eeprom": "a\0b"}, "eeprom: string should match pattern"),
        ({"bus": {"host": "a\0b"}}, "bus: host: string should match pattern"),
    ],
)
def test_a_faulty_device_file(workshop: Any, triaxcal: Run, settings: dict[str, Any], words: str) -> None:
    device = workshop.device(**settings)
    triaxcal("sim", device).failed(2, words)
    if settings.get("profile") not in ("none", "a\0b"):
        triaxcal("sim", device).failed(2, str(device))


def test_a_port_that_is_taken_is_4(workshop: Any, triaxcal: Run) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        device = workshop.device(bus={"host": "127.0.0.1", "port": port})
        triaxcal("sim", device).failed(4, f"cannot listen on 127.0.0.1:{port}")


def test_an_eeprom_file_that_is_a_folder(workshop: Any, triaxcal: Run) -> None:
    (workshop.folder / "eeprom").mkdir()
    triaxcal("sim", workshop.device(eeprom="eeprom")).failed(2, f"{workshop.folder / 'eeprom'}: Is a directory")
