"""A disk that fails in a run: the next start in the folder seals the recording with the outcome of that run."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit
from triaxcald.errors import DiskError
from triaxcald.recording.reader import Recording
from triaxcald.run import attempts, unit_run
from triaxcald.run.attempts import FOLDER, ROOM, settle_killed
from triaxcald.run.unit_run import Outcome, TrayRun
from triaxcald.schema.codes import Stage
from triaxcald.simulation.unit import ReferenceUnit
from triaxcald.station.config import load_station

MIB = 2**20
BUS = {"host": "127.0.0.1", "port": 502}
PLAN = {"poses": 9, "hold_s": 1.0, "check_poses": 3}
DISK = ("aborted", "disk", 5)


class At:
    """Calls ``act`` once: at a stage, or at the third pose."""

    def __init__(self, stage: Stage, act: Callable[[], None]) -> None:
        self._stage, self._act, self._done = stage, act, False

    def stage(self, unit: str, stage: Stage) -> None:
        if stage is self._stage is not Stage.POSES:
            self._once()

    def poses(self, unit: str, phase: str, guide: Any) -> None:
        if self._stage is Stage.POSES and guide.found == 3:
            self._once()

    def note(self, unit: str, text: str) -> None: ...
    def lost(self, unit: str, code: object, reason: str) -> None: ...
    def back(self, unit: str) -> None: ...

    def _once(self) -> None:
        if not self._done:
            self._done = True
            self._act()


class Line:
    """A station of one simulated unit, whose recordings go to a disk of their own."""

    def __init__(self, workshop: Any, disk: Path) -> None:
        self.folder = disk / "line"
        self._device = workshop.device("modbus.toml", bus=BUS, serial=4712)
        entry = {"name": "right", "serial": "4712", "bus": BUS}
        self.station: Path = workshop.station(entry, plan=PLAN, folder=str(self.folder))

    def run(self, progress: At) -> Outcome:
        async def work() -> list[Outcome]:
            return await TrayRun(load_station(self.station), progress)

        unit: ReferenceUnit = described(self._device)
        with virtual_line(unit):
            (outcome,) = asyncio.run(work())
        return outcome

    def outcomes(self) -> list[dict[str, Any]]:
        return [json.loads(path.read_bytes()) for path in sorted(self.folder.glob("*.outcome.json"))]

    def fill(self) -> None:
        """To the last byte."""
        with open(self.folder.parent / "filler", "wb", buffering=0) as filler, suppress(OSError):
            while True:
                filler.write(bytes(4096))

    def empty(self) -> None:
        os.unlink(self.folder.parent / "filler")

    def settle(self, outcome: Outcome) -> Mapping[str, Any]:
        """What the next start makes of it: the outcome of the run, and no second one."""
        (settled,) = settle_killed(load_station(self.station))
        assert not (self.folder / FOLDER).exists()
        assert settle_killed(load_station(self.station)) == []
        assert self.outcomes() == [settled.document]
        assert {**settled.document, "contents": None} == outcome.document
        return settled.document


@pytest.fixture
def line(workshop: Any, tmp_path: Path) -> Iterator[Line]:
    disk = tmp_path / "disk"
    disk.mkdir()
    if (
        shutil.which("mount") is None
        or subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={24 * MIB}", "tmpfs", disk], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("no file system may be mounted here")
    yield Line(workshop, disk)
    subprocess.run(["umount", disk], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("stage", [Stage.POSES, Stage.WRITING, Stage.CHECK_POSES, Stage.REPORT])
def test_the_next_start_seals_the_recording_with_the_outcome_of_the_run(line: Line, stage: Stage) -> None:
    outcome = line.run(At(stage, line.fill))
    told = outcome.document
    assert (told["verdict"], told["code"], outcome.exit_code) == DISK, told["reason"]
    assert re.search("No space left on device|ended, as [0-9]+ bytes are free", told["reason"])
    assert told["contents"] is None
    assert told["measured"] is None
    assert line.outcomes() == []  # there is no room for it
    with pytest.raises(DiskError, match=r"a killed run has no outcome yet|No space left"):
        settle_killed(load_station(line.station))  # nor for mending
    assert len(list(line.folder.glob("*.mcap"))) == 1
    line.empty()
    settled = line.settle(outcome)
    recording = line.folder / settled["recording"]
    with Recording.open(recording) as found:
        assert json.loads(found.attachments["outcome.json"]) == settled
    assert audit(recording).differences == ()
    again = line.run(At(Stage.IDENTITY, lambda: None)).document
    assert (again["code"], again["work"]["attempt"]) == ("no_limit", 2)
    (outcome_file,) = line.folder.glob(f"{recording.stem}.outcome.json")
    assert again["supersedes"] == hashlib.sha256(outcome_file.read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_disk_that_is_full_before_the_recording_leaves_the_outcome_in_the_attempt(line: Line) -> None:
    outcome = line.run(At(Stage.IDENTITY, line.fill))
    told = outcome.document
    assert (told["verdict"], told["code"], outcome.exit_code, outcome.recording) == (*DISK, None)
    assert line.outcomes() == []
    with pytest.raises(DiskError, match="No space left on device"):
        settle_killed(load_station(line.station))
    line.empty()
    assert line.settle(outcome)["recording"] is None


@pytest.mark.slow
def test_a_disk_that_fails_beneath_the_seal_leaves_the_reported_outcome(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sealed outcome of the run is in the file, whose end the disk did not confirm."""
    finalize = unit_run.UnitRun._finalize
    passed: list[str] = []

    def unconfirmed(self: Any, writer: Any, ending: Any) -> None:
        finalize(self, writer, ending)
        passed.append(self._document["code"])
        self._document = None
        raise DiskError("rec.mcap: writing failed: Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(unit_run.UnitRun, "_finalize", unconfirmed)
        outcome = line.run(At(Stage.IDENTITY, lambda: None))
    assert (passed, outcome.document["code"]) == (["no_limit"], "disk")
    assert outcome.document["device_state"] == "new_verified"
    settled = line.settle(outcome)
    assert audit(line.folder / settled["recording"]).differences == ()


@pytest.mark.slow
def test_a_start_that_dies_after_the_sealing_seals_nothing_twice(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = line.run(At(Stage.POSES, line.fill))
    line.empty()

    class Died(BaseException): ...

    def die(*_: object) -> None:
        raise Died

    with monkeypatch.context() as patch:
        patch.setattr(attempts, "write_text", die)
        with pytest.raises(Died):
            settle_killed(load_station(line.station))
    (recording,) = line.folder.glob("*.mcap")
    sealed = recording.read_bytes()
    assert settle_killed(load_station(line.station)) == []
    assert recording.read_bytes() == sealed
    (found,) = line.outcomes()
    assert {**found, "contents": None} == outcome.document
    assert audit(recording).differences == ()


@pytest.mark.slow
def test_a_folder_that_takes_nothing_ends_the_run_with_the_code_of_the_disk(line: Line) -> None:
    line.folder.mkdir()
    subprocess.run(["mount", "-o", "remount,ro", line.folder.parent], check=True)
    with pytest.raises(DiskError, match="Read-only file system"):
        line.run(At(Stage.IDENTITY, lambda: None))


def test_the_room_of_an_attempt_takes_an_outcome_without_figures_several_times(line: Line) -> None:
    outcome = line.run(At(Stage.POSES, line.fill))
    assert 3 * len(json.dumps(outcome.document)) < ROOM
