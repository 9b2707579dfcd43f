"""The corrected calibration: the model average as a calibration, with the residuals
of the poses under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.effects.empirical import Empirical
from triaxcal.estimate.calibration import (
    BirgeRatio,
    Calibration,
    ExcessVariance,
    ReferenceEpoch,
    Residual,
    ResidualsTooSmall,
)
from triaxcal.estimate.fit_assessment import too_small
from triaxcal.estimate.likelihood import State, linearise
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.mixture import components
from triaxcal.evidence.model_average import Average, Refusal, least_loss
from triaxcal.evidence.posterior import Posterior, shapes_of
from triaxcal.poses.degrees_of_freedom import lack_of_fit_p, within_pose_dof
from triaxcal.uncertainty.propagation import extrapolated, gain_given_prior


def corrected(before: Calibration, posterior: Posterior, at: ReferenceEpoch) -> tuple[Calibration, Refusal | None]:
    """The calibration with the likely effects at their mean coefficients, and the
    reason for no effects in it. ``before`` is the linear calibration of all given
    poses: where no effect is corrected (`least_loss`), it stays, with the errors from
    all likely sets."""
    model_average, refused = least_loss(posterior, at, before.sensor, components(posterior))
    rows = posterior.evidence.rows
    needed = dict.fromkeys(name for effect, _ in model_average.sensor.effects for name in effect.needs)
    after = replace(
        before,
        sensor=model_average.sensor,
        covariance=model_average.covariance,
        thermal=model_average.thermal,
        prior_sd=model_average.prior_sd,
        weights=model_average.weights,
        unmodelled=model_average.unmodelled,
        shape_errors=_shape_errors(posterior, model_average),
        channel_reference={name: rows.problem.channel_reference[name] for name in needed},
        birge_ratio=1.0,
        excess_g=0.0,
        dof=rows.noise.students_dof + rows.residual_dof,
        slopes=rows.slopes,
        # What residuals show beyond noise is in the covariance, by the
        # probability of whatever may have made it.
        cautions=tuple(c for c in before.cautions if not isinstance(c, BirgeRatio | ExcessVariance)),
        holds_at=at,
        linear_only=before if model_average.sensor.effects else None,
    )
    if not model_average.sensor.effects:
        return after, refused
    beyond = extrapolated(after)
    after = after if beyond is None else replace(after, cautions=(*after.cautions, beyond))
    after = _with_residuals(after, rows, model_average)
    others = (c for c in after.cautions if not isinstance(c, ResidualsTooSmall))
    return replace(after, cautions=(*others, *too_small(after.residual))), refused


def _shape_errors(posterior: Posterior, model_average: Average) -> dict[str, float]:
    """Errors of the shapes in the calibration, about the posterior means."""
    out = {}
    for effect, _ in model_average.sensor.effects:
        for name, shape in shapes_of(posterior, effect.name).items():
            if shape.standard_error is not None:
                off = shape.value - effect.shape[name][0]
                out[f"{effect.name}.{name}"] = float(np.hypot(shape.standard_error, off))
    return out


def _with_residuals(c: Calibration, rows: LinearisedData, model_average: Average) -> Calibration:
    """Residuals in the recording's own poses, at their own times; NaN for faulty
    poses that lack a channel."""
    logged = set.intersection(*(set(p.pose.channels) for p in c.poses if p.used))
    known = [i for i, p in enumerate(c.poses) if logged <= set(p.pose.channels)]
    nan = float("nan")
    unknown = (i for i in range(len(c.poses)) if i not in known)
    rest = {i: replace(c.poses[i], residual_g=nan, studentized=nan, total_standard_error_g=None) for i in unknown}
    found = _with_known_residuals(replace(c, poses=tuple(c.poses[i] for i in known)), rows, model_average, known)
    both = dict(zip(known, found.poses, strict=True)) | rest
    return replace(found, poses=tuple(both[i] for i in range(len(c.poses))))


def _with_known_residuals(
    c: Calibration, rows: LinearisedData, model_average: Average, places: list[int]
) -> Calibration:
    poses = [p.pose for p in c.poses]
    u, covariates = np.array([p.mean for p in poses]), c.covariates_of(poses)
    length, by_u = c.sensor.magnitude(u, covariates)
    direction = c.sensor.up(u, covariates)
    r = length - c.reference
    error = np.sqrt(np.einsum("ni,nij,nj->n", by_u, np.array([p.covariance for p in poses]), by_u))
    leverage = np.zeros(len(poses))
    of_place = {place: i for i, place in enumerate(places)}
    used = [k for k, place in enumerate(rows.places) if c.poses[of_place[int(place)]].used]
    of_used = np.array([of_place[int(place)] for place in rows.places[used]])
    leverage[of_used] = _leverage(rows, used, model_average)
    free = np.maximum(1 - leverage, 1e-6)
    results = tuple(
        replace(
            p,
            direction=direction[i],
            residual_g=float(r[i]),
            standard_error_g=float(error[i]),
            studentized=float(r[i] / error[i] / np.sqrt(free[i])),
            leverage=float(leverage[i]),
            total_standard_error_g=None,
        )
        for i, p in enumerate(c.poses)
    )
    if Empirical().name in c.terms:  # whose linear part is a fit of its own: no one knows how much a pose decides
        return replace(c, residual=Residual.of(r[of_used], error[of_used]), poses=results)
    own, noise, left = r[of_used], error[of_used], len(used) - float(leverage.sum())
    pure = within_pose_dof([poses[i] for i in of_used])
    residual = Residual.of(
        own,
        noise,
        cross_validated_rms_g=rms(own / free[of_used]),
        lack_of_fit_p=lack_of_fit_p(float(np.sum((own / noise) ** 2)), left, pure),
        left=left,
    )
    return replace(c, residual=residual, poses=results)


def _leverage(rows: LinearisedData, used: list[int], model_average: Average) -> Floats:
    """(n,) leverage of those poses, with the priors of the coefficients."""
    problem = replace(rows.problem.only(np.array(used)), slopes=None)
    _, J, error = linearise(problem, State.of(problem, model_average.sensor))
    weighted = J / error[:, None]
    return np.asarray(
        np.clip(np.einsum("np,pn->n", weighted, gain_given_prior(weighted, model_average.prior_sd)), 0.0, 1.0)
    )
