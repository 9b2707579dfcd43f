"""A simulated unit whose bias jumps goes through `triaxcal run`, and its output is text."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.virtual_line import described, virtual_line

FIXTURE = {"poses": 26, "hold_s": 2.0, "move_s": 0.8}
KNOCKED_S = 31.2
START_S = 1.0
"""The recording begins so much after the unit, at most."""
STEP = {"x": 7e-4, "y": -6e-4, "z": 8e-4, "at": KNOCKED_S}


@pytest.mark.slow
def test_a_unit_with_an_effect_that_no_register_takes_is_told_of_with_every_coefficient(
    workshop: Any, triaxcal: Any
) -> None:
    device = workshop.device(fixture=FIXTURE, sensor={"effects": {"bias_step": STEP}})
    bus = {"host": "127.0.0.1", "port": 502}
    station = workshop.station({"serial": "4711", "bus": bus}, plan={"poses": 26, "hold_s": 0.6})
    with virtual_line(described(device)):
        done = triaxcal("run", station)
    assert done.code == 0, done.err
    assert "terms: linear, " in done.out
    assert "bias_step" in done.out
    (certificate,) = workshop.folder.glob("*.certificate.json")
    found = json.loads(certificate.read_text())["result"]["calibration"]["effects"]["bias_step"]
    assert set(found) == {*STEP, "weight"}
    for name, truth in STEP.items():
        coefficient = found[name]
        late = START_S if name == "at" else 0.0
        assert abs(coefficient["value"] - truth) < 4 * coefficient["standard_error"] + late
