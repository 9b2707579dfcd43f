"""Datasheet values refined by few poses, judged by truth over seeds and by the full posterior of an outside solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, stats

from triaxcal.effects import effect_named
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.datasheet import Datasheet, DatasheetContradicted, Refinement, StillOfDatasheet, refine
from triaxcal.model.directions import cube_directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

SIGNS = (-1, 1, 1)
UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))
TRUTH = np.concatenate([UNIT.scale_factor, UNIT.misalignment, UNIT.bias])
ERROR = np.concatenate([np.abs(TRUTH[:3]) * 1e-3, np.full(3, 1e-3), np.full(3, 2e-3)])


def sensor(values: np.ndarray) -> Sensor:
    return Sensor(values[:3], values[3:6], values[6:9])


def datasheet(seed: int, error: np.ndarray = ERROR, reference: float = 1.0) -> Datasheet:
    """One as good as it says."""
    rng = np.random.default_rng([seed, 1])
    return Datasheet(sensor(TRUTH + rng.standard_normal(9) * error), error, {}, reference)


def poses(count: int, seed: int, noise: float = 1e-5) -> list[Pose]:
    ups = np.array([v for _, v in cube_directions()])[:count]
    return noisy_poses(UNIT, ups, noise, np.random.default_rng(seed))


@pytest.mark.parametrize("count", [1, 2, 4, 9, 14])
@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_truth_comes_back_within_the_stated_errors_however_few_the_poses(count: int, noise: float) -> None:
    squares = []
    seeds = 40
    for seed in range(seeds):
        c = refine(poses(count, seed, noise), datasheet(seed)).calibration
        e = (c.values - TRUTH) / ERROR
        squares.append(e @ np.linalg.solve(c.covariance / np.outer(ERROR, ERROR), e))
    low, high = stats.chi2.interval(0.9998, 9 * seeds)
    assert low < np.sum(squares) < high


@pytest.mark.parametrize("count", [1, 2, 4, 9, 14])
def test_each_standard_error_is_true_where_the_poses_know_a_thousand_times_better(count: int) -> None:
    """The nine together lie on a curved surface then, of which a covariance knows nothing; each by itself does not."""
    pulls = []
    for seed in range(40):
        c = refine(poses(count, seed, 1e-6), datasheet(seed)).calibration
        pulls.append((c.values - TRUTH) / c.standard_errors)
    low, high = stats.chi2.interval(0.9998, 40 * 3) / np.array(40 * 3)  # pulls of one seed go together
    assert low < np.mean(np.square(pulls)) < high


@pytest.mark.parametrize("count", [2, 5])
def test_the_result_is_the_mode_of_the_posterior(count: int) -> None:
    held, prior = poses(count, 3), datasheet(3)
    c = refine(held, prior).calibration
    u = np.array([p.mean for p in held])
    sigma = np.array([p.standard_error for p in held])

    def residuals(x: np.ndarray) -> np.ndarray:
        """Of everything at once: the nine values, and the attitude of each pose as two angles."""
        values, angles = prior.values + x[:9] * ERROR, x[9:].reshape(-1, 2)
        polar, azimuth = angles.T
        a = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
        return np.concatenate([((sensor(values).output(a, {}) - u) / sigma).ravel(), x[:9]])

    a = prior.sensor.specific_force(u, {})
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    begin = np.stack([np.arccos(a[:, 2]), np.arctan2(a[:, 1], a[:, 0])], axis=1)
    best = optimize.least_squares(residuals, np.concatenate([np.zeros(9), begin.ravel()]), xtol=1e-15, ftol=1e-15)
    assert (c.values - prior.values) / ERROR == pytest.approx(best.x[:9], abs=2e-3)
    covariance = np.linalg.pinv(best.jac.T @ best.jac)[:9, :9]
    assert c.standard_errors / ERROR == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-2)


def test_with_enough_poses_and_a_vague_datasheet_it_is_the_fit_to_the_poses() -> None:
    held = poses(14, 2)
    vague = Datasheet(sensor(TRUTH * 1.05), np.abs(TRUTH) * 10, {}, 1.0)
    found, free = refine(held, vague), fit(held, signs=SIGNS, excluded=())
    assert np.max(np.abs(found.calibration.values - free.values) / free.standard_errors) < 1e-3
    assert found.sources == ("poses",) * 9


def test_one_pose_moves_only_the_axis_that_it_points_along() -> None:
    found = refine(poses(1, 1), datasheet(1))
    assert [found.sources[i] for i in (0, 6)] == ["both", "both"]
    assert [found.sources[i] for i in (1, 2, 3, 4, 5, 7, 8)] == ["passport"] * 7
    moved = (found.calibration.values - found.datasheet.values) / ERROR
    assert np.max(np.abs(moved[[1, 2, 3, 4, 5, 7, 8]])) < 0.1 < np.max(np.abs(moved[[0, 6]]))
    kept = ("scale_factor.y", "scale_factor.z", *(f"misalignment.{a}" for a in "xyz"), "bias.y", "bias.z")
    assert found.calibration.cautions == (StillOfDatasheet(kept),)


def test_shares_of_information_grow_with_every_pose() -> None:
    before = np.zeros(9)
    for count in range(1, 15):
        share = refine(poses(count, 1), datasheet(1)).share
        assert np.all(share >= before - 1e-4)
        before = share
    assert np.all(before > 0.99)


@pytest.mark.slow
def test_a_datasheet_as_good_as_it_says_hardly_ever_conflicts() -> None:
    seeds = 200
    conflicts = [refine(poses(4, seed), datasheet(seed)).conflict_p for seed in range(seeds)]
    p = np.array([c for c in conflicts if c is not None])
    assert len(p) == seeds
    assert stats.binom.ppf(1e-4, seeds, 0.1) <= np.sum(p < 0.1) <= stats.binom.isf(1e-4, seeds, 0.1)


def test_a_unit_that_has_changed_conflicts_and_the_value_is_named() -> None:
    for seed in range(20):
        prior = datasheet(seed)
        values = prior.values
        values[7] += 20 * ERROR[7]
        found = refine(poses(6, seed), Datasheet(sensor(values), ERROR, {}, 1.0))
        assert found.conflict_p is not None
        assert found.conflict_p < 1e-6
        assert found.calibration.birge_ratio > 2
        caution = found.calibration.cautions[0]
        assert isinstance(caution, DatasheetContradicted)
        assert caution.parameters == ("bias.y",)


def changed(at: int, by: float, count: int, seed: int) -> Refinement:
    """Poses of a unit of which value ``at`` has changed by ``by`` of the datasheet's standard errors."""
    values = datasheet(seed).values
    values[at] += by * ERROR[at]
    return refine(poses(count, seed), Datasheet(sensor(values), ERROR, {}, 1.0))


@pytest.mark.parametrize("at", [0, 6])
def test_one_pose_does_not_tell_a_scale_factor_from_a_bias_and_both_are_named(at: int) -> None:
    for seed in range(20):
        found = changed(at, 20, 1, seed)
        assert set(found.changed) == {0, 6}
        assert found.changed_alone
        caution = found.calibration.cautions[0]
        assert isinstance(caution, DatasheetContradicted)
        assert set(caution.parameters) == {"scale_factor.x", "bias.x"}


@pytest.mark.parametrize("count", [2, 4, 6, 9, 14])
@pytest.mark.parametrize("by", [6, 20])
def test_the_value_that_changed_is_among_those_named_and_alone_where_the_poses_tell(count: int, by: float) -> None:
    named, alone, conflicts = 0, 0, 0
    for at in (0, 6, 7):  # values that each of these plans feels
        for seed in range(20):
            found = changed(at, by, count, seed)
            if found.changed:
                conflicts += 1
                named += at in found.changed
                alone += tuple(found.changed) == (at,)
    assert conflicts > 40
    assert named >= stats.binom.ppf(1e-3, conflicts, 0.95)
    assert alone >= 0.95 * conflicts if count >= 6 else alone == 0


def test_two_values_that_changed_are_not_explained_by_one() -> None:
    apart = 0
    for seed in range(20):
        values = datasheet(seed).values
        values[[6, 8]] += 20 * ERROR[[6, 8]]
        found = refine(poses(6, seed), Datasheet(sensor(values), ERROR, {}, 1.0))
        apart += not found.changed_alone and next(iter(found.changed)) in (6, 8)
    assert apart == 20


def test_errors_that_go_together_blame_the_value_that_does_not_go_with_the_others() -> None:
    """Scale factors known to 1e-3, their ratios to 1e-5, as where the reference was off: all may move, not one."""
    together = np.full((9, 9), 0.0)
    together[:3, :3] = np.outer(np.sign(TRUTH[:3]), np.sign(TRUTH[:3])) * (1 - 1e-4)
    np.fill_diagonal(together, 1.0)
    for seed in range(20):
        values = TRUTH.copy()
        values[1] *= 1 + 1e-4  # a tenth of its standard error, ten of its ratio
        found = refine(poses(6, seed), Datasheet(sensor(values), ERROR, {}, 1.0, together))
        assert tuple(found.changed) == (1,)
        assert abs(found.changed[1]) > 4 > abs(found.shift[1])


def test_a_value_without_error_stays_where_it_is() -> None:
    error = ERROR.copy()
    error[3:6] = 0
    prior = Datasheet(sensor(TRUTH), error, {}, 1.0)
    c = refine(poses(6, 1), prior).calibration
    assert np.array_equal(c.values[3:6], TRUTH[3:6])
    assert np.all(c.standard_errors[3:6] == 0)


def test_a_datasheet_from_earlier_poses_and_new_poses_are_as_good_as_all_poses_at_once() -> None:
    """Its errors go together: 10 K away from where the coefficients count from, a bias is hardly told from its drift
    with temperature."""
    effect = effect_named("temperature_bias")
    hot = Sensor(UNIT.scale_factor, UNIT.misalignment, UNIT.bias, ((effect, np.array([2e-4, -1e-4, 1e-4])),))
    rng = np.random.default_rng(3)
    ups = np.array([v for _, v in cube_directions()])
    held = noisy_poses(
        hot, np.concatenate([ups, ups[:14]]), 1e-6, rng,
        channels={"temp_c": 35 + rng.uniform(-1, 1, 40)}, channel_reference={"temp_c": 25.0},
    )  # fmt: skip
    earlier, today = held[:26], held[26:]
    whole = fit(held, signs=SIGNS, effects=[effect], excluded=())
    before = fit(earlier, signs=SIGNS, effects=[effect], excluded=())
    reference = before.channel_reference["temp_c"]
    # Moved to 25 °C, as if it had been made to count from there.
    values, V = _counted_from(before.values, before.covariance / before.birge_ratio**2, 25.0 - reference)
    error = np.sqrt(np.diag(V))
    known = Sensor(values[:3], values[3:6], values[6:9], ((effect, values[9:]),))
    prior = Datasheet(known, error, {"temp_c": 25.0}, 1.0, V / np.outer(error, error))
    found = refine(today, prior).calibration
    values, V = _counted_from(
        whole.values, whole.covariance / whole.birge_ratio**2, 25.0 - whole.channel_reference["temp_c"]
    )
    np.testing.assert_allclose(found.standard_errors, np.sqrt(np.diag(V)), rtol=0.02)
    assert np.max(np.abs(found.values - values) / np.sqrt(np.diag(V))) < 0.1
    assert found.birge_ratio == 1


def _counted_from(values: np.ndarray, V: np.ndarray, by_k: float) -> tuple[np.ndarray, np.ndarray]:
    """Values and covariance of the nine and three drifts with temperature, for another reference temperature."""
    M = np.eye(12)
    M[6:9, 9:] = by_k * np.eye(3)
    return M @ values, M @ V @ M.T


def test_effects_of_the_datasheet_are_kept_and_refined_too() -> None:
    effect = effect_named("temperature_bias")
    q = np.array([2e-4, -1e-4, 1e-4])
    hot = Sensor(UNIT.scale_factor, UNIT.misalignment, UNIT.bias, ((effect, q),))
    ups = np.array([v for _, v in cube_directions()[:14]])
    held = noisy_poses(
        hot, ups, 1e-6, np.random.default_rng(0), channels={"temp_c": np.linspace(35, 45, 14)},
        channel_reference={"temp_c": 25.0},
    )  # fmt: skip
    known = Sensor(UNIT.scale_factor, UNIT.misalignment, UNIT.bias, ((effect, q * 1.1),))
    found = refine(held, Datasheet(known, np.concatenate([ERROR, np.full(3, 3e-5)]), {"temp_c": 25.0}, 1.0))
    c = found.calibration
    assert np.max(np.abs(c.values[9:] - q) / c.standard_errors[9:]) < 4
    assert np.all(c.standard_errors[9:] < 3e-5)
    with pytest.raises(InvalidData, match="no channel temp_c"):
        refine(poses(4, 1), Datasheet(known, np.concatenate([ERROR, np.full(3, 3e-5)]), {"temp_c": 25.0}, 1.0))


def test_a_field_of_48_microtesla_with_its_hard_iron_is_no_harder() -> None:
    iron = np.concatenate([[1.1, 0.9, 1.05], [0.02, -0.03, 0.01], [200.0, -350.0, 90.0]])
    error = np.concatenate([np.full(3, 1e-2), np.full(3, 1e-2), np.full(3, 5.0)])
    ups = 48.0 * np.array([v for _, v in cube_directions()[:14]])[:6]
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        prior = Datasheet(sensor(iron + rng.standard_normal(9) * error), error, {}, 48.0)
        c = refine(noisy_poses(sensor(iron), ups, 0.02, rng), prior).calibration
        e = (c.values - iron) / error
        squares.append(e @ np.linalg.solve(c.covariance / np.outer(error, error), e))
    low, high = stats.chi2.interval(0.999, 360)
    assert low < np.sum(squares) < high


def test_no_pose_is_refused() -> None:
    with pytest.raises(Refused, match="no still pose"):
        refine([], datasheet(1))


@pytest.mark.parametrize("error", [np.zeros(9), np.ones(8), -np.ones(9), np.full(9, np.nan)])
def test_standard_errors_that_are_none_are_an_error(error: np.ndarray) -> None:
    with pytest.raises(InvalidData, match="standard error"):
        Datasheet(UNIT, error, {}, 1.0)
