"""Under which conditions nine parameters are all of a reading, and that effects add nothing there."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.effects import CATALOGUE
from triaxcal.effects.channel import ChannelBias
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, RUN, SCATTER, SINCE_START, TIME, Effect
from triaxcal.effects.memory import Hysteresis
from triaxcal.effects.nonlinear import CrossCoupling, VibrationRectification
from triaxcal.effects.runs import InRuns, RunBias
from triaxcal.effects.thermal import TemperatureBias, TemperatureLag, TemperatureScaleFactor, ThermalGradient
from triaxcal.effects.time import BiasDrift, BiasStep, WarmUp
from triaxcal.text import holds, use

S = np.array([[0.6, -0.64, 0.48], [0.0, 0.8, -0.6]])
HOLDING: list[tuple[Effect, str, dict[str, list[float]]]] = [
    (TemperatureBias(), "at temp_c = 24.5 °C", {"temp_c": [0.0, 0.0]}),
    (ChannelBias("supply_v"), "at supply_v = 5", {"supply_v": [0.0, 0.0]}),
    (ThermalGradient(), "while temp_c does not change", {"temp_c.rate": [0.0, 0.0]}),
    (BiasDrift(3), "at t_s = 90 s", {TIME: [0.0, 0.0]}),
    (WarmUp(60.0), "long after the start", {SINCE_START: [3000.0, 4000.0]}),
    (BiasStep(83.5), "after the step at 83.5 s", {SINCE_START: [90.0, 1e5], DURATION: [0.0, 5.0]}),
    (InRuns(BiasStep(83.5), (1,)), "after the step at 83.5 s of recording 2",
     {SINCE_START: [90.0, 0.0], DURATION: [0.0, 5.0], RUN: [1.0, 2.0]}),
    (RunBias(3, alone=1), "in all recordings but recording 2", {RUN: [0.0, 2.0]}),
    (Hysteresis("memory"), "after a pose with no specific force along the axis", {n: [0.0, 0.0] for n in BEFORE}),
    (Hysteresis("reversal"), "with no change along the axis since the pose before", {n: [0.0, 0.0] for n in CHANGE}),
    (VibrationRectification(), "with readings that do not scatter", {n: [0.0, 0.0] for n in SCATTER}),
]  # fmt: skip
REFERENCE = {
    "temp_c": 24.5, "supply_v": 5.0, TIME: 90.0, SINCE_START: 0.0, DURATION: 0.0, RUN: 0.0,
    **dict.fromkeys((*BEFORE, *CHANGE, *SCATTER, "temp_c.rate"), 0.0),
}  # fmt: skip


@pytest.mark.parametrize(("effect", "words", "there"), HOLDING, ids=lambda v: getattr(v, "name", ""))
def test_the_values_hold_where_an_effect_adds_nothing(
    effect: Effect, words: str, there: dict[str, list[float]]
) -> None:
    assert holds([effect], REFERENCE) == (words,)
    assert np.abs(effect.basis(S, {name: np.array(v) for name, v in there.items()})).max() < 1e-20


def test_a_warm_up_is_largest_at_the_start_so_the_values_do_not_hold_there() -> None:
    assert WarmUp(60.0).basis(S, {SINCE_START: np.zeros(2)}).max() == 1.0
    assert "since_start" not in holds([WarmUp(60.0)], REFERENCE)[0]


def test_a_run_bias_of_all_runs_is_no_condition_of_one_of_them() -> None:
    """Deviations from the mean, by hand: 0.3 and −0.1 in the second and third, so −0.2 in the first."""
    there = {RUN: np.array([0.0, 1.0, 2.0])}
    added = RunBias(3).basis(np.zeros((3, 3)), there) @ np.array([0.3, 0, 0, -0.1, 0, 0])
    assert added[:, 0] == pytest.approx([-0.2, 0.3, -0.1])
    assert holds([RunBias(3)], REFERENCE) == ("in the mean over the recordings",)


def test_every_recording_of_several_has_its_own_middle() -> None:
    assert holds([BiasDrift()], {TIME: 0.0}, several=True) == ("at the middle of each recording's poses",)


def test_each_condition_is_told_once_and_effects_of_directions_have_none() -> None:
    effects = [CrossCoupling(), TemperatureBias(), TemperatureScaleFactor(), WarmUp(60.0)]
    assert holds(effects, REFERENCE) == ("at temp_c = 24.5 °C", "long after the start")


def test_no_effect_of_the_catalogue_is_said_to_hold_at_a_derived_conditions_zero() -> None:
    said = " ".join(holds(CATALOGUE, REFERENCE))
    derived = (SINCE_START, DURATION, RUN, "before_", "change_", "scatter_", ".rate", ".lag")
    assert not [name for name in derived if name in said]


def test_a_lagging_temperature_has_caught_up_where_the_temperature_does_not_change() -> None:
    assert holds([TemperatureLag(200.0)], REFERENCE) == ("at temp_c = 24.5 °C", "while temp_c does not change")


def test_with_effects_the_matrix_alone_is_said_not_to_be_the_calibration() -> None:
    assert use([], linear_only=False) == "a = matrix (u - centre)"
    said = use([BiasDrift()], linear_only=True)
    assert said.startswith("matrix and centre alone are not the calibration")
    assert "linear_only" in said
    assert "linear_only" not in use([BiasDrift()], linear_only=False)
