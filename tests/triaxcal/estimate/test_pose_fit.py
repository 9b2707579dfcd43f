"""The fit's derivatives, errors, leverage and weights, each against brute force or an outside authority."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import CATALOGUE, TIME, effect_named
from triaxcal.effects.contract import SCATTER, rate_of
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import ExcessVariance, Exclusion, FaultyPosesExcluded
from triaxcal.estimate.initial_estimate import problem_of, start, with_history
from triaxcal.estimate.likelihood import Problem, State, linearise, solve
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SIZED: dict[str, list[float]] = {
    "second_order_nonlinearity": [3e-3, -2e-3, 1e-3],
    "third_order_nonlinearity": [-1e-3, 4e-3, 2e-3],
    "scale_factor_asymmetry": [1e-3, -2e-3, 1e-3],
    "cross_coupling": [1e-3, -1e-3, 2e-3, 1e-3, -2e-3, 1e-3, 1e-3],
    "temperature_bias": [1e-4, -2e-4, 3e-4],
    "temperature_bias_quadratic": [1e-4, 1e-4, -2e-4, 1e-5, -2e-5, 3e-5],
    "temperature_scale_factor": [2e-4, -1e-4, 3e-4],
    "thermal_gradient": [1e-2, -2e-2, 1e-2],
    "bias_drift": [1e-5, -2e-5, 1e-5],
    "warm_up": [1e-3, 2e-3, -1e-3],
    "bias_step": [1e-3, -1e-3, 2e-3],
    "hysteresis": [1e-3, 1e-3, -2e-3],
    "vibration_rectification": [10.0, -20.0, 30.0],
    "fifth_order_nonlinearity": [1e-3, -2e-3, 1e-3],
    "compression": [3e-3, 2e-3, -3e-3],
    "scale_factor_drift": [1e-5, -1e-5, 2e-5],
    "temperature_lag": [1e-4, 2e-4, -1e-4],
    "remanence": [1e-3, -1e-3, 2e-3],
}
COEFFICIENTS = {e.name: SIZED.get(e.name, [1e-3] * len(e.coefficients)) for e in CATALOGUE}
"""Of every effect; those not in `SIZED` act alike on all axes, by a thousandth."""
SHAPES = {
    "compression": {"knee": 0.5},
    "temperature_lag": {"time_constant": 30.0},
    "warm_up": {"time_constant": 80.0},
    "bias_step": {"at": 75.0},
}
# On these poses a drift that bends and a step in the middle of one have columns of their own.
ALL_ON = tuple(e.shaped(SHAPES[e.name]) if e.shape else e for e in CATALOGUE)


def wandering(n: int) -> dict[str, np.ndarray]:
    return {"temp_c": 25 + 3 * np.sin(1.7 * np.arange(n)) + np.cos(0.9 * np.arange(n))}


def everything_on(paper_unit: Sensor, directions: np.ndarray, seed: int = 0) -> tuple[Problem, State, list[Pose]]:
    sensor = replace(paper_unit, effects=tuple((e, np.array(COEFFICIENTS[e.name])) for e in ALL_ON))
    rng = np.random.default_rng(seed)
    n = len(directions)
    rate, scatter = rng.uniform(-0.02, 0.02, n), rng.uniform(1e-6, 1e-4, (n, 3))
    logged = wandering(n)
    there = logged | {rate_of("temp_c"): rate} | {name: scatter[:, i] for i, name in enumerate(SCATTER)}
    reference = {"temp_c": 25.0, TIME: 5.0 * n}
    poses = [
        replace(
            p,
            channels={"temp_c": float(logged["temp_c"][i])},
            rates={"temp_c": float(rate[i])},
            scatter=scatter[i] * sensor.scale_factor**2,
        )
        for i, p in enumerate(noisy_poses(sensor, directions, 1e-4, rng, channels=there, channel_reference=reference))
    ]
    problem = problem_of(poses, signs=MINUS, effects=ALL_ON)
    linear = start(problem, poses, MINUS)
    problem = with_history(problem, poses, linear.sensor(problem))
    theta = np.concatenate([linear.theta, *(np.array(COEFFICIENTS[e.name]) for e in ALL_ON)])
    return problem, State(theta, ALL_ON), poses


def test_the_jacobian_is_that_of_central_differences_with_every_effect_on(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    assert set(SIZED) <= {e.name for e in CATALOGUE}
    problem, state, _ = everything_on(paper_unit, twenty_six)
    _, J, _ = linearise(problem, state)
    assert np.all(np.abs(J).max(axis=0) > 0)
    for column in range(J.shape[1]):
        h = np.zeros(J.shape[1])
        # Far below any curvature, far above rounding; an effect's column is as large as its condition.
        h[column] = 1e-5 / float(np.abs(J[:, column]).max())
        up, down = (linearise(problem, State(state.theta + s * h, ALL_ON))[0] for s in (1, -1))
        slope = (up - down) / (2 * h[column])
        assert J[:, column] == pytest.approx(slope, rel=1e-6, abs=1e-8 * np.abs(J[:, column]).max())


@pytest.mark.slow
def test_the_standard_error_of_a_residual_is_the_noise_along_its_gradient(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    problem, state, poses = everything_on(paper_unit, twenty_six)
    r, _, s = linearise(problem, state)
    rng = np.random.default_rng(1)
    tiny = 1e-3
    draws = []
    for _ in range(400):
        noise = np.array([rng.multivariate_normal(np.zeros(3), p.covariance) for p in poses]) * tiny
        draws.append((linearise(replace(problem, u=problem.u + noise), state, jacobian=False)[0] - r) / tiny)
    assert np.std(draws, axis=0) / s == pytest.approx(np.ones(len(s)), abs=4.5 / np.sqrt(2 * 400))


@pytest.mark.slow
def test_the_covariance_of_effects_too_is_the_spread_over_seeds(
    with_effects: Callable[..., Sensor], twenty_six: np.ndarray
) -> None:
    chosen = [e for e in CATALOGUE if e.name in ("second_order_nonlinearity", "temperature_scale_factor")]
    sensor = with_effects(**{e.name: COEFFICIENTS[e.name] for e in chosen})
    truth = np.concatenate(
        [sensor.scale_factor, sensor.misalignment, sensor.bias, *(COEFFICIENTS[e.name] for e in chosen)]
    )
    seeds, pulls = 60, []
    for seed in range(seeds):
        poses = noisy_poses(
            sensor,
            twenty_six,
            1e-5,
            np.random.default_rng(seed),
            channels=wandering(26),
            channel_reference={"temp_c": round(float(wandering(26)["temp_c"].mean()), 1)},
        )
        c = fit(poses, signs=MINUS, effects=chosen)
        pulls.append((c.values - truth) / (c.standard_errors / c.birge_ratio))
    each = 1e-3 / len(truth)
    low, high = stats.chi2.ppf([each / 2, 1 - each / 2], seeds - 1) / (seeds - 1)
    variance = np.var(pulls, axis=0, ddof=1)
    assert np.all((low < variance) & (variance < high)), variance
    assert np.all(np.abs(np.mean(pulls, axis=0)) < stats.norm.isf(each / 2) / np.sqrt(seeds))


def test_the_cross_validated_error_is_that_of_fits_without_each_pose(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-4, np.random.default_rng(3))
    whole = fit(poses, signs=MINUS)
    misses = []
    for i, pose in enumerate(poses):
        without = fit(poses[:i] + poses[i + 1 :], signs=MINUS)
        misses.append(np.linalg.norm(without.specific_force(pose.mean[None], {})[0]) - 1)
    assert whole.residual.cross_validated_rms_g == pytest.approx(np.sqrt(np.mean(np.square(misses))), rel=1e-4)


def test_leverage_is_how_much_a_pose_pulls_its_own_residual(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, fourteen, 1e-5, np.random.default_rng(0))
    whole = fit(poses, signs=MINUS)
    assert sum(p.leverage for p in whole.poses) == pytest.approx(9)
    for i in (0, 9):
        out = whole.poses[i].direction / np.linalg.norm(whole.poses[i].direction)
        moved = list(poses)
        moved[i] = replace(poses[i], mean=poses[i].mean + 1e-7 * out * paper_unit.scale_factor)
        change = fit(moved, signs=MINUS).poses[i].residual_g - whole.poses[i].residual_g
        # 1 − leverage of what was added stays in the residual; R turns the axes by 0.4 degrees at most.
        assert change / 1e-7 == pytest.approx(1 - whole.poses[i].leverage, abs=0.02)


@pytest.mark.slow
def test_poses_measured_worse_weigh_less(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    error = np.where(np.arange(26) % 2 == 0, 1e-5, 1e-3)[:, None] * np.ones(3)
    truth = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    weighted, equal = [], []
    for seed in range(40):
        poses = noisy_poses(paper_unit, twenty_six, error, np.random.default_rng(seed))
        c = fit(poses, signs=MINUS)
        weighted.append((c.values - truth) / c.standard_errors * c.birge_ratio)
        flat = fit([replace(p, covariance=np.eye(3) * 1e-9) for p in poses], signs=MINUS)
        equal.append((flat.values - truth) / c.standard_errors * c.birge_ratio)
    # 13 good poses leave only the weighted fit near its bound; the equal one is tens of times off.
    assert 0.7 < np.mean(np.square(weighted)) < 1.3
    assert np.mean(np.square(equal)) > 20


@pytest.mark.slow
def test_a_noisy_axis_weighs_less_and_the_errors_stay_true(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    truth = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    pulls, z_errors, flat_errors = [], [], []
    for seed in range(60):
        poses = noisy_poses(paper_unit, twenty_six, np.array([1e-5, 1e-5, 1e-3]), np.random.default_rng(seed))
        c = fit(poses, signs=MINUS)
        pulls.append((c.values - truth) / c.standard_errors * c.birge_ratio)
        flat = fit([replace(p, covariance=np.eye(3) * 1e-9) for p in poses], signs=MINUS)
        z_errors.append(c.values[0] - truth[0])
        flat_errors.append(flat.values[0] - truth[0])
    low, high = stats.chi2.ppf([5e-5, 1 - 5e-5], 59) / 59
    assert np.all((low < np.var(pulls, axis=0, ddof=1)) & (np.var(pulls, axis=0, ddof=1) < high))
    assert np.std(z_errors) < np.std(flat_errors) / 5


def test_a_bad_pose_has_the_largest_studentised_residual(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    named = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        poses = noisy_poses(paper_unit, twenty_six, 1.5e-5, rng)
        bad = int(rng.integers(26))
        along = twenty_six[bad] * paper_unit.scale_factor * 12 * 1.5e-5
        poses[bad] = replace(poses[bad], mean=poses[bad].mean + along)
        studentized = [abs(p.studentized) for p in fit(poses, signs=MINUS).poses]
        named += int(np.argmax(studentized)) == bad
    assert named >= 39


def test_residuals_far_beyond_the_noise_raise_the_standard_errors_however_small_p_is(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-3, np.random.default_rng(0))
    # Said to be known a thousand times better than they are: p underflows to nothing.
    c = fit([replace(p, covariance=p.covariance * 1e-6) for p in poses], signs=MINUS)
    assert c.residual.lack_of_fit_p == pytest.approx(0, abs=1e-300)
    assert c.excess_g == pytest.approx(1e-3, rel=0.6)
    assert ExcessVariance(c.excess_g) in c.cautions


def test_the_noise_floor_is_the_rms_of_standard_errors_along_the_vector(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    c = fit(noisy_poses(paper_unit, twenty_six, 3e-5, np.random.default_rng(0)), signs=MINUS)
    assert c.residual.noise_floor_g == pytest.approx(3e-5, rel=0.01)
    assert c.residual.rms_g == pytest.approx(np.sqrt(np.mean([p.residual_g**2 for p in c.poses])))
    assert c.residual.max_abs_g == max(abs(p.residual_g) for p in c.poses)


def test_a_reference_other_than_one_scales_the_answer(fourteen: np.ndarray) -> None:
    field = Sensor(np.array([0.02, 0.021, 0.019]), np.array([0.01, 0.02, -0.01]), np.array([3.0, -2.0, 1.0]))
    poses = noisy_poses(field, 49.3 * fourteen, 1e-6, np.random.default_rng(0))
    found = fit(poses, reference=49.3)
    assert found.values == pytest.approx(
        np.concatenate([field.scale_factor, field.misalignment, field.bias]), rel=1e-4, abs=1e-5
    )
    assert np.linalg.norm(found.specific_force(np.array([p.mean for p in poses]), {}), axis=1) == pytest.approx(
        np.full(14, 49.3), abs=1e-4
    )


def test_the_answer_does_not_depend_on_the_order_of_the_poses(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-4, np.random.default_rng(0))
    shuffled = [poses[i] for i in np.random.default_rng(1).permutation(26)]
    assert fit(shuffled, signs=MINUS).values == pytest.approx(fit(poses, signs=MINUS).values, abs=1e-12)


def test_the_solution_is_a_minimum_of_chi_square(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    problem, state, _ = everything_on(paper_unit, twenty_six)
    second = (CATALOGUE[0],)
    found = solve(problem, State(state.theta[:9], ()), second)
    r, J, s = linearise(problem, found)
    weighted = J / s[:, None]
    slope = weighted.T @ (r / s) / (np.linalg.norm(weighted, axis=0) * np.linalg.norm(r / s))
    assert slope == pytest.approx(np.zeros(12), abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"signs": (1, 0, 1)}, "signs"),
        ({"reference": 0.0}, "reference"),
        ({"reference": float("nan")}, "reference"),
        ({"effects": (effect_named("temperature_bias"),)}, "temp_c"),
    ],
)
def test_arguments_that_make_no_sense_are_named(
    paper_unit: Sensor, fourteen: np.ndarray, arguments: dict[str, object], why: str
) -> None:
    poses = noisy_poses(paper_unit, fourteen, 1e-5, np.random.default_rng(0))
    with pytest.raises(InvalidData, match=why):
        fit(poses, **arguments)  # type: ignore[arg-type]


def test_a_pose_whose_outputs_were_stuck_is_left_out_whatever_its_noise_says(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A frozen output has no noise: taken as it is, the pose would outweigh all others."""
    poses = noisy_poses(paper_unit, twenty_six, 1.5e-5, np.random.default_rng(0))
    frozen = replace(poses[7], mean=poses[7].mean * 1.001, covariance=poses[7].covariance * 1e-8, fault="stuck_output")
    with_it = fit([*poses[:7], frozen, *poses[8:]], signs=MINUS)
    without = fit([*poses[:7], *poses[8:]], signs=MINUS)
    assert np.array_equal(with_it.values, without.values)
    assert np.array_equal(with_it.covariance, without.covariance)
    assert [i for i, p in enumerate(with_it.poses) if not p.used] == [7]
    assert with_it.poses[7].pose is frozen
    assert with_it.cautions[0] == FaultyPosesExcluded(((frozen.began, "stuck_output"),))
    assert with_it.poses[7].excluded is Exclusion.FAULT


def test_a_faulty_pose_and_a_spoiled_one_are_both_left_out(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1.5e-5, np.random.default_rng(1))
    poses[3] = replace(poses[3], mean=poses[3].mean * 1.01, fault="saturation")
    poses[12] = replace(poses[12], mean=poses[12].mean + 1e-3 * twenty_six[12] * paper_unit.scale_factor)
    found = fit(poses, signs=MINUS)
    assert [i for i, p in enumerate(found.poses) if not p.used] == [3, 12]
    assert [i for i, p in enumerate(fit(poses, signs=MINUS, excluded=(3, 5)).poses) if not p.used] == [3, 5]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "amount", "name"),
    [(47, 0.5, "third_order_nonlinearity"), (283, 0.5, "second_order_nonlinearity"), (0, 0.8, "cross_coupling")],
)
def test_a_step_to_where_the_model_has_no_inverse_is_one_too_far(
    paper_unit: Sensor, twenty_six: np.ndarray, seed: int, amount: float, name: str
) -> None:
    """Two poses read half as much again, or more, which the effect bends itself to."""
    rng = np.random.default_rng(seed)
    bent = effect_named("second_order_nonlinearity"), rng.normal(size=3) * 1e-3
    poses = noisy_poses(replace(paper_unit, effects=(bent,)), twenty_six, 1.5e-5, rng)
    for i in rng.choice(26, 2, replace=False):
        poses[i] = replace(poses[i], mean=poses[i].mean * (1 + amount))
    with contextlib.suppress(Refused):
        fit(poses, signs=MINUS, effects=[effect_named(name)], excluded=())
