"""What would do as well: aliases are listed, what is told apart is not, and what merely contains the finding is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import Effect, effect_named
from triaxcal.effects.part import Part
from triaxcal.poses.pose import Pose
from triaxcal.search import Search, alternatives, coincidence
from triaxcal.search.alternatives import instead_of
from triaxcal.sensor import Sensor

Recorded = Callable[..., list[Pose]]
Searched = Callable[..., Search]
WARMTH, DRIFT = effect_named("temperature_bias"), effect_named("bias_drift")
CROSS = effect_named("cross_coupling")
Q = np.array([2e-4, -3e-4, 2.5e-4])
T_S = (np.arange(26) + 0.5) * 10.0


def catalogue(*names: str) -> list[Effect]:
    return [effect_named(n) for n in names]


def beside_the_truth(search: Search, effect: Effect) -> tuple[str, ...]:
    """Alternatives of an effect that is in the model, as the truth would be."""
    model = search.model([effect])
    assert model is not None
    search.found = model
    return tuple(alternatives(search, effect, model))


def test_a_temperature_that_rises_with_time_is_an_alternative_of_drift_and_drift_of_it(
    paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    sensor = replace(paper_unit, effects=((WARMTH, Q),))
    poses = recorded(sensor, 0, channels={"temp_c": 25 + 0.02 * (T_S - 130)})
    search = searched(poses, [WARMTH, DRIFT])
    assert beside_the_truth(search, WARMTH) == ("bias_drift",)
    assert beside_the_truth(search, DRIFT) == ("temperature_bias",)


@pytest.mark.parametrize("noise_k", [0.0, 0.01, 1.0])
def test_a_temperature_that_goes_its_own_way_is_no_alternative(
    noise_k: float, paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    """By as much as moves |a| by ten standard errors, temperature is told from time; by a tenth of one it is not."""
    off = np.random.default_rng(1).standard_normal(26)
    sensor = replace(paper_unit, effects=((WARMTH, Q),))
    poses = recorded(sensor, 0, channels={"temp_c": 25 + 0.02 * (T_S - 130) + noise_k * off})
    found = beside_the_truth(searched(poses, [WARMTH, DRIFT]), WARMTH)
    # What a straight line leaves of the bias: q · noise / σ in each of 26 poses.
    apart = np.linalg.norm(Q) / np.sqrt(3) * noise_k / 1.5e-5 * np.sqrt(26)
    assert found == (() if apart > 20 else ("bias_drift",))


def test_what_contains_the_finding_and_has_more_to_it_is_no_alternative(
    paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    sensor = replace(paper_unit, effects=((WARMTH, Q),))
    search = searched(recorded(sensor, 0), catalogue("temperature_bias", "temperature_bias_quadratic"))
    assert beside_the_truth(search, WARMTH) == ()


SECOND = effect_named("second_order_nonlinearity")


def test_what_contains_one_of_two_findings_is_no_alternative_of_it_in_a_pair_either(
    paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    sensor = replace(paper_unit, effects=((WARMTH, Q), (SECOND, 3 * Q)))
    others = catalogue("temperature_bias_quadratic", "bias_drift")
    search = searched(recorded(sensor, 0), [WARMTH, SECOND, *others])
    model = search.model([WARMTH, SECOND])
    assert model is not None
    search.found = model
    parabola = {"temperature_bias_quadratic", SECOND.name}
    assert any({e.name for e in m.effects} == parabola for m in search.pairs_from(search.linear))
    assert names_of(search, model.effects) == {"temperature_bias": (), "second_order_nonlinearity": ()}


def test_beside_what_contains_a_finding_the_other_name_stands_for_the_other_finding(
    paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    """As beside the finding itself, in whatever form."""
    sensor = replace(paper_unit, effects=((WARMTH, Q), (SECOND, 3 * Q)))
    parabola, third = catalogue("temperature_bias_quadratic", "third_order_nonlinearity")
    search = searched(recorded(sensor, 0), [WARMTH, SECOND, parabola, third])
    model = search.model([WARMTH, SECOND])
    assert model is not None
    search.found = model
    for beside in (WARMTH, Part.of(WARMTH, "x"), parabola):
        assert instead_of(search, WARMTH, [third, beside]) == []
        assert instead_of(search, SECOND, [third, beside]) == ["third_order_nonlinearity"]
    assert instead_of(search, WARMTH, [third]) == ["third_order_nonlinearity"]
    assert instead_of(search, SECOND, [third]) == []
    assert instead_of(search, WARMTH, [parabola]) == []


def test_unlike_effects_are_told_apart(paper_unit: Sensor, recorded: Recorded, searched: Searched) -> None:
    names = ("second_order_nonlinearity", "third_order_nonlinearity", "temperature_bias", "bias_drift", "hysteresis")
    second = effect_named("second_order_nonlinearity")
    sensor = replace(paper_unit, effects=((second, 3 * Q),))
    assert beside_the_truth(searched(recorded(sensor, 0), catalogue(*names)), second) == ()


def test_an_effect_that_is_not_much_beyond_noise_has_alternatives(
    paper_unit: Sensor, recorded: Recorded, searched: Searched, directions: np.ndarray
) -> None:
    """Second order and scale-factor asymmetry differ by a twelfth of their size: at ten standard errors, by less than
    one."""
    second, other = effect_named("second_order_nonlinearity"), effect_named("scale_factor_asymmetry")
    share = told_apart(directions)
    assert share < 0.2
    small = replace(paper_unit, effects=((second, 0.25 * Q),))
    assert "scale_factor_asymmetry" in beside_the_truth(searched(recorded(small, 0), [second, other]), second)
    large = replace(paper_unit, effects=((second, 12 * Q),))
    assert beside_the_truth(searched(recorded(large, 0), [second, other]), second) == ()


def told_apart(a: np.ndarray) -> float:
    """Of second order on the three axes by these coefficients, the share that asymmetry leaves, beside nine parameters
    on the sphere."""
    x, y, z = a.T
    nine = np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1)
    q = np.linalg.qr(nine)[0]
    second, asymmetry = (a**3 @ Q)[:, None], a * np.abs(a)
    left = second - q @ (q.T @ second)
    both = np.linalg.qr(np.concatenate([nine, asymmetry], axis=1))[0]
    return float(np.linalg.norm(second - both @ (both.T @ second)) / np.linalg.norm(left))


def test_beside_a_second_effect_alternatives_are_sought_with_it_in_the_model(
    paper_unit: Sensor, recorded: Recorded, searched: Searched
) -> None:
    second = effect_named("second_order_nonlinearity")
    sensor = replace(paper_unit, effects=((WARMTH, Q), (second, 3 * Q)))
    poses = recorded(sensor, 0, channels={"temp_c": 25 + 0.02 * (T_S - 130)})
    search = searched(poses, [WARMTH, DRIFT, second])
    model = search.model([WARMTH, second])
    assert model is not None
    search.found = model
    assert names_of(search, model.effects) == {"temperature_bias": ("bias_drift",), "second_order_nonlinearity": ()}


def names_of(search: Search, effects: Sequence[Effect]) -> dict[str, tuple[str, ...]]:
    return {e.name: tuple(alternatives(search, e, search.found)) for e in effects}


def of_cross_coupling(paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, seed: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    sensor = replace(paper_unit, effects=((CROSS, 6e-4 * rng.standard_normal(len(CROSS.coefficients))),))
    where = fourteen[rng.permutation(14)] + 0.06 * rng.standard_normal((14, 3))
    return recorded(sensor, seed, where=where / np.linalg.norm(where, axis=1, keepdims=True))


def test_fourteen_poses_list_what_they_cannot_test_where_chance_would_explain_as_much(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    """Five degrees of freedom, of which cross coupling takes all: whatever is found instead is found by chance."""
    others = catalogue("temperature_bias", "second_order_nonlinearity", "bias_drift", "warm_up", "hysteresis")
    listed, found = 0, 0
    for seed in range(6):
        search = searched(of_cross_coupling(paper_unit, fourteen, recorded, seed), [*others, CROSS])
        assert {m.effects[0].name for m in search.untestable()} >= {"cross_coupling"}
        for model in search.singles_from(search.linear):
            if model.effects[0].name != "cross_coupling" and not search.left_over(model):
                found += 1
                search.found = model
                listed += "cross_coupling" in alternatives(search, model.effects[0], model)
    assert listed == found > 0


def test_a_single_number_that_explains_all_is_no_coincidence(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    one = Part.of(WARMTH, "y")
    sensor = replace(paper_unit, effects=((one, np.array([6e-4])),))
    search = searched(recorded(sensor, 0, where=fourteen), [WARMTH, CROSS])
    model = search.model([one])
    assert model is not None
    assert coincidence(search, one, model) < 1e-4
    search.found = model
    assert "cross_coupling" not in alternatives(search, one, model)
