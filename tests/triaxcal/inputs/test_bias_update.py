"""Three biases anew, all else kept: judged by truth over seeds, and by the whole posterior of an outside solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

import triaxcal as tc
from benchmarks import rezero as benchmark
from benchmarks.next_recording import FOLDER
from triaxcal.documents import earlier_of
from triaxcal.effects import effect_named
from triaxcal.estimate.calibration import BiasUpdate
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.bias_update import SCALE_FACTOR_SHARE, BiasMoved, Earlier, updated_biases
from triaxcal.model.directions import bias_directions, cube_directions
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import START_TO_START

UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-3, -6e-3]), np.array([5e-3, -3e-3, 4e-3]))
SIGNS = (-1, 1, 1)
CUBE = np.array([v for _, v in cube_directions()])
TETRAHEDRON = np.array([v for _, v in bias_directions(4)])
NOISE = 5e-5
SHIFT = np.array([2e-3, -1.5e-3, 1e-3])


def shifted(by: np.ndarray = SHIFT, scale: float | Sequence[float] = 1.0, unit: Sensor = UNIT) -> Sensor:
    return replace(unit, bias=unit.bias + by, scale_factor=unit.scale_factor * np.asarray(scale))


def poses_of(unit: Sensor, ups: np.ndarray, seed: int = 0, noise: float = NOISE, **more: object) -> list[Pose]:
    return noisy_poses(unit, ups, noise, np.random.default_rng([seed, 7]), **more)  # type: ignore[arg-type]


def calibrated(seed: int = 1, noise: float = NOISE) -> tc.Calibration:
    return tc.calibrate(poses_of(UNIT, CUBE, seed, noise), signs=SIGNS)


def update_of(c: tc.Calibration) -> BiasUpdate:
    assert c.fitted.update is not None
    return c.fitted.update


@pytest.mark.parametrize("ups", [CUBE[:3], TETRAHEDRON, CUBE[:6], CUBE])
def test_biases_come_back_and_all_else_is_kept(ups: np.ndarray) -> None:
    first = calibrated()
    found = tc.rezero(first, poses_of(shifted(), ups))
    assert np.allclose(found.bias, UNIT.bias + SHIFT, atol=5 * NOISE * 2)
    for kept in ("scale_factor", "misalignment"):
        assert np.array_equal(getattr(found, kept), np.array(first.to_dict()[kept]))
    assert found.terms == first.terms


@pytest.mark.parametrize("ups", [CUBE[:3], TETRAHEDRON, CUBE[:6]])
def test_the_biases_are_those_of_the_whole_posterior(ups: np.ndarray) -> None:
    """Of a solver that moves all nine parameters, with the priors as penalties."""
    earlier, poses = earlier_of(calibrated()), poses_of(shifted(scale=1 + 2e-4), ups)
    c, k = earlier.calibration, earlier.calibration.sensor.scale_factor
    change = np.zeros(9)
    change[:3], change[6:] = k * SCALE_FACTOR_SHARE * START_TO_START, START_TO_START
    prior = np.linalg.cholesky(earlier.covariance + np.diag(change**2))
    sigma = np.hypot(NOISE, earlier.scatter_g)
    u = np.array([p.mean for p in poses])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.append((c.sensor.moved(prior @ x).magnitude(u, {})[0] - 1) / sigma, x)

    best = optimize.least_squares(residuals, np.zeros(9), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = updated_biases(poses, earlier)
    off = found.sensor.bias - c.sensor.moved(prior @ best.x).bias
    assert np.all(np.abs(off) < 0.01 * found.standard_errors[6:9])


@pytest.mark.parametrize("count", [3, 4, 6, 14])
def test_errors_of_all_parameters_together_are_as_stated(count: int) -> None:
    seeds = 25
    squares = []
    for seed in range(seeds):
        made = benchmark.trial(seed, count)
        truth = np.concatenate([made.truth.scale_factor, made.truth.misalignment, made.truth.bias])
        scale = made.found.standard_errors
        off = (made.found.values - truth) / scale
        squares.append(off @ np.linalg.solve(made.found.covariance / np.outer(scale, scale), off))
    low, high = stats.chi2.interval(0.9998, 9 * seeds)
    assert low < np.sum(squares) < high


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 4, 6])
def test_stated_intervals_hold_the_truth(count: int) -> None:
    assert np.all(np.abs(benchmark.coverage(600, count) - 0.94) < 0.04)


def test_biases_and_kept_parameters_are_correlated_as_the_poses_say() -> None:
    """A pose shows the sum of a bias and of an error of a kept scale factor."""
    found = tc.rezero(calibrated(), poses_of(shifted(), CUBE[:3]))
    correlation = np.array(found.to_dict()["correlation"])
    # +X up: |a| = k' (1 + b')/k − b is 1, so where k is too small b comes out too large.
    assert [np.sign(correlation[i, 6 + i] * found.scale_factor[i]) for i in range(3)] == [-1, -1, -1]
    assert np.abs(correlation[range(3), range(6, 9)]).min() > 0.5


def test_a_tetrahedron_keeps_changes_of_scale_factors_out_of_the_biases() -> None:
    changed = shifted(scale=(1 + 3e-4, 1 - 2e-4, 1 + 1e-4))
    first = calibrated(noise=1e-6)
    by_four, by_three = (tc.rezero(first, poses_of(changed, ups, noise=1e-6)).bias for ups in (TETRAHEDRON, CUBE[:3]))
    assert np.abs(by_four - changed.bias).max() < 1e-5
    assert np.abs(by_three - changed.bias).max() > 1e-4


def test_the_covariance_is_the_sum_of_its_sources_and_the_budget_says_so() -> None:
    c = tc.rezero(calibrated(), poses_of(shifted(), TETRAHEDRON)).fitted
    assert c.update is not None
    assert np.allclose(sum(c.update.covariances.values()), c.covariance, rtol=1e-12)
    lines = budget(c)
    assert {line.source for line in lines.components} == set(c.update.covariances)
    assert np.allclose(lines.parameters.standard, c.standard_errors)


def test_the_first_so_many_distinct_poses_are_used() -> None:
    ups = np.array([CUBE[0], CUBE[0], CUBE[1], CUBE[2], CUBE[1], CUBE[4], CUBE[5]])
    poses = poses_of(shifted(), ups)
    found = tc.rezero(calibrated(), poses, first=4)
    assert [p.pose.start_s for p in found.poses] == [poses[i].start_s for i in (0, 2, 3, 5)]
    assert len(tc.rezero(calibrated(), poses).poses) == 7


@pytest.mark.parametrize(
    ("ups", "enough"),
    [
        (CUBE[:0], 3),
        (CUBE[:1], 2),
        (CUBE[[0, 0, 0]], 2),
        (CUBE[:2], 1),
        (np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]]), 1),
    ],
)
def test_poses_that_do_not_determine_three_biases_are_refused_and_the_missing_ones_named(
    ups: np.ndarray, enough: int
) -> None:
    first = calibrated()
    with pytest.raises(tc.Refused) as e:
        tc.rezero(first, poses_of(shifted(), ups))
    assert len(e.value.wanted) == enough
    labels = dict(cube_directions())
    mended = np.concatenate([ups.reshape(-1, 3), [labels[name] for name in e.value.wanted]])
    tc.rezero(first, poses_of(shifted(), mended))


@pytest.mark.parametrize("first", [1, 2])
def test_fewer_than_three_are_refused(first: int) -> None:
    with pytest.raises(tc.Refused):
        tc.rezero(calibrated(), poses_of(shifted(), CUBE), first=first)


@pytest.mark.parametrize("first", [0, -1, 2.5, True, "4"])
def test_a_count_that_is_none_is_invalid(first: object) -> None:
    with pytest.raises(tc.InvalidData, match="first"):
        tc.rezero(calibrated(), poses_of(shifted(), CUBE), first=first)  # type: ignore[arg-type]


@pytest.mark.parametrize("ups", [TETRAHEDRON, CUBE[:6], CUBE])
@pytest.mark.parametrize("scale", [1.01, (1.01, 1, 1), (1, 1, 0.99)])
def test_scale_factors_that_no_longer_fit_are_refused(ups: np.ndarray, scale: float | Sequence[float]) -> None:
    with pytest.raises(tc.Refused, match="no longer fit"):
        tc.rezero(calibrated(), poses_of(shifted(scale=scale), ups))


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 6, 14])
def test_sound_units_are_refused_no_more_often_than_stated(count: int) -> None:
    refused = 0
    for seed in range(150):
        try:
            benchmark.trial(seed, count)
        except tc.Refused:
            refused += 1
    assert refused <= 1  # one in ten thousand each


def test_an_output_that_never_changes_is_refused() -> None:
    poses = [replace(p, mean=np.array([p.mean[0], p.mean[1], 3.0])) for p in poses_of(shifted(), TETRAHEDRON)]
    with pytest.raises(tc.Refused, match="axis z never changes"):
        tc.rezero(calibrated(), poses)


@pytest.mark.parametrize("factor", [1000.0, 1.2, 0.001])
def test_outputs_in_another_unit_are_refused_however_few_the_poses(factor: float) -> None:
    poses = [
        replace(p, mean=p.mean * factor, covariance=p.covariance * factor**2) for p in poses_of(shifted(), CUBE[:3])
    ]
    with pytest.raises(tc.Refused):
        tc.rezero(calibrated(), poses)


def test_a_unit_that_moved_by_more_than_expected_is_not_pulled_back_and_it_is_told() -> None:
    far = np.array([0.03, -0.02, 0.025])
    found = tc.rezero(calibrated(), poses_of(shifted(far), CUBE[:3]))
    assert np.allclose(found.bias, UNIT.bias + far, atol=4 * NOISE)
    assert any(isinstance(c, BiasMoved) for c in found.fitted.cautions)
    assert not any(isinstance(c, BiasMoved) for c in tc.rezero(calibrated(), poses_of(shifted(), CUBE)).fitted.cautions)


def test_a_calibration_without_errors_keeps_nothing() -> None:
    document = calibrated().to_dict()
    del document["standard_error"]
    with pytest.raises(tc.Refused, match="how uncertain"):
        tc.rezero(tc.Calibration.from_dict(document), poses_of(shifted(), TETRAHEDRON))


WARM = replace(UNIT, effects=((effect_named("temperature_bias"), np.array([3e-4, -2e-4, 4e-4])),))


def warm_poses(unit: Sensor, ups: np.ndarray, temperature: np.ndarray, seed: int) -> list[Pose]:
    return poses_of(unit, ups, seed, channels={"temp_c": temperature}, channel_reference={"temp_c": 25.0})


def warm_calibration() -> tc.Calibration:
    """Of which the temperature effect is known, from 15 to 35 °C."""
    order = np.random.default_rng(3).permutation(26)
    poses = warm_poses(WARM, CUBE[order], np.linspace(15, 35, 26), 1)
    return tc.calibrate(poses, signs=SIGNS, effects=["temperature_bias"])


@pytest.mark.parametrize("temperature", [25.0, 33.0, 10.0])
def test_biases_are_referred_to_the_reference_temperature(temperature: float) -> None:
    first = warm_calibration()
    found = tc.rezero(first, warm_poses(shifted(unit=WARM), TETRAHEDRON, np.full(4, temperature), 2))
    at_reference = (first.fitted.channel_reference["temp_c"] - 25.0) * np.array(WARM.effects[0][1])
    off = found.bias - (UNIT.bias + SHIFT + at_reference)
    assert np.all(np.abs(off) < 4 * found.fitted.standard_errors[6:9])
    assert np.all(np.abs(off) < 3e-4)
    assert found.effects["temperature_bias"]["x"][0] == pytest.approx(first.effects["temperature_bias"]["x"][0])


def test_far_from_the_reference_temperature_the_biases_are_less_certain() -> None:
    first = warm_calibration()
    near, far = (
        tc.rezero(first, warm_poses(shifted(unit=WARM), TETRAHEDRON, np.full(4, t), 2)).fitted.standard_errors[6:9]
        for t in (25.0, 60.0)
    )
    assert np.all(far > near)


def test_a_channel_that_an_effect_needs_has_to_be_there() -> None:
    with pytest.raises(tc.InvalidData, match="temp_c"):
        tc.rezero(warm_calibration(), poses_of(shifted(), TETRAHEDRON))


def test_far_from_the_temperature_of_a_calibration_without_thermal_effects_all_is_less_certain() -> None:
    first = tc.calibrate(warm_poses(UNIT, CUBE, np.full(26, 25.0), 1), signs=SIGNS)
    near, far = (
        tc.rezero(first, warm_poses(shifted(), TETRAHEDRON, np.full(4, t), 2)).fitted.standard_errors
        for t in (25.0, 45.0)
    )
    assert np.all(far[:3] > 5 * near[:3])


def test_loaded_and_made_calibrations_give_the_same(tmp_path: object) -> None:
    first, poses = calibrated(), poses_of(shifted(), TETRAHEDRON)
    path = f"{tmp_path}/cal.json"
    first.save(path)
    made, loaded = tc.rezero(first, poses).to_dict(), tc.rezero(tc.Calibration.load(path), poses).to_dict()
    assert made == loaded


def test_the_document_says_what_it_was_made_from() -> None:
    first, poses = calibrated(), poses_of(shifted(), TETRAHEDRON)
    document = tc.rezero(first, poses).to_dict()
    assert document["origin"]["poses"] == len(document["poses"]) == 4
    assert document["origin"]["calibration"]["sha256"] == earlier_of(first).origin.sha256
    assert document["next_recording"]["source"] == "assumed"
    assert document["next_recording"]["start_to_start_g"] == START_TO_START
    assert document["holds_at"] == {"moment": Moment.MEAN.value, "t_s": np.mean([p.t_s for p in poses])}
    read, made = tc.Calibration.from_dict(document).fitted, tc.rezero(first, poses).fitted
    assert np.allclose(read.standard_errors, made.standard_errors, rtol=1e-4)
    both = [c.covariance / np.outer(c.standard_errors, c.standard_errors) for c in (read, made)]
    assert np.allclose(*both, rtol=0, atol=2e-6)


def test_a_measured_start_to_start_is_kept_and_used() -> None:
    document = calibrated().to_dict()
    document["next_recording"] |= {"start_to_start_g": 2e-5, "source": "measured"}
    first = tc.Calibration.from_dict(document)
    found = tc.rezero(first, poses_of(shifted(np.full(3, 1e-5)), TETRAHEDRON))
    assert found.to_dict()["next_recording"]["source"] == "measured"
    assert found.fitted.standard_errors[0] < 0.2 * tc.rezero(calibrated(), found_poses()).fitted.standard_errors[0]


def found_poses() -> list[Pose]:
    return poses_of(shifted(np.full(3, 1e-5)), TETRAHEDRON)


def test_an_update_can_be_updated_again() -> None:
    once = tc.rezero(calibrated(), poses_of(shifted(), TETRAHEDRON))
    twice = tc.rezero(tc.Calibration.from_dict(once.to_dict()), poses_of(shifted(2 * SHIFT), CUBE[:6], 5))
    assert np.allclose(twice.bias, UNIT.bias + 2 * SHIFT, atol=4 * NOISE)
    assert update_of(twice).scatter_g == pytest.approx(update_of(once).scatter_g, rel=1e-4)


def test_the_linear_calibration_beside_effects_is_updated_too() -> None:
    curved = replace(UNIT, effects=((effect_named("second_order_nonlinearity"), np.array([4e-4, -3e-4, 5e-4])),))
    first = tc.diagnose(poses_of(curved, CUBE), signs=SIGNS).calibration
    assert "second_order_nonlinearity" in first.terms
    found = tc.rezero(first, poses_of(shifted(unit=curved), TETRAHEDRON))
    assert found.terms == first.terms
    assert np.allclose(found.linear_only.bias - first.linear_only.bias, SHIFT, atol=4e-4)
    assert np.allclose(found.bias - first.bias, SHIFT, atol=2e-4)


def test_effects_of_time_keep_their_moment() -> None:
    first = tc.calibrate(poses_of(UNIT, CUBE), signs=SIGNS, effects=["bias_drift"])
    found = tc.rezero(first, poses_of(shifted(), TETRAHEDRON))
    assert found.holds_at == tc.Calibration.from_dict(first.to_dict()).holds_at


def test_a_faulty_pose_is_not_used_and_it_is_told() -> None:
    poses = poses_of(shifted(), CUBE[:6])
    poses[1] = replace(poses[1], mean=poses[1].mean * 1.5, fault="saturation")
    found = tc.rezero(calibrated(), poses)
    assert len(found.poses) == 5
    assert any("saturation" in line for line in found.warnings)


def test_poses_of_unknown_noise_take_that_of_the_calibration() -> None:
    poses = [replace(p, dof=0.0, covariance=p.covariance * 1e-12) for p in poses_of(shifted(), TETRAHEDRON)]
    found = tc.rezero(calibrated(), poses)
    assert np.all(found.fitted.standard_errors[6:9] > 0.3 * NOISE)


def test_what_residuals_of_the_earlier_fit_show_beside_noise_counts() -> None:
    rng = np.random.default_rng(4)
    rough = [replace(p, mean=p.mean + 4e-4 * rng.standard_normal(3) * UNIT.scale_factor) for p in poses_of(UNIT, CUBE)]
    earlier = earlier_of(tc.calibrate(rough, signs=SIGNS))
    assert 2e-4 < earlier.scatter_g < 7e-4
    assert isinstance(earlier, Earlier)
    assert fit(rough, signs=SIGNS).excess_g == pytest.approx(earlier.scatter_g, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 14])
def test_a_stand_that_does_not_come_back_is_no_reason_to_refuse(count: int) -> None:
    """Which the residuals of the earlier fit tell, by few degrees of freedom."""
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng([seed, 3])
        first, today = (
            [
                replace(p, mean=p.mean + 2 * NOISE * rng.standard_normal(3) * UNIT.scale_factor)
                for p in poses_of(unit, ups, int(rng.integers(1e9)))
            ]
            for unit, ups in ((UNIT, CUBE[:14]), (shifted(), CUBE[:14] if count == 14 else TETRAHEDRON))
        )
        try:
            tc.rezero(tc.calibrate(first, signs=SIGNS), today)
        except tc.Refused:
            refused += 1
    assert refused == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("scale_factor", v) for v in (1e-300, -1e-160, 1e150, 1e300)]
    + [(name, v) for name in ("bias", "misalignment") for v in (1e6, -1e150, 1e300)],
)
def test_absurd_numbers_of_a_file_are_refused(name: str, value: float) -> None:
    document = calibrated().to_dict()
    document[name] = [value, *document[name][1:]]
    with pytest.raises((tc.Refused, tc.InvalidData)):
        tc.rezero(tc.Calibration.from_dict(document), poses_of(shifted(), CUBE))


@pytest.mark.datasets
@pytest.mark.slow
def test_the_next_real_run_is_better_by_four_poses_and_never_much_worse() -> None:
    if not FOLDER.is_dir():
        pytest.skip(f"{FOLDER}: no recordings there")
    found = benchmark.ratios(benchmark.real(2))
    by_four = found[:, benchmark.COUNTS.index(4)]
    assert np.isfinite(found).all()
    assert np.exp(np.mean(np.log(by_four))) <= 0.40
    assert found.max() <= 1.2  # two of 32 pairs are above 1.1, where hardly anything had moved
