"""The units of a tray: their events, their handles, and one outcome for each attempt."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from pydantic import TypeAdapter

from tests.daemon.audit.forging import Forgery
from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit
from triaxcald.cli.events import EventLines, writes_to
from triaxcald.errors import DiskError
from triaxcald.provision.journal import Entry, Journal
from triaxcald.provision.state import DeviceState, Evidence, Held
from triaxcald.recording.reader import Recording
from triaxcald.run.attempts import FOLDER, Attempts, settle_killed
from triaxcald.run.unit_run import Outcome, TrayRun
from triaxcald.schema.codes import Stage
from triaxcald.schema.event import Event
from triaxcald.station.config import load_station
from triaxcald.work import Attempt, Work

EVENT: TypeAdapter[Any] = TypeAdapter(Event)
LIMITS = {"rms_g": 1e-4, "cross_validated_rms_g": None, "verification_rms_g": 1e-4}
"""Of the finished run."""
PLAN = {"poses": 9, "hold_s": 1.0, "check_poses": 3}


class Quiet:
    """Shows nothing; ``at`` is called at each state of the poses."""

    def __init__(self, at: Callable[[str, int], None] = lambda unit, found: None) -> None:
        self._at = at

    def stage(self, unit: str, stage: Stage) -> None: ...
    def note(self, unit: str, text: str) -> None: ...
    def lost(self, unit: str, code: object, reason: str) -> None: ...
    def back(self, unit: str) -> None: ...

    def poses(self, unit: str, phase: str, guide: Any) -> None:
        self._at(unit, guide.found)


@pytest.fixture
def bench(workshop: Any) -> Iterator[Path]:
    """A station of two simulated units, on a virtual clock."""
    can_bus = {"interface": "virtual", "channel": "tray", "node_id": 5}
    modbus_bus = {"host": "127.0.0.1", "port": 502}
    can = workshop.device("can.toml", profile="triax-ref-can", bus=can_bus)
    modbus = workshop.device("modbus.toml", bus=modbus_bus, serial=4712, seed=4)
    station = workshop.station(
        {"name": "left", "profile": "triax-ref-can", "serial": "4711", "bus": can_bus},
        {"name": "right", "serial": "4712", "bus": modbus_bus},
        plan=PLAN,
    )
    with virtual_line(described(can), described(modbus)):
        yield station


@pytest.mark.slow
def test_every_event_is_of_the_model_and_the_outcome_comes_when_its_unit_ends(bench: Path, triaxcal: Any) -> None:
    done = triaxcal("run", bench, "--events", "--operator", "A. Smith", "--order", "WO 7")
    assert done.code == 0
    lines = [json.loads(line) for line in done.out.splitlines()]
    for line in lines:
        assert EVENT.validate_python(line).document() == line
    assert [line["seq"] for line in lines] == list(range(1, len(lines) + 1))
    assert len({line["tray"] for line in lines}) == 1
    assert [line["state"] for line in lines if line["event"] == "tray"] == ["started", "ended"]
    assert (lines[0]["event"], lines[-1]["event"]) == ("tray", "tray")
    for line in lines:
        at = datetime.fromisoformat(line["time"])
        assert (at.utcoffset(), line["time"][-6:], len(line["time"])) == (UTC.utcoffset(at), "+00:00", 29)
    for slot, serial in ("left", "4711"), ("right", "4712"):
        own = [line for line in lines if line["unit"] == slot]
        (run,) = {line["run"] for line in own}
        stages = [line["stage"] for line in own if line["event"] == "stage"]
        assert stages == ["identity", "poses", "fitting", "writing", "check_poses", "report"]
        assert own[-1]["event"] == "ended"
        outcome = own[-1]["outcome"]
        assert (outcome["run"], outcome["unit"], outcome["serial"]) == (run, slot, serial)
        (path,) = bench.parent.glob(f"{slot}-*.outcome.json")
        assert json.loads(path.read_bytes()) == outcome
        assert outcome["work"] == {
            "serial": serial, "operator": "A. Smith", "order": "WO 7", "batch": None, "part_number": None,
            "fixture": None, "slot": slot, "attempt": 1, "reason": None,
        }  # fmt: skip
        poses = [line for line in own if line["event"] == "poses"]
        first = [p for p in poses if p["wanted"] == PLAN["poses"]]
        assert first[0]["found"] < first[-1]["found"] == PLAN["poses"]
        assert all(a != b for a, b in pairwise(poses))
        for p in poses:
            if p["next"] is not None:
                assert sum(v * v for v in p["next"]["vector"]) == pytest.approx(1, abs=1e-5)
        assert any(p["next"] and p["next"]["once_more"] for p in first)


@pytest.mark.slow
def test_a_second_run_is_the_second_attempt_and_supersedes_the_first(bench: Path, triaxcal: Any) -> None:
    held = []
    for _ in range(2):
        done = triaxcal("run", bench, "--events")
        ended = [json.loads(line) for line in done.out.splitlines() if '"ended"' in line]
        held.append({e["unit"]: e["outcome"] for e in ended if e["event"] == "ended"})
    for slot in "left", "right":
        first, second = held[0][slot], held[1][slot]
        assert (first["work"]["attempt"], second["work"]["attempt"]) == (1, 2)
        assert first["supersedes"] is None
        assert second["supersedes"] is not None
        assert first["run"] < second["run"]  # they sort by time


@pytest.mark.slow
def test_one_unit_is_stopped_with_a_reason_while_the_other_goes_on(bench: Path) -> None:
    ended: list[str] = []

    async def work() -> list[Outcome]:
        def at(unit: str, found: int) -> None:
            if unit == "left" and found == 3:
                tray.units["left"].stop("wrong label")

        tray = TrayRun(load_station(bench), Quiet(at), ended=lambda o: ended.append(o.unit))
        outcomes = await tray
        assert all(handle.ended for handle in tray.units.values())
        return outcomes

    left, right = asyncio.run(work())
    assert ended == ["left", "right"]
    assert (left.exit_code, left.document["code"], left.document["reason"]) == (130, "stopped", "stopped: wrong label")
    assert (right.exit_code, right.document["code"]) == (0, "no_limit")
    assert left.recording is not None
    assert audit(left.recording).differences == ()
    assert list(bench.parent.glob(f"{FOLDER}/*")) == []


@pytest.mark.slow
def test_a_failed_unit_keeps_its_coefficients_and_has_no_certificate(workshop: Any, triaxcal: Any) -> None:
    bus = {"host": "127.0.0.1", "port": 502}
    device = workshop.device("modbus.toml", bus=bus, serial=4712)
    station = workshop.station({"name": "right", "serial": "4712", "bus": bus}, plan=PLAN, limits={"rms_g": 1e-9})
    with virtual_line(described(device)):
        done = triaxcal("run", station, "--events")
    assert done.code == 1
    (ended,) = [e for e in map(json.loads, done.out.splitlines()) if e["event"] == "ended"]
    outcome = ended["outcome"]
    assert (outcome["verdict"], outcome["code"], outcome["work"]["serial"]) == ("fail", "fit_outside", "4712")
    held = outcome["measured"]["calibration"]
    for name, truth in ("scale_factor", [-2.41, -2.40, -2.37]), ("bias", [5.6e-3, -2.9e-3, 4.6e-3]):
        assert held[name] == pytest.approx(truth, rel=0.05)
        assert all(0 < error < 1e-3 for error in held["standard_error"][name])
    assert len(held["misalignment"]) == len(held["standard_error"]["misalignment"]) == 3
    assert list(workshop.folder.glob("*.certificate.json")) == []
    (recording,) = workshop.folder.glob("*.mcap")
    assert audit(recording).differences == ()


def test_json_and_events_exclude_each_other(bench: Path, triaxcal: Any) -> None:
    triaxcal("run", bench, "--events", "--json").failed(2, "--events", "--json")
    assert list(bench.parent.glob("*.outcome.json")) == []


def test_a_vanished_reader_of_the_events_stops_nothing() -> None:
    near, far = os.pipe()
    with os.fdopen(far, "w") as out, writes_to(out) as write, EventLines(write, "tray", {"u": "run"}) as events:
        out.close()
        events.begun()
        assert json.loads(os.read(near, 4096))["event"] == "tray"
        os.close(near)
        for _ in range(1000):
            events.stage("u", Stage.POSES)


@pytest.mark.parametrize("blocking", [True, False])
def test_a_reader_that_does_not_read_holds_up_no_event(blocking: bool) -> None:
    """Nor is one lost where another program has set the pipe not to block."""
    near, far = os.pipe()
    os.set_blocking(far, blocking)
    told: list[bytes] = []
    with os.fdopen(far, "w") as out, writes_to(out) as write, EventLines(write, "tray", {"u": "run"}) as events:
        out.close()
        begun_s = time.monotonic()
        for _ in range(5000):  # a pipe takes 64 KiB
            events.stage("u", Stage.POSES)
        assert time.monotonic() - begun_s < 60  # a write that waits for the reader never ends
        reader = threading.Thread(target=lambda: told.extend(iter(lambda: os.read(near, 65536), b"")))
        reader.start()
    reader.join(60)  # the writer has closed its end
    assert [json.loads(line)["seq"] for line in b"".join(told).splitlines()] == list(range(1, 5002))


@pytest.mark.slow
def test_a_unit_that_is_stopped_before_the_start_gets_its_outcome(bench: Path) -> None:
    async def work() -> list[Outcome]:
        tray = TrayRun(load_station(bench), Quiet())
        tray.units["left"].stop("wrong label")
        return await tray

    left, right = asyncio.run(work())
    assert (left.document["code"], left.document["reason"], left.recording) == ("stopped", "stopped: wrong label", None)
    assert left.outcome is not None
    assert (right.exit_code, right.document["code"]) == (0, "no_limit")
    assert list(bench.parent.glob(f"{FOLDER}/*")) == []


def test_a_unit_that_is_stopped_as_its_tray_starts_gets_its_outcome(workshop: Any) -> None:
    """Between the start of the tray and the first step of the unit."""
    bus = {"host": "127.0.0.1", "port": 1}
    station = workshop.station({"name": "left", "bus": bus}, {"name": "right", "bus": {**bus, "unit_id": 2}}, plan=PLAN)
    ended: list[str] = []

    async def work() -> list[Outcome]:
        tray = TrayRun(load_station(station), Quiet(), ended=lambda o: ended.append(o.unit))
        started = asyncio.ensure_future(tray)
        asyncio.get_running_loop().call_soon(tray.units["left"].stop, "wrong label")
        async with asyncio.timeout(60):
            return await started

    left, right = asyncio.run(work())
    assert (left.document["code"], left.document["reason"]) == ("stopped", "stopped: wrong label")
    assert left.outcome is not None
    assert right.document["code"] == "absent"
    assert sorted(ended) == ["left", "right"]


def test_a_tray_has_started_before_a_unit_of_it_has_ended(
    workshop: Any, triaxcal: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the disk takes not even the note of an attempt."""

    def full(self: Attempts, *_: object) -> None:
        raise DiskError("no space left")

    monkeypatch.setattr(Attempts, "begin", full)
    done = triaxcal("run", workshop.station({"name": "left", "bus": {"host": "127.0.0.1", "port": 1}}), "--events")
    assert done.code == 5
    told = [(line["event"], line.get("state")) for line in map(json.loads, done.out.splitlines())]
    assert told == [("tray", "started"), ("ended", None), ("tray", "ended")]


# Killed runs. The recording is cut off at any byte, as a killed process leaves it.


class Killed:
    """A folder with the attempt of a killed process, whose recording is cut off."""

    def __init__(self, folder: Path, station: Path, recording: Path) -> None:
        self.folder, self.station = folder, station
        self._whole = recording.read_bytes()
        with Recording.open(recording) as found:
            told, work = found.metadata["run"], Work.recorded(found.metadata["work"])
        self.attempt = Attempt(told["run"], told["started"], work)

    def leave(self, cut: int | None, **more: Any) -> None:
        tray = Attempts(self.folder, "0193f0e4-0000-7000-8000-00000000000f", "bench", LIMITS)
        name = "modbus-4712-20260302T090000Z.mcap"
        with contextlib.suppress(OSError):
            (self.folder / FOLDER).mkdir()
        attempt = self.attempt if cut is None else Attempt(**{**vars(self.attempt), "recording": name})
        file = tray.begin(attempt)
        for key, value in more.items():
            setattr(file, key, value)
        file.write()
        if cut is not None:
            (self.folder / name).write_bytes(self._whole[:cut])

    def settled(self) -> Mapping[str, Any]:
        (killed,) = settle_killed(load_station(self.station))
        assert json.loads(killed.path.read_bytes()) == killed.document
        assert not (self.folder / FOLDER).exists()
        assert settle_killed(load_station(self.station)) == []
        return killed.document


@pytest.fixture
def killed(finished_run: Any, tmp_path: Path) -> Killed:
    """The finished run, without the documents that it ended with and with the metadata of its attempt."""
    bus = {"host": "127.0.0.1", "port": 502}
    station = tmp_path / "station.toml"
    text = 'format = "triaxcal.station/1"\nname = "bench"\n[[units]]\nname = "modbus"\nprofile = "triax-ref-modbus"\n'
    station.write_text(text + f'bus = {{ host = "{bus["host"]}", port = {bus["port"]} }}\n')
    return Killed(tmp_path, station, finished_run.modbus)


@pytest.mark.parametrize("share", [0.001, 0.1, 0.37, 0.5, 0.73, 0.9])
def test_a_killed_run_gets_its_outcome_and_its_recording_is_audited(killed: Killed, share: float) -> None:
    killed.leave(round(len(killed._whole) * share), serial="4712")
    writing = share > 0.7  # of this recording, by its registers
    if writing:
        journal = Journal(killed.folder / "journal" / "TRIAX-REF-4712.json")
        journal.write(Entry("modbus", "4712", "0" * 64, "2026", {}, {}, run=killed.attempt.run))
    held = killed.settled()
    assert (held["verdict"], held["code"], held["exit_code"]) == ("aborted", "killed", None)
    assert (held["run"], held["serial"], held["work"]["attempt"]) == (killed.attempt.run, "4712", 1)
    state = "unknown" if writing else "untouched"
    assert (held["device_state"], held["journal"] is not None) == (state, writing)
    recordings = list(killed.folder.glob("*.mcap"))
    if held["recording"] is None:  # not even its head was there: what is left of it is kept
        assert recordings == []
        assert len(list(killed.folder.glob("*.damaged"))) == 1
    else:
        (recording,) = recordings
        assert recording.name == held["recording"]
        names = [r.name for r in Forgery.of(recording).records if hasattr(r, "media_type")]
        assert names[-1] == "outcome.json"
        assert not {"certificate.json", "report.html"} & set(names)
        assert audit(recording).differences == ()


def _parts_written(recording: Path) -> list[int]:
    """Where each attachment of the writing ends, and the next chunk after it."""
    with open(recording, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = [c.chunk_start_offset + c.chunk_length for c in summary.chunk_indexes]
    names = ("registers-before.json", "registers-after.json", "verification.json")
    ends = [a.offset + a.length for a in summary.attachment_indexes if a.name in names]
    return sorted({*ends, *(chunk for end in ends for chunk in [c for c in chunks if c > end][:1])})


@pytest.mark.slow
def test_a_run_that_was_killed_while_it_wrote_registers_is_audited(finished_run: Any, tmp_path: Path) -> None:
    """Whichever part of its recording was the last on the disk."""
    with Recording.open(finished_run.modbus) as recording:
        run, work = recording.metadata["run"], recording.metadata["work"]
        station_file = recording.attachments["station.toml"]
    ends = _parts_written(finished_run.modbus)
    assert len(ends) == 5
    seen = set()
    for number, end in enumerate(ends):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "station.toml").write_bytes(station_file)
        killed = Killed(folder, folder / "station.toml", finished_run.modbus)
        killed.attempt = Attempt(run["run"], run["started"], Work.recorded(work))
        journal = folder / "journal" / "TRIAX-REF-4712.json"
        journal.parent.mkdir()
        journal.write_text("{}")
        killed.leave(end, serial="4712")
        held = killed.settled()
        assert (held["code"], held["device_state"]) == ("killed", "unknown")
        found = audit(folder / held["recording"])
        assert found.differences == (), end
        seen |= set(found.checked)
    assert {"registers-after.json", "verification.json"} <= seen


def test_an_attempt_that_was_killed_before_its_recording_gets_an_outcome(killed: Killed) -> None:
    killed.leave(None)
    held = killed.settled()
    assert (held["code"], held["recording"], held["serial"], held["contents"]) == ("killed", None, None, None)
    assert len(list(killed.folder.glob("modbus-unknown-*.outcome.json"))) == 1


def test_a_run_that_was_killed_after_its_end_keeps_its_own_outcome(killed: Killed) -> None:
    killed.leave(len(killed._whole), serial="4712")
    assert settle_killed(load_station(killed.station)) == []
    (outcome,) = killed.folder.glob("*.outcome.json")
    own = next(r.data for r in Forgery.of(next(killed.folder.glob("*.mcap"))).records if _is_outcome(r))
    assert outcome.read_bytes() == own
    assert not (killed.folder / FOLDER).exists()


def test_a_run_that_was_killed_before_the_end_of_its_file_keeps_its_own_outcome(killed: Killed) -> None:
    """Its outcome is stored in the recording, whose indexes are missing."""
    killed.leave(len(killed._whole) - 100, serial="4712")
    assert settle_killed(load_station(killed.station)) == []
    (recording,) = killed.folder.glob("*.mcap")
    held = {r.name: r.data for r in Forgery.of(recording).records if hasattr(r, "media_type")}
    for name in "outcome.json", "certificate.json", "report.html":
        assert recording.with_suffix(f".{name}").read_bytes() == held[name]
    assert json.loads(held["outcome.json"])["verdict"] == "pass"
    assert audit(recording).differences == ()


def _is_outcome(record: Any) -> bool:
    return getattr(record, "name", None) == "outcome.json" and hasattr(record, "data")


@pytest.mark.parametrize("run", [True, False])
def test_a_journal_leaves_the_device_unknown_and_is_named(killed: Killed, run: bool) -> None:
    """Of this run by its id, whatever units the station file has by now; of an earlier run by its path."""
    journal = killed.folder / "journal" / "OTHER-77.json"
    earlier = None if run else str(journal)
    killed.leave(None, serial="4712", journal=earlier, held=Held(DeviceState.NEW_VERIFIED, Evidence.RESTART))
    journal.parent.mkdir()
    entry = Entry("other", "77", "0" * 64, "2026", {}, {}, run=killed.attempt.run if run else "another")
    Journal(journal).write(entry)
    held = killed.settled()
    assert (held["device_state"], held["evidence"]) == ("unknown", "no_answer")
    assert held["journal"] == str(journal)


def test_without_a_journal_the_settled_state_is_stated(killed: Killed) -> None:
    killed.leave(None, serial="4712", held=Held(DeviceState.NEW_VERIFIED, Evidence.RESTART))
    held = killed.settled()
    assert (held["device_state"], held["evidence"]) == ("new_verified", "read_after_restart")


def test_an_attempt_under_way_is_left_alone(killed: Killed) -> None:
    tray = Attempts(killed.folder, "0193f0e4-0000-7000-8000-00000000000f", "bench")
    with tray.under_way():
        tray.begin(killed.attempt)
        assert settle_killed(load_station(killed.station)) == []
    assert len(settle_killed(load_station(killed.station))) == 1
