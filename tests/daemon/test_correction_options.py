"""What each choice of who corrects leaves: from the loop and from the calibration that registers hold."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest

from triaxcal.diagnosis import Loop, diagnose
from triaxcal.effects import effect_of
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcald.caveats import correction_options

BENT: Mapping[str, Mapping[str, float]] = {"second_order_nonlinearity": {"x": 4e-4, "y": -4e-4, "z": 4e-4}}
WARM = {"warm_up": {"x": 6e-4, "y": -6e-4, "z": 6e-4, "time_constant": 60.0}}


@cache
def closed(*names: str) -> Loop:
    """The loop of a unit with these effects."""
    effects = [effect_of(name, (BENT | WARM)[name]) for name in names]
    sensor = Sensor(np.full(3, 2.4), np.array([6e-3, 4e-3, -6e-4]), np.array([5e-3, -3e-3, 4e-3]), effects)
    up = np.array([v for _, v in directions(26)] * 2)
    loop = diagnose(noisy_poses(sensor, up, 1.5e-5, np.random.default_rng(3)))
    assert set(loop.after.terms) >= {"linear", *names}
    return loop


@pytest.mark.slow
def test_where_nothing_is_found_the_linear_model_is_all_there_is_to_correct() -> None:
    loop = closed()
    assert [(c.corrected_by, c.terms) for c in correction_options(loop)] == [(("host",), ("linear",))]
    assert [(c.corrected_by, c.terms) for c in correction_options(loop, loop.after)] == [(("registers",), ("linear",))]


@pytest.mark.slow
def test_without_registers_the_host_corrects_the_effect_or_nobody_does() -> None:
    loop = closed("second_order_nonlinearity")
    alone, whole = correction_options(loop)
    assert (alone.corrected_by, alone.terms) == (("host",), ("linear",))
    assert (whole.corrected_by, whole.terms) == (("host",), loop.after.terms)
    assert (alone.residual, whole.residual) == (loop.before.residual, loop.after.residual)


@pytest.mark.slow
def test_what_the_registers_lack_is_left_to_the_host() -> None:
    loop = closed("second_order_nonlinearity")
    held = fit([p.pose for p in loop.after.poses])
    told = correction_options(loop, held)
    assert [c.corrected_by for c in told] == [("registers",), ("registers", "host")]
    assert [c.residual for c in told] == [held.residual, loop.after.residual]


def test_registers_that_hold_everything_leave_the_host_nothing() -> None:
    loop = closed("second_order_nonlinearity")
    told = correction_options(loop, loop.after)
    assert [c.corrected_by for c in told] == [("registers",), ("registers",)]
    assert told[-1].terms == loop.after.terms


@pytest.mark.slow
def test_what_belongs_to_the_recording_is_the_business_of_the_process() -> None:
    loop = closed("warm_up")
    told = correction_options(loop, loop.after)
    assert [(c.corrected_by, c.terms) for c in told] == [
        (("registers",), ("linear",)),
        (("registers", "process"), ("linear",)),
    ]
    assert told[0].residual.rms_g == loop.before.residual.rms_g
    assert told[1].residual.rms_g == loop.after.residual.rms_g
