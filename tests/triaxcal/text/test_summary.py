"""A calibration in a few lines."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from triaxcal.effects.contract import Effect
from triaxcal.effects.thermal import TemperatureBias
from triaxcal.effects.time import WarmUp
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.text import summary, verification


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


@pytest.mark.parametrize(
    ("rms", "said"),
    [(300e-6, "20 µg expected of noise and the calibration's uncertainty: the error is 15 times that"),
     (39e-6, "20 µg expected of noise and the calibration's uncertainty")],
)  # fmt: skip
def test_an_error_beyond_what_is_expected_is_told_in_times_of_that(rms: float, said: str) -> None:
    line = verification("14 poses", rms, 15e-6, 20e-6, ("g", 1.0))
    assert line.replace(".0", "").endswith(said)
