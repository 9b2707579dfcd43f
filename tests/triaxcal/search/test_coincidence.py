"""How likely a name comes out whatever acts: judged by residuals drawn in random directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.effects.part import Part
from triaxcal.poses.pose import Pose
from triaxcal.problem import linearise
from triaxcal.search import LeftOut, Model, Search, coincidence, coincidence_of_spoiled
from triaxcal.sensor import Sensor

Recorded = Callable[..., list[Pose]]
Searched = Callable[..., Search]
MINUS = (-1, -1, -1)
WARMTH = effect_named("temperature_bias")
HYSTERESIS = effect_named("hysteresis")


def shares_left(dof: int, columns: np.ndarray, drawn: int, seed: int) -> np.ndarray:
    """(m,) of random directions in ``dof`` dimensions, what columns (dof,q) leave of the sum of squares."""
    y = np.random.default_rng(seed).standard_normal((drawn, dof))
    q, _ = np.linalg.qr(columns)
    return np.asarray(1 - np.sum((y @ q) ** 2, axis=1) / np.sum(y**2, axis=1))


@pytest.fixture
def search(paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched) -> Search:
    """Of one given candidate, where the linear model leaves thirty standard errors."""
    made = searched(recorded(paper_unit, 0, where=fourteen), [WARMTH])
    made.tests = 1.0
    made.linear = replace(made.linear, chi2=900.0)
    return made


def test_it_is_the_chance_of_a_random_direction(search: Search) -> None:
    share = shares_left(search.left([]), np.eye(search.left([]))[:, :3], 200_000, 3)
    for chi2 in (40.0, 150.0):
        model = Model((WARMTH,), search.linear.state, chi2, 0.0)
        assert coincidence(search, WARMTH, model) == pytest.approx(np.mean(share < chi2 / 900), rel=0.05)


def test_a_pose_to_leave_out_is_one_choice_more(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    """Of random directions, of which a given candidate with the best of all poses left out explains as much: never more
    often than is said, and where it is rare half as often at least."""
    poses = recorded(paper_unit, 0, where=fourteen)
    whole = searched(poses, [WARMTH])
    _, singular, rows = np.linalg.svd(linearise(whole.problem, whole.linear.state)[1].T)
    own = rows[len(singular) :].T  # (14,5), what nine parameters leave
    candidate = np.random.default_rng(4).standard_normal((5, 2))
    share = np.min([shares_left(5, np.column_stack([candidate, pose]), 100_000, 5) for pose in own], axis=0)
    spoiled = [replace(poses[0], mean=poses[0].mean * 1.02), *poses[1:]]
    kept = searched(poses[1:], [WARMTH])
    kept.tests, kept.left_out = 1.0, LeftOut(spoiled, (0,), MINUS, 1.0)
    total = kept.left_out.chi2((), set())
    assert total > 1e4
    kept.linear = replace(kept.linear, chi2=total)
    one = Part(WARMTH, np.eye(3)[:, :2])
    for rest in (0.002, 0.005):
        model = Model((one,), kept.linear.state, rest * total, 0.0)
        said = coincidence(kept, one, model)
        assert 0.5 * said < np.mean(share < rest) < 1.05 * said


def test_trends_that_are_as_foretold_make_it_less_of_a_coincidence_and_others_do_not(search: Search) -> None:
    """As often as two tests in a row are passed, both in random directions."""
    search.linear = replace(search.linear, trends=60.0)
    rng = np.random.default_rng(6)
    by_means, by_trends = (
        shares_left(dof, np.eye(dof)[:, :3], 400_000, seed) for dof, seed in ((search.left([]), 7), (14, 8))
    )

    def said(trends: float, foretells: bool = True) -> float:
        model = Model((WARMTH,), search.linear.state, 150.0, 0.0, trends=trends, foretells=foretells)
        return coincidence(search, WARMTH, model)

    passed = np.mean(by_means < 150 / 900) * np.mean(by_trends < 20 / 60)
    product = rng.random((400_000, 2)).prod(axis=1)
    assert said(20.0) == pytest.approx(np.mean(product < passed), rel=0.1)
    assert said(60.0) == said(20.0, foretells=False)
    assert said(20.0) < said(40.0) < said(60.0)
    assert said(70.0) < 1.0 == said(130.0)  # |a| moves, and should have gone another way
    quiet = replace(search.linear, trends=14.0)
    search.linear = quiet
    assert said(20.0) == pytest.approx(np.mean(by_means < 150 / 900), rel=0.05)
    assert said(60.0) == 1.0  # it should have moved |a| inside the poses
    within_chance = Model((WARMTH,), search.linear.state, 150.0, 0.0, trends=29.0)
    assert search.trends_p(within_chance) > 0.01
    assert said(29.0) == 1.0  # not all of them together are beyond chance, but they are far nearer to nothing
    assert said(60.0, foretells=False) == said(20.0)


def test_each_of_several_effects_is_put_to_the_test_by_itself(
    paper_unit: Sensor, twenty_six: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    """A large effect of the temperature, and hysteresis that 2 of 17 degrees of freedom take for what no one knows."""
    rng = np.random.default_rng(2)
    temp_c = 25 + 4 * np.sin(0.9 * np.arange(26))
    sensor = replace(paper_unit, effects=((WARMTH, np.array([2e-3, 0.0, 0.0])),))
    poses = recorded(sensor, 0, where=twenty_six, channels={"temp_c": temp_c})
    off = [replace(p, mean=p.mean * (1 + 1e-4 * rng.standard_normal())) for p in poses]
    search = searched(off, [WARMTH, HYSTERESIS])
    both = search.model([WARMTH, HYSTERESIS])
    assert both is not None
    assert coincidence(search, WARMTH, both) < 1e-6
    assert coincidence(search, HYSTERESIS, both) > 0.1


def test_a_pose_that_is_left_out_because_of_what_was_before_it_is_no_choice(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    """However far off it is: hysteresis needs what was before the first pose, and nobody knows it."""
    poses = recorded(paper_unit, 0, where=fourteen)
    first = [replace(poses[0], mean=poses[0].mean * 1.02, before=None), *poses[1:]]
    kept = searched(poses[1:], [WARMTH, HYSTERESIS])
    kept.linear = replace(kept.linear, chi2=900.0)
    of_hysteresis, of_warmth = (Model((e,), kept.linear.state, 40.0, 0.0) for e in (HYSTERESIS, WARMTH))
    alone = coincidence(kept, HYSTERESIS, of_hysteresis)
    kept.left_out = LeftOut(first, (0,), MINUS, 1.0)
    assert coincidence(kept, HYSTERESIS, of_hysteresis) == alone
    assert coincidence_of_spoiled(kept, of_hysteresis) == 0.0
    assert coincidence_of_spoiled(kept, of_warmth) > 0.0


def test_a_pose_that_is_far_off_vouches_for_nothing_else(
    paper_unit: Sensor, twenty_six: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    """Neither for an effect beside it, nor for another pose left out."""
    poses = recorded(paper_unit, 0, where=twenty_six)
    far, near = (replace(p, mean=p.mean * (1 + off)) for p, off in zip(poses, (0.02, 1e-4), strict=False))
    kept = searched(poses[2:], [WARMTH])
    state = kept.linear.state
    kept.linear = replace(kept.linear, chi2=1600.0)
    model = Model((WARMTH,), state, 1200.0, 0.0)
    alone = coincidence(kept, WARMTH, model)
    assert alone > 0.1
    kept.left_out = LeftOut([far, *poses[1:]], (0,), MINUS, 1.0)
    assert coincidence(kept, WARMTH, model) == alone
    assert coincidence_of_spoiled(kept, model) < 1e-6
    kept.left_out = LeftOut([poses[0], near, *poses[2:]], (1,), MINUS, 1.0)
    of_near = coincidence_of_spoiled(kept, model)
    kept.left_out = LeftOut([far, near, *poses[2:]], (0, 1), MINUS, 1.0)
    assert of_near > 0.01
    assert coincidence_of_spoiled(kept, model) == pytest.approx(of_near, rel=1e-3)
