"""The order of a plan keeps what happens in time apart from what happens with direction: judged by plain regression."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.model.directions import closed, cube_directions, directions, in_order


def taken(plan: list[tuple[str, np.ndarray]]) -> np.ndarray:
    """(n+1,3), the first repeated at the end."""
    return np.array([v for _, v in closed(plan)])


def columns(a: np.ndarray) -> dict[str, np.ndarray]:
    """What |a| shows of everything, pose by pose, time from −1 to 1."""
    t = np.linspace(-1, 1, len(a))[:, None]
    x, y, z = a.T
    before = np.concatenate([a[:1], a[:-1]])
    return {
        "linear": np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1),
        "second": a**3,
        "third": a**4,
        "drift": t * a,
        "bent drift": t**2 * a,
        "ramp": t * a**2,
        "hysteresis": before * a,
    }


def errors(a: np.ndarray, *names: str) -> dict[str, float]:
    """Worst standard error of each group beside the linear columns and the other groups."""
    held = columns(a)
    X = np.concatenate([held["linear"], *(held[n] for n in names)], axis=1)
    if np.linalg.matrix_rank(X) < X.shape[1]:
        return dict.fromkeys(names, float("inf"))
    variance = np.diag(np.linalg.inv(X.T @ X))
    return {n: float(np.sqrt(variance[9 + 3 * i : 12 + 3 * i].max())) for i, n in enumerate(names)}


def test_with_fourteen_poses_drift_and_second_order_are_told_apart_which_the_plain_order_cannot() -> None:
    assert errors(taken(cube_directions()[:14]), "second", "drift")["drift"] == float("inf")
    ours = errors(taken(directions(14)), "second", "drift")
    assert ours["drift"] < 1.5
    assert ours["second"] < 1.1 * errors(taken(directions(14)), "second")["second"]


@pytest.mark.parametrize("other", ["bent drift", "ramp", "hysteresis"])
def test_of_twenty_six_poses_nothing_comes_out_much_worse_than_in_the_plain_order(other: str) -> None:
    plain = errors(taken(cube_directions()), "second", "third", "drift", other)
    ours = errors(taken(directions(26)), "second", "third", "drift", other)
    assert all(ours[name] <= plain[name] * 1.05 for name in ours), (plain, ours)
    assert ours["second"] < 0.95 * plain["second"]


def test_drift_costs_the_second_order_little_and_itself_little_more_than_it_must() -> None:
    a = taken(directions(26))
    assert errors(a, "second", "drift")["second"] < 1.1 * errors(a, "second")["second"]
    # Best possible: the sum of the three coefficients' information is that of time squared.
    best = np.sqrt(3 / np.sum(np.linspace(-1, 1, 27) ** 2))
    assert errors(a, "second", "third", "drift")["drift"] < 1.35 * best


@pytest.mark.parametrize("count", [20, 26])
def test_a_random_order_rarely_tells_drift_and_second_order_apart_better(count: int) -> None:
    plan = directions(count)
    rng = np.random.default_rng(1)

    def worst(order: np.ndarray) -> float:
        return max(errors(taken([plan[i] for i in order]), "second", "drift").values())

    ours = worst(np.arange(count))
    others = [worst(np.append(0, 1 + rng.permutation(count - 1))) for _ in range(200)]
    assert np.mean(np.array(others) < ours) < 0.05


@pytest.mark.parametrize("count", [9, 14, 20, 26])
def test_no_random_order_has_a_smaller_sum_of_variances(count: int) -> None:
    plan = directions(count)
    # Standard deviations: second order, third order, steady drift, and the rest.
    prior = np.repeat([10.0, 1.0, 10.0, 0.3, 0.3, 0.3], 3)

    def variances(order: np.ndarray) -> float:
        held = columns(taken([plan[i] for i in order]))
        X = np.concatenate(list(held.values()), axis=1)
        rows = np.concatenate([X, np.eye(27)[9:] / prior[:, None]])
        return float(np.sum(np.linalg.pinv(rows)[9:] ** 2))

    rng = np.random.default_rng(2)
    ours = variances(np.arange(count))
    assert all(variances(np.append(0, 1 + rng.permutation(count - 1))) > ours - 1e-9 for _ in range(200))


@pytest.mark.slow
def test_the_same_directions_give_the_same_order_and_every_one_is_taken_once() -> None:
    a = np.array([v for _, v in cube_directions()])
    order = in_order(a)
    assert order[0] == 0
    assert sorted(order) == list(range(26))
    # The last bits, in which processors differ, do not matter.
    assert np.array_equal(order, in_order(a * (1 + 1e-15 * np.random.default_rng(0).standard_normal(a.shape))))


def test_poses_of_one_kind_stay_in_the_places_of_that_kind() -> None:
    a = np.array([v for _, v in cube_directions()])
    kind = np.arange(26) // 9
    order = in_order(a, kind=kind)
    assert np.array_equal(kind[order], kind)
    assert not np.array_equal(order, np.arange(26))
