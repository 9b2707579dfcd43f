"""The projection of a calibration onto the effects that a device can hold.

A device corrects by its registers alone. It holds the whole correction at one
moment, projected onto its own terms: the contribution of an effect that it lacks
over the sphere goes into the nine parameters and the effects that it has, as far
as these can take it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.effects.contract import Effect, is_derived
from triaxcal.estimate.calibration import BiasUpdate, Calibration, Residual, Unmodelled
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import at_moment

SPHERE = 50
"""Directions: an effect of fifth order in the reading has no more than so many
independent values over the sphere."""
COVARIATES = 7
"""Values of the logged channels, from the least to the most: more than any
effect has coefficients for them."""
STEPS = 4
"""Gauss–Newton steps, from parameters that are right to a few parts in a
thousand."""


@dataclass(frozen=True)
class Reduced:
    """``calibration`` has the kept effects alone; ``cost`` is the rms difference
    of |a| from the whole correction over the sphere and the covariates of the
    poses, in the unit of the reference."""

    calibration: Calibration
    cost: float


def reduced(c: Calibration, keep: Callable[[Effect], bool], logged: Mapping[str, Floats] | None = None) -> Reduced:
    """The nine parameters and the effects for which ``keep`` is true; the same
    calibration where it is true for all.

    ``logged`` are the channels in the poses, (n,) each, for a calibration that
    has no poses of its own."""
    kept = [(effect, q) for effect, q in c.sensor.effects if keep(effect)]
    if len(kept) == len(c.sensor.effects):
        return Reduced(c, 0.0)
    # Outputs of the whole sensor all over the sphere, under the covariates of use.
    up, covariates = _readings(c, logged or {})
    u = c.sensor.output(up, covariates)
    sensor = Sensor(c.sensor.scale_factor, c.sensor.misalignment, c.sensor.bias, tuple(kept))
    # Gauss–Newton: fit the kept terms to |a(u)| = reference on these outputs.
    for _ in range(STEPS):
        off = np.linalg.norm(sensor.specific_force(u, covariates), axis=1) - c.reference
        sensor = sensor.moved(-_gain(sensor.radius_by_parameters(u, covariates)) @ off)
    off = np.linalg.norm(sensor.specific_force(u, covariates), axis=1) - c.reference
    # What an error of the whole calibration becomes: the kept parameters follow
    # |a| as nearly as they can.
    through = _gain(sensor.radius_by_parameters(u, covariates)) @ c.sensor.radius_by_parameters(u, covariates)
    # Mask of the parameters that stay: the nine, and those of the kept effects.
    own = np.concatenate([np.ones(9, bool), *(np.full(len(q), keep(e)) for e, q in c.sensor.effects)])
    names = {effect.name for effect, _ in kept}
    needed = {name for effect, _ in kept for name in effect.needs}
    calibration = replace(
        c,
        sensor=sensor,
        covariance=through @ c.covariance @ through.T,
        thermal=None if c.thermal is None else through @ c.thermal @ through.T,
        prior_sd=None if c.prior_sd is None else c.prior_sd[own[9:]],
        weights={name: p for name, p in c.weights.items() if name in names},
        unmodelled=_unmodelled(c, sensor, through, u, covariates),
        channel_reference={name: v for name, v in c.channel_reference.items() if name in needed},
        update=None if c.update is None else _update(c.update, through),
    )
    return Reduced(_with_residual(calibration) if c.poses else calibration, rms(off))


def _update(update: BiasUpdate, through: Floats) -> BiasUpdate:
    return replace(update, covariances={n: through @ v @ through.T for n, v in update.covariances.items()})


def _unmodelled(
    c: Calibration, sensor: Sensor, through: Floats, u: Floats, covariates: Mapping[str, Floats]
) -> Unmodelled:
    """Unmodelled error of the projected calibration: that of the whole one, and
    the difference of the components across the measured vector, which no fit of
    |a| can compensate."""
    a, _, by_all = c.sensor.specific_force_and_derivatives(u, covariates)
    b, _, by_kept = sensor.specific_force_and_derivatives(u, covariates)
    # P = 1 − up upᵀ projects onto the plane across the measured vector.
    up = a / np.linalg.norm(a, axis=1, keepdims=True)
    across = np.eye(3) - up[:, :, None] * up[:, None, :]
    off = np.einsum("nij,nj->ni", across, a - b)
    # Mean square of P (a − b): its value, and its variance P (∂a − ∂b G) C (…)ᵀ.
    by = across @ (by_all - by_kept @ through)
    square = np.sum(off**2, axis=1) + np.einsum("nip,pq,niq->n", by, c.covariance, by, optimize=True)
    whole = c.unmodelled or Unmodelled(0.0, 0.0)
    # Two components lie across the vector: half of the mean square for each.
    return Unmodelled(whole.along, float(np.sqrt(whole.across**2 + max(float(np.mean(square)), 0.0) / 2)))


def _with_residual(c: Calibration) -> Calibration:
    """The residual in the recording's own poses, without cross-validation."""
    used = [p for p in c.poses if p.used]
    u = np.array([p.pose.mean for p in used])
    off = c.sensor.magnitude(u, c.covariates_of([p.pose for p in used]))[0] - c.reference
    largest, floor = float(np.max(np.abs(off))), c.residual.noise_floor_g
    return replace(c, residual=Residual(rms(off), largest, None, floor, None))


def _readings(c: Calibration, logged: Mapping[str, Floats]) -> tuple[Floats, Mapping[str, Floats]]:
    """(m,3) specific forces over the sphere and the covariates of a unit in use:
    logged channels as in some of the poses, clocks at the moment of the
    calibration, other covariates at their reference."""
    up = spiral(SPHERE) * c.reference
    in_use = at_moment(c.channel_reference, 1, c.moment)
    poses = [p.pose for p in c.poses if p.used]
    # Deviations of the logged channels from their reference, pose by pose.
    if poses:
        logged = {n: v for n, v in c.covariates_of(poses).items() if not is_derived(n)}
    else:
        logged = {n: np.asarray(v) - c.channel_reference[n] for n, v in logged.items() if n in c.channel_reference}
    # Sort the poses by the first channel and take a few over its range, so that the
    # channels keep the values that occurred together.
    by_first = np.argsort(next(iter(logged.values())), kind="stable") if logged else np.zeros(1, dtype=int)
    some = by_first[np.linspace(0, len(by_first) - 1, COVARIATES).astype(int)] if logged else by_first
    # Every direction under every set of covariates.
    covariates = {n: logged[n][some] if n in logged else np.repeat(v, len(some)) for n, v in in_use.items()}
    return np.tile(up, (len(some), 1)), {n: np.repeat(v, len(up)) for n, v in covariates.items()}


def _gain(by_parameters: Floats) -> Floats:
    # Pseudo-inverse with columns of length one.
    size = np.maximum(np.linalg.norm(by_parameters, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(by_parameters / size, rcond=1e-9) / size[:, None])
