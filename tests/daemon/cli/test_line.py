"""What a run says of a unit at its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects.third_order_nonlinearity import ThirdOrderNonlinearity
from triaxcal.loop import Loop, diagnose
from triaxcal.planning import directions
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcald.certificate import Certified
from triaxcald.cli.line import show_outcome
from triaxcald.provision.state import Held
from triaxcald.station.line import Outcome

UNIT = Sensor(
    np.array([2.0, 2.1, 1.9]), np.array([0.01, -0.005, 0.004]), np.array([0.003, -0.002, 0.001]),
    ((ThirdOrderNonlinearity(), np.array([8e-4, -7e-4, 9e-4])),),
)  # fmt: skip


@pytest.fixture(scope="module")
def loop() -> Loop:
    up = np.array([v for _, v in directions()])
    return diagnose(noisy_poses(UNIT, up, 1.5e-5, np.random.default_rng(2)), catalogue=[ThirdOrderNonlinearity()])


def shown(loop: Loop, capsys: pytest.CaptureFixture[str]) -> list[str]:
    result = {"data_quality": ["missing_samples: 3 of 900"]}
    document = {"unit": {"serial": "7"}, "not_written": "no registers", "outside": [], "result": result}
    show_outcome(
        Outcome("left", 0, {"verdict": "pass", "reason": ""}, Held(), certified=Certified(document, loop, None, True))
    )
    return [line.strip() for line in capsys.readouterr().out.splitlines()]


def test_a_coefficient_is_told_with_its_standard_error(loop: Loop, capsys: pytest.CaptureFixture[str]) -> None:
    value, error, unit = loop.findings[0].coefficients["x"]
    assert f"x {value:+.4g} ± {error:.1g} {unit}" in shown(loop, capsys)


def test_one_that_the_poses_show_in_a_combination_alone_is_told_without_it(
    loop: Loop, capsys: pytest.CaptureFixture[str]
) -> None:
    found = loop.findings[0]
    value, _, unit = found.coefficients["x"]
    combined = replace(found, coefficients=dict(found.coefficients) | {"x": (value, None, unit)})
    said = shown(replace(loop, findings=(combined,)), capsys)
    assert f"x {value:+.4g} {unit} (no standard error by itself)" in said
