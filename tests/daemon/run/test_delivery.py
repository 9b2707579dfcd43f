"""Units that deliver in bursts, at another rate than the declared one, or a constant, and what commands say of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import virtual_line
from tests.conftest import FIXTURE, PLAN, Workshop
from triaxcal_drivers.catalogue import BUILT_IN

Run = Callable[..., Any]
CAN = {"interface": "virtual", "channel": "delivery", "node_id": 5}
COUNTED, UNCOUNTED = 'counter = "Counter"', 'together = "time"'


@pytest.fixture
def bench(workshop: Workshop, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Path, Any]]:
    """A station and its unit, which samples at 100 Hz; ``every_s``: its messages come together as often, by one
    stamp."""
    monkeypatch.setattr(virtual_line, "LOOK_S", 2.0)

    def made(
        rate_hz: float = 100.0, counter: str = COUNTED, every_s: float = 0.1, plan: Any = PLAN
    ) -> tuple[Path, Any]:
        monkeypatch.setattr(virtual_line, "BATCH_S", every_s)
        for beside in BUILT_IN.glob("triax-ref-can.*"):
            shutil.copy(beside, workshop.folder)
        profile = (BUILT_IN / "triax-ref-can.toml").read_text()
        profile = profile.replace("rate_hz = 100.0", f"rate_hz = {rate_hz}").replace(COUNTED, counter)
        name = workshop.write("mine.toml", profile).name
        device = workshop.device(profile="triax-ref-can", bus=CAN, fixture={**FIXTURE, "poses": 14})
        station = workshop.station({"name": "can", "profile": name, "serial": "4711", "bus": CAN}, plan=plan)
        return station, virtual_line.described(device)

    return made


def named(lines: Any) -> dict[str, str]:
    return dict(line.split(": ", 1) for line in lines)


CASES = [
    pytest.param({}, {}, id="as declared"),
    pytest.param({"rate_hz": 105.0}, {}, id="nearly as declared"),
    pytest.param({"rate_hz": 80.0}, {"rate": "100 Hz"}, id="another rate"),
    pytest.param({"counter": UNCOUNTED, "every_s": 0.25}, {"bursts": "25 samples every 250 ms"}, id="bursts"),
    pytest.param(
        {"counter": UNCOUNTED, "every_s": 0.1, "rate_hz": 130.0},
        {"bursts": "10 samples every 100 ms", "rate": "100 Hz"},
        id="both",
    ),
]


@pytest.mark.parametrize(("settings", "expected"), CASES)
def test_record_warns_of_what_fit_has_in_its_data_quality(
    settings: dict[str, Any], expected: dict[str, str], bench: Any, tmp_path: Path, triaxcal: Run
) -> None:
    station, unit = bench(**settings)
    out = tmp_path / "rec.mcap"
    with virtual_line.virtual_line(unit):
        done = triaxcal("record", station, "-o", out, "--seconds", "42")
    assert done.code == 0, done.err
    warned = named(line.split("unit can: ")[1] for line in done.err.splitlines() if "warning: unit can: " in line)
    assert warned.keys() == expected.keys()
    fitted = triaxcal("fit", out, "--json").json
    found = named(fitted["data_quality"])
    assert found.keys() >= expected.keys()
    assert not {"rate", "bursts", "stuck_output", "missing_samples"} & (found.keys() - expected.keys())
    for name, begins in expected.items():
        assert found[name].startswith(begins)
        assert warned[name] == found[name]


@pytest.mark.slow
def test_a_run_of_bursts_has_the_poses_of_one_without(bench: Any, tmp_path: Path, triaxcal: Run) -> None:
    means = []
    for settings in ({}, {"counter": UNCOUNTED, "every_s": 0.25}):
        station, unit = bench(**settings)
        with virtual_line.virtual_line(unit):
            done = triaxcal("run", station, "--json")
        assert done.code == 0, done.err
        (one,) = done.json["units"]
        assert one["outcome"]["code"] == "no_limit"
        poses = triaxcal("poses", one["recording"], "--json").json
        means.append(np.array([p["mean"] for p in poses["poses"]]))
        assert ("bursts" in named(poses["data_quality"])) == bool(settings)
        with open(one["certificate"], "rb") as file:
            text = file.read().decode()
        assert ('"bursts: 25 samples every 250 ms' in text) == bool(settings)
        assert triaxcal("audit", one["recording"]).code == 0
    assert means[0].shape == means[1].shape
    half_g = np.ptp(means[0], axis=0).max() / 2
    assert np.abs(means[0] - means[1]).max() < 1e-4 * half_g


@pytest.mark.slow
def test_a_run_of_three_constant_outputs_is_refused_and_names_them(
    bench: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    station, unit = bench(plan={**PLAN, "patience_s": 20.0})
    sampled = unit.advance

    def constant(now_s: float) -> Any:
        run = sampled(now_s)
        run.counts[:] = (1000, -2_000_000, 7)
        return run

    monkeypatch.setattr(unit, "advance", constant)
    with virtual_line.virtual_line(unit):
        done = triaxcal("run", station, "--json")
    assert done.code == 3
    (one,) = done.json["units"]
    assert named(one["data_quality"])["stuck_output"] == "x never changes; y never changes; z never changes"
