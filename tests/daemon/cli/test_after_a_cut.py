"""`provision --resume` and `restore`, as a person calls them after a cut."""

from __future__ import annotations

import hashlib
import json
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from tests.devices.bench import TRANSPORTS, Bench, Transport
from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.place import Trouble
from tests.devices.profiles import Timing
from tests.devices.table import OLD
from triaxcald.cli import provisioning
from triaxcald.schema.codes import Stage

QUICK = Timing(reply_s=0.3, silence_s=0.6)
CUT = Habits(cut_at_byte=17)
every_transport = pytest.mark.parametrize("transport", TRANSPORTS)


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 0.5)


def cut_short(bench: Bench) -> Path:
    """The journal that is left."""
    done = bench.provision()
    assert done.code == 4
    journal = bench.journal
    assert f"provision --resume {bench.station} --unit unit" in done.err
    assert f"restore {journal} {bench.station} --unit unit" in done.err
    assert bench.holds_mixture()
    bench.power_on()
    return journal


@pytest.mark.slow
@every_transport
def test_a_provisioning_that_was_cut_short_is_finished(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        done = triaxcal("provision", "--resume", bench.station)
        assert done.code == 0, done.err
        assert "the device holds the new calibration" in done.out
        assert bench.holds_new()
        assert not journal.exists()


@pytest.mark.slow
@every_transport
def test_or_what_the_device_held_before_is_put_back(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        done = triaxcal("restore", journal, bench.station, "--json")
        assert done.code == 0, done.err
        assert (done.json["device_state"], done.json["evidence"]) == ("old", "read_after_restart")
        assert bench.holds_old()
        assert not journal.exists()


@pytest.mark.slow
def test_the_outcome_of_a_resumed_provisioning_replaces_that_of_the_one_cut_short(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        cut_short(bench)
        first = json.loads(next(tmp_path.glob("*.outcome.json")).read_text())
        assert (first["device_state"], first["journal"]) == ("unknown", str(bench.journal))
        outcome = triaxcal("provision", "--resume", bench.station, "--json").json["outcome"]
        assert outcome["supersedes"] is not None
        assert outcome["registers"]["cut_short_before"]


@pytest.mark.slow
def test_a_dry_run_after_a_cut_says_that_a_restart_decides_what_would_be_written(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=Habits(), wanted=OLD) as bench:
        told = bench.provision("--dry-run").out
        assert "nothing was written; 0 registers in use differ from the calibration; the device would be " in told
        assert bench.unit.written == []
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        told = bench.provision("--dry-run").out
        assert "registers in use differ from the calibration; the device would be restarted first" in told
        assert f"restore {journal}" in told


@pytest.mark.slow
def test_a_restore_that_no_restart_proves_is_proven_by_the_supply(
    tmp_path: Path, triaxcal, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Bench(tmp_path, triaxcal, habits=Habits(cut_at_byte=17, reset_command=False), timing=QUICK) as bench:
        journal = cut_short(bench)
        done = triaxcal("restore", journal, bench.station)
        assert done.code == 0, done.err
        assert "no restart has proven it" in done.out
        assert f"'triaxcal restore {journal} {bench.station} --unit unit --power-cycle'" in done.out
        assert journal.exists()
        bench.unit.habits = replace(bench.unit.habits, restart_s=2.0)  # so long its supply is off

        def ask(stage: Stage, _: str) -> None:
            if stage is Stage.POWER_OFF:
                threading.Timer(0.3, bench.power_cycle).start()

        monkeypatch.setattr(provisioning, "_ask", ask)
        done = triaxcal("restore", journal, bench.station, "--power-cycle")
        assert "read back after a power cycle" in done.out
        assert bench.holds_old()
        assert not journal.exists()


@pytest.mark.slow
def test_a_restore_ends_with_an_outcome_too(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        (first,) = tmp_path.glob("*.outcome.json")
        done = triaxcal("restore", journal, bench.station, "--json")
        outcome = json.loads(Path(done.json["outcome_file"]).read_text())
        assert outcome == done.json["outcome"]
        assert (outcome["verdict"], outcome["device_state"], outcome["journal"]) == ("not_judged", "old", None)
        assert outcome["supersedes"] == hashlib.sha256(first.read_bytes()).hexdigest()
        assert 0 < len(outcome["registers"]["written"]) <= len(outcome["registers"]["differing"])


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["{", '{"format": "triaxcal.journal/1", "step": "writing"}'])
def test_a_journal_that_cannot_be_read_does_not_keep_a_recordings_registers_away(
    tmp_path: Path, triaxcal, spoilt: str
) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        kept = tmp_path / "kept.json"
        kept.write_bytes(journal.read_bytes())
        journal.write_text(spoilt)
        done = triaxcal("restore", kept, bench.station)
        assert done.code == 0, done.err
        assert bench.holds_old()
        assert not journal.exists()


def test_a_device_that_holds_the_values_in_use_is_not_said_to_have_them_stored(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=Habits(reset_command=False), wanted=OLD) as bench:
        done = bench.provision("--json")
        assert (done.code, bench.unit.written) == (0, [])
        assert (done.json["outcome"]["device_state"], done.json["outcome"]["journal"]) == ("new_unverified", None)
        told = bench.provision().out
        assert "in use held these values already, and nothing was written; no restart shows them stored" in told
        assert f"'triaxcal provision CAL.json {bench.station} --unit unit --power-cycle'" in told
        assert "journal" not in told


@pytest.mark.slow
def test_a_provisioning_that_ends_before_it_has_looked_names_the_journal_of_an_earlier_one(
    tmp_path: Path, triaxcal
) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        bench.place.trouble = Trouble(dead_after=bench.place.requests + 3)
        done = bench.provision("--json")
        assert (done.json["outcome"]["device_state"], done.json["outcome"]["journal"]) == ("unknown", str(journal))
        assert "triaxcal provision --resume" in done.err


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "provision"])
def test_and_so_does_one_that_does_not_reach_the_device(tmp_path: Path, triaxcal, command: str) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        bench.place.trouble = Trouble(dead_after=0)
        done = triaxcal("run", bench.station, "--json") if command == "run" else bench.provision("--json")
        outcome = done.json["units"][0]["outcome"] if command == "run" else done.json["outcome"]
        assert (outcome["device_state"], outcome["journal"]) == ("unknown", str(journal))
        assert f"triaxcal provision --resume {bench.station} --unit unit" in done.err


@pytest.mark.slow
def test_a_restore_heeds_the_serial_number_of_the_station(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        other = tmp_path / "other.toml"
        other.write_text(bench.station.read_text().replace("4711", "4712"))
        requests = bench.place.requests
        triaxcal("restore", journal, other).failed(3, "serial 4711", "expects 4712")
        assert bench.place.requests == requests


@pytest.mark.slow
def test_a_run_with_a_journal_that_cannot_be_read_takes_no_pose(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        journal.write_text(journal.read_text()[:200])
        triaxcal("run", bench.station).failed(2, str(journal), "without that file the unit can be provisioned")
        assert list(tmp_path.glob("**/*.mcap")) == []


@pytest.mark.slow
def test_and_so_does_a_run(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        journal = cut_short(bench)
        bench.place.trouble = Trouble(dead_after=bench.place.requests + 4)
        (unit,) = triaxcal("run", bench.station, "--json").json["units"]
        assert unit["outcome"]["verdict"] == "aborted"
        assert (unit["outcome"]["device_state"], unit["outcome"]["journal"]) == ("unknown", str(journal))
        assert f"triaxcal provision --resume {bench.station} --unit unit" in unit["error"]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["registers", "record"])
def test_who_reads_or_records_a_unit_in_between_is_warned(tmp_path: Path, triaxcal, command: str) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK) as bench:
        cut_short(bench)
        reading = [command, bench.station]
        if command == "record":
            reading += ["-o", tmp_path / "rec.mcap", "--seconds", 0.2]
        warned = triaxcal(*reading)
        assert warned.code == 0, warned.err
        assert "warning: unit unit: an earlier provisioning was cut short or not verified" in warned.err
        assert f"triaxcal provision --resume {bench.station} --unit unit" in warned.err
        assert triaxcal("provision", "--resume", bench.station).code == 0
        (tmp_path / "rec.mcap").unlink(missing_ok=True)
        assert "an earlier provisioning" not in triaxcal(*reading).err


def test_there_is_nothing_to_resume_where_nothing_was_cut_short(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal) as bench:
        triaxcal("provision", "--resume", bench.station).failed(
            2, "journal/misbehaving_unit-4711.json", "no provisioning of this unit"
        )
        assert bench.unit.written == []


@pytest.mark.slow
def test_a_journal_is_for_its_own_unit_alone(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=CUT, timing=QUICK, serial=None) as bench:
        journal = cut_short(bench)
        other = bench.place.unit = Electronics(serial_number=4712)
        triaxcal("restore", journal, bench.station).failed(4, "serial", "4711", "4712")
        assert other.written == []


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ("{", "no journal of a provisioning"),
        ('{"format": "triaxcal.journal/2"}', "expected 'triaxcal.journal/1'"),
        ('{"format": "triaxcal.journal/1", "step": "writing"}', "serial is missing"),
    ],
)
@pytest.mark.parametrize("name", ["misbehaving_unit-4711.json", "4711.json"])
def test_a_journal_that_cannot_be_read_is_named_and_nothing_written(
    tmp_path: Path, triaxcal, spoilt: str, said: str, name: str
) -> None:
    with Bench(tmp_path, triaxcal) as bench:
        journal = tmp_path / "journal" / name
        journal.parent.mkdir()
        journal.write_text(spoilt)
        triaxcal("provision", "--resume", bench.station).failed(2, str(journal), said)
        triaxcal("restore", journal, bench.station).failed(2, str(journal), said)
        bench.provision().failed(2, str(journal), said)
        done = triaxcal("run", bench.station, "--events")
        assert done.code == 2
        (outcome,) = (e["outcome"] for e in map(json.loads, done.out.splitlines()) if e["event"] == "ended")
        assert outcome["device_state"] == "unknown"  # something may have been written
        assert bench.unit.written == []
