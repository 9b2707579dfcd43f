"""A run that ends its poses by itself, and what an audit makes of its recording."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Workshop
from tests.daemon.run.test_tray_run import MOUNTINGS, _mounted
from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit
from triaxcald.audit.conduct import Result
from triaxcald.cli.commands import main
from triaxcald.recording.reader import Recording
from triaxcald.station.on_demand import CONFIRMING, LEFT_LEAST

BUS = {"host": "127.0.0.1", "port": 502}
STOP = {"uncertainty_g": 1e-4, "poses_least": 9, "poses_most": 26}


@dataclass(frozen=True)
class Done:
    """``found`` and ``wanted`` of the calibration as they were told; ``judged`` are the events of the recording."""

    code: int
    recording: Path
    certificate: dict[str, Any]
    told: list[tuple[int, int]]
    judged: list[dict[str, Any]]

    @property
    def stated_g(self) -> float:
        return float(self.certificate["result"]["calibration"]["uncertainty"]["magnitude"]["standard_g"])


def ran(folder: Path, *, poses: int = 26, **stop: Any) -> Done:
    workshop = Workshop(folder)
    fixture = {"poses": poses, "hold_s": 3.0, "move_s": 0.8}
    device = workshop.device("left.toml", bus=BUS, fixture=fixture, seed=3)
    plan = {"stop": {**STOP, **stop}, "hold_s": 1.0, "check_poses": 3, "repeat": False}
    unit = {"name": "left", "serial": "4711", "bus": BUS}
    station = workshop.station(unit, plan=plan, limits={"rms_g": 1e-3}, provisioning={"write": False})
    out, err = io.StringIO(), io.StringIO()
    with virtual_line(described(device)), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["run", str(station), "--events"])
    events = [json.loads(line) for line in out.getvalue().splitlines()]
    (recording,) = folder.glob("left-*.mcap")
    with Recording.open(recording) as opened:
        judged = [e.detail for e in opened.events() if e.kind == "poses_judged"]
    certificate = json.loads(recording.with_suffix(".certificate.json").read_text())
    told = [(e["found"], e["wanted"]) for e in events if e["event"] == "poses"]
    return Done(code, recording, certificate, told, judged)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    return ran(tmp_path_factory.mktemp("on-demand"))


@pytest.mark.slow
def test_the_poses_end_once_the_certificate_states_the_uncertainty(done: Done) -> None:
    assert done.code == 0
    assert 12 <= done.certificate["recording"]["poses"] < 20
    assert done.stated_g <= STOP["uncertainty_g"]


@pytest.mark.slow
def test_the_most_poses_are_wanted_until_fewer_suffice(done: Done) -> None:
    wanted = [wanted for _, wanted in done.told]
    decided = next(j["found"] for j in done.judged if j["enough"])
    assert list(dict.fromkeys(wanted)) == [26, decided + CONFIRMING]
    assert [found for found, _ in done.told] == sorted(found for found, _ in done.told)
    assert done.told[-1] == (decided + CONFIRMING,) * 2
    assert done.certificate["recording"]["poses"] == decided + CONFIRMING


@pytest.mark.slow
def test_the_recording_says_how_the_poses_were_judged(done: Done) -> None:
    *_, decision, last = done.judged
    assert decision["enough"]
    assert decision["settled"]
    assert decision["uncertainty_g"] <= STOP["uncertainty_g"]
    assert last["found"] == decision["found"] + CONFIRMING
    assert not last["unexplained"]


@pytest.mark.slow
def test_an_audit_gets_the_same_bytes(done: Done, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(done.recording.parent)
    found = audit(done.recording)
    assert found.differences == ()
    assert found.result is Result.SAME_BYTES
    assert main(["audit", str(done.recording)]) == 0


@pytest.mark.slow
def test_an_uncertainty_that_is_not_reached_takes_the_most_poses(tmp_path: Path) -> None:
    found = ran(tmp_path, poses=12, uncertainty_g=1e-6, poses_most=12)
    assert found.code == 0
    assert {wanted for _, wanted in found.told} == {12}
    assert found.told[-1] == (12, 12)
    assert found.judged == []  # the noise alone is above it


@pytest.mark.slow
def test_units_of_one_fixture_end_each_by_itself(tmp_path: Path) -> None:
    """The noise of the second is five times that of the first."""
    workshop, units, slots = Workshop(tmp_path), [], []
    for i, (name, mounting) in enumerate(MOUNTINGS.items()):
        bus, serial = {"host": "127.0.0.1", "port": 502 + i}, 4711 + i
        noise = {"noise_g": 2e-4 * 5**i}
        fixture = {"poses": 26, "hold_s": 3.0, "move_s": 0.8}
        device = workshop.device(f"{name}.toml", bus=bus, serial=serial, fixture=fixture, seed=3 + i, sensor=noise)
        units.append(_mounted(device, mounting))
        slots.append({"name": name, "serial": str(serial), "mounting": mounting, "bus": bus})
    plan = {"stop": {"uncertainty_g": 5e-5}, "hold_s": 1.0, "repeat": False}
    station = workshop.station(
        *slots, plan=plan, fixture={"together": True}, limits={"rms_g": 1e-3}, provisioning={"write": False}
    )
    out, err = io.StringIO(), io.StringIO()
    with virtual_line(*units), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main(["run", str(station), "--json"]) == 0, err.getvalue()
    taken = {}
    for unit in json.loads(out.getvalue())["units"]:
        found = json.loads(Path(unit["certificate"]).read_text())
        taken[unit["unit"]] = found["recording"]["poses"]
        assert found["result"]["calibration"]["uncertainty"]["magnitude"]["standard_g"] <= 5e-5
        assert main(["audit", unit["recording"]]) == 0
    left, right = taken.values()
    assert 9 + LEFT_LEAST + CONFIRMING <= left < right <= 26
