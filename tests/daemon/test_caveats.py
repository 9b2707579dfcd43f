"""Sentences that are added to what the metrology says."""

from __future__ import annotations

import pytest

from triaxcal.interchange.calibration_document import assumed_in
from triaxcal.uncertainty.statements import ThermometerAt, UnmodelledTemperature
from triaxcald.caveats import assumption, none_could_show


@pytest.mark.parametrize(
    ("lacking", "said"),
    [
        (("temperature_bias", "temperature_scale_factor"), "bias 500 µg/K and scale factor 300 ppm/K;"),
        (("temperature_scale_factor",), "data sheets: scale factor 300 ppm/K;"),
        (("temperature_bias",), "data sheets: bias 500 µg/K;"),
    ],
)
def test_what_is_assumed_of_temperature_is_what_the_model_has_no_effect_for(
    lacking: tuple[str, ...], said: str
) -> None:
    effects = assumed_in(UnmodelledTemperature(lacking, 1.0, identifiable=True))
    assert said in assumption(effects)
    assert "µg" not in assumption(effects, "m/s^2")


def test_nothing_is_said_of_an_assumption_that_nobody_made() -> None:
    assert assumption(assumed_in(ThermometerAt(25.0))) == ""


def test_none_could_show_where_none_of_direction_and_time_does() -> None:
    every = {
        "second_order_nonlinearity", "third_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling",
        "bias_drift", "warm_up", "bias_step", "hysteresis", "fifth_order_nonlinearity", "compression",
        "scale_factor_drift", "remanence",
    }  # fmt: skip
    assert none_could_show(every)
    assert none_could_show({*every, "temperature_bias"})
    assert not any(none_could_show(every - {name}) for name in every)
