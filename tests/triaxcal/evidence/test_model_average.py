"""What is corrected, held against the truth in poses of another recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import FEW, MINUS, SIGMA_G
from tests.undeclared.examine import Case, still_poses
from triaxcal.estimate.calibration import ReferenceEpoch
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Average, Posterior, Refusal, average, posterior_of, refusal
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose


def seen_in(poses: list[Pose], signs: tuple[float, ...] = MINUS) -> Posterior:
    return posterior_of(poses, fit(poses, signs=signs), signs=signs, catalogue=FEW)


def at(t_s: float) -> ReferenceEpoch:
    return ReferenceEpoch(Moment.SECONDS, t_s, t_s)


def errors_of(made: Sensor, truth: Sensor) -> np.ndarray:
    """Of |a| all over the sphere, in g, at the reference of every condition."""
    rng = np.random.default_rng(0)
    up = rng.standard_normal((500, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    still = {name: np.zeros(500) for effect, _ in (*truth.effects, *made.effects) for name in effect.needs}
    still |= {"since_start_s": np.full(500, np.inf)}
    return np.linalg.norm(made.specific_force(truth.output(up, still), still), axis=1) - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects", [{"third_order_nonlinearity": [2e-3, -1e-3, 2e-3]}, {"scale_factor_asymmetry": [1e-3, 8e-4, -9e-4]}, {}]
)
def test_the_average_comes_as_near_the_truth_as_noise_allows(
    poses_with: Callable[..., list[Pose]], with_effects: Callable[..., Sensor], effects: dict[str, list[float]]
) -> None:
    errors, linear = [], []
    for seed in range(4):
        poses = poses_with(seed, **effects)
        errors.append(errors_of(average(seen_in(poses), at(0.0)).sensor, with_effects(**effects)))
        linear.append(errors_of(fit(poses, signs=MINUS).sensor, with_effects(**effects)))
    # Twelve parameters from thirty poses: rms error of a prediction is √(12/30) of a pose's.
    assert np.sqrt(np.mean(np.square(errors))) < 1.0 * SIGMA_G
    if effects:
        assert np.sqrt(np.mean(np.square(errors))) < 0.2 * np.sqrt(np.mean(np.square(linear)))


def stated(made: Average, truth: Sensor) -> np.ndarray:
    """The standard uncertainty of the same, by the covariance."""
    size, axes = np.linalg.eigh(made.covariance)
    here = errors_of(made.sensor, truth)
    steps = (axes * np.sqrt(np.maximum(size, 0.0))).T
    return np.sqrt(sum((errors_of(made.sensor.moved(step), truth) - here) ** 2 for step in steps))


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [{}, {"third_order_nonlinearity": [3e-4, -1e-4, 2e-4]}, {"second_order_nonlinearity": [1e-4, 8e-5, -9e-5]}],
    ids=["nothing", "clear", "weak"],
)
def test_errors_are_as_large_as_they_are_said_to_be(
    poses_with: Callable[..., list[Pose]], with_effects: Callable[..., Sensor], effects: dict[str, list[float]]
) -> None:
    off = []
    for seed in range(20, 26):
        made, truth = average(seen_in(poses_with(seed, **effects)), at(0.0)), with_effects(**effects)
        off.append(errors_of(made.sensor, truth) / stated(made, truth))
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_document_has_one_shape_for_a_name_and_coefficients_that_do_the_same(
    poses_with: Callable[..., list[Pose]], with_effects: Callable[..., Sensor]
) -> None:
    """A warm-up, whose time constant nobody knows."""
    made = average(seen_in(poses_with(2, warm_up=[4e-4, 3e-4, -5e-4])), at(300.0))
    names = [effect.name for effect, _ in made.sensor.effects]
    assert len(set(names)) == len(names)
    assert sum(made.weights[name] for name in names if name in ("warm_up", "bias_drift")) > 0.9
    assert len(made.covariance) == 9 + sum(len(q) for _, q in made.sensor.effects)


@pytest.mark.slow
def test_a_knock_moves_the_average_as_little_as_if_it_were_left_out(
    poses_with: Callable[..., list[Pose]],
    with_effects: Callable[..., Sensor],
    knocked: Callable[[list[Pose], int, float], list[Pose]],
) -> None:
    poses = poses_with(4)
    with_knock = errors_of(average(seen_in(knocked(poses, 9, 1e-3)), at(0.0)).sensor, with_effects())
    assert np.sqrt(np.mean(with_knock**2)) < SIGMA_G


@pytest.mark.slow
def test_what_has_no_name_is_not_corrected() -> None:
    recording = Case("dead_zone", 1, (100.0, 200.0), 26, "white").make()
    assert refusal(seen_in(still_poses(recording.samples()), recording.signs)) is Refusal.UNMODELLED


@pytest.mark.slow
def test_a_name_is_corrected_where_nothing_else_acts(poses_with: Callable[..., list[Pose]]) -> None:
    assert refusal(seen_in(poses_with(1, temperature_bias=[5e-4, -4e-4, 6e-4]))) is None
    assert refusal(seen_in(poses_with(1))) is None


@pytest.mark.slow
def test_a_process_in_time_says_where_the_bias_is_at_the_moment_asked_for(
    poses_with: Callable[..., list[Pose]], paper_unit: Sensor
) -> None:
    """A bias that swings, and no name for that."""

    def bias_g(t_s: float) -> np.ndarray:
        return np.sin(2 * np.pi * t_s / 400) * np.array([6e-4, -4e-4, 5e-4])

    poses = [replace(p, mean=p.mean + paper_unit.scale_factor * bias_g(p.t_s)) for p in poses_with(3)]
    posterior = posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS, catalogue=())
    assert next(iter(posterior.unmodelled_kind_probabilities)) is UnmodelledKind.TIME
    moments = np.linspace(0, poses[-1].end_s, 7)
    told = np.array([average(posterior, at(t)).sensor.bias for t in moments])
    # What is constant all along is the sensor's bias.
    told, truth = (b - b.mean(axis=0) for b in (told, np.array([bias_g(t) for t in moments])))
    assert np.sqrt(np.mean((told - truth) ** 2)) < 0.2 * np.sqrt(np.mean(truth**2))


@pytest.mark.slow
def test_the_bias_at_a_moment_is_as_sure_as_a_process_in_time_leaves_it(
    poses_with: Callable[..., list[Pose]], paper_unit: Sensor
) -> None:
    """Biases that wander smoothly, drawn anew for each seed."""
    off = []
    for seed in range(8):
        poses = poses_with(seed + 40)
        t_s = np.array([*(p.t_s for p in poses), poses[-1].end_s])
        near = np.exp(-((t_s[:, None] - t_s) ** 2) / 2 / (0.25 * t_s[-1]) ** 2)
        rng = np.random.default_rng(seed)
        bias_g = np.linalg.cholesky(near + 1e-9 * np.eye(len(near))) @ rng.normal(0, 4e-4, (len(t_s), 3))
        moved = [replace(p, mean=p.mean + paper_unit.scale_factor * b) for p, b in zip(poses, bias_g, strict=False)]
        made = average(posterior_of(moved, fit(moved, signs=MINUS), signs=MINUS, catalogue=()), at(float(t_s[-1])))
        truth = paper_unit.bias + bias_g[-1]
        off.append((made.sensor.bias - truth) / np.sqrt(np.diag(made.covariance)[6:9]))
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5
