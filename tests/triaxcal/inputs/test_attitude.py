"""Poses of known attitude, judged by truth, by the full likelihood with every attitude a nuisance, and by |a| alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.attitude import (
    AttitudeExcluded,
    AttitudeFit,
    AttitudesContradict,
    AttitudesTied,
    DeclaredErrorContradicted,
    MagnitudeContradicts,
    fit_attitudes,
)
from triaxcal.model.directions import cube_directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

SIGNS = (-1, 1, 1)
NOISE = 1e-5
UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))
TRUTH = np.concatenate([UNIT.scale_factor, UNIT.misalignment, UNIT.bias])
FOUR = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -1.0, -1.0]])
FOUR[3] /= np.sqrt(3)


def plan(count: int) -> np.ndarray:
    return np.array([v for _, v in cube_directions()[:count]])


def turntable(
    ups: np.ndarray, seed: int, *, error_rad: float = 0.0, noise: float = NOISE, turn_rad: float = 2.0
) -> tuple[list[Pose], np.ndarray]:
    """Poses at ``ups``, which the table misses by ``error_rad`` in either angle; and the rotation C."""
    rng = np.random.default_rng(seed)
    C = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * turn_rad).as_matrix()
    true = ups + np.cross(rng.standard_normal(ups.shape) * error_rad, ups)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    return noisy_poses(UNIT, true @ C.T, noise, rng), C


def turns(found: AttitudeFit, C: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(found.rotation @ C.T).as_rotvec()


def errors_of(found: AttitudeFit, C: np.ndarray) -> np.ndarray:
    return np.concatenate([found.calibration.values - TRUTH, turns(found, C)])


def stated(found: AttitudeFit) -> np.ndarray:
    return np.concatenate([found.calibration.standard_errors, found.rotation_error_rad])


class Likelihood:
    """Everything unknown at once: twelve parameters and two angles a pose. Written without the fit's own algebra."""

    def __init__(self, poses: Sequence[Pose], ups: np.ndarray, C: np.ndarray, error_rad: float) -> None:
        self.u = np.array([p.mean for p in poses])
        self.sigma = np.array([p.standard_error for p in poses])
        self.ups, self.C, self.error_rad = ups, C, error_rad
        self.sides = np.array([np.linalg.svd(v[None])[2][1:] for v in ups])
        self.truth = np.concatenate([TRUTH, np.zeros(3 + 2 * len(ups))])

    def residuals(self, p: np.ndarray) -> np.ndarray:
        tilt = p[12:].reshape(-1, 2)
        g = self.ups + np.einsum("nk,nki->ni", tilt, self.sides)
        g /= np.linalg.norm(g, axis=1, keepdims=True)
        C = Rotation.from_rotvec(p[9:12]).as_matrix() @ self.C
        u = Sensor(p[:3], p[3:6], p[6:9]).output(g @ C.T, {})
        return np.concatenate([((self.u - u) / self.sigma).ravel(), (tilt / self.error_rad).ravel()])

    def bound(self) -> np.ndarray:
        p = self.truth
        J = np.stack([(self.residuals(p + h) - self.residuals(p - h)) / 2e-6 for h in 1e-6 * np.eye(len(p))], axis=1)
        return np.asarray(np.linalg.inv(J.T @ J)[:12, :12])

    def best(self) -> np.ndarray:
        return np.asarray(optimize.least_squares(self.residuals, self.truth, x_scale="jac", xtol=1e-15).x[:12])


@pytest.mark.parametrize("error_rad", [1e-9, 1e-5, 1e-3])
def test_the_stated_errors_are_the_cramer_rao_bound(error_rad: float) -> None:
    poses, C = turntable(plan(14), 0, error_rad=error_rad)
    found = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=error_rad)
    bound = np.sqrt(np.diag(Likelihood(poses, plan(14), C, error_rad).bound()))
    assert stated(found) == pytest.approx(bound * found.calibration.birge_ratio, rel=0.01)


@pytest.mark.parametrize("error_rad", [1e-5, 1e-2])
def test_the_estimate_is_that_of_the_full_likelihood(error_rad: float) -> None:
    poses, C = turntable(plan(14), 3, error_rad=error_rad)
    found = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=error_rad)
    best = Likelihood(poses, plan(14), C, error_rad).best()
    away = np.concatenate([found.calibration.values - best[:9], turns(found, C) - best[9:]])
    assert np.max(np.abs(away) / stated(found)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ups", "error_rad", "declared"),
    [
        (FOUR, 0.0, 0.0),
        (plan(14), 0.0, None),
        (plan(14), 1e-5, 1e-5),
        (plan(14), 1e-2, 1e-2),
        (np.concatenate([np.eye(3), -np.eye(3)]), 1e-2, 1e-2),
        (plan(26), 1e-3, None),
    ],
    ids=["four exact", "exact", "an error like the noise", "a large error", "six faces", "an error unknown"],
)
def test_truth_comes_back_within_the_stated_errors(ups: np.ndarray, error_rad: float, declared: float | None) -> None:
    pulls = []
    seeds = 25
    for seed in range(seeds):
        poses, C = turntable(ups, seed, error_rad=error_rad)
        found = fit_attitudes(poses, ups, signs=SIGNS, attitude_error_rad=declared)
        pulls.append(errors_of(found, C) / stated(found))
        assert all(p.used for p in found.calibration.poses)
    # Pulls of a seed go together, at worst two by two: six degrees of freedom a seed.
    low, high = stats.chi2.interval(0.999, 6 * seeds) / np.array(6 * seeds)
    assert low < np.mean(np.square(pulls)) < high


def test_exact_attitudes_give_smaller_errors_than_magnitudes_and_poor_ones_the_same() -> None:
    poses, _ = turntable(plan(14), 1)
    by_magnitude = fit(poses, signs=SIGNS).standard_errors
    exact = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=0.0).calibration.standard_errors
    poor = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=1e-2).calibration.standard_errors
    assert np.all(exact < 0.8 * by_magnitude)
    assert poor == pytest.approx(by_magnitude, rel=0.02)


def test_what_the_errors_of_the_attitudes_cost_is_told() -> None:
    poses, _ = turntable(plan(14), 1)
    exact = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=0.0).calibration.standard_errors
    poor = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=1e-3)
    assert poor.noise_error == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
def test_the_error_of_the_attitudes_is_estimated_and_told() -> None:
    estimates = []
    for seed in range(12):
        poses, _ = turntable(plan(26), seed, error_rad=1e-3)
        found = fit_attitudes(poses, plan(26), signs=SIGNS)
        assert found.estimated
        assert AttitudesContradict(found.attitude_error_rad) in found.calibration.cautions
        estimates.append(found.attitude_error_rad)
    # About 46 of the 52 angles are free: one estimate scatters by 10 %, their mean by 3 %.
    assert np.mean(estimates) == pytest.approx(1e-3, rel=0.12)


def test_an_error_declared_too_small_is_noticed_and_raises_the_errors() -> None:
    poses, _ = turntable(plan(14), 2, error_rad=1e-3)
    c = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=1e-5).calibration
    assert c.birge_ratio > 10
    assert any(isinstance(caution, MagnitudeContradicts) for caution in c.cautions)
    assert c.residual.lack_of_fit_p is not None
    assert c.residual.lack_of_fit_p < 1e-6


@pytest.mark.slow
def test_an_error_declared_fifty_times_too_small_is_told_with_the_estimate_and_what_the_fit_would_be() -> None:
    declared, estimated, true, away = [], [], [], []
    for seed in range(20):
        poses, C = turntable(plan(14), seed, error_rad=1e-3)
        found = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=2e-5)
        instead = found.if_estimated
        assert instead is not None
        assert instead.attitude_error_uncertainty_rad is not None
        told = [c for c in found.calibration.cautions if isinstance(c, DeclaredErrorContradicted)]
        assert [c.error_rad for c in told] == [instead.attitude_error_rad]
        assert told[0].raised > 10
        assert found.attitude_error_rad == 2e-5
        away.append((instead.attitude_error_rad - 1e-3) / instead.attitude_error_uncertainty_rad)
        right = fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=1e-3)
        for errors, fitted in ((declared, found), (estimated, instead), (true, right)):
            errors.append(errors_of(fitted, C)[:9])
    low, high = stats.chi2.interval(0.999, 20) / np.array(20)
    assert low < np.mean(np.square(away)) < high
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (declared, estimated, true)]
    assert rms[0] > 10 * rms[2]
    assert rms[1] == pytest.approx(rms[2], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("poses_of_plan", [14, 26])
def test_the_estimated_error_has_a_true_standard_error(poses_of_plan: int) -> None:
    ups, seeds, away = plan(poses_of_plan), 40, []
    for seed in range(seeds):
        poses, _ = turntable(ups, seed, error_rad=1e-3)
        found = fit_attitudes(poses, ups, signs=SIGNS)
        assert found.attitude_error_uncertainty_rad is not None
        # Of the logarithm: a small estimate has a small error, which makes the others' pulls lopsided.
        relative = found.attitude_error_uncertainty_rad / found.attitude_error_rad
        away.append(np.log(found.attitude_error_rad / 1e-3) / relative)
    low, high = stats.chi2.interval(0.999, seeds) / np.array(seeds)
    assert low < np.mean(np.square(away)) < high


@pytest.mark.slow
def test_an_error_declared_rightly_is_hardly_ever_contradicted() -> None:
    contradicted = 0
    for seed in range(60):
        poses, _ = turntable(plan(14), seed, error_rad=1e-3)
        contradicted += fit_attitudes(poses, plan(14), signs=SIGNS, attitude_error_rad=1e-3).if_estimated is not None
    assert contradicted <= stats.binom.isf(0.001, 60, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("step", [2e-5, 1e-3])
def test_an_error_that_does_not_explain_the_magnitudes_is_not_offered(step: float) -> None:
    """A bias that steps halfway moves |a|, which no attitude does: an estimate would stand for both."""
    ups, offered = plan(26), []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        true = ups + np.cross(rng.standard_normal(ups.shape) * 1e-3, ups)
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        stepped = Sensor(UNIT.scale_factor, UNIT.misalignment, UNIT.bias + np.array([step, -step, step]))
        poses = [*noisy_poses(UNIT, true[:13], NOISE, rng), *noisy_poses(stepped, true[13:], NOISE, rng)]
        instead = fit_attitudes(poses, ups, signs=SIGNS, attitude_error_rad=2e-5).if_estimated
        if instead is not None:
            assert instead.attitude_error_uncertainty_rad is not None
            offered.append((instead.attitude_error_rad - 1e-3) / instead.attitude_error_uncertainty_rad)
    assert len(offered) < 15 * (0.5 if step == 2e-5 else 0.1)
    assert all(abs(away) < 3.5 for away in offered)


SEVEN = np.random.default_rng(4).standard_normal((7, 3))
SEVEN /= np.linalg.norm(SEVEN, axis=1, keepdims=True)


@pytest.mark.parametrize("off", [[2.0, 0.0, 1.0], [0.02, 0.0, 0.01]], ids=["another side", "by a degree"])
@pytest.mark.parametrize("ups", [SEVEN, plan(14)], ids=["seven", "fourteen"])
def test_a_wrong_row_is_named_left_out_and_costs_little(ups: np.ndarray, off: list[float]) -> None:
    named = 0
    for seed in range(14):
        at = seed % len(ups)
        poses, C = turntable(ups, seed)
        rows = ups.copy()
        rows[at] = ups[at] + np.cross(ups[at], off)
        found = fit_attitudes(poses, rows, signs=SIGNS, names=[f"line {i}" for i in range(len(ups))])
        out = [i for i, p in enumerate(found.calibration.poses) if not p.used]
        excluded = [c.row.name for c in found.calibration.cautions if isinstance(c, AttitudeExcluded)]
        if out == [at] and excluded == [f"line {at}"]:
            named += 1
            assert np.max(np.abs(errors_of(found, C)) / stated(found)) < 6
    assert named == 14


def test_a_wrong_row_that_cannot_be_told_from_another_is_not_left_out() -> None:
    ups = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1], [-1, -1, -1]], dtype=float)
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    poses, _ = turntable(ups, 0)
    rows = ups.copy()
    rows[1] += [0.0, 0.0, 0.02]
    c = fit_attitudes(poses, rows, signs=SIGNS).calibration
    assert all(p.used for p in c.poses)
    assert isinstance(c.cautions[0], AttitudesTied)
    assert "row 2" in {row.name for row in c.cautions[0].rows}


@pytest.mark.slow
def test_right_rows_are_hardly_ever_called_wrong() -> None:
    lost = 0
    for seed in range(60):
        poses, _ = turntable(plan(14), seed)
        found = fit_attitudes(poses, plan(14), signs=SIGNS)
        lost += any(not p.used for p in found.calibration.poses)
    assert lost <= stats.binom.isf(0.001, 60, 0.01)


def test_rows_in_another_order_are_refused() -> None:
    poses, _ = turntable(plan(14), 1)
    with pytest.raises(Refused, match=r"of 14 attitudes contradict.*order of the poses"):
        fit_attitudes(poses, np.roll(plan(14), 1, axis=0), signs=SIGNS)


def test_without_signs_the_sensors_frame_is_the_one_nearest_to_the_tables() -> None:
    for seed in range(10):
        poses, C = turntable(plan(14), seed, turn_rad=0.3)
        found = fit_attitudes(poses, plan(14))
        assert tuple(np.sign(found.calibration.sensor.scale_factor)) == SIGNS
        assert np.max(np.abs(turns(found, C))) < 1e-3


def test_signs_against_the_handedness_are_an_error() -> None:
    poses, _ = turntable(plan(14), 1)
    with pytest.raises(InvalidData, match="product of the signs"):
        fit_attitudes(poses, plan(14), signs=(1, 1, 1))


def test_the_reference_sets_the_unit() -> None:
    rng = np.random.default_rng(1)
    poses = noisy_poses(UNIT, 48.0 * plan(14), 1e-4, rng)
    c = fit_attitudes(poses, plan(14), reference=48.0).calibration
    assert np.max(np.abs(c.values - TRUTH) / c.standard_errors) < 4.5


def test_vectors_of_any_length_are_directions() -> None:
    poses, _ = turntable(plan(14), 1)
    longer = plan(14) * np.linspace(0.1, 1e6, 14)[:, None]
    one, other = (fit_attitudes(poses, v, signs=SIGNS).calibration.values for v in (plan(14), longer))
    assert other == pytest.approx(one, rel=1e-9)


@pytest.mark.parametrize("ups", [FOUR[:3], np.concatenate([np.eye(3)[:2], -np.eye(3)[:2]]), np.tile(FOUR[0], (8, 1))])
def test_attitudes_that_cannot_carry_twelve_parameters_are_refused_with_what_is_missing(ups: np.ndarray) -> None:
    poses, _ = turntable(ups, 0)
    with pytest.raises(Refused, match="cannot carry twelve parameters") as refused:
        fit_attitudes(poses, ups, signs=SIGNS)
    assert refused.value.wanted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v[:5], "14 poses, but attitudes of shape"),
        (lambda v: v * 0, "no length"),
        (lambda v: v + np.nan, "not a finite number"),
    ],
)
def test_attitudes_that_are_no_directions_are_an_error(change: object, message: str) -> None:
    poses, _ = turntable(plan(14), 1)
    assert callable(change)
    with pytest.raises(InvalidData, match=message):
        fit_attitudes(poses, change(plan(14)), signs=SIGNS)


@pytest.mark.parametrize("bad", [{"reference": 0.0}, {"attitude_error_rad": -1.0}, {"attitude_error_rad": 1.0}])
def test_options_that_make_no_sense_are_an_error(bad: dict[str, float]) -> None:
    poses, _ = turntable(plan(14), 1)
    with pytest.raises(InvalidData):
        fit_attitudes(poses, plan(14), **bad)  # type: ignore[arg-type]
