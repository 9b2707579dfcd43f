"""The next pose of a sequential design is the one with which |a| is least uncertain, over the whole sphere."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.truth import PAPER_UNIT, information
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import Direction, directions, linear_design, spiral
from triaxcal.model.sensor import Sensor
from triaxcal.planning import best_first, magnitude_error
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget

IDEAL = Sensor(np.ones(3), np.zeros(3), np.zeros(3))


def ups(plan: list[Direction]) -> np.ndarray:
    return np.array([v for _, v in plan]).reshape(-1, 3)


def sequence(count: int) -> list[Direction]:
    left, taken = directions(count), list[Direction]()
    while left:
        taken.append(best_first(ups(taken), left)[0])
        left = [d for d in left if d[0] != taken[-1][0]]
    return taken


@pytest.mark.parametrize("count", [14, 20, 26])
def test_the_error_of_the_magnitude_is_the_bound_of_an_ideal_unit(count: int) -> None:
    """By an algebra of its own: of all parameters and attitudes, in `benchmarks.truth`."""
    up, sphere = ups(directions(count)), spiral(1000)
    bound = np.linalg.inv(information(IDEAL, up, np.ones((count, 3))))
    x = np.concatenate([sphere**2, sphere[:, [1]] * sphere[:, [2]], sphere[:, [0]] * sphere[:, [2]]], axis=1)
    x = np.concatenate([x, sphere[:, [0]] * sphere[:, [1]], sphere], axis=1)
    expected = np.sqrt(np.mean(np.einsum("ni,ij,nj->n", x, bound, x)))
    assert magnitude_error(up) == pytest.approx(expected, rel=1e-3)


def test_it_is_the_noise_of_a_budget() -> None:
    poses = noisy_poses(PAPER_UNIT, ups(directions(14)), 2e-5, np.random.default_rng(0))
    lines = budget(fit(poses, signs=(-1, -1, -1))).components
    (noise,) = (line.magnitude for line in lines if line.source == "noise")
    assert noise == pytest.approx(2e-5 * magnitude_error(ups(directions(14))), rel=0.01)


def test_fewer_than_nine_poses_and_singular_ones_leave_it_open() -> None:
    ring = np.array([[np.cos(t), np.sin(t), 0.0] for t in np.linspace(0, 6, 12)])
    assert magnitude_error(ups(directions(9))[:8]) == np.inf
    assert magnitude_error(ring) == np.inf


@pytest.mark.parametrize("taken", [9, 12, 17])
def test_the_candidates_are_in_the_order_of_the_error_with_each(taken: int) -> None:
    plan = directions(26)
    before, left = ups(plan[:taken]), plan[taken:]
    order = best_first(before, left)
    errors = [magnitude_error(np.concatenate([before, v[None]])) for _, v in order]
    assert sorted(label for label, _ in order) == sorted(label for label, _ in left)
    assert errors == pytest.approx(sorted(errors), rel=1e-5)
    assert errors[0] < errors[-1]


def test_equal_candidates_stay_in_the_order_of_the_plan() -> None:
    """Four corners and their opposites lower the uncertainty by as much after the six faces."""
    faces = ups([d for d in directions(26) if len(d[0]) == 2])
    corners = [d for d in directions(26) if len(d[0]) == 6]
    assert [label for label, _ in best_first(faces, corners)] == [label for label, _ in corners]
    assert [label for label, _ in best_first(faces, corners[::-1])] == [label for label, _ in corners[::-1]]


@pytest.mark.parametrize("count", [14, 20, 26])
def test_nine_poses_of_the_sequence_determine_all_parameters(count: int) -> None:
    taken = ups(sequence(count))
    assert np.linalg.matrix_rank(linear_design(taken[:9], taken[:9])) == 9
    assert magnitude_error(taken[:9]) < 2
    assert magnitude_error(taken[:12]) < 1.2
    assert magnitude_error(taken) == pytest.approx(magnitude_error(ups(directions(count))))
