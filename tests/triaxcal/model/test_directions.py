"""Plans of poses, judged by geometry and by the paper's protocol."""

from __future__ import annotations

import re

import numpy as np
import pytest

from triaxcal.errors import InvalidData
from triaxcal.model.directions import (
    closed,
    cube_directions,
    dilution,
    directions,
    distinct,
    elsewhere,
    in_range,
    linear_design,
    most_wanted,
    worst_error,
)


def vectors(plan: list[tuple[str, np.ndarray]]) -> np.ndarray:
    return np.array([v for _, v in plan])


def test_the_paper_s_plan_is_six_faces_and_eight_vertices() -> None:
    v = vectors(directions(14))
    assert sorted(np.abs(v).max(axis=1)) == pytest.approx([3**-0.5] * 8 + [1.0] * 6)
    assert len({label for label, _ in directions(14)}) == 14


def test_the_full_plan_adds_the_twelve_edges() -> None:
    fourteen = {label for label, _ in directions(14)}
    edges = np.array([v for label, v in directions(26) if label not in fourteen])
    assert len(edges) == 12
    assert np.abs(edges).max(axis=1) == pytest.approx(np.full(12, 2**-0.5))
    assert np.array_equal(vectors(directions()), vectors(directions(26)))


def test_labels_say_which_axes_point_up() -> None:
    for label, v in cube_directions():
        expected = np.zeros(3)
        for sign, axis in zip(label[::2], label[1::2], strict=True):
            expected["XYZ".index(axis)] = 1 if sign == "+" else -1
        assert v == pytest.approx(expected / np.linalg.norm(expected)), label


@pytest.mark.slow
@pytest.mark.parametrize("count", [9, 10, 14, 18, 20, 26, 33, 100])
def test_a_plan_has_as_many_distinct_unit_vectors_as_asked_for(count: int) -> None:
    v = vectors(directions(count))
    assert v.shape == (count, 3)
    assert np.linalg.norm(v, axis=1) == pytest.approx(np.ones(count))
    assert distinct(v) == count


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, 18, 20, 33, 100])
def test_a_spiral_is_spread_evenly_and_carries_nine_parameters(count: int) -> None:
    v = vectors(directions(count))
    assert np.abs(v.mean(axis=0)).max() < 0.1
    assert v.T @ v / count == pytest.approx(np.eye(3) / 3, abs=0.06)
    assert dilution(v) < 3 * np.sqrt(14 / count)


@pytest.mark.parametrize("count", [-1, 0, 8])
def test_fewer_than_nine_poses_are_no_plan(count: int) -> None:
    with pytest.raises(InvalidData, match=f"a plan of {count} poses"):
        directions(count)


def test_the_dilution_of_the_fourteen_is_about_one() -> None:
    assert dilution(vectors(directions(14))) == pytest.approx(1, abs=0.1)
    assert dilution(vectors(directions(26))) < dilution(vectors(directions(14)))


def test_dilution_is_the_worst_standard_error_of_least_squares() -> None:
    a = vectors(directions(14))
    J = linear_design(a, a)
    worst = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(J.T @ J))[-1])
    assert dilution(a) == worst_error(J) == pytest.approx(worst)
    assert dilution(np.concatenate([a] * 4)) == pytest.approx(worst / 2)


def test_dilution_is_scaled_by_the_range_and_the_worst_error_is_not() -> None:
    edges = np.array([v for label, v in directions(26) if np.sum(np.abs(v) > 0.1) == 2])
    assert dilution(edges) == pytest.approx(np.sqrt(0.5))
    assert worst_error(linear_design(edges, edges)) == pytest.approx(1.0)
    outputs = in_range(edges * [3, 2, 1] + 5)
    assert dilution(edges) == pytest.approx(dilution(edges, linear_design(edges, outputs)), rel=1e-12)


@pytest.mark.parametrize("rows", [slice(0, 6), slice(6, 14), slice(0, 8)])
def test_dilution_of_a_singular_set_is_infinite(rows: slice) -> None:
    a = np.tile(vectors(directions(14))[rows], (3, 1))
    assert dilution(a) > 1e6


def test_the_linear_design_is_the_derivative_of_the_magnitude() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((10, 3))
    T, o = np.triu(rng.standard_normal((3, 3))) + 2 * np.eye(3), rng.standard_normal(3)

    def magnitude(p: np.ndarray) -> np.ndarray:
        upper = np.zeros((3, 3))
        upper[np.triu_indices(3)] = p[:6]
        return np.linalg.norm(x @ upper.T - p[6:], axis=1)

    p = np.concatenate([T[np.triu_indices(3)], o])
    slope = np.stack([(magnitude(p + h) - magnitude(p - h)) / 2e-6 for h in 1e-6 * np.eye(9)], axis=1)
    a = x @ T.T - o
    assert linear_design(a / np.linalg.norm(a, axis=1, keepdims=True), x) == pytest.approx(slope, abs=1e-8)


def test_a_closed_plan_ends_with_its_first_pose() -> None:
    plan = closed(directions(14))
    assert len(plan) == 15
    assert plan[-1][0] == plan[0][0] == "+X"
    assert np.array_equal(plan[-1][1], plan[0][1])


def test_nothing_is_wanted_of_a_good_set() -> None:
    assert most_wanted(vectors(directions(14))) == []


def test_what_is_wanted_of_six_faces_makes_them_a_good_set() -> None:
    faces = vectors(directions(14))[:6]
    wanted = most_wanted(faces)
    assert 3 <= len(wanted) <= 5
    assert dilution(np.concatenate([faces, vectors(wanted)])) <= 2.0 + 1e-6


def test_from_nothing_a_whole_set_is_wanted() -> None:
    wanted = most_wanted(np.zeros((0, 3)))
    assert len(wanted) == 9
    assert dilution(vectors(wanted)) <= 2.0


@pytest.mark.slow
def test_no_direction_is_wanted_twice() -> None:
    """Poses bunched on one side lack the same direction most, again and again."""
    for seed in range(30):
        a = np.random.default_rng(seed).normal((0.6, 0.6, 0.0), 0.35, (10, 3))
        labels = [label for label, _ in most_wanted(a, 1.0)]
        assert len(set(labels)) == len(labels)


def test_all_directions_are_wanted_where_even_they_do_not_suffice() -> None:
    assert len(most_wanted(np.zeros((0, 3)), 0.1, most=40)) == 26


def test_of_directions_that_are_unsure_the_worst_that_they_may_be_is_mended() -> None:
    faces = vectors(cube_directions()[:6])
    sure, unsure = most_wanted(faces), most_wanted(faces, unsure_rad=0.15)
    assert len(unsure) > len(sure)
    rng = np.random.default_rng(5)
    for _ in range(50):
        off = faces @ (np.eye(3) + 0.15 * rng.uniform(-1, 1, (3, 3))) + 0.15 * rng.uniform(-1, 1, 3)
        off /= np.linalg.norm(off, axis=1, keepdims=True)
        assert dilution(np.concatenate([off, vectors(unsure)])) < 3


def test_a_pose_of_little_weight_does_not_count_for_one() -> None:
    a = vectors(directions(14))
    noisy = np.where(np.arange(14) < 6, 1e-4, 1.0)
    wanted = most_wanted(a, weights=noisy)
    assert wanted
    root = np.sqrt(np.append(noisy, np.ones(len(wanted))))[:, None]
    linearise_all = np.concatenate([a, vectors(wanted)])
    assert dilution(linearise_all, linear_design(linearise_all, linearise_all) * root) <= 2.0
    assert most_wanted(a, weights=np.full(14, 4.0)) == []


def test_directions_within_five_degrees_count_as_one() -> None:
    angle = np.radians([0.0, 3.0, 90.0, 94.0, 180.0, 0.5, 6.0])
    assert distinct(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)) == 4


@pytest.mark.parametrize("count", [9, 14, 18, 26])
def test_directions_elsewhere_lie_apart_from_those_taken_and_from_each_other(count: int) -> None:
    taken = np.array([v for _, v in directions(count)])
    chosen = elsewhere(taken, 10)
    ups = np.array([v for _, v in chosen])
    assert np.degrees(np.arccos(np.max(ups @ taken.T))) > 15.0
    assert np.degrees(np.arccos(np.max(ups @ ups.T - 2 * np.eye(10)))) > 15.0
    assert len({label for label, _ in chosen}) == 10


def test_a_label_elsewhere_tells_the_parts_of_the_axes() -> None:
    for label, up in elsewhere(np.array([v for _, v in directions(26)]), 98):
        parts = np.zeros(3)
        for sign, size, axis in re.findall(r"([+-])(2?)([XYZ])", label):
            parts["XYZ".index(axis)] = (-1 if sign == "-" else 1) * (2 if size else 1)
        np.testing.assert_allclose(up, parts / np.linalg.norm(parts), atol=1e-15)
