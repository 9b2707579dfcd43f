"""Standard errors and correlation as calibration documents hold them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.errors import InvalidData
from triaxcal.estimate.pose_fit import fit
from triaxcal.interchange.calibration_document import calibration_document
from triaxcal.interchange.calibration_reading import correlation_of, effect_errors_of, linear_errors_of
from triaxcal.model.directions import cube_directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcald.framing import covariance_of

EFFECT = effect_named("temperature_bias")
UNIT = Sensor(np.array([-2.41, -2.40, -2.37]), np.array([6e-3, 4e-3, -1e-3]), np.array([6e-3, -3e-3, 5e-3]))
UPS = np.array([v for _, v in cube_directions()])
HUGE = pytest.param(10**400, id="huge")


@pytest.fixture
def made() -> tuple[dict[str, Any], Sensor, np.ndarray]:
    """A document, its sensor and covariance, with an effect of a logged channel."""
    warm = {"temp_c": 20 + 5 * np.sin(np.arange(26) * 1.7)}
    poses = noisy_poses(UNIT, UPS, 1e-5, np.random.default_rng(1), channels=warm)
    c = fit(poses, signs=(-1, -1, -1), effects=[EFFECT], excluded=())
    return calibration_document(c, budgeted=False), c.sensor, c.covariance


def test_the_covariance_comes_back_from_the_document(made: tuple[dict[str, Any], Sensor, np.ndarray]) -> None:
    document, sensor, covariance = made
    found, warnings = covariance_of(document, sensor, where="cal.json")
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        found / np.outer(deviation, deviation), covariance / np.outer(deviation, deviation), atol=1e-5
    )
    assert not warnings


def test_names_tell_the_order_of_the_correlation(made: tuple[dict[str, Any], Sensor, np.ndarray]) -> None:
    document, sensor, _ = made
    right = correlation_of(document, sensor, where="cal.json")
    order = np.random.default_rng(0).permutation(12)
    document["parameters"] = [document["parameters"][i] for i in order]
    document["correlation"] = np.array(document["correlation"])[np.ix_(order, order)].tolist()
    np.testing.assert_array_equal(correlation_of(document, sensor, where="cal.json"), right)


def test_a_document_without_correlation_counts_as_independent(
    made: tuple[dict[str, Any], Sensor, np.ndarray],
) -> None:
    document, sensor, covariance = made
    del document["correlation"]
    found, (warning,) = covariance_of(document, sensor, where="cal.json")
    np.testing.assert_allclose(found, np.diag(np.diag(covariance)), rtol=1e-5, atol=0)
    assert "independent" in warning


@pytest.mark.parametrize("value", [[[1.0]], None, "x", [[float("nan")] * 12] * 12, (2 * np.eye(12)).tolist(), HUGE])
def test_a_correlation_that_is_none_is_named(made: tuple[dict[str, Any], Sensor, np.ndarray], value: Any) -> None:
    document, sensor, _ = made
    document["correlation"] = value
    with pytest.raises(InvalidData, match=r"cal.json: correlation: expected a correlation matrix of 12 rows"):
        correlation_of(document, sensor, where="cal.json")


def test_one_that_no_errors_can_have_is_named(made: tuple[dict[str, Any], Sensor, np.ndarray]) -> None:
    document, sensor, _ = made
    document["correlation"] = (2 * np.eye(12) - 1).tolist()
    with pytest.raises(InvalidData, match="correlation"):
        correlation_of(document, sensor, where="cal.json")


@pytest.mark.parametrize("value", [-1.0, float("nan"), "x", None, HUGE, [1.0]])
def test_errors_that_are_none_are_named(made: tuple[dict[str, Any], Sensor, np.ndarray], value: Any) -> None:
    document, sensor, _ = made
    document["standard_error"]["bias"] = [1e-5, value, 1e-5]
    with pytest.raises(InvalidData, match=r"cal.json: standard_error.bias: expected three numbers"):
        linear_errors_of(document, where="cal.json")
    document["effects"]["temperature_bias"][EFFECT.coefficients[0].name]["standard_error"] = value
    with pytest.raises(InvalidData, match=r"cal.json: effects.temperature_bias.*expected a number of at least 0"):
        effect_errors_of(document, sensor, where="cal.json")
