"""Verification by physics: |a| in check poses, from the device's own corrected output."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.poses.pose import Pose
from triaxcald.documents import Document, error, number, uncertainty


@dataclass(frozen=True)
class Verification:
    """Errors of the magnitude that the device itself reports, (n,) in g, and their standard errors from noise."""

    poses: list[Pose]
    error_g: Floats
    standard_error_g: Floats

    @property
    def rms_g(self) -> float | None:
        return _rms(self.error_g)

    @property
    def noise_floor_g(self) -> float | None:
        return _rms(self.standard_error_g)


def verify(poses: list[Pose], reference: float) -> Verification:
    """``poses`` of the corrected stream, in units of the reference vector."""
    if not poses:
        return Verification([], np.zeros(0), np.zeros(0))
    a = np.array([p.mean for p in poses])
    length = np.linalg.norm(a, axis=1)
    n = a / np.maximum(length[:, None], 1e-300)
    covariance = np.array([p.covariance for p in poses])
    return Verification(list(poses), length - reference, np.sqrt(np.einsum("ni,nij,nj->n", n, covariance, n)))


def _rms(values: Floats) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def verification_document(
    before: Verification, after: Verification, *, limit_g: float | None, raw_sha256: str
) -> Document:
    """``before``: the device's output with its old registers; ``after``: with the new ones, after a power cycle."""
    rms = after.rms_g
    within = None if limit_g is None else rms is not None and rms <= limit_g
    return {
        "format": "triaxcal.verification/1",
        "raw_sha256": raw_sha256,
        "before_rms_g": error(before.rms_g),
        "after_rms_g": error(rms),
        "after_max_abs_g": error(float(np.max(np.abs(after.error_g)))) if len(after.error_g) else None,
        "noise_floor_g": error(after.noise_floor_g),
        "limit_rms_g": number(limit_g),
        "verdict": "not judged" if within is None else "within limits" if within else "outside limits",
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "error_g": error(float(e)),
                "standard_error_g": uncertainty(float(s)),
            }
            for p, e, s in zip(after.poses, after.error_g, after.standard_error_g, strict=True)
        ],
    }
