"""What a set of poses can show of an effect, against what is known of |a| (METHOD §5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from triaxcal.effects import CATALOGUE, Effect, effect_named
from triaxcal.effects.contract import per_axis, per_axis_slope
from triaxcal.planning.directions import directions
from triaxcal.poses.pose import Pose
from triaxcal.problem import State
from triaxcal.search.candidates import Ground, candidates_of
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start
from triaxcal.synthetic import noisy_poses
from triaxcal.visibility import sight, unseen_effects


def ground_of(poses: list[Pose], given: Sequence[Effect] = ()) -> Ground:
    """The nine parameters, and effects given, at the start of the fit."""
    problem = problem_of(poses, signs=(-1, -1, -1))
    state: State = start(problem, poses, (-1, -1, -1))
    return Ground.at(problem, state.extended(given))


def is_visible(ground: Ground, effect: Effect) -> bool:
    """Whether every coefficient of an effect shows."""
    return effect.name in candidates_of(ground, [effect], set())[1]


def test_fourteen_poses_show_the_second_order_but_not_the_third(fourteen: np.ndarray) -> None:
    unseen = unseen_effects(fourteen)
    assert "third_order_nonlinearity" in unseen
    assert "second_order_nonlinearity" not in unseen


def test_of_the_third_order_fourteen_poses_show_the_sum_alone(fourteen: np.ndarray) -> None:
    # METHOD §5: a⁴ takes two values on these directions, and x⁴ + y⁴ + z⁴ tells faces from vertices.
    third = sight(fourteen, effect_named("third_order_nonlinearity"))
    assert (third.visible, third.of, len(third.hidden)) == (1, 3, 2)
    for combination in third.hidden:
        assert sum(combination.values()) == pytest.approx(0, abs=1e-9)
    assert sight(fourteen, effect_named("second_order_nonlinearity")).hidden == ()


@pytest.mark.parametrize("name", ["second_order_nonlinearity", "third_order_nonlinearity", "bias_drift"])
@pytest.mark.parametrize("count", [9, 10, 12, 14, 18, 26])
def test_what_is_hidden_changes_no_fit_and_what_is_visible_does(name: str, count: int) -> None:
    """By plain projection, effect by effect."""
    a = np.array([v for _, v in directions(count)])
    a = np.concatenate([a, a[:1]])
    effect = effect_named(name)
    t = np.linspace(-1, 1, len(a))
    columns = np.einsum("ni,nip->np", a, effect.basis(a, {"t_s": t}))
    x, y, z = a.T
    q, _ = np.linalg.qr(np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1))
    rest = columns - q @ (q.T @ columns)
    found = sight(a, effect)
    assert found.visible == np.linalg.matrix_rank(rest, tol=0.02)
    assert found.visible + len(found.hidden) == found.of
    for combination in found.hidden:
        v = np.array([combination.get(c.name, 0.0) for c in effect.coefficients])
        assert np.linalg.norm(v) == pytest.approx(1)
        assert np.linalg.norm(rest @ v) < 0.05


@dataclass(frozen=True)
class Half(type(effect_named("second_order_nonlinearity"))):  # type: ignore[misc]
    """A square that adds nothing to the y axis."""

    name: str = "half"

    def basis(self, s: np.ndarray, conditions: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis(s**2 * [1.0, 0.0, 1.0])

    def slope(self, s: np.ndarray, conditions: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis_slope(2 * s * [1.0, 0.0, 1.0])


def test_a_coefficient_that_does_nothing_does_not_hide_the_others(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-9, np.random.default_rng(0))
    ground = ground_of(poses)
    assert ground.shown(ground.columns(Half()))[0].shape == (26, 2)
    assert not is_visible(ground, Half())
    assert sight(twenty_six, Half()).hidden == ({"y": 1.0},)


@pytest.mark.parametrize("count", [26, 40, 60])
def test_poses_enough_show_every_effect_of_the_catalogue(count: int) -> None:
    assert unseen_effects(np.array([v for _, v in directions(count)])) == []


@pytest.mark.parametrize("name", ["second_order_nonlinearity", "third_order_nonlinearity"])
def test_what_is_projected_cannot_be_made_by_the_nine_parameters(
    name: str, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-9, np.random.default_rng(0))
    ground = ground_of(poses)
    rows = ground.shown(ground.columns(effect_named(name)))[0].T
    assert rows @ rows.T == pytest.approx(np.eye(3), abs=1e-9)
    # The nine columns by themselves: on the unit sphere they are all even terms and the three odd linear ones.
    a = twenty_six
    quadric = np.stack([*(a.T**2), a[:, 0] * a[:, 1], a[:, 1] * a[:, 2], a[:, 0] * a[:, 2], *a.T], axis=1)
    assert rows @ quadric / np.linalg.norm(quadric, axis=0) == pytest.approx(np.zeros((3, 9)), abs=0.02)


def test_an_effect_whose_channel_stands_still_or_is_not_there_does_not_show(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    for channels, visible in (({}, False), ({"temp_c": np.full(26, 25.0)}, False), ({"temp_c": None}, True)):
        held = {n: np.random.default_rng(1).normal(25, 2, 26) if v is None else v for n, v in channels.items()}
        poses = noisy_poses(paper_unit, twenty_six, 1e-9, np.random.default_rng(0), channels=held)
        assert is_visible(ground_of(poses), effect_named("temperature_bias")) is visible


def test_beside_the_same_thing_under_another_name_an_effect_does_not_show(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    t_s = (np.arange(26) + 0.5) * 10.0
    poses = noisy_poses(
        with_effects(), twenty_six, 1e-9, np.random.default_rng(0), channels={"temp_c": 20 + 0.02 * t_s}
    )
    drift, warmth = effect_named("bias_drift"), effect_named("temperature_bias")
    assert is_visible(ground_of(poses), drift)
    assert is_visible(ground_of(poses), warmth)
    assert not is_visible(ground_of(poses, [warmth]), drift)
    assert len(CATALOGUE) >= 6
