"""A calibration in a few lines."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from triaxcal.effects.contract import Effect
from triaxcal.effects.temperature_bias import TemperatureBias
from triaxcal.effects.warm_up import WarmUp
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.text import summary


@pytest.mark.parametrize(
    ("effects", "said"),
    [
        ((TemperatureBias(),), "the linear parameters hold at temp_c = "),
        ((WarmUp(60.0),), "the linear parameters hold long after the start"),
    ],
)
def test_a_summary_says_where_the_linear_parameters_hold(
    poses_with: Callable[..., list[Pose]], effects: tuple[Effect, ...], said: str
) -> None:
    c = fit(poses_with(1), signs=(-1, -1, -1), effects=effects)
    assert said in summary(c, "V", "g", ())
    assert "hold" not in summary(fit(poses_with(1), signs=(-1, -1, -1)), "V", "g", ())
