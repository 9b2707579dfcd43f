"""However a run ends, its outcome says what the device holds, in the table, in the document and by the exit code."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.cli.stations import _unit, show_outcome, worst
from triaxcald.errors import DiskError, InputError
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run import unit_run
from triaxcald.run.unit_run import Outcome, TrayRun, UnitRun
from triaxcald.schema.codes import Stage
from triaxcald.simulation.can_unit import CanUnit
from triaxcald.simulation.unit import CALIBRATION, Stored, factory_calibration
from triaxcald.station.config import load_station
from triaxcald.text import VERDICTS

Run = Callable[..., Any]
OLD = Stored(factory_calibration())
FIXTURE = {"poses": 12, "hold_s": 1.4, "move_s": 0.6}
QUICK = {"speed": 60.0, "fixture": FIXTURE}
PLAN = {"poses": 12, "hold_s": 0.6, "check_poses": 2}
NEW = "the device holds the new calibration, read back after a restart"
NO_ROOM = "rec.mcap: writing failed: No space left on device"
PROGRAM = Path(sys.executable).with_name("triaxcal")


class Quiet:
    """Shows nobody how it goes."""

    def stage(self, unit: str, stage: Stage) -> None: ...
    def note(self, unit: str, text: str) -> None: ...
    def back(self, unit: str) -> None: ...
    def lost(self, unit: str, code: object, trouble: str) -> None: ...

    def poses(self, unit: str, phase: Any, guide: Any) -> None: ...


def _holds_old(served: Any) -> None:
    """In use and stored; writing it back may have counted."""
    held = Stored.from_image(served.unit.eeprom)
    assert held.valid
    assert held.calibration == OLD.calibration
    assert {name: served.unit._ram[name] for name in CALIBRATION} == OLD.calibration


async def _outcome(workshop: Any, served: Any, **settings: Any) -> Outcome:
    unit = {"bus": served.bus, "profile": settings.pop("profile", "triax-ref-modbus")}
    station = workshop.station(unit, **{"plan": PLAN, **settings})
    (outcome,) = await TrayRun(load_station(station), Quiet())
    return outcome


@pytest.mark.slow
@pytest.mark.parametrize("terminal", [False, True])
def test_a_standard_error_that_is_closed_in_the_check_poses_stops_nothing(workshop: Any, terminal: bool) -> None:
    """As by `2>&1 | head`; rich takes a pipe for a terminal where the environment says so."""
    environment = {**os.environ, "COLUMNS": "200", **({"FORCE_COLOR": "1"} if terminal else {})}
    with workshop.serve(workshop.device(speed=40.0, fixture={**FIXTURE, "hold_s": 2.2})) as served:
        station = workshop.station({"bus": served.bus}, plan={**PLAN, "check_poses": 9})
        reading, writing = os.pipe()
        with subprocess.Popen(
            [PROGRAM, "run", station, "--json"], stdout=subprocess.PIPE, stderr=writing, env=environment
        ) as process:
            os.close(writing)
            said = b""
            while b"check poses: " not in said and (more := os.read(reading, 65536)):
                said += more
            os.close(reading)
            out, _ = process.communicate(timeout=180)
        assert b"check poses: " in said
        assert process.returncode == 0, out
        assert b'"device_state": "new_verified"' in out
        assert Stored.from_image(served.unit.eeprom).calibration != OLD.calibration


class _Closed:
    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")

    def flush(self) -> None:
        raise BrokenPipeError(32, "Broken pipe")


async def test_an_internal_error_is_an_outcome_even_where_nobody_can_be_told(
    workshop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: UnitRun, identity: Any) -> Path:
        raise ValueError("a fault of the program")

    monkeypatch.setattr(UnitRun, "recording_path", broken)
    with workshop.serve(workshop.device(**QUICK)) as served:
        station = load_station(workshop.station({"bus": served.bus}))
        monkeypatch.setattr(sys, "stderr", _Closed())
        (outcome,) = await TrayRun(station, Quiet())
    assert outcome.exit_code == 4
    assert outcome.error == "unit unit0: internal error: ValueError('a fault of the program')"
    assert outcome.device_state is None


@pytest.mark.slow
@pytest.mark.parametrize("where", ["attaching", "writing", "closing"])
def test_a_disk_that_fails_after_the_verification_says_that_the_new_calibration_is_in(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    attach, close, write_text = RecordingWriter.attach, RecordingWriter.close, unit_run.write_text

    def full_attach(self: RecordingWriter, name: str, *more: Any) -> None:
        if name == "report.html":
            raise DiskError(NO_ROOM)
        attach(self, name, *more)

    def full_close(self: RecordingWriter) -> None:
        close(self)
        raise DiskError(NO_ROOM)

    def full_write_text(path: Path, text: str) -> Path:
        if path.name.endswith(".report.html"):
            raise InputError(f"{path}: cannot be written: No space left on device")
        return write_text(path, text)

    if where == "attaching":
        monkeypatch.setattr(RecordingWriter, "attach", full_attach)
    elif where == "closing":
        monkeypatch.setattr(RecordingWriter, "close", full_close)
    else:
        monkeypatch.setattr(unit_run, "write_text", full_write_text)
    with workshop.serve(workshop.device(**QUICK)) as served:
        done = triaxcal("run", workshop.station({"bus": served.bus}, plan=PLAN), "--json")
        assert served.unit.eeprom != OLD.image()
    assert done.code == 5
    (unit,) = done.json["units"]
    assert (unit["exit_code"], unit["outcome"]["device_state"]) == (5, "new_verified")
    assert "No space left on device" in unit["error"]
    assert done.err.splitlines()[-1] == f"triaxcal: {VERDICTS[unit['outcome']['verdict']]} {unit['error']}"
    assert unit["error"].endswith(NEW)
    if where == "closing":  # the recording cannot vouch for what was drawn
        (beside,) = [path for path in workshop.folder.glob("unit0-*") if path.suffix != ".mcap"]
        assert str(beside) == unit["outcome_file"]
        assert json.loads(Path(unit["outcome_file"]).read_text()) == {**unit["outcome"], "contents": None}
        assert unit["outcome"]["verdict"] == "aborted"


@pytest.mark.slow
async def test_the_table_and_the_document_say_that_the_old_calibration_is_back(
    workshop: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with workshop.serve(workshop.device(**QUICK)) as served:
        outcome = await _outcome(workshop, served, limits={"verification_rms_g": 1e-9})
        _holds_old(served)
    assert worst([outcome]) == 1
    document = _unit(outcome).document()
    assert (document["exit_code"], document["outcome"]["device_state"], document["error"]) == (1, "old", None)
    assert document["verification"]["verdict"] == "outside limits"
    capsys.readouterr()
    show_outcome(outcome)
    shown = capsys.readouterr().out
    assert "verified by physics: outside limits" in shown
    assert "the device holds the old calibration, read back after a restart" in shown


def _without_corrected(workshop: Any) -> str:
    text = (workshop.folder / workshop.impatient_profile()).read_text()
    kept = [part for part in re.split(r"(?m)^(?=\[)", text) if not part.startswith("[streams.corrected")]
    assert len(kept) < len(re.split(r"(?m)^(?=\[)", text))
    kept.append('[correction]\nreadings = "before"\n')
    name: str = workshop.write("uncorrected.toml", "".join(kept)).name
    return name


def test_a_limit_that_no_device_could_be_verified_by_is_refused_on_loading(workshop: Any, triaxcal: Run) -> None:
    unit = {"bus": {"host": "127.0.0.1", "port": 1}, "profile": _without_corrected(workshop)}
    station = workshop.station(unit, limits={"verification_rms_g": 1e-4})
    triaxcal("run", station).failed(2, f"{station}: limits.verification_rms_g: unit unit0 has no corrected stream")


@pytest.mark.slow
async def test_a_device_without_a_corrected_stream_is_written_and_said_to_be_unverified(
    workshop: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with workshop.serve(workshop.device(**QUICK)) as served:
        outcome = await _outcome(workshop, served, profile=_without_corrected(workshop))
        assert served.unit.eeprom != OLD.image()
    assert (outcome.exit_code, outcome.device_state, outcome.verification) == (0, NEW, None)
    assert outcome.document["verdict"] == "not_judged"
    capsys.readouterr()
    show_outcome(outcome)
    shown = capsys.readouterr().out
    assert NEW in shown
    assert "  verified by physics: " not in shown
    assert NEW[1:] in Path(str(outcome.report)).read_text()


@pytest.mark.slow
def test_an_internal_error_in_one_unit_does_not_disturb_the_other(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = unit_run.unit_report

    def broken(certified: Any, *more: Any) -> str:
        if certified.document["unit"]["serial"] == "4712":
            raise ValueError("a fault of the program")
        return report(certified, *more)

    monkeypatch.setattr(unit_run, "unit_report", broken)
    good, bad = workshop.device("good.toml", **QUICK), workshop.device("bad.toml", serial=4712, **QUICK)
    with workshop.serve(good) as first, workshop.serve(bad) as second:
        station = workshop.station({"name": "good", "bus": first.bus}, {"name": "bad", "bus": second.bus}, plan=PLAN)
        done = triaxcal("run", station, "--json")
        assert OLD.image() not in (first.unit.eeprom, second.unit.eeprom)
    assert done.code == 4
    units = {u["unit"]: u for u in done.json["units"]}
    assert (units["good"]["exit_code"], units["good"]["error"]) == (0, None)
    assert Path(units["good"]["report"]).stat().st_size > 0
    assert (units["bad"]["exit_code"], units["bad"]["outcome"]["device_state"]) == (4, "new_verified")
    assert units["bad"]["error"].startswith("unit bad: internal error: ValueError('a fault of the program'); ")
    assert units["bad"]["report"] is None


@pytest.mark.slow
async def test_a_device_that_cannot_hold_a_calibration_is_left_alone_and_told_why(
    workshop: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (BUILT_IN / "triax-ref-modbus.toml").read_text()
    profile = re.sub(r'role = "misalignment\.(.)"', r'description = "\1"', text)
    assert profile.count('description = "y"') == 1
    workshop.write("homeless.toml", profile)
    with workshop.serve(workshop.device(**QUICK)) as served:
        outcome = await _outcome(workshop, served, profile="homeless.toml")
        assert served.unit.eeprom == OLD.image()
    why = "the device has no register for misalignment.x, misalignment.y, misalignment.z"
    assert (outcome.exit_code, outcome.device_state, outcome.provisioned) == (0, None, None)
    assert outcome.certified is not None
    assert outcome.certified.document["not_written"] == why
    assert outcome.certified.document["registers"] is None
    assert outcome.recording is not None
    with Recording.open(outcome.recording) as recording:
        assert all(a.operation == "read" for a in recording.register_accesses())
    capsys.readouterr()
    show_outcome(outcome)
    assert f"  no registers written: {why}\n" in capsys.readouterr().out


@pytest.mark.slow
def test_corrected_frames_that_stop_are_found_out_and_the_old_calibration_is_put_back(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The readings go on, so the bus itself is not silent."""
    send, event, stopped = CanUnit._send, RecordingWriter.event, []

    def then_stop(self: RecordingWriter, kind: str, detail: Any = None) -> None:
        event(self, kind, detail)
        if kind == "provisioned":
            stopped.append(kind)

    def send_readings(self: CanUnit, identifier: int, data: bytes) -> None:
        if not (stopped and identifier in (0x385, 0x485)):
            send(self, identifier, data)

    monkeypatch.setattr(RecordingWriter, "event", then_stop)
    monkeypatch.setattr(CanUnit, "_send", send_readings)
    bus = {"interface": "virtual", "channel": f"half-silent-{os.getpid()}", "node_id": 5}
    device = workshop.device(profile="triax-ref-can", bus=bus, speed=30.0, fixture={**FIXTURE, "hold_s": 2.2})
    profile = workshop.impatient_profile("triax-ref-can")
    with workshop.serve(device) as served:
        done = triaxcal("run", workshop.station({"bus": bus, "profile": profile}, plan=PLAN))
        _holds_old(served)
    done.failed(
        4, "verification failed: ", "stream corrected: the device sends, but no whole sample", "the old calibration"
    )


class _Stingy:
    """Room for all but two that come one after the other, a batch and a block."""

    def __init__(self, room: Any) -> None:
        self._room, self._asked = room, 0

    def acquire(self, *, blocking: bool) -> bool:
        self._asked += 1
        return self._asked not in (7, 8) and self._room.acquire(blocking=blocking)

    def release(self) -> None:
        self._room.release()


@pytest.fixture
def slow_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = RecordingWriter.__init__

    def stingy(self: RecordingWriter, *arguments: Any, **options: Any) -> None:
        begin(self, *arguments, **options)
        self._room = _Stingy(self._room)  # type: ignore[assignment]

    monkeypatch.setattr(RecordingWriter, "__init__", stingy)


@pytest.mark.slow
@pytest.mark.usefixtures("slow_disk")
async def test_what_a_run_loses_between_bus_and_disk_is_in_its_table_and_its_document(
    workshop: Any, triaxcal: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    with workshop.serve(workshop.device(**QUICK)) as served:
        outcome = await _outcome(workshop, served, provisioning={"write": False})
    assert outcome.error is None
    assert outcome.recording is not None
    with Recording.open(outcome.recording) as recording:
        lost = sum(loss.records for loss in recording.losses())
    assert lost > 0
    assert _unit(outcome).document()["records_lost"] == outcome.lost == lost
    capsys.readouterr()
    show_outcome(outcome)
    assert f"  {lost} records were lost between bus and disk\n" in capsys.readouterr().out
    fitted = triaxcal("poses", outcome.recording, "--json")
    assert f"missing_samples: {lost} records were lost between bus and disk" in fitted.json["data_quality"]


@pytest.mark.slow
@pytest.mark.usefixtures("slow_disk")
def test_what_a_recording_loses_between_bus_and_disk_is_in_its_summary(workshop: Any, triaxcal: Run) -> None:
    path = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device(**QUICK)) as served:
        done = triaxcal("record", workshop.station({"bus": served.bus}), "-o", path, "--seconds", "120")
    assert done.code == 0
    (lost,) = re.findall(r", (\d+) records? lost between bus and disk$", done.err, re.MULTILINE)
    with Recording.open(path) as recording:
        assert int(lost) == sum(loss.records for loss in recording.losses()) > 0
    for command in ("fit", "diagnose"):
        (line,) = [w for w in triaxcal(command, path, "--json").json["data_quality"] if "between bus and disk" in w]
        assert line.startswith(f"missing_samples: {lost} record")
        assert f"warning: {line}" in triaxcal(command, path).err.splitlines()
