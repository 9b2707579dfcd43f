"""Directions for three biases: against all sets of the cube's directions, and by what they are."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from triaxcal.model.directions import (
    bias_dilution,
    bias_directions,
    cube_directions,
    determined,
    first_distinct,
    wanted_for_biases,
)

CUBE = np.array([v for _, v in cube_directions()])


def variance(ups: np.ndarray) -> float:
    """Of the biases, where scale factors may be off by two errors of a pose, angles by 0.3, biases by 20."""
    x, y, z = ups.T
    rows = np.stack([x * x, y * y, z * z, y * z, x * z, x * y, x, y, z], axis=1)
    prior = np.diag(np.repeat([2.0, 0.3, 20.0], 3) ** 2)
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + np.eye(len(rows)))
    return float(np.trace((prior - gain @ rows @ prior)[6:, 6:]))


def ups_of(count: int) -> np.ndarray:
    return np.array([v for _, v in bias_directions(count)])


@pytest.mark.parametrize("count", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_no_set_of_the_cube_is_better(count: int) -> None:
    best = min(variance(CUBE[list(rows)]) for rows in combinations(range(26), count))
    assert variance(ups_of(count)) == pytest.approx(best, rel=1e-6)


def test_four_are_the_corners_of_a_tetrahedron() -> None:
    cosines = ups_of(4) @ ups_of(4).T
    assert np.allclose(cosines[~np.eye(4, dtype=bool)], -1 / 3)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 8, 14, 26, 40])
def test_any_count_gives_so_many_distinct_directions_that_determine_the_biases(count: int) -> None:
    labels = [label for label, _ in bias_directions(count)]
    assert len(set(labels)) == count
    assert determined(ups_of(count))


def test_more_poses_are_never_worse() -> None:
    values = [variance(ups_of(count)) for count in range(3, 15)]
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(values))


def test_dilution_is_one_for_three_axes_and_infinite_in_a_plane() -> None:
    assert bias_dilution(np.eye(3)) == pytest.approx(1.0)
    assert bias_dilution(np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0]])) == np.inf
    assert bias_dilution(CUBE[:2]) == np.inf


@pytest.mark.parametrize("have", [CUBE[:0], CUBE[:1], CUBE[:2], CUBE[[0, 3]]])
def test_wanted_poses_mend_a_set_with_the_fewest(have: np.ndarray) -> None:
    labels = dict(cube_directions())
    wanted = wanted_for_biases(have)
    assert len(wanted) >= 3 - len(have)
    assert determined(np.concatenate([have, [labels[name] for name in wanted]]))


def test_the_first_distinct_ones_are_found_in_order() -> None:
    near = CUBE[0] + np.array([0.0, 0.05, 0.0])
    ups = np.array([CUBE[0], near / np.linalg.norm(near), CUBE[1], CUBE[0], CUBE[2], CUBE[3]])
    assert first_distinct(ups, 3) == [0, 2, 4]
    assert first_distinct(ups, 9) == [0, 2, 4, 5]


def test_poses_far_apart_come_first_and_nearer_ones_where_there_are_no_others() -> None:
    leaning = np.array([1.0, 0.4, 0.0]) / np.hypot(1.0, 0.4)  # 22° off
    ups = np.array([CUBE[0], leaning, CUBE[1], CUBE[2]])
    assert first_distinct(ups, 3) == [0, 2, 3]
    assert first_distinct(ups, 4) == [0, 1, 2, 3]
    assert first_distinct(CUBE, 26) == list(range(26))
