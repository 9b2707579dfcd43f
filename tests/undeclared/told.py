"""What a fit that was told the effect makes of held-out poses, by its own algebra: nobody can do better."""

from __future__ import annotations

import numpy as np

from tests.undeclared.generator import Recording, Take, along, true_errors
from tests.undeclared.scene import Triad
from tests.undeclared.visible import Linear


def told_errors_g(recording: Recording) -> tuple[float, float]:
    """Rms of |a| − 1 in the held-out poses: of nine parameters where noise is all there is, and of the fit whose model
    has the effects with their shape known, coefficients free. To first order, weights by the true errors.
    """
    r = recording
    linear = [_linear(r, take) for take in (r.take, r.held_out)]
    noise = [along(t.scene.by_pose(t.noise_g), t.scene, r.triad) for t in (r.take, r.held_out)]
    nine = [part.jacobian for part in linear]
    told = [np.concatenate([nine[i], _columns(r, i)], axis=1) for i in range(2)]
    return (
        _error(r, nine, noise, linear[0].error),
        _error(r, told, noise, linear[0].error),
    )


def rms_g(recording: Recording, miss: np.ndarray) -> float:
    """Of misses of |a| (m,) in held-out poses. Where the effect is one of the recording, another recording begins with
    a bias of its own, which no calibration can know: then of what the best three biases leave.
    """
    if any(e.of_recording for e in recording.effects):
        basis = np.linalg.qr(biases(recording.triad, recording.held_out))[0]
        miss = miss - basis @ (basis.T @ miss)
    return float(np.sqrt(np.mean(miss**2)))


def biases(triad: Triad, take: Take) -> np.ndarray:
    """(m,3) by how much |a| goes with the bias of each axis."""
    return take.scene.up @ np.linalg.inv(triad.axes)


def _linear(r: Recording, take: Take) -> Linear:
    return Linear.of(r.triad, r.triad.outputs(take.scene.pose_force), true_errors(r.triad, take.scene, r.noise))


def _columns(r: Recording, held_out: int) -> np.ndarray:
    take = (r.take, r.held_out)[held_out]
    parts = []
    for e in r.effects:
        by_pose = along(take.scene.by_pose(e.columns(take.scene)), take.scene, r.triad)
        parts.append(np.zeros_like(by_pose) if held_out and e.of_recording else by_pose)
    return np.concatenate(parts, axis=1) if parts else np.zeros((take.scene.poses, 0))


def _error(r: Recording, design: list[np.ndarray], noise: list[np.ndarray], error: np.ndarray) -> float:
    size = np.maximum(np.linalg.norm(design[0], axis=0), 1e-300)
    weighted = design[0] / size / error[:, None]
    moved = np.linalg.pinv(weighted, rcond=1e-9) @ (noise[0] / error) / size
    return rms_g(r, noise[1] - design[1] @ moved)
