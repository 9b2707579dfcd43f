"""Plans for suspected effects: judged by what theory says is best, by another algorithm, and by fits to made poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import CATALOGUE, Coefficient, Effect, effect_named
from triaxcal.effects.contract import per_axis, per_axis_slope
from triaxcal.errors import Refused
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.estimate.likelihood import solve
from triaxcal.model.directions import cube_directions, dilution, directions, distinct
from triaxcal.model.sensor import Sensor
from triaxcal.planning.design import OptimalPlan, bound, optimal, target_effects
from triaxcal.synthetic import noisy_poses

SECOND, THIRD = effect_named("second_order_nonlinearity"), effect_named("third_order_nonlinearity")
WARM, WARM_SCALE = effect_named("temperature_bias"), effect_named("temperature_scale_factor")
BENT, DRIFT = effect_named("temperature_bias_quadratic"), effect_named("bias_drift")


@cache
def planned(count: int, *effects: Effect) -> OptimalPlan:
    return optimal(count, effects)


def quadric(a: np.ndarray) -> np.ndarray:
    x, y, z = a.T
    return np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1)


def log_information(a: np.ndarray, columns: np.ndarray) -> float:
    """log det of the information on ``columns`` (n,p) that the nine parameters leave, by plain projection."""
    q, _ = np.linalg.qr(quadric(a))
    rest = columns - q @ (q.T @ columns)
    return float(np.linalg.slogdet(rest.T @ rest)[1])


def covariates(plan: OptimalPlan) -> dict[str, np.ndarray]:
    return {"t_s": np.linspace(-1, 1, len(plan.ups)), **plan.levels}


# Against theory


def test_the_bound_for_a_bias_that_goes_with_temperature_is_what_theory_says() -> None:
    # The three coefficients share an information of T² |a|² ≤ 1 a pose; the determinant is largest where they do so
    # evenly, and at the two ends of the range they can be at right angles to all nine parameters.
    assert bound(target_effects([WARM]), 21) == pytest.approx(3 * np.log(1 / 3), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("n", [15, 27])
def test_the_bound_for_drift_counts_time_as_it_passes(n: int) -> None:
    assert bound(target_effects([DRIFT]), n) == pytest.approx(
        3 * np.log(np.mean(np.linspace(-1, 1, n) ** 2) / 3), abs=0.01
    )


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "power"), [([SECOND], (3,)), ([THIRD], (4,)), ([SECOND, THIRD], (3, 4))])
def test_the_bound_is_the_optimum_that_another_algorithm_finds(effects: list[Effect], power: tuple[int, ...]) -> None:
    """Fedorov's and Wynn's, one direction at a time, on directions of its own."""
    rng = np.random.default_rng(0)
    a = rng.standard_normal((3000, 3))
    a = np.concatenate([a / np.linalg.norm(a, axis=1, keepdims=True), [v for _, v in cube_directions()]])
    X = np.concatenate([quadric(a), *(a**p for p in power)], axis=1)
    weight = np.full(len(X), 1 / len(X))
    q = 3 * len(power)
    for step in range(1000):
        M = (X * weight[:, None]).T @ X
        variance = np.sum(X @ np.linalg.inv(M) * X, axis=1)
        variance -= np.sum(X[:, :9] @ np.linalg.inv(M[:9, :9]) * X[:, :9], axis=1)
        weight *= 1 - 1 / (step + 2 + 50)
        weight[np.argmax(variance)] += 1 / (step + 2 + 50)
    reached = float(np.linalg.slogdet(M)[1] - np.linalg.slogdet(M[:9, :9])[1])
    limit = bound(target_effects(effects), 27)
    assert reached <= limit + 1e-6
    assert reached == pytest.approx(limit, abs=0.03 * q)


# Against brute force


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "power", "count"), [(SECOND, 3, 14), (THIRD, 4, 14), (THIRD, 4, 20)])
def test_no_choice_from_the_cube_is_better(effect: Effect, power: int, count: int) -> None:
    ours = planned(count, effect).ups
    cube = np.array([v for _, v in cube_directions()])
    limit = 1.5 * dilution(np.array([v for _, v in directions(count)]))
    rng = np.random.default_rng(2)
    best = -np.inf
    for _ in range(6):
        chosen = list(rng.permutation(np.arange(1, 26))[: count - 1])
        for _ in range(4):
            for k in range(count - 1):
                free = [c for c in range(1, 26) if c not in chosen]
                trials = [[*chosen[:k], c, *chosen[k + 1 :]] for c in [chosen[k], *free]]
                sets = [cube[[0, 0, *t]] for t in trials]
                values = [log_information(a, a**power) if dilution(a) <= limit else -np.inf for a in sets]
                chosen = trials[int(np.argmax(values))]
        a = cube[[0, 0, *chosen]]
        best = max(best, log_information(a, a**power))
    # One per cent of efficiency may go for directions that fixtures have.
    assert log_information(ours, ours**power) > best - 0.03 - 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "count"), [(SECOND, 13), (WARM, 13), (SECOND, 20), (THIRD, 20), (DRIFT, 20), (WARM, 20)]
)
def test_it_beats_the_plain_plan_of_as_many_poses_and_keeps_the_nine_parameters_good(
    effect: Effect, count: int
) -> None:
    found = planned(count, effect)
    plain = np.array([v for _, v in directions(count)])
    plain = np.concatenate([plain, plain[:1]])
    held = covariates(found)

    def value(a: np.ndarray) -> float:
        return log_information(a, np.einsum("ni,nip->np", a, effect.basis(a, held)))

    assert value(found.ups) > value(plain) - 0.03
    assert dilution(found.ups) <= 1.5 * dilution(plain[:-1]) * (1 + 1e-9)
    assert distinct(found.ups, apart_deg=9.999) == count
    assert np.array_equal(found.ups[0], found.ups[-1])
    claimed = np.exp((value(found.ups) - 3 * np.log(count + 1) - bound(found.targets, count + 1)) / 3)
    assert found.efficiency == pytest.approx(claimed, rel=1e-6)
    assert 0.75 < found.efficiency <= 1


@pytest.mark.slow
def test_channels_go_up_and_come_back_and_do_not_go_with_time_nor_with_each_other() -> None:
    found = optimal(26, [effect_named("temperature_bias"), Humid()])
    t = np.linspace(-1, 1, 27)
    temperature, humidity = found.levels["temp_c"], found.levels["humidity"]
    for levels in (temperature, humidity):
        assert set(levels) == {-1.0, 1.0}
        assert abs(np.corrcoef(t, levels)[0, 1]) < 0.15
    assert abs(np.corrcoef(temperature, humidity)[0, 1]) < 0.15
    assert (np.diff(temperature) != 0).sum() == 2


@pytest.mark.slow
def test_a_parabola_in_temperature_takes_three_levels() -> None:
    assert set(optimal(16, [BENT]).levels["temp_c"]) == {-1.0, 0.0, 1.0}


# Against fits


@pytest.mark.slow
@pytest.mark.parametrize("effects", [[THIRD], [WARM], [DRIFT, SECOND]], ids=lambda e: e[0].name)
def test_fits_to_poses_of_the_plan_scatter_as_promised(effects: list[Effect], paper_unit: Sensor) -> None:
    found = planned(20, *effects)
    rng = np.random.default_rng(3)
    truth = [1e-4 * rng.standard_normal(len(e.coefficients)) for e in effects]
    # Time in the fit is in seconds: half of it lies between the first pose and the middle.
    half_s = 10.0 * (len(found.ups) - 1) / 2
    scale = {"bias_drift": half_s}
    unit = Sensor(
        paper_unit.scale_factor,
        paper_unit.misalignment,
        paper_unit.bias,
        tuple((e, q / scale.get(e.name, 1.0)) for e, q in zip(effects, truth, strict=True)),
    )
    sigma, runs = 1e-5, 100
    channels = {name: 25.0 + v for name, v in found.levels.items()}
    reference = {"temp_c": 25.0, "t_s": half_s}
    meant = np.concatenate([q / scale.get(e.name, 1.0) for e, q in zip(effects, truth, strict=True)])
    missed = []
    for _ in range(runs):
        poses = noisy_poses(unit, found.ups, sigma, rng, channels=channels, channel_reference=reference)
        problem = problem_of(poses, signs=(-1, -1, -1))
        state = solve(problem, start(problem, poses, (-1, -1, -1)), tuple(effects))
        missed.append(state.theta[9:] - meant)
    promised = np.array([v / scale.get(e.name, 1.0) for e in effects for v in found.errors[e.name].values()]) * sigma
    ratio = (np.array(missed) ** 2).sum(axis=0) / promised**2
    low, high = stats.chi2.ppf([0.0005, 0.9995], runs)
    assert np.all((low < ratio) & (ratio < high)), ratio / runs


# What cannot be seen


@dataclass(frozen=True)
class Humid:
    """Bias that goes with humidity."""

    name: str = "channel_bias:humidity"
    coefficients: tuple[Coefficient, ...] = tuple(Coefficient(c, "g/%") for c in "xyz")
    needs: tuple[str, ...] = ("humidity",)
    remedy: str = ""

    def basis(self, s: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis(np.repeat(held["humidity"][:, None], 3, axis=1))

    def slope(self, s: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis_slope(np.zeros_like(s))


@dataclass(frozen=True)
class Swirl:
    """Adds to each axis what turns the vector and does not lengthen it, and to x what does."""

    name: str = "swirl"
    coefficients: tuple[Coefficient, ...] = (Coefficient("turn", "1"), Coefficient("bend", "g/g²"))
    needs: tuple[str, ...] = ()
    remedy: str = ""

    def basis(self, s: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        out = np.zeros((len(s), 3, 2))
        out[:, :, 0] = np.cross(s, [0.0, 0.0, 1.0]) * s[:, 2:]
        out[:, 0, 1] = s[:, 0] ** 2
        return out

    def slope(self, s: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        raise NotImplementedError


@dataclass(frozen=True)
class Gain(Humid):
    """A scale factor by another name."""

    name: str = "gain"
    needs: tuple[str, ...] = ()

    def basis(self, s: np.ndarray, held: Mapping[str, np.ndarray]) -> np.ndarray:
        return per_axis(s)


def test_what_the_nine_parameters_absorb_is_refused_whatever_the_plan() -> None:
    with pytest.raises(Refused, match=r"shows nothing of gain beside the nine parameters; no plan can"):
        optimal(26, [Gain()])


@pytest.mark.slow
def test_of_an_effect_of_which_a_part_shows_that_part_is_planned_for() -> None:
    found = optimal(20, [Swirl()])
    assert found.targets.rank == 1
    assert np.abs(found.targets.hidden[:, 0]) == pytest.approx([1.0, 0.0], abs=1e-9)
    assert found.errors["swirl"]["turn"] is None
    assert found.errors["swirl"]["bend"] is not None


@pytest.mark.slow
def test_effects_that_share_a_part_leave_it_open_whose_it_is() -> None:
    found = optimal(16, [WARM, BENT])
    assert found.targets.rank == 6
    assert all(v is None for v in found.errors["temperature_bias"].values())
    assert all(found.errors["temperature_bias_quadratic"][f"quadratic_{axis}"] is not None for axis in "xyz")


@pytest.mark.slow
def test_fewer_poses_than_parameters_are_refused_with_the_number_that_it_takes() -> None:
    with pytest.raises(Refused, match=r"11 poses cannot show third_order_nonlinearity; at least 12"):
        optimal(11, [THIRD])
    assert np.isfinite(dilution(optimal(12, [THIRD]).ups))
    with pytest.raises(Refused, match=r"at least 23"):
        optimal(22, [SECOND, THIRD, WARM, WARM_SCALE, DRIFT])


@pytest.mark.slow
def test_every_effect_of_the_catalogue_can_show_all_of_itself() -> None:
    for effect in CATALOGUE:
        assert target_effects([effect]).rank == len(effect.coefficients)
