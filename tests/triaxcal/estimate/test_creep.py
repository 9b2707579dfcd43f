"""Poses that creep because an effect moves inside them: no error of theirs once the effect is in the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import Verdict, diagnose
from triaxcal.effects import effect_named
from triaxcal.effects.time import BiasDrift
from triaxcal.estimate.creep import with_unexplained_creep, without_creep
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
HOLD_S = 10.0
SENSITIVITY = np.array([1.5e-4, -1e-4, 2e-4])  # g/K


def creeping(
    unit: Sensor, ups: np.ndarray, seed: int, change_g: np.ndarray, rates: np.ndarray | None = None
) -> list[Pose]:
    """Poses whose outputs change by ``change_g`` (n,3) from their beginning to their end, as a detector states them:
    the variance of a steady change, a twelfth of its square, on top of the noise's."""
    rng = np.random.default_rng(seed)
    n = len(ups)
    temp_c = 25 + 3 * np.sin(0.9 * np.arange(n)) + rng.standard_normal(n)
    sensor = replace(unit, effects=((effect_named("temperature_bias"), SENSITIVITY),))
    poses = noisy_poses(
        sensor, ups, SIGMA_G, rng, channels={"temp_c": temp_c}, channel_reference={"temp_c": 25.0}, hold_s=HOLD_S
    )
    out = []
    for i, p in enumerate(poses):
        creep = unit.scale_factor * change_g[i]
        slope = {} if rates is None else {"temp_c": float(rates[i])}
        out.append(replace(p, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12, rates=slope))
    return out


def with_slopes(poses: list[Pose], seed: int) -> list[Pose]:
    """The poses with what a detector says of the straight line through each: the creep, and noise."""
    rng = np.random.default_rng([seed, 1])
    error = float(np.median([np.sqrt(12 * np.trace(p.covariance) / 3) for p in without_creep(poses)]))
    still = dict.fromkeys(("temp_c",), 0.0)
    return [
        replace(
            p,
            slope=p.creep + error * rng.standard_normal(3),
            slope_error=error,
            rate_errors=still,
            bends=still,
            bend_errors=still,
        )
        for p in poses
    ]


@pytest.fixture(scope="module")
def rates() -> np.ndarray:
    """Temperature moves by up to 2 K inside a pose: by 13 to 27 times the noise of its mean."""
    return np.random.default_rng(9).uniform(-0.2, 0.2, 26)


@pytest.fixture(scope="module")
def warm(paper_unit: Sensor, twenty_six: np.ndarray, rates: np.ndarray) -> list[Pose]:
    return creeping(paper_unit, twenty_six, 0, rates[:, None] * HOLD_S * SENSITIVITY, rates)


def test_without_creep_the_noise_inside_the_poses_is_left(warm: list[Pose], paper_unit: Sensor) -> None:
    for p in without_creep(warm):
        assert p.covariance == pytest.approx(np.diag((SIGMA_G * paper_unit.scale_factor) ** 2), abs=1e-16)
        assert not p.creep.any()


def test_poses_that_do_not_creep_stay_the_same(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, SIGMA_G, np.random.default_rng(0))
    assert all(a is b for a, b in zip(without_creep(poses), poses, strict=True))
    model = fit(poses, signs=MINUS, effects=[BiasDrift()])
    assert all(a is b for a, b in zip(with_unexplained_creep(poses, model), poses, strict=True))


def test_a_model_without_the_effect_leaves_all_of_the_creep(warm: list[Pose]) -> None:
    left = with_unexplained_creep(warm, fit(without_creep(warm), signs=MINUS))
    assert all(np.array_equal(a.covariance, b.covariance) for a, b in zip(left, warm, strict=True))


def test_creep_that_the_effect_explains_is_taken_off_the_covariance(warm: list[Pose], paper_unit: Sensor) -> None:
    effects = [effect_named("temperature_bias")]
    model = fit(without_creep(warm), signs=MINUS, effects=effects)
    left = with_unexplained_creep(warm, model)
    clean = np.diag((SIGMA_G * paper_unit.scale_factor) ** 2)
    for before, after in zip(warm, left, strict=True):
        # The sensitivities are known to some per cent, of which what is left of the creep is as much.
        assert np.linalg.norm(after.creep) < 0.1 * np.linalg.norm(before.creep)
        assert np.trace(after.covariance - clean) < 0.02 * np.trace(before.covariance - clean)
        assert np.linalg.eigvalsh(after.covariance).min() > 0.99 * np.diag(clean).min()


def test_creep_that_goes_against_the_effect_stays(
    paper_unit: Sensor, twenty_six: np.ndarray, rates: np.ndarray
) -> None:
    """A stand that settles while the temperature moves: the effect explains none of it."""
    against = creeping(paper_unit, twenty_six, 0, -rates[:, None] * HOLD_S * SENSITIVITY, rates)
    model = fit(without_creep(against), signs=MINUS, effects=[effect_named("temperature_bias")])
    left = with_unexplained_creep(against, model)
    assert all(np.array_equal(a.covariance, b.covariance) for a, b in zip(left, against, strict=True))


def test_drift_explains_the_creep_of_its_own_slope(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    slope = np.array([2e-5, -1e-5, 3e-5])
    sensor = replace(paper_unit, effects=((BiasDrift(), slope),))
    rng = np.random.default_rng(0)
    creep = paper_unit.scale_factor * slope * HOLD_S
    poses = [
        replace(p, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12)
        for p in noisy_poses(sensor, twenty_six[rng.permutation(26)], SIGMA_G, rng, hold_s=HOLD_S)
    ]
    model = fit(without_creep(poses), signs=MINUS, effects=[BiasDrift()])
    for p in with_unexplained_creep(poses, model):
        assert np.linalg.norm(p.creep) < 0.1 * np.linalg.norm(creep)


@pytest.mark.slow
def test_a_bias_that_follows_a_channel_inside_the_poses_is_named_with_errors_that_are_not_inflated(
    paper_unit: Sensor, twenty_six: np.ndarray, rates: np.ndarray
) -> None:
    pulls, ratio = [], []
    catalogue = [effect_named(n) for n in ("temperature_bias", "bias_drift", "thermal_gradient", "warm_up")]
    for seed in range(3):
        poses = with_slopes(creeping(paper_unit, twenty_six, seed, rates[:, None] * HOLD_S * SENSITIVITY, rates), seed)
        loop = diagnose(poses, signs=MINUS, catalogue=catalogue)
        (finding,) = loop.findings
        assert (finding.effect, finding.verdict) == ("temperature_bias", Verdict.ADOPTED)
        assert not loop.found.unexplained.significant
        # Told that the poses do not creep, the fit states these errors.
        told = fit(without_creep(poses), signs=MINUS, effects=[effect_named("temperature_bias")])
        ratio.append(np.max(loop.after.standard_errors / told.standard_errors))
        for (value, error, _), truth in zip(
            loop.after.coefficients_of("temperature_bias").values(), SENSITIVITY, strict=True
        ):
            assert error is not None
            pulls.append((value - truth) / error)
    assert np.max(ratio) < 1.1
    assert np.sum(np.square(pulls)) < 27.9  # chi-square of nine, 0.1 %


@pytest.mark.slow
@pytest.mark.parametrize("slopes", [False, True])
@pytest.mark.parametrize("along", [False, True])
def test_creep_that_nothing_explains_makes_no_effect_and_widens_the_errors_where_the_magnitude_creeps(
    along: bool, slopes: bool, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A stand that settles turns the unit, across the measured vector; what creeps along it is the sensor's."""
    rng = np.random.default_rng(3)
    poses = noisy_poses(paper_unit, twenty_six, SIGMA_G, rng)
    settled = []
    for p, up in zip(poses, twenty_six, strict=True):
        move = rng.normal(0, 6e-5, 3)
        creep = paper_unit.scale_factor * (move if along else move - up * (up @ move))
        where = rng.uniform(-0.5, 0.5)
        settled.append(
            replace(p, mean=p.mean + where * creep, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12)
        )
    loop = diagnose(with_slopes(settled, 0) if slopes else settled, signs=MINUS)
    assert loop.findings == ()
    assert all(c.probability is None for c in loop.candidates)
    # As an error of each pose creep is accounted for; poses that know their slopes show that something moves.
    assert (loop.found.nothing < 0.5) is (along and slopes)
    wider = loop.after.standard_errors[:9] / fit(poses, signs=MINUS).standard_errors
    if along:
        assert (np.mean(wider) if slopes else np.min(wider)) > 1.1
    else:
        assert np.max(wider) < 1.05


@pytest.mark.slow
def test_what_is_left_is_no_less_than_the_residuals_that_are_told(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """A slow swing of the bias that nothing explains, in poses that creep by it and are weighed by that."""
    rng = np.random.default_rng(0)
    t = 10.0 * np.arange(26)
    swing = 4e-4 * np.sin(2 * np.pi * t / 70)[:, None] * np.ones(3)
    settled = []
    for k, p in enumerate(noisy_poses(paper_unit, twenty_six, SIGMA_G, rng)):
        creep = paper_unit.scale_factor * 4e-4 * np.cos(2 * np.pi * t[k] / 70) * 2 * np.pi / 70 * HOLD_S
        mean = p.mean + paper_unit.scale_factor * swing[k]
        settled.append(replace(p, mean=mean, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12))
    loop = diagnose(settled, signs=MINUS)
    told, left = loop.after.residual, loop.found.unexplained
    assert left.significant
    assert left.rms_g >= np.sqrt(told.rms_g**2 - told.noise_floor_g**2) > SIGMA_G
    assert left.rms_g < 2 * np.sqrt(np.mean(np.sum(swing * twenty_six, axis=1) ** 2))


def test_in_another_recording_the_channel_explains_creep_and_the_clock_does_not(
    warm: list[Pose], paper_unit: Sensor, twenty_six: np.ndarray, rates: np.ndarray
) -> None:
    warmth = effect_named("temperature_bias")
    model = fit(without_creep(warm), signs=MINUS, effects=[warmth, BiasDrift()])
    other = creeping(paper_unit, twenty_six, 7, rates[:, None] * HOLD_S * SENSITIVITY, rates)
    for before, after in zip(other, with_unexplained_creep(other, model, elsewhere=True), strict=True):
        assert np.linalg.norm(after.creep) < 0.1 * np.linalg.norm(before.creep)
    drift = ((BiasDrift(), np.full(3, 1e-3)),)
    steep = replace(model, holds_at=None, sensor=replace(model.sensor, effects=drift))
    assert with_unexplained_creep(other, steep, elsewhere=True) == other


@pytest.mark.slow
def test_the_noise_floor_of_held_out_poses_has_only_the_creep_that_the_model_does_not_explain(
    warm: list[Pose], paper_unit: Sensor, twenty_six: np.ndarray, rates: np.ndarray
) -> None:
    check = creeping(paper_unit, twenty_six, 3, rates[:, None] * HOLD_S * SENSITIVITY, rates)
    loop = diagnose(warm, signs=MINUS, check=check)
    assert loop.held_out is not None
    assert loop.held_out.noise_floor_g == pytest.approx(SIGMA_G, rel=0.1)
    assert loop.held_out.after_rms_g < 2 * SIGMA_G


def test_a_step_between_two_poses_explains_no_creep_inside_them(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    step = effect_named("bias_step").shaped({"at": 10 * HOLD_S})
    sensor = replace(paper_unit, effects=((step, np.array([2e-3, -1e-3, 3e-3])),))
    poses = noisy_poses(sensor, twenty_six, SIGMA_G, np.random.default_rng(0), hold_s=HOLD_S)
    turned = [replace(p, start_s=p.start_s + 1.0, end_s=p.end_s - 1.0) for p in poses]
    creep = 0.5 * paper_unit.scale_factor * np.array([2e-3, -1e-3, 3e-3])
    creeps = [replace(p, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12) for p in turned]
    model = fit(turned, signs=MINUS, effects=[step])
    for p in with_unexplained_creep(creeps, model):
        assert p.creep == pytest.approx(creep, abs=0.05 * np.linalg.norm(creep))


def test_of_a_pose_that_only_turns_an_effect_makes_no_creep_along_the_measured_vector(
    warm: list[Pose], paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """Its |a| stayed within its noise, whatever the effect says it should have done."""
    out = twenty_six / paper_unit.scale_factor
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    quiet = without_creep(warm)
    turning = []
    for p, g in zip(warm, out, strict=True):
        across = p.creep - (p.creep @ g) * g
        turning.append(
            replace(
                p, creep=across, covariance=p.covariance + (np.outer(across, across) - np.outer(p.creep, p.creep)) / 12
            )
        )
    model = fit(quiet, signs=MINUS, effects=[effect_named("temperature_bias")], excluded=())
    left = with_unexplained_creep(turning, model)
    for before, after, still, g in zip(turning, left, quiet, out, strict=True):
        assert g @ after.covariance @ g < 1.1 * g @ still.covariance @ g
        assert np.trace(after.covariance) <= np.trace(before.covariance)
    assert sum(np.trace(p.covariance) for p in left) < 0.5 * sum(np.trace(p.covariance) for p in turning)
