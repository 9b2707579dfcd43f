"""Simulated units with effects of time and of the pose before go through `triaxcal run`, and its output is text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import pytest

FIXTURE = {"poses": 26, "hold_s": 2.0, "move_s": 0.8}
KNOCKED_S = 31.2
START_S = 1.0
"""The recording begins so much after the unit, at most."""
LIVE: dict[str, Mapping[str, float]] = {
    "bias_step": {"x": 7e-4, "y": -6e-4, "z": 8e-4, "at": KNOCKED_S},
    "hysteresis": {"x": 6e-4, "y": -7e-4, "z": 6e-4},
}


@pytest.mark.parametrize("effect", LIVE)
def test_a_unit_with_an_effect_that_no_register_takes_is_told_of_with_every_coefficient(
    effect: str, workshop: Any, triaxcal: Any
) -> None:
    device = workshop.device(fixture=FIXTURE, sensor={"effects": {effect: dict(LIVE[effect])}})
    with workshop.serve(device, elastic=True) as served:
        station = workshop.station({"serial": "4711", "bus": served.bus}, plan={"poses": 26, "hold_s": 0.6})
        done = triaxcal("run", station)
    said = [line.strip() for line in done.out.splitlines()]
    assert done.code == 0, done.err
    (named,) = [line for line in said if line.startswith(("adopted: ", "confounded: "))]
    first = said.index(named) + 1
    told = said[first : first + len(LIVE[effect])]
    assert named == f"adopted: {effect}"
    for (name, truth), line in zip(LIVE[effect].items(), told, strict=True):
        found = re.fullmatch(rf"{name} (\S+) ± (\S+) .*", line)
        assert found, line
        late = START_S if name == "at" else 0.0
        assert abs(float(found[1]) - truth) < 4 * float(found[2]) + late, line
