"""Poses of which only the means are known, as in publications and from old test
benches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.pose import Pose

NOISE_FIRST = 1e-4
"""Initial noise as a share of the outputs' size, far below the change by
orientation."""
ROUNDS, SETTLED = 10, 0.05
"""The noise is estimated until it changes by a smaller share; two or three rounds
suffice."""


def poses_of_means(
    u: Floats,
    t_s: Floats | None = None,
    standard_errors: Floats | None = None,
    channels: Mapping[str, Floats] | None = None,
) -> list[Pose]:
    """One pose a row: ``u`` (n,3) means in output units, ``t_s`` (n,) times in
    seconds (one pose a second where not given), ``standard_errors`` (n,3) of the
    means in output units.

    Without standard errors the noise is the residual of the linear model, equal on
    all axes, with the degrees of freedom of the fit. Then no lack of fit can show,
    and an effect shows only against the other poses. Raises Refused where no degree
    of freedom is left, InvalidData for bad standard errors.
    """
    n = len(u)
    if standard_errors is not None and not (np.isfinite(standard_errors).all() and (standard_errors > 0).all()):
        raise InvalidData("standard errors of pose means have to be positive")
    size = float(np.sqrt(np.mean(u**2))) if n else 0.0
    variances = np.full((n, 3), (NOISE_FIRST * size) ** 2) if standard_errors is None else standard_errors**2
    times = np.arange(n, dtype=float) if t_s is None else t_s - t_s[:1]
    poses = [
        Pose(
            float(times[i]),
            float(times[i]),
            1,
            u[i],
            np.diag(variances[i]),
            float("inf"),
            channels={name: float(values[i]) for name, values in (channels or {}).items()},
            before=None if i == 0 else u[i - 1],
        )
        for i in range(n)
    ]
    return poses if standard_errors is not None else _with_noise_of_residuals(poses)


def _with_noise_of_residuals(poses: Sequence[Pose]) -> list[Pose]:
    if len(poses) <= LINEAR:
        raise Refused(
            f"{len(poses)} pose means without standard errors: nine parameters leave nothing to tell the noise by; "
            f"{LINEAR + 1} or more are needed"
        )
    # Alternate: fit with the present noise, then estimate it from the residuals as σ² =
    # Σ r² k² / (n − 9).
    before = 0.0
    for _ in range(ROUNDS):
        found = fit(poses)
        used = sum(p.excluded is None for p in found.poses)
        if used <= LINEAR:
            raise Refused(f"{used} pose means that agree leave nothing to tell the noise by")
        gain = float(np.sqrt(np.mean(found.sensor.scale_factor**2)))
        variance = (found.residual.rms_g * gain) ** 2 * used / (used - LINEAR)
        left = float(used - LINEAR)
        poses = [replace(p, covariance=variance * np.eye(3), dof=left, shared_dof=left) for p in poses]
        if abs(np.sqrt(variance) - before) < SETTLED * before:
            break
        before = float(np.sqrt(variance))
    return list(poses)
