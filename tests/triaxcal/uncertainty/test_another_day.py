"""How well a calibration predicts another recording, by what recordings of one unit show of how it starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import Effect, effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.estimate.recordings import by_run, gather
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import channels_of, covariates, references
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import START_TO_START, Source, next_recording

MINUS = (-1.0, -1.0, -1.0)


def run_of(unit: Sensor, seed: int, start_g: float = 0.0) -> list[Pose]:
    """A recording, with biases that came back otherwise."""
    rng = np.random.default_rng(seed)
    ups = rng.permutation(np.array([up for _, up in directions(26)]))
    started = replace(unit, bias=unit.bias + start_g * rng.standard_normal(3))
    return noisy_poses(started, ups, 2e-5, rng)


def test_of_one_recording_the_start_is_assumed_and_said_to_be(paper_unit: Sensor) -> None:
    c = fit(run_of(paper_unit, 1), signs=MINUS)
    found = next_recording(c, budget(c))
    assert found.source is Source.ASSUMED
    assert found.start_to_start == START_TO_START
    assert found.expanded_uncertainty == pytest.approx(1.96 * START_TO_START, rel=0.02)


def test_a_type_of_unit_may_be_known_to_start_alike(paper_unit: Sensor) -> None:
    c = fit(run_of(paper_unit, 1), signs=MINUS)
    found, b = next_recording(c, budget(c), start_to_start=0.0), budget(c)
    assert found.expanded_uncertainty == pytest.approx(float(b.magnitude.expanded), rel=1e-6)


def test_of_several_recordings_the_start_is_measured(paper_unit: Sensor) -> None:
    told = []
    for seed in range(8):
        poses = gather([run_of(paper_unit, 100 * seed + k, start_g=5e-4) for k in range(5)])
        c = fit(poses, signs=MINUS, excluded=())
        found = next_recording(c, budget(c))
        assert found.source is Source.MEASURED
        told.append(found.start_to_start)
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(5e-4, rel=0.25)


def test_recordings_that_start_alike_say_so(paper_unit: Sensor) -> None:
    c = fit(gather([run_of(paper_unit, k) for k in range(4)]), signs=MINUS)
    assert next_recording(c, budget(c)).start_to_start < 1e-5


def test_few_recordings_widen_the_interval(paper_unit: Sensor) -> None:
    two = fit(gather([run_of(paper_unit, k, start_g=5e-4) for k in range(2)]), signs=MINUS, excluded=())
    found = next_recording(two, budget(two))
    assert found.expanded_uncertainty > 2.5 * found.start_to_start


@pytest.mark.slow
def test_errors_in_the_next_recording_stay_within_what_is_stated(paper_unit: Sensor) -> None:
    within = []
    for seed in range(30):
        runs = [run_of(paper_unit, 50 * seed + k, start_g=4e-4) for k in range(5)]
        c = fit(gather(runs[:4]), signs=MINUS, excluded=())
        stated = next_recording(c, budget(c)).expanded_uncertainty
        u = np.array([p.mean for p in runs[4]])
        off = np.linalg.norm((u - c.sensor.centre) @ c.sensor.matrix.T, axis=1) - 1
        within.append(np.sqrt(np.mean(off**2)) <= stated)
    assert np.mean(within) >= 0.9


def test_what_differs_from_run_to_run_counts_though_an_effect_explains_it(paper_unit: Sensor) -> None:
    """A board that warms up anew, less each time: explained in all runs, and unknown of the next."""
    decays = np.array([4e-3, 2.5e-3, 1.5e-3, 1e-3])
    runs = []
    for k, size in enumerate(decays):
        poses = run_of(paper_unit, 70 + k)
        warm = [size * np.exp(-p.t_s / 300) for p in poses]
        scale = paper_unit.scale_factor
        runs.append([replace(p, mean=p.mean + scale * w) for p, w in zip(poses, warm, strict=True)])
    poses = gather(runs)
    (effect,) = (e for e in by_run([effect_named("warm_up")], poses) if e.name == "warm_up")
    shown = next(e for e in effect.variants(_covariates(poses)) if len(e.coefficients) == 12 and 200 < _tau(e) < 450)
    c = fit(poses, signs=MINUS, effects=[shown])
    end_s = max(p.end_s for p in runs[-1])
    biases = decays * np.exp(-end_s / _tau(shown))
    assert next_recording(c, budget(c)).start_to_start == pytest.approx(np.std(biases, ddof=1), rel=0.3)


def _tau(effect: Effect) -> float:
    return next(value for value, _ in effect.shape.values())


def _covariates(poses: list[Pose]) -> dict[str, np.ndarray]:
    channels = channels_of(poses)
    return covariates(channels, references(channels))
