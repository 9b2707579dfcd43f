"""Poses that hardly carry a calibration: half spheres, restless wrists, the same attitude over and over. There is
always an answer, and a fit and a diagnosis do not contradict each other."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import diagnose
from triaxcal.errors import Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import posterior_of
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget

UNIT = Sensor(np.array([1.01, 0.99, 1.02]), np.array([0.004, -0.003, 0.006]), np.array([0.01, -0.02, 0.005]))


def up(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    found = rng.standard_normal((n, 3))
    if kind == "half a sphere":
        found[:, 2] = abs(found[:, 2])
    elif kind == "a cap":
        found[:, 2] = abs(found[:, 2]) + 1
    elif kind == "few attitudes":
        found = rng.standard_normal((7, 3))[rng.integers(0, 7, n)] + 0.05 * found
    elif kind == "near a plane":
        found[:, 2] *= 0.15
    elif kind == "each four times":
        found = np.repeat(found[: n // 4], 4, axis=0)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def restless(poses: list[Pose], rng: np.random.Generator, share: float, size_g: float) -> list[Pose]:
    """Some of them moved while they were taken: their means are off, and they creep."""
    out = []
    for p in poses:
        noise = float(np.sqrt(p.covariance[0, 0]))
        moved = size_g if rng.random() < share else 0.0
        slope = np.hypot(2 * moved, 2 * noise) * rng.standard_normal(3)
        mean = p.mean + moved * rng.standard_normal(3)
        creep = slope if moved else np.zeros(3)
        out.append(replace(p, mean=mean, slope=slope, slope_error=2 * noise + 0.3 * moved, creep=creep))
    return out


def made(kind: str, seed: int, n: int, noise_g: float, size_g: float) -> list[Pose]:
    rng = np.random.default_rng(seed)
    warm = {"temp_c": 25 + 3 * np.cumsum(rng.standard_normal(n)) / np.sqrt(n)}
    poses = noisy_poses(UNIT, up(kind, n, rng), noise_g, rng, channels=warm)
    return restless(poses, rng, 0.3, size_g)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise_g", [1e-6, 1e-4, 3e-3])
@pytest.mark.parametrize("kind", ["half a sphere", "a cap", "few attitudes", "near a plane", "each four times"])
def test_there_is_always_an_answer(kind: str, noise_g: float, seed: int) -> None:
    poses = made(kind, seed, 24, noise_g, 0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            loop = diagnose(poses)
        except Refused:
            return
        assert np.isfinite([action.information for action in loop.advice.actions]).all()
        assert np.isfinite(loop.after.covariance).all()
        assert (np.diag(loop.after.covariance) >= 0).all()
        assert np.isfinite(loop.next_recording.expanded_uncertainty)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_on_half_a_sphere_fit_and_diagnosis_state_alike_errors(seed: int) -> None:
    poses = made("half a sphere", seed, 120, 3e-3, 0.01)
    loop = diagnose(poses)
    by_fit, by_diagnosis = (float(budget(c).magnitude.standard) for c in (fit(poses), loop.after))
    assert 1 / 3 < by_diagnosis / by_fit < 3
    assert loop.found.unexplained.rms_g < 0.03


def test_misfits_do_not_choose_what_explains_them() -> None:
    """A constant is no more than nine parameters make of it, whatever each pose is off; on half a sphere, where
    functions of direction show little else, none may be certain by that."""
    rng = np.random.default_rng(8)
    poses = noisy_poses(UNIT, up("half a sphere", 60, rng), 5e-3, rng)
    posterior = posterior_of(poses, fit(poses))
    assert posterior.unmodelled_probability < 0.5
    assert max(posterior.effect_probabilities.values(), default=0.0) < 0.5
