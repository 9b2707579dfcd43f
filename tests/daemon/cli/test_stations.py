"""What a run says of a unit at its end."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.diagnosis import Loop, diagnose
from triaxcal.effects.nonlinear import ThirdOrderNonlinearity
from triaxcal.model.sensor import Sensor
from triaxcal.planning import directions
from triaxcal.rounding import concise
from triaxcal.synthetic import noisy_poses
from triaxcald.certificate import Certified
from triaxcald.cli.stations import show_outcome
from triaxcald.provision.state import Held
from triaxcald.run.unit_run import Outcome

UNIT = Sensor(
    np.array([2.0, 2.1, 1.9]), np.array([0.01, -0.005, 0.004]), np.array([0.003, -0.002, 0.001]),
    ((ThirdOrderNonlinearity(), np.array([8e-4, -7e-4, 9e-4])),),
)  # fmt: skip

SUMMARY = ["usable", "third_order_nonlinearity acts", "residual rms", "use the calibration"]


@pytest.fixture(scope="module")
def loop() -> Loop:
    up = np.array([v for _, v in directions()])
    return diagnose(noisy_poses(UNIT, up, 1.5e-5, np.random.default_rng(2)), catalogue=[ThirdOrderNonlinearity()])


def shown(loop: Loop, capsys: pytest.CaptureFixture[str]) -> list[str]:
    result = {"data_quality": ["missing_samples: 3 of 900"], "summary": SUMMARY}
    document = {"unit": {"serial": "7"}, "not_written": "no registers", "outside": [], "result": result}
    show_outcome(
        Outcome("left", 0, {"verdict": "pass", "reason": ""}, Held(), certified=Certified(document, loop, None, True))
    )
    return [line.strip() for line in capsys.readouterr().out.splitlines()]


def test_what_is_corrected_is_told_with_its_probability_and_its_coefficients(
    loop: Loop, capsys: pytest.CaptureFixture[str]
) -> None:
    said = shown(loop, capsys)
    ((effect, _),) = loop.after.sensor.effects
    assert f"corrected: {effect.name} (share {loop.after.weights[effect.name]:.2g})" in said
    for name, (value, error, unit) in loop.after.coefficients_of(effect.name).items():
        assert error is not None
        assert f"{name} {concise(value, error, unit)}" in said


def test_the_four_lines_of_the_diagnosis_come_first(loop: Loop, capsys: pytest.CaptureFixture[str]) -> None:
    said = shown(loop, capsys)
    first = next(i for i, line in enumerate(said) if line == SUMMARY[0])
    assert said[first : first + 4] == SUMMARY
