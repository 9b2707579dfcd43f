"""What a device holds that knows fewer effects than the calibration, against the whole correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import TIME, effect_named
from triaxcal.estimate.calibration import Calibration, ReferenceEpoch, reduced
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import directions
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

MINUS = (-1.0, -1.0, -1.0)


@pytest.fixture
def fitted(with_effects: Callable[..., Sensor]) -> Callable[..., Calibration]:
    """Of forty poses over the sphere, twelve kelvin wide, with the effects inside, as (noise_g, name=coefficients)."""

    def make(noise_g: float = 1e-6, **effects: list[float]) -> Calibration:
        rng = np.random.default_rng(3)
        ups = rng.permutation(np.array([up for _, up in directions(40)]))
        warm = {"temp_c": 25 + 6 * np.sin(np.arange(len(ups)))}
        poses = noisy_poses(
            with_effects(**effects), ups, noise_g, rng, channels=warm, channel_reference={"temp_c": 25.0}
        )
        return fit(poses, signs=MINUS, effects=[effect_named(name) for name in effects])

    return make


def errors_g(sensor: Sensor, whole: Calibration, **held: float) -> np.ndarray:
    """Of |a| that a sensor makes of the outputs of the whole one, all over the sphere, under these conditions."""
    rng = np.random.default_rng(0)
    up = rng.standard_normal((400, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    covariates = {name: np.full(400, held.get(name, 0.0)) for name in whole.channel_reference}
    u = whole.sensor.output(up, covariates)
    return np.asarray(np.linalg.norm(sensor.specific_force(u, covariates), axis=1) - 1)


def test_a_device_that_knows_every_effect_holds_the_same(fitted: Callable[..., Calibration]) -> None:
    whole = fitted(second_order_nonlinearity=[3e-4, -2e-4, 3e-4])
    found = reduced(whole, lambda effect: True)
    assert found.calibration is whole
    assert found.cost == 0.0


def test_what_a_device_lacks_goes_into_what_it_has(fitted: Callable[..., Calibration]) -> None:
    """Third order is a scale factor for the most part: dropped, it leaves 600 µg/g³; taken up, a third of that."""
    whole = fitted(second_order_nonlinearity=[3e-4, -2e-4, 3e-4], third_order_nonlinearity=[6e-4, -6e-4, 6e-4])
    found = reduced(whole, lambda effect: effect.name == "second_order_nonlinearity")
    assert found.calibration.terms == ("linear", "second_order_nonlinearity")
    left = np.sqrt(np.mean(errors_g(found.calibration.sensor, whole) ** 2))
    cut = replace(
        whole.sensor, effects=tuple((e, q) for e, q in whole.sensor.effects if e.name == "second_order_nonlinearity")
    )
    assert left < 0.5 * np.sqrt(np.mean(errors_g(cut, whole) ** 2))
    assert found.cost == pytest.approx(left, rel=0.1)


def test_what_remains_is_as_little_as_any_nine_parameters_could_leave(fitted: Callable[..., Calibration]) -> None:
    whole = fitted(third_order_nonlinearity=[6e-4, -6e-4, 6e-4])
    found = reduced(whole, lambda effect: False)
    rng = np.random.default_rng(1)
    least = np.sqrt(np.mean(errors_g(found.calibration.sensor, whole) ** 2))
    size = np.array([1e-4] * 3 + [1e-4] * 3 + [1e-4] * 3) * np.array([2.0] * 3 + [1.0] * 6)
    for _ in range(40):
        other = found.calibration.sensor.moved(size * rng.standard_normal(9))
        assert np.sqrt(np.mean(errors_g(other, whole) ** 2)) > 0.98 * least


def test_an_effect_of_time_is_held_as_the_bias_at_the_moment(fitted: Callable[..., Calibration]) -> None:
    whole = fitted(bias_drift=[5e-7, -4e-7, 3e-7])
    end_s = max(p.pose.end_s for p in whole.poses)
    held = replace(whole, holds_at=ReferenceEpoch(Moment.END, end_s, end_s))
    found = reduced(held, lambda effect: False)
    ((_, rate),) = whole.sensor.effects
    drift = rate * (end_s - whole.channel_reference[TIME])
    assert found.calibration.sensor.bias - whole.sensor.bias == pytest.approx(drift, rel=1e-3)
    assert found.cost < 1e-9


def test_a_temperature_that_no_register_follows_costs_what_it_did_in_the_poses(
    fitted: Callable[..., Calibration],
) -> None:
    whole = fitted(temperature_bias=[1e-4, 1e-4, 1e-4])
    found = reduced(whole, lambda effect: False)
    swings = np.std([p.pose.channels["temp_c"] for p in whole.poses])
    assert found.cost == pytest.approx(1e-4 * swings, rel=0.25)  # each axis acts on |a| by its own share of up
    assert found.calibration.channel_reference == {}


def test_errors_follow_the_parameters_into_the_device(fitted: Callable[..., Calibration]) -> None:
    """Coefficients that the poses hardly tell from a scale factor cost nothing once they are one."""
    whole = fitted(noise_g=2e-5, third_order_nonlinearity=[3e-4, -3e-4, 3e-4])
    alone = reduced(whole, lambda effect: False).calibration
    bare = fit([p.pose for p in whole.poses], signs=MINUS)
    assert alone.covariance.shape == (9, 9)
    assert alone.standard_errors[:3] == pytest.approx(bare.standard_errors[:3] / bare.birge_ratio, rel=0.6)
