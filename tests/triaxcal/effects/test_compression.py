"""Output that gives way beyond a knee: recovered at either end, in any unit, and its knee by the fit that leaves
least."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.effects import Effect, effect_of
from triaxcal.effects.contract import BEFORE
from triaxcal.effects.nonlinear import KINDS, KNEES, Compression
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.planning.design import observability
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
TRUTH = [3e-3, -2e-3, 4e-3]


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("knee", [0.6, 0.85])
def test_the_fit_gives_it_back_as_far_off_as_it_says(kind: str, knee: float, recovers: Callable[..., None]) -> None:
    recovers(Compression(kind, knee), TRUTH)


@pytest.mark.parametrize(
    ("kind", "lower"), [pytest.param("odd", 1.0, id="both ends give way"), pytest.param("even", -1.0, id="one gains")]
)
def test_far_below_the_knee_there_is_nothing_and_far_beyond_the_slope_is_less_by_its_share(
    kind: str, lower: float
) -> None:
    s = np.array([0.0, 0.2, -0.2, 2.0, 3.0, -2.0, -3.0])[:, None] * np.ones(3)
    added = Compression(kind, 0.8).basis(s, {})[:, 0, 0]
    assert added[:3] == pytest.approx(np.zeros(3), abs=1e-4)
    assert added[3:5] == pytest.approx([-1.2, -2.2], abs=1e-4)
    assert added[5:] == pytest.approx([1.2 * lower, 2.2 * lower], abs=1e-4)


def test_one_end_alone_is_half_of_either() -> None:
    s = np.linspace(-1.5, 1.5, 31)[:, None] * np.ones(3)
    both = sum(0.5 * Compression(kind).basis(s, {})[:, 0, 0] for kind in KINDS)
    assert np.abs(both[s[:, 0] < 0]).max() < 1e-4
    assert both[-1] == pytest.approx(-0.8, abs=1e-4)


def test_coefficients_say_which_form_they_are_of() -> None:
    assert effect_of("compression", {"x": 1e-3, "knee": 0.8})[0] == Compression("odd", 0.8)
    assert effect_of("compression", {"even_y": 1e-3, "knee": 0.8})[0] == Compression("even", 0.8)


@pytest.mark.parametrize("reference", [1.0, 9.80665, 5e4, 4.8e-5])
def test_the_search_tries_knees_that_are_parts_of_the_reference(reference: float, twenty_six: np.ndarray) -> None:
    before = dict(zip(BEFORE, reference * twenty_six.T, strict=True))
    tried = Compression().variants(before)
    assert [v.shape["knee"][0] / reference for v in tried] == pytest.approx([*KNEES, *KNEES], rel=1e-3)
    assert [len(v.coefficients) for v in tried] == [3] * 10
    assert [v.shape["knee"][0] for v in Compression().variants({})] == [*KNEES, *KNEES]


def test_in_metres_per_second_squared_it_is_the_same_with_a_knee_in_that_unit(
    twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    g = 9.80665
    sensor = with_effect(Compression("odd", 0.7 * g), TRUTH)
    poses = noisy_poses(sensor, g * twenty_six, 1.5e-5 * g, np.random.default_rng(0))
    c = fit(poses, signs=MINUS, reference=g, effects=[Compression("odd", 0.7 * g)])
    assert np.all(np.abs(c.values[9:] - TRUTH) < 4.5 * c.standard_errors[9:])
    assert c.coefficients_of("compression")["knee"][0] == 0.7 * g


def test_the_knee_is_where_least_is_left_and_has_an_error(
    with_effect: Callable[[Effect, Sequence[float]], Sensor],
) -> None:
    """In directions that reach all parts of the axes; faces, edges and vertices of a cube reach three."""
    rng = np.random.default_rng(1)
    ups = rng.standard_normal((60, 3))
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    poses = noisy_poses(with_effect(Compression("odd", 0.8), [1e-2, -1e-2, 1e-2]), ups, 1.5e-5, rng)
    fits = {knee: fit(poses, signs=MINUS, effects=[Compression("odd", knee)], excluded=()) for knee in KNEES}
    best = min(fits, key=lambda knee: fits[knee].residual.rms_g)
    assert best == 0.8
    _, error, unit = fits[best].coefficients_of("compression")["knee"]
    assert unit == "g"
    assert error is not None
    assert 0 < error < 0.02


def test_poses_without_edges_say_that_they_show_the_sum_of_both_ends_alone(
    fourteen: np.ndarray, twenty_six: np.ndarray, with_effect: Callable[[Effect, Sequence[float]], Sensor]
) -> None:
    odd, even = Compression("odd"), Compression("even")
    assert (observability(fourteen, odd).visible, observability(fourteen, even).visible) == (1, 3)
    assert (observability(twenty_six, odd).visible, observability(twenty_six, even).visible) == (3, 3)


def test_poses_in_few_directions_say_that_they_cannot_show_it(
    with_effect: Callable[[Effect, Sequence[float]], Sensor],
) -> None:
    ups = np.array([up for _, up in directions(10)])
    poses = noisy_poses(with_effect(Compression(), [0, 0, 0]), ups, 1.5e-5, np.random.default_rng(0))
    loop = diagnose(poses, signs=MINUS, catalogue=[Compression()])
    assert loop.after.blind_to == ("compression",)
    assert loop.not_identifiable["compression"] == NotIdentifiable(Why.FEW_DIRECTIONS)
