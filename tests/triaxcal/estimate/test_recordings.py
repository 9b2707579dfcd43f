"""Several recordings of one unit: one linear model, and what is each run's own comes out as that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.arrays import Floats
from triaxcal.diagnosis import diagnose
from triaxcal.effects import CATALOGUE, Effect, effect_named, effect_of
from triaxcal.effects.contract import DURATION, RUN, SINCE_START, TIME
from triaxcal.effects.runs import InRuns, RunBias
from triaxcal.effects.time import BiasDrift, BiasStep, WarmUp
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.estimate.likelihood import solve
from triaxcal.estimate.pose_fit import fit
from triaxcal.estimate.recordings import ByRun, by_run, gather, residuals_by_run
from triaxcal.model.directions import directions
from triaxcal.poses.covariates import channels_of, covariates_elsewhere
from triaxcal.poses.pose import Pose, PoseStart, Run

K, ANGLES, BIAS = np.array([2.4, -2.1, 2.2]), np.array([6e-3, 4e-3, -1e-3]), np.array([5e-3, -3e-3, 4e-3])
SIGMA_G, HOLD_S = 1e-5, 10.0
SIGNS = (1, -1, 1)
FEW: tuple[Effect, ...] = (effect_named("second_order_nonlinearity"), BiasDrift(), BiasStep())
Bias = Callable[[Floats], Floats]


def nothing(t_s: Floats) -> Floats:
    return np.zeros((len(t_s), 3))


def recording(
    rng: np.random.Generator, bias: Bias = nothing, *, square: Floats | float = 0.0, count: int = 26
) -> list[Pose]:
    """One run, in an order of its own: the bias moves as a function of time, and the output has a square term in g/g².

    Physics of its own: u = K (s + b + q s² + bias(t)) with s = R a.
    """
    up = np.array([v for _, v in directions(count)])[rng.permutation(count)]
    ax, ay, az = ANGLES
    s = np.stack([up[:, 0] + az * up[:, 1] + ay * up[:, 2], up[:, 1] + ax * up[:, 2], up[:, 2]], axis=1)
    t_s = (np.arange(len(s)) + 0.5) * HOLD_S
    u = K * (s + BIAS + square * s**2 + bias(t_s) + SIGMA_G * rng.standard_normal(s.shape))
    covariance = np.diag((K * SIGMA_G) ** 2)
    return [
        Pose(i * HOLD_S, (i + 1) * HOLD_S, 1000, u[i], covariance, 1e6, before=u[i - 1] if i else None)
        for i in range(len(s))
    ]


@pytest.fixture(scope="module")
def three() -> list[Pose]:
    rng = np.random.default_rng(1)
    return gather([recording(rng, count=14) for _ in range(3)])


# What belongs to a run


def test_one_recording_stays_as_it_is_and_is_searched_as_ever() -> None:
    poses = recording(np.random.default_rng(0))
    assert gather([poses]) == poses
    assert by_run(CATALOGUE, poses) == CATALOGUE
    assert RUN not in channels_of(poses)
    assert poses[3].began == PoseStart(30.0)


def test_time_counts_from_the_middle_of_each_run_and_the_start_from_its_own(three: list[Pose]) -> None:
    covariates = channels_of(three)
    assert np.array_equal(covariates[RUN], np.repeat([0.0, 1.0, 2.0], 14))
    assert np.array_equal(covariates[SINCE_START], np.tile((np.arange(14) + 0.5) * HOLD_S, 3))
    assert np.allclose(covariates[TIME], np.tile((np.arange(14) - 6.5) * HOLD_S, 3), atol=0.051)


def test_a_pose_says_which_recording_it_is_of(three: list[Pose]) -> None:
    assert three[20].run == Run(1, 3, 70.0)
    assert three[20].began == PoseStart(60.0, recording=1)
    assert three[14].before is None  # nobody knows how the unit lay before it was switched on


def test_a_fit_that_runs_away_on_poses_of_two_units_is_refused() -> None:
    """Before they are so large that nothing makes a difference to them, coefficients tell nothing of a unit."""
    third = effect_named("third_order_nonlinearity")
    for seed in range(6):
        rng = np.random.default_rng(seed)
        other = [replace(p, mean=1.15 * p.mean) for p in recording(rng, count=9)]
        poses = gather([recording(rng, count=9), other])
        problem = problem_of(poses, signs=SIGNS, reference=1.0)
        with pytest.raises(Refused, match="the fit ran away"):
            solve(problem, start(problem, poses, SIGNS), (third,))


def test_a_recording_without_a_pose_is_named() -> None:
    with pytest.raises(InvalidData, match="recording 2 of 2 has no still pose"):
        gather([recording(np.random.default_rng(0)), []])


# Effects run by run


def test_a_drift_in_one_run_is_zero_in_the_others(three: list[Pose]) -> None:
    covariates = channels_of(three)
    basis = InRuns(BiasDrift(), (1,)).basis(np.zeros((42, 3)), covariates)
    expected = np.where(covariates[RUN] == 1, covariates[TIME], 0.0)
    assert np.array_equal(basis, expected[:, None, None] * np.eye(3))


def test_a_warm_up_in_two_runs_has_coefficients_in_each(three: list[Pose]) -> None:
    effect = InRuns(WarmUp(50.0), (0, 2))
    assert [c.name for c in effect.coefficients] == [f"{axis}_run{k}" for k in (1, 3) for axis in "xyz"]
    basis = effect.basis(np.zeros((42, 3)), channels_of(three))
    decay = np.exp(-(np.arange(14) + 0.5) * HOLD_S / 50.0)
    assert np.allclose(basis[:, 0, 0], [*decay, *np.zeros(28)])
    assert np.allclose(basis[:, 2, 5], [*np.zeros(28), *decay])


def test_a_step_lasts_so_that_runs_before_it_are_before_it(three: list[Pose]) -> None:
    basis = InRuns(BiasStep(at_s=70.0), (1,)).basis(np.zeros((42, 3)), channels_of(three))
    assert np.array_equal(basis[:, 1, 1], [-1.0] * 21 + [0.0] * 21)


def test_the_runs_biases_have_the_units_for_their_mean(three: list[Pose]) -> None:
    basis = RunBias(3).basis(np.zeros((42, 3)), channels_of(three))
    assert np.array_equal(basis[::14, 0, 0], [-1, 1, 0])
    assert np.array_equal(basis[::14, 0, 3], [-1, 0, 1])
    assert np.array_equal(RunBias(3, alone=0).basis(np.zeros((42, 3)), channels_of(three))[::14, 2, 2], [1, 0, 0])


def tried(poses: Sequence[Pose]) -> list[Effect]:
    covariates = channels_of(poses)
    return [v for e in by_run(CATALOGUE, poses) for v in e.variants(covariates)]


def test_every_form_that_is_tried_is_read_back_from_its_coefficients(three: list[Pose]) -> None:
    covariates, rng = channels_of(three), np.random.default_rng(3)
    checked = set()
    for effect in tried(three):
        if RUN not in effect.needs:
            continue
        q = rng.standard_normal(len(effect.coefficients))
        values = dict(zip([c.name for c in effect.coefficients], q, strict=True))
        again, q2 = effect_of(effect.name, values | {n: v for n, (v, _) in effect.shape.items()})
        s = rng.standard_normal((42, 3))
        assert np.allclose(again.basis(s, covariates) @ q2, effect.basis(s, covariates) @ q, atol=1e-12)
        checked.add(effect.name)
    assert checked == {"bias_drift", "warm_up", "bias_step", "run_bias", "run_scale_factor", "scale_factor_drift"}


def test_effects_of_the_clocks_are_tried_alike_in_each_alone_and_by_run(three: list[Pose]) -> None:
    drift = [v for v in ByRun(BiasDrift(), 3).variants(channels_of(three)) if "³" not in str(v.coefficients)]
    names = {tuple(c.name for c in v.coefficients if c.name.startswith("x")) for v in drift}
    alone = {(f"x_run{k}",) for k in (1, 2, 3)}
    assert {("x",), *alone, ("x_run1", "x_run2", "x_run3"), ("x_run1", "x_run3")} <= names
    assert max(len(v.coefficients) for v in drift if v.needs != (TIME,)) == 9  # of 14 poses a run has three at most


def test_elsewhere_everything_that_was_a_runs_own_is_zero(three: list[Pose]) -> None:
    reference = {TIME: 0.0, SINCE_START: 0.0, DURATION: 0.0, RUN: 0.0}
    for poses in (recording(np.random.default_rng(9)), three):
        away = covariates_elsewhere(poses, reference, K, BIAS)
        for effect in tried(three):
            if RUN in effect.needs:
                assert not effect.basis(np.ones((len(poses), 3)), away).any(), effect


# The truth comes back


@pytest.mark.slow
def test_coefficients_and_standard_errors_of_three_runs_are_right_over_many_seeds() -> None:
    """A square term of the unit, a drift in the second run, another bias in each: χ² of all 24 coefficients."""
    square, slope = np.array([2e-4, -1e-4, 3e-4]), np.array([1e-6, -2e-6, 1e-6])
    shifts = np.array([[-3e-4, 1e-4, 2e-4], [1e-4, 2e-4, -3e-4], [2e-4, -3e-4, 1e-4]])
    effects = [effect_named("second_order_nonlinearity"), InRuns(BiasDrift(), (1,)), RunBias(3)]
    truth = np.concatenate([K, ANGLES, BIAS, square, slope, shifts[1], shifts[2]])
    chi2, seeds, middle = 0.0, 40, 13 * HOLD_S
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        runs = [
            recording(rng, lambda t: shifts[0] + 0 * t[:, None], square=square),
            recording(rng, lambda t: shifts[1] + slope * (t - middle)[:, None], square=square),
            recording(rng, lambda t: shifts[2] + 0 * t[:, None], square=square),
        ]
        found = fit(gather(runs), signs=SIGNS, effects=effects, excluded=())
        off = found.values - truth
        chi2 += float(off @ np.linalg.solve(found.covariance / found.birge_ratio**2, off))
    low, high = stats.chi2.ppf([0.0005, 0.9995], len(truth) * seeds)
    assert low < chi2 < high


@pytest.mark.slow
def test_the_loop_finds_a_square_term_of_the_unit_a_drift_of_one_run_and_the_runs_biases() -> None:
    rng = np.random.default_rng(0)
    square, slope = np.array([2e-4, -2e-4, 3e-4]), np.array([1.5e-6, -2e-6, 1e-6])
    shift = np.array([2e-4, -2e-4, 3e-4])
    runs = [
        recording(rng, square=square),
        recording(rng, lambda t: shift + slope * (t - 130.0)[:, None], square=square),
    ]
    loop = diagnose(gather(runs), signs=SIGNS, catalogue=FEW)
    found = {f.effect: f for f in loop.findings}
    assert any("second_order_nonlinearity" in (f.effect, *f.alternatives) for f in loop.findings)
    assert "run_bias" in found
    drift = next(f for f in loop.findings if "bias_drift" in (f.effect, *f.alternatives))
    assert {name.rpartition("_")[2] for name in drift.coefficients if "_run" in name} == {"run2"}
    assert not loop.found.unexplained.significant
    assert loop.after.residual.cross_validated_rms_g is not None
    assert loop.after.residual.cross_validated_rms_g < 1.5 * SIGMA_G


@pytest.mark.slow
def test_runs_that_come_back_with_another_bias_show_that_and_nothing_else() -> None:
    rng = np.random.default_rng(5)
    shifts = [1e-4 * rng.standard_normal(3) for _ in range(3)]
    runs = [recording(rng, lambda t, b=b: b + 0 * t[:, None], count=14) for b in shifts]  # type: ignore[misc]
    loop = diagnose(gather(runs), signs=SIGNS, catalogue=FEW)
    assert [f.effect for f in loop.findings] == ["run_bias"]
    mean = np.mean(shifts, axis=0)
    first = loop.after.sensor.bias - BIAS
    error = loop.after.standard_errors[6:9]
    if all("alone" not in name for name in loop.findings[0].coefficients):
        assert np.all(np.abs(first - mean) < 5 * error)


@pytest.mark.slow
def test_a_drift_that_is_alike_in_all_runs_has_one_slope() -> None:
    rng = np.random.default_rng(7)
    slope = np.array([2e-6, -1e-6, 2e-6])
    runs = [recording(rng, lambda t: slope * (t - 70.0)[:, None], count=14) for _ in range(3)]
    loop = diagnose(gather(runs), signs=SIGNS, catalogue=FEW)
    assert [f.effect for f in loop.findings] == ["bias_drift"]
    for axis, value in zip("xyz", slope, strict=True):
        got, error, _ = loop.findings[0].coefficients[axis]
        assert error is not None
        assert abs(got - value) < 4 * error


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_found_where_runs_differ_in_nothing(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    loop = diagnose(gather([recording(rng, count=14) for _ in range(2)]), signs=SIGNS, catalogue=FEW)
    assert loop.findings == ()


@pytest.mark.slow
def test_a_scale_factor_that_differs_from_run_to_run_is_named() -> None:
    rng = np.random.default_rng(8)
    first, second = recording(rng, count=14), recording(rng, count=14)
    other = [replace(p, mean=p.mean + (p.mean - K * BIAS) * [2e-4, -2e-4, 1e-4]) for p in second]
    loop = diagnose(gather([first, other]), signs=SIGNS, catalogue=FEW)
    assert [f.effect for f in loop.findings] == ["run_scale_factor"]
    # Half of it on either side of the mean.
    for axis, value in zip("xyz", [1e-4, -1e-4, 0.5e-4], strict=True):
        got, error, _ = loop.findings[0].coefficients.get(f"{axis}_run2", (0.0, 1e-5, ""))
        assert error is not None
        assert abs(got - value) < 5 * error


@pytest.mark.slow
def test_the_residual_by_run_is_the_rms_over_its_poses() -> None:
    rng = np.random.default_rng(4)
    runs = [recording(rng, count=14), recording(rng, lambda t: np.outer(t, [2e-6, 0, 0]), count=18)]
    loop = diagnose(gather(runs), signs=SIGNS, catalogue=(BiasDrift(),))
    first, second = residuals_by_run(loop.before, loop.after)
    assert (first.poses, second.poses) == (14, 18)
    off = [p.residual_g for p in loop.after.poses]
    assert first.after_rms_g == pytest.approx(float(np.sqrt(np.mean(np.square(off[:14])))))
    assert second.after_rms_g == pytest.approx(float(np.sqrt(np.mean(np.square(off[14:])))))
    whole = (14 * first.before_rms_g**2 + 18 * second.before_rms_g**2) / 32
    assert whole == pytest.approx(loop.before.residual.rms_g**2)
    assert second.after_rms_g < second.before_rms_g / 2
