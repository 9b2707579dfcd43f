"""Whatever fails in a run: the right exit code, the other unit finishes, the device holds the old calibration."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.audit.forging import Forgery
from triaxcald.audit import audit, text
from triaxcald.documents import to_text
from triaxcald.errors import DiskError
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.simulation.unit import CALIBRATION, Faults, Stored, factory_calibration

OLD = Stored(factory_calibration())
QUICK: Mapping[str, Any] = {"speed": 60.0, "fixture": {"poses": 12, "hold_s": 1.4, "move_s": 0.6}}
BACK = "the device holds the old calibration, read back after a restart"
PLAN = {"poses": 12, "hold_s": 0.6, "check_poses": 2, "comes_back_s": 0.5}


@pytest.fixture(autouse=True)
def _short_wait_for_a_dead_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 0.5)


def _holds_old(served: Any) -> None:
    """In use and stored; writing it back may have counted."""
    held = Stored.from_image(served.unit.eeprom)
    assert held.valid
    assert held.calibration == OLD.calibration
    assert {name: served.unit._ram[name] for name in CALIBRATION} == OLD.calibration


def _only(folder: Path, pattern: str) -> Path:
    found = list(folder.glob(pattern))
    assert len(found) == 1, found
    return found[0]


def _run(
    workshop: Any,
    triaxcal: Callable[..., Any],
    faults: Faults | None = None,
    device: Mapping[str, Any] = QUICK,
    *,
    recorded: bool = True,
    **settings: Any,
) -> Any:
    """One Modbus unit; the command's outcome, the unit, and its recording: finished, readable, and in agreement with
    itself, where all that was done to the unit was ``recorded``."""
    with workshop.serve(workshop.device(**device), faults) as served:
        unit = {"bus": served.bus, "profile": workshop.impatient_profile()}
        done = triaxcal("run", workshop.station(unit, **{"plan": PLAN, **settings}))
        path = _only(workshop.folder, "*.mcap")
        assert not recorded or audit(path).differences == ()
        return done, served, path


def _events(path: Path) -> list[tuple[str, Any]]:
    with Recording.open(path) as recording:
        return [(e.kind, e.detail) for e in recording.events()]


def _outcome(path: Path) -> Any:
    with Recording.open(path) as recording:
        assert list(recording.attachments)[-1] == "outcome.json"
        return json.loads(recording.attachments["outcome.json"])


@pytest.mark.slow
def test_verification_outside_the_limit_brings_the_old_calibration_back(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    done, served, path = _run(workshop, triaxcal, limits={"verification_rms_g": 1e-9})
    assert done.code == 1
    assert done.out.startswith("FAIL     unit unit0, ")
    _holds_old(served)
    assert ("restored", {"state": "old"}) in _events(path)
    ended = _outcome(path)
    assert (ended["verdict"], ended["device_state"], ended["exit_code"]) == ("fail", "old", 1)
    assert list(workshop.folder.glob("*.certificate.json")) == []
    assert _only(workshop.folder, "*.outcome.json").read_bytes() == to_text(ended).encode()
    report = _only(workshop.folder, "*.report.html").read_text()
    assert "<strong>Failed</strong>" in report
    assert "No limit was declared" not in report
    assert f"{BACK[1:]}." in report
    _whitewashed(path)


def _whitewashed(path: Path) -> None:
    """A failed unit said to have passed, by one who knows of the inventory and the digests, is found."""
    forged = Forgery.of(path)
    reason = "the fit is within the limits; the device's own output was not checked"
    with_pass = {"verdict": "pass", "exit_code": 0, "reason": reason}
    forged.edit("outcome.json", lambda o: o.update(with_pass))
    forged.seal()
    lines = [text.difference(d) for d in audit(forged.write(path.with_name("forged.mcap"))).differences]
    assert 'outcome.json: verdict: stored "pass", computed again "fail"' in lines


@pytest.mark.slow
def test_a_fit_outside_its_limit_writes_nothing(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    done, served, path = _run(workshop, triaxcal, limits={"rms_g": 1e-9})
    assert done.code == 1
    assert done.out.startswith("FAIL     unit unit0, ")
    assert served.unit.eeprom == OLD.image()
    assert "provisioned" not in [kind for kind, _ in _events(path)]
    ended = _outcome(path)
    assert "<strong>Failed</strong>" in _only(workshop.folder, "*.report.html").read_text()
    assert (ended["verdict"], ended["device_state"], ended["evidence"]) == ("fail", "untouched", "nothing_written")
    assert ended["reason"].startswith("rms_g ")
    assert list(workshop.folder.glob("*.certificate.json")) == []


@pytest.mark.slow
def test_a_station_that_is_told_not_to_write_does_not(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    done, served, path = _run(workshop, triaxcal, provisioning={"write": False})
    assert done.code == 0
    assert served.unit.eeprom == OLD.image()
    report = _only(workshop.folder, "*.report.html").read_text()
    assert "<strong>Not judged; usable: nothing found beyond noise</strong>" in report
    assert "No register was written." in report
    with Recording.open(path) as recording:
        assert all(a.operation == "read" for a in recording.register_accesses())


@pytest.mark.slow
def test_a_register_that_is_refused_leaves_the_old_calibration(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    done, served, path = _run(workshop, triaxcal, Faults(refuse_registers=frozenset({"misalignment_y"})))
    done.failed(4, "unit unit0: ", "provisioning failed at writing misalignment_y: ", "nothing was stored")
    _holds_old(served)
    assert _events(path)[-1][0] == "failed"
    with Recording.open(path) as recording:
        assert [a.register for a in recording.register_accesses() if a.error] == ["misalignment_y"]


@pytest.mark.slow
def test_a_store_that_the_unit_forgets_is_found_after_the_restart(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    done, served, _ = _run(workshop, triaxcal, Faults(forget_store=True))
    done.failed(
        4,
        "the registers hold the old calibration: nothing was stored",
        BACK,
    )
    assert served.unit.eeprom == OLD.image()
    _holds_old(served)


@pytest.mark.slow
def test_a_unit_that_dies_while_it_is_written_is_not_said_to_be_restored(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    done, served, _ = _run(workshop, triaxcal, Faults(die_on_write="bias_y"))
    done.failed(4, "provisioning failed at writing bias_y: ", "unknown", "to settle: 'triaxcal provision --resume ")
    assert served.unit.eeprom == OLD.image()


@pytest.mark.slow
def test_a_unit_that_falls_silent_leaves_a_readable_recording_and_no_result(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    device = {"speed": 10.0, "fixture": {"poses": 14, "hold_s": 2.0, "move_s": 0.8}}
    done, served, path = _run(workshop, triaxcal, Faults(die_at_s=20.0), device)
    done.failed(4, "unit unit0: ")
    assert served.unit.eeprom == OLD.image()
    with Recording.open(path) as recording:
        assert recording.finished
        assert int(recording.metadata["raw"]["records"]) > 50
    assert list(workshop.folder.glob("*.certificate.json")) == []
    assert triaxcal("poses", path, "--json").json["poses"]
    triaxcal("fit", path).failed(3, "refused: ")
    ended = _outcome(path)
    assert (ended["verdict"], ended["code"], ended["device_state"]) == ("aborted", "lost", "untouched")
    assert ended["measured"] is None


@pytest.mark.slow
def test_a_unit_that_falls_silent_in_the_verification_is_an_error(
    workshop: Any, triaxcal: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its calibration was written by then; nobody can say that it was put back."""
    event = RecordingWriter.event

    with workshop.serve(workshop.device(**QUICK), Faults()) as served:

        def then_die(self: RecordingWriter, kind: str, detail: Any = None) -> None:
            event(self, kind, detail)
            if kind == "provisioned":
                served.unit._died_s = 0.0

        monkeypatch.setattr(RecordingWriter, "event", then_die)
        unit = {"bus": served.bus, "profile": workshop.impatient_profile()}
        done = triaxcal("run", workshop.station(unit, plan=PLAN))
    done.failed(4, "verification failed: ", "the device holds the new calibration", "'triaxcal restore ")
    path = _only(workshop.folder, "*.mcap")
    assert _events(path)[-1][0] == "failed"
    assert _outcome(path)["verdict"] == "aborted"
    assert Path(_outcome(path)["journal"]).exists()


@pytest.mark.slow
@pytest.mark.parametrize("at", ["scale_factor_y", "reset"])
def test_a_disk_that_fails_while_registers_are_written_does_not_keep_the_old_ones_away(
    workshop: Any, triaxcal: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    register = RecordingWriter.register
    failed = []

    def full(self: RecordingWriter, name: str, operation: Any, raw: bytes, error: str = "", **more: Any) -> None:
        if failed or (name, operation) == (at, "write"):
            failed.append(name)
            raise DiskError("rec.mcap: writing failed: No space left on device")
        register(self, name, operation, raw, error, **more)

    monkeypatch.setattr(RecordingWriter, "register", full)
    done, served, path = _run(workshop, triaxcal, recorded=False)
    assert "device_state" in {d.place for d in audit(path).differences}
    done.failed(5, "No space left on device", "the old calibration")
    assert failed[0] == at
    _holds_old(served)


@pytest.mark.slow
def test_a_disk_that_fails_in_the_verification_brings_the_old_calibration_back(
    workshop: Any, triaxcal: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = RecordingWriter.raw

    def full(self: RecordingWriter, phase: Any, batch: Any) -> bool:
        if phase == "verification":
            raise DiskError("rec.mcap: writing failed: No space left on device")
        return raw(self, phase, batch)

    monkeypatch.setattr(RecordingWriter, "raw", full)
    done, served, _ = _run(workshop, triaxcal)
    done.failed(
        5,
        "No space left on device",
        BACK,
    )
    _holds_old(served)


@pytest.mark.slow
def test_old_registers_that_will_not_come_back_are_an_error(
    workshop: Any, triaxcal: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    event = RecordingWriter.event

    with workshop.serve(workshop.device(**QUICK), Faults()) as served:

        def then_refuse(self: RecordingWriter, kind: str, detail: Any = None) -> None:
            event(self, kind, detail)
            if kind == "provisioned":
                served.unit.faults = Faults(refuse_registers=frozenset({"bias_x"}))

        monkeypatch.setattr(RecordingWriter, "event", then_refuse)
        unit = {"bus": served.bus, "profile": workshop.impatient_profile()}
        done = triaxcal("run", workshop.station(unit, plan=PLAN, limits={"verification_rms_g": 1e-9}))
    done.failed(4, "verification outside limits", "could not be put back", "'triaxcal restore ")


@pytest.mark.slow
def test_no_new_pose_for_too_long_is_refused_with_the_poses_that_are_wanted(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    device = workshop.device(fixture={"poses": 9, "hold_s": 2.0, "move_s": 0.8})
    with workshop.serve(device) as served:
        station = workshop.station({"bus": served.bus}, plan={"poses": 26, "hold_s": 1.0, "patience_s": 8.0})
        done = triaxcal("run", station)
    done.failed(3, "no new still pose for 8 s; ", " of 26 are there; add the poses ")


@pytest.mark.slow
def test_of_two_units_the_sound_one_finishes_and_the_worst_code_counts(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    good, bad = workshop.device("good.toml", **QUICK), workshop.device("bad.toml", serial=4712, **QUICK)
    with workshop.serve(good) as first, workshop.serve(bad, Faults(die_at_s=14.0)) as second:
        profile = workshop.impatient_profile()
        station = workshop.station(
            {"name": "good", "bus": first.bus}, {"name": "bad", "profile": profile, "bus": second.bus}, plan=PLAN
        )
        done = triaxcal("run", station, "--json")
        assert first.unit.eeprom != OLD.image()
        assert second.unit.eeprom == OLD.image()
    assert done.code == 4
    units = {u["unit"]: u for u in done.json["units"]}
    assert (units["good"]["exit_code"], units["bad"]["exit_code"]) == (0, 4)
    assert units["good"]["error"] is None
    assert units["good"]["verification"]["verdict"] == "not judged"
    assert "unit bad: " in units["bad"]["error"]
    assert units["bad"]["error"] in done.err
    assert units["bad"]["certificate"] is None
    json.loads(Path(units["good"]["certificate"]).read_text())
    assert audit(Path(units["good"]["recording"])).differences == ()


def test_another_serial_number_is_refused_before_anything_is_recorded(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    with workshop.serve(workshop.device()) as served:
        done = triaxcal("run", workshop.station({"bus": served.bus, "serial": "0815"}))
        assert served.unit.eeprom == OLD.image()
    done.failed(4, "unit unit0: ", "is serial 4711, expected 0815")
    assert list(workshop.folder.glob("*.mcap")) == []


@pytest.mark.parametrize("folder", ["file", "file/below"])
def test_a_folder_that_cannot_be_is_an_error_of_one_line(
    workshop: Any, triaxcal: Callable[..., Any], folder: str
) -> None:
    workshop.write("file", "")
    with workshop.serve(workshop.device()) as served:
        done = triaxcal("run", workshop.station({"bus": served.bus}, folder=folder))
    done.failed(2, f"{workshop.folder / folder}: no folder for recordings: ")


@pytest.mark.slow
def test_a_wrong_address_of_the_readings_is_named_though_another_stream_goes_on(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    with workshop.serve(workshop.device(**QUICK)) as served:
        profile = workshop.folder / workshop.impatient_profile()
        profile.write_text(profile.read_text().replace("address = 0x0000", "address = 0x2000", 1))
        done = triaxcal("run", workshop.station({"bus": served.bus, "profile": profile.name}, plan=PLAN))
    done.failed(4, "stream readings has been silent for 0.5 s: exception 0x02 (illegal data address)")
    causes = [detail["cause"] for kind, detail in _events(_only(workshop.folder, "*.mcap")) if kind == "interrupted"]
    assert len(causes) == 1
    assert "illegal data address" in causes[0]


@pytest.mark.slow
def test_what_spoils_the_readings_is_said_where_no_new_pose_comes(workshop: Any, triaxcal: Callable[..., Any]) -> None:
    """One axis is dead, so that turns about it look like one pose."""
    with workshop.serve(workshop.device(**QUICK)) as served:
        profile = workshop.folder / workshop.impatient_profile()
        y = 'uy = { word = 5, type = "int32", scale = 1.1920928955078125e-6'
        profile.write_text(
            profile.read_text().replace(y, 'uy = { word = 5, type = "int32", offset = 1.0, scale = 1e-30')
        )
        station = workshop.station({"bus": served.bus, "profile": profile.name}, plan={**PLAN, "patience_s": 20.0})
        done = triaxcal("run", station, "--json")
    assert done.code == 3, done.err
    assert "warning: unit unit0: stuck_output: y never changes" in done.err
    quality = done.json["units"][0]["data_quality"]
    assert [line for line in quality if line.startswith("stuck_output: y never changes")]
