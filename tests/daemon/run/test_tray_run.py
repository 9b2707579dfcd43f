"""Two units on one fixture, one of them turned: a run of the whole line by one instruction."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Workshop
from tests.virtual_line import described, virtual_line
from triaxcal.model.directions import directions
from triaxcald.cli.commands import main
from triaxcald.mounting import rotation
from triaxcald.simulation import bench
from triaxcald.station.faces import described as named

MOUNTINGS = {"left": "+x+y+z", "right": "-y+x+z"}
FACES = {"+x": "A", "-x": "B", "+y": "C", "-y": "D", "+z": "E", "-z": "F"}
FIXTURE = {"poses": 14, "hold_s": 3.0, "move_s": 1.0}
PLAN = {"poses": 14, "hold_s": 1.0, "check_poses": 3}


@dataclass(frozen=True)
class Done:
    units: dict[str, Any]
    instructions: list[str]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Done:
    workshop = Workshop(tmp_path_factory.mktemp("tray"))
    buses = {name: {"host": "127.0.0.1", "port": 502 + i} for i, name in enumerate(MOUNTINGS)}
    serials = {name: str(4711 + i) for i, name in enumerate(MOUNTINGS)}
    units = []
    for name, mounting in MOUNTINGS.items():
        device = workshop.device(f"{name}.toml", bus=buses[name], serial=int(serials[name]), fixture=FIXTURE, seed=3)
        units.append(_mounted(device, mounting))
    station = workshop.station(
        *({"name": n, "serial": serials[n], "mounting": m, "bus": buses[n]} for n, m in MOUNTINGS.items()),
        plan=PLAN,
        fixture={"together": True, "faces": {f'"{axis}"': name for axis, name in FACES.items()}},
        limits={"rms_g": 2e-4, "verification_rms_g": 2e-4},
    )
    out, err = io.StringIO(), io.StringIO()
    with virtual_line(*units), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["run", str(station), "--json"])
    assert code == 0, err.getvalue()
    lines = err.getvalue().splitlines()
    told = [line.removeprefix("the fixture: ") for line in lines if line.startswith("the fixture: ")]
    return Done({u["unit"]: u for u in json.loads(out.getvalue())["units"]}, told)


def _mounted(device: Path, mounting: str) -> Any:
    """The simulated unit, whose fixture goes through the plan in the fixture's axes."""
    tumble_of = bench.tumble_of

    def turned(file: bench.DeviceFile) -> bench.CheckedTumble:
        tumble, matrix = tumble_of(file), rotation(mounting)
        return replace(tumble, directions=tumble.directions @ matrix, tours=tumble.tours @ matrix)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "tumble_of", turned)
        return described(device)


@pytest.mark.slow
def test_both_units_pass_by_the_poses_of_one_plan(done: Done) -> None:
    for unit in done.units.values():
        assert unit["outcome"]["verdict"] == "pass"
        certificate = json.loads(Path(unit["certificate"]).read_text())
        assert certificate["recording"]["poses"] == 15


@pytest.mark.slow
def test_the_instructions_are_those_of_the_plan_in_the_names_of_the_faces(done: Done) -> None:
    plan = directions(14)
    expected = [named(v, FACES) for _, v in plan]
    assert done.instructions[:15] == [*expected, f"{expected[0]} once more"]
    assert not np.any(["+X" in told for told in done.instructions])
