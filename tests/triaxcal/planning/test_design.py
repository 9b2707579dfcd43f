"""What a set of poses can show of an effect, against what is known of |a| (METHOD §5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.effects.contract import per_axis, per_axis_slope
from triaxcal.model.directions import directions
from triaxcal.planning.design import observability, unseen_effects


def test_fourteen_poses_show_the_second_order_but_not_the_third(fourteen: np.ndarray) -> None:
    unseen = unseen_effects(fourteen)
    assert "third_order_nonlinearity" in unseen
    assert "second_order_nonlinearity" not in unseen


def test_of_the_third_order_fourteen_poses_show_the_sum_alone(fourteen: np.ndarray) -> None:
    # METHOD §5: a⁴ takes two values on these directions, and x⁴ + y⁴ + z⁴ tells faces from vertices.
    third = observability(fourteen, effect_named("third_order_nonlinearity"))
    assert (third.visible, third.of, len(third.hidden)) == (1, 3, 2)
    for combination in third.hidden:
        assert sum(combination.values()) == pytest.approx(0, abs=1e-9)
    assert observability(fourteen, effect_named("second_order_nonlinearity")).hidden == ()


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
    found = observability(a, effect)
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

    def basis(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis(s**2 * [1.0, 0.0, 1.0])

    def slope(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis_slope(2 * s * [1.0, 0.0, 1.0])


def test_a_coefficient_that_does_nothing_does_not_hide_the_others(twenty_six: np.ndarray) -> None:
    found = observability(twenty_six, Half())
    assert (found.visible, found.hidden) == (2, ({"y": 1.0},))


@pytest.mark.slow
@pytest.mark.parametrize("count", [26, 40, 60])
def test_poses_enough_show_every_effect_of_the_catalogue(count: int) -> None:
    assert unseen_effects(np.array([v for _, v in directions(count)])) == []
