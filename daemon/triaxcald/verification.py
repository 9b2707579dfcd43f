"""Verification by physics: |a| in check poses, from the device's own corrected
output or under a calibration.

Poses in which the outputs do not follow the acceleration
(`triaxcal.poses.quality`) stay in the documents, marked, and count for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

import triaxcal as tc
from triaxcald.computer import compute_with_one_thread
from triaxcald.raw_to_poses import Pipeline, of_poses
from triaxcald.station.guidance import ups

WITHIN: Final = "within limits"
OUTSIDE: Final = "outside limits"
UNJUDGED: Final = "not judged"
WORSE: Final = "worse than before"
BY_CHANCE = 0.01
UNLIKE = 0.05
"""rms error of the magnitude, as a share of the reference, above which another
unit is likelier than a change of this one: 60 K away, the sensitivities of
mass-market data sheets (`triaxcal.uncertainty`) make 0.035."""


@dataclass(frozen=True)
class Verification:
    """Errors of the magnitude, (n,) in the unit of the reference, and their
    standard errors from noise.

    The figures are over the poses that can be trusted, None where there are
    none. ``data_quality`` is what the stream is to be blamed for, one line
    each.
    """

    poses: Sequence[tc.Pose]
    error_g: tc.Floats
    standard_error_g: tc.Floats
    data_quality: tuple[str, ...] = ()

    @property
    def untrusted(self) -> list[tc.Pose]:
        return [p for p in self.poses if p.fault]

    @property
    def rms_g(self) -> float | None:
        return _rms(self._trusted(self.error_g))

    @property
    def max_abs_g(self) -> float | None:
        values = self._trusted(self.error_g)
        return float(np.max(np.abs(values))) if len(values) else None

    @property
    def noise_floor_g(self) -> float | None:
        return _rms(self._trusted(self.standard_error_g))

    @property
    def expanded_uncertainty_g(self) -> float | None:
        """Of the rms, from the noise of the poses, with a coverage factor of 2.

        An error m measured as e with the standard error s: e² has the variance
        4 m² s² + 2 s⁴, and m² is e² − s² on average.
        """
        rms_g, e, s = self.rms_g, self._trusted(self.error_g), self._trusted(self.standard_error_g)
        if not rms_g:
            return None
        variance = max(float(np.sum(4 * e**2 * s**2 - 2 * s**4)), float(np.sum(2 * s**4)))
        return float(np.sqrt(variance)) / (len(e) * rms_g)

    @property
    def is_finite(self) -> bool:
        """Whether all figures are numbers."""
        with np.errstate(all="ignore"):
            figures = [*self.error_g, *self.standard_error_g, self.rms_g or 0.0, self.noise_floor_g or 0.0]
        return bool(np.isfinite(figures).all())

    def _trusted(self, values: tc.Floats) -> tc.Floats:
        return np.delete(values, [i for i, p in enumerate(self.poses) if p.fault])


def verify(poses: Sequence[tc.Pose], reference: float) -> Verification:
    """``poses`` of the corrected stream, in units of the reference vector."""
    if not poses:
        return Verification([], np.zeros(0), np.zeros(0))
    a = np.array([p.mean for p in poses])
    length = np.linalg.norm(a, axis=1)
    n = a / np.maximum(length[:, None], 1e-300)
    covariance = np.array([p.covariance for p in poses])
    return Verification(poses, length - reference, np.sqrt(np.einsum("ni,nij,nj->n", n, covariance, n)))


@dataclass(frozen=True)
class Apart:
    """``fitted`` (n,3) are the directions of up of the fit's poses; a check
    pose ``apart_deg`` from all of them is in another attitude."""

    fitted: tc.Floats
    apart_deg: float

    def angles_deg(self, poses: Sequence[tc.Pose]) -> tc.Floats:
        """(m,) from each check pose to the nearest of the fit."""
        a = np.array([p.mean for p in poses]).reshape(-1, 3)
        n = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
        cosines: tc.Floats = np.clip(np.max(n @ self.fitted.T, axis=1, initial=-1.0), -1.0, 1.0)
        return np.asarray(np.degrees(np.arccos(cosines)))


def fitted_attitudes(readings: Pipeline, signs: Sequence[int]) -> tc.Floats:
    """(n,3): the directions of up of the poses that a calibration is made of,
    to a degree or so. ``signs`` of the outputs, where the profile has no
    nominal scale factors."""
    output = readings.bundle.profile.output
    nominal = output.nominal_scale_factor
    up = ups(readings.poses(), nominal, output.offsets)
    return up if nominal is not None else up * np.asarray(signs)


def verified(pipeline: Pipeline, reference: float) -> Verification:
    """The whole of a device's own output, with what it is to be blamed for.
    Finishes the ``pipeline``."""
    compute_with_one_thread()
    poses = pipeline.finish()
    quality = pipeline.data_quality() + of_poses(poses, pipeline.output_unit)
    in_g = _per_g(poses, pipeline.bundle.profile.output_per_g)
    return replace(verify(in_g, reference), data_quality=tuple(quality))


def _per_g(poses: list[tc.Pose], output_per_g: float) -> list[tc.Pose]:
    """Poses of a device's own output in g."""
    if output_per_g == 1.0:
        return poses
    return [
        replace(
            p, mean=p.mean / output_per_g, covariance=p.covariance / output_per_g**2,
            scatter=p.scatter / output_per_g**2, creep=p.creep / output_per_g, slope=p.slope / output_per_g,
        )
        for p in poses
    ]  # fmt: skip


def errors_under(poses: Sequence[tc.Pose], model: tc.estimate.Calibration, reference: float) -> Verification:
    """``poses`` of readings under the calibration ``model`` of another recording. The
    errors are not finite where its numbers are absurd. Raises InvalidData if a channel
    that it needs is missing."""
    if not poses:
        return verify(poses, reference)
    with np.errstate(all="ignore"):  # numbers out of a file may be any
        errors, noise = tc.estimate.magnitude_errors(
            model.sensor,
            tc.estimate.with_unexplained_creep(poses, model, elsewhere=True),
            channel_reference=model.channel_reference,
            reference=reference,
            moment=model.moment,
        )
    return Verification(poses, errors, noise)


def under_calibration(pipeline: Pipeline, model: tc.estimate.Calibration, reference: float) -> Verification:
    """The whole of a stream of readings under the calibration ``model``, as `verified`.
    Finishes the ``pipeline``."""
    compute_with_one_thread()
    poses = pipeline.finish()
    quality = pipeline.data_quality() + of_poses(poses, pipeline.output_unit)
    return replace(errors_under(poses, model, reference), data_quality=tuple(quality))


def _rms(values: tc.Floats) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def unlike(name: str, rms_g: float, reference: float, said: str = "does not look like this unit") -> list[str]:
    """A line where the poses of the recording ``name`` can hardly be of the
    unit of the calibration."""
    if not rms_g > UNLIKE * reference:
        return []
    return [
        f"{name} {said}: |a| is off by {tc.number_format.plain(rms_g / reference, 2)} of the reference; "
        "is it another unit, or are signs, order or unit of its outputs others?"
    ]


def trust(pose: tc.Pose) -> dict[str, Any]:
    """Whether a pose counts, as it stands in documents."""
    return {"used": not pose.fault, "fault": pose.fault or None}


def pose_rows(found: Verification, reference: float = 1.0) -> list[tc.interchange.Document]:
    """Pose by pose, the untrusted ones among them."""
    return [
        {
            "start_s": tc.rounding.number(p.start_s),
            "end_s": tc.rounding.number(p.end_s),
            "error_g": tc.rounding.error(float(e), reference),
            "standard_error_g": tc.rounding.uncertainty(float(s)),
            **trust(p),
        }
        for p, e, s in zip(found.poses, found.error_g, found.standard_error_g, strict=True)
    ]


def verdict_by_limit(rms_g: float | None, limit_g: float) -> Literal["within limits", "outside limits"]:
    """On the figure as it is printed."""
    return WITHIN if rms_g is not None and rms_g <= limit_g else OUTSIDE


def _verdict(
    before: Verification, after: Verification, limit_g: float | None
) -> Literal["within limits", "outside limits", "not judged", "worse than before"]:
    if limit_g is not None:
        return verdict_by_limit(tc.rounding.error(after.rms_g), limit_g)
    return WORSE if _is_worse(before, after) else UNJUDGED


def _is_worse(before: Verification, after: Verification) -> bool:
    """Whether errors so much larger would be chance in less than `BY_CHANCE` of
    poses no worse than before (F-test), where noisier poses have more to be
    forgiven."""
    old, new, floor, noise = before.rms_g, after.rms_g, before.noise_floor_g, after.noise_floor_g
    if old is None or new is None or floor is None or noise is None:
        return False
    expected = old**2 + max(noise**2 - floor**2, 0.0)
    count = [len(v.poses) - len(v.untrusted) for v in (after, before)]
    p = tc.rounding.probability(float(tc.distributions.f_sf(new**2 / max(expected, 1e-300), *count)))
    return p is not None and p < BY_CHANCE


def poses_apart(rows: Sequence[tc.interchange.Document], apart_deg: float) -> int:
    """How many check poses that count are so far from all attitudes of the fit,
    by the angles as they are printed."""
    return sum(bool(row["used"]) and row["from_fit_deg"] >= apart_deg for row in rows)


def verification_document(
    before: Verification, after: Verification, *, limit_g: float | None, raw_sha256: str, apart: Apart
) -> tc.interchange.Document:
    """``before``: the device's output with its old registers; ``after``: with
    the new ones, after a restart.
    """
    from triaxcald.schema.verification import CheckPose  # most commands that verify write no such document
    from triaxcald.schema.verification import Verification as CheckDocument

    angles = apart.angles_deg(after.poses)
    rows = [
        row | {"from_fit_deg": tc.rounding.degrees(float(angle))}
        for row, angle in zip(pose_rows(after), angles, strict=True)
    ]
    return CheckDocument(
        format="triaxcal.verification/1",
        raw_sha256=raw_sha256,
        before_rms_g=tc.rounding.error(before.rms_g),
        after_rms_g=tc.rounding.error(after.rms_g),
        after_max_abs_g=tc.rounding.error(after.max_abs_g),
        noise_floor_g=tc.rounding.error(after.noise_floor_g),
        limit_rms_g=tc.rounding.number(limit_g),
        verdict=_verdict(before, after, limit_g),
        poses=[CheckPose.model_validate(row) for row in rows],
        data_quality=list(after.data_quality),
        expanded_uncertainty_g=tc.rounding.uncertainty(after.expanded_uncertainty_g),
        poses_apart=poses_apart(rows, apart.apart_deg),
    ).document()
