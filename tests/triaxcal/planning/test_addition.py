"""Poses worth adding: what each is said to do is what a fit with it does."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.effects import Effect, effect_named
from triaxcal.model.directions import (
    cube_directions,
    dilution,
    directions,
    linear_design,
    most_wanted,
    worst_error,
)
from triaxcal.planning.addition import ENOUGH, Addition, ExistingPoses, additions
from triaxcal.planning.design import target_effects

SECOND, THIRD = effect_named("second_order_nonlinearity"), effect_named("third_order_nonlinearity")
WARM, DRIFT = effect_named("temperature_bias"), effect_named("bias_drift")
NOTHING = target_effects([])


def existing(
    ups: np.ndarray, weights: np.ndarray | None = None, temperature: np.ndarray | None = None
) -> ExistingPoses:
    n = len(ups)
    held = {"t_s": np.linspace(-1, 1, n), "temp_c": np.zeros(n) if temperature is None else temperature}
    return ExistingPoses(ups, np.ones(n) if weights is None else weights, held, {"t_s": 60.0, "temp_c": 4.0})


def plan(count: int) -> np.ndarray:
    return np.array([v for _, v in directions(count)])


def with_them(ups: np.ndarray, added: list[Addition]) -> np.ndarray:
    return np.concatenate([ups, *(a.up[None] for a in added)])


def test_a_good_set_wants_nothing() -> None:
    assert additions(existing(plan(14)), NOTHING, most_wanted(plan(14), enough=ENOUGH)) == []
    assert additions(existing(plan(14)), target_effects([SECOND])) == []
    assert additions(existing(plan(26)), target_effects([THIRD])) == []


def test_the_worst_error_and_the_dilution_after_each_pose_are_those_of_the_poses_so_far() -> None:
    ups = plan(26)[plan(26)[:, 0] < 0.4]
    weights = np.random.default_rng(0).uniform(0.2, 3, len(ups))
    first = most_wanted(ups, enough=ENOUGH, most=26, weights=weights)
    added = additions(existing(ups, weights), NOTHING, first)
    assert [a.label for a in added] == [label for label, _ in first]
    for k in range(1, len(added) + 1):
        a = with_them(ups, added[:k])
        root = np.sqrt(np.append(weights, np.ones(k)))[:, None]
        assert added[k - 1].worst_error == pytest.approx(worst_error(linear_design(a, a) * root))
        assert added[k - 1].dilution == pytest.approx(dilution(a))
    assert added[-1].worst_error <= ENOUGH


def test_fourteen_poses_want_edges_for_the_third_order() -> None:
    added = additions(existing(plan(14)), target_effects([THIRD]))
    edges = {label for label, v in cube_directions() if np.sum(np.abs(v) > 0.1) == 2}
    assert {a.label for a in added} <= edges
    errors = [max(np.inf if e is None else e for e in a.errors[THIRD.name].values()) for a in added]
    assert errors[0] == np.inf
    # Each helps, and they stop as soon as it is nearly what the whole plan does.
    assert errors == sorted(errors, reverse=True)
    a = np.concatenate([plan(26), plan(26)[:1]])
    X = np.concatenate([linear_design(a, a), a**4], axis=1)
    whole = np.sqrt(np.diag(np.linalg.inv(X.T @ X))[9:].max())
    assert errors[-1] <= ENOUGH * whole < errors[-2]


@pytest.mark.parametrize("effects", [[THIRD], [WARM], [DRIFT, SECOND]], ids=lambda e: e[0].name)
def test_the_errors_told_are_those_of_least_squares_in_the_units_of_the_channels(effects: list[Effect]) -> None:
    start = plan(14)[:11]
    temperature = np.where(np.arange(11) < 3, -1.0, 1.0)
    added = additions(existing(start, temperature=temperature), target_effects(effects))
    assert added
    a = with_them(start, added)
    n = len(added)
    t = np.concatenate([np.linspace(-1, 1, 11), 1 + 0.2 * np.arange(1, n + 1)]) * 60.0
    warmth = np.concatenate([temperature, [x.levels.get("temp_c", 0.0) for x in added]]) * 4.0
    held = {"t_s": t, "temp_c": warmth}
    X = np.concatenate([linear_design(a, a), *(np.einsum("ni,nip->np", a, e.basis(a, held)) for e in effects)], axis=1)
    expected = np.sqrt(np.diag(np.linalg.inv(X.T @ X)))[9:]
    told = [v for e in effects for v in added[-1].errors[e.name].values()]
    assert told == pytest.approx(expected.tolist(), rel=1e-6)


def test_where_the_temperature_stood_still_the_poses_added_are_at_both_ends() -> None:
    levels = [a.levels["temp_c"] for a in additions(existing(plan(14)), target_effects([WARM]))]
    assert {-1.0, 1.0} <= set(levels)


def test_from_nothing_a_whole_set_is_wanted_for_an_effect_too() -> None:
    nothing = ExistingPoses(np.zeros((0, 3)), np.zeros(0), {"t_s": np.zeros(0)}, {"t_s": 1.0})
    added = additions(nothing, target_effects([SECOND]), most_wanted(np.zeros((0, 3))))
    assert len(added) > 9
    assert all(e is not None for e in added[-1].errors[SECOND.name].values())
