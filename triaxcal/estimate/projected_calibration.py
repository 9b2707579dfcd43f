"""The correction of a calibration, as nearly as a device can hold it that knows
fewer effects.

A device corrects by its registers alone. So what it holds is the whole
correction at the moment for which that holds, projected onto its own terms:
what an effect that it lacks does over the sphere goes into the nine parameters
and the effects that it has, as far as these can take it.
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
"""Of Gauss and Newton, from parameters that are right to a few parts in a
thousand."""


@dataclass(frozen=True)
class Reduced:
    """``calibration`` has the kept effects alone; ``cost`` is the rms of what
    |a| then differs from the whole correction over the sphere and the
    covariates of the poses, in the unit of the reference."""

    calibration: Calibration
    cost: float


def reduced(c: Calibration, keep: Callable[[Effect], bool], logged: Mapping[str, Floats] | None = None) -> Reduced:
    """Nine parameters and the effects that ``keep`` says of; the same
    calibration where that is all of them.

    ``logged`` are channels as they were in the poses, (n,) each, where the
    calibration has no poses of its own."""
    kept = [(effect, q) for effect, q in c.sensor.effects if keep(effect)]
    if len(kept) == len(c.sensor.effects):
        return Reduced(c, 0.0)
    up, covariates = _readings(c, logged or {})
    u = c.sensor.output(up, covariates)
    sensor = Sensor(c.sensor.scale_factor, c.sensor.misalignment, c.sensor.bias, tuple(kept))
    for _ in range(STEPS):
        off = np.linalg.norm(sensor.specific_force(u, covariates), axis=1) - c.reference
        sensor = sensor.moved(-_gain(sensor.radius_by_parameters(u, covariates)) @ off)
    off = np.linalg.norm(sensor.specific_force(u, covariates), axis=1) - c.reference
    # What an error of the whole calibration becomes: the kept parameters follow
    # |a| as nearly as they can.
    through = _gain(sensor.radius_by_parameters(u, covariates)) @ c.sensor.radius_by_parameters(u, covariates)
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
        unmodelled=_beside(c, sensor, through, u, covariates),
        channel_reference={name: v for name, v in c.channel_reference.items() if name in needed},
        update=None if c.update is None else _update(c.update, through),
    )
    return Reduced(_with_residual(calibration) if c.poses else calibration, rms(off))


def _update(update: BiasUpdate, through: Floats) -> BiasUpdate:
    return replace(update, covariances={n: through @ v @ through.T for n, v in update.covariances.items()})


def _beside(c: Calibration, sensor: Sensor, through: Floats, u: Floats, covariates: Mapping[str, Floats]) -> Unmodelled:
    """What is unmodelled of a whole calibration, and by how much components
    across the measured vector then differ from it: no magnitude makes up for
    what they lose."""
    a, _, by_all = c.sensor.specific_force_and_derivatives(u, covariates)
    b, _, by_kept = sensor.specific_force_and_derivatives(u, covariates)
    up = a / np.linalg.norm(a, axis=1, keepdims=True)
    across = np.eye(3) - up[:, :, None] * up[:, None, :]
    off = np.einsum("nij,nj->ni", across, a - b)
    by = across @ (by_all - by_kept @ through)
    square = np.sum(off**2, axis=1) + np.einsum("nip,pq,niq->n", by, c.covariance, by, optimize=True)
    whole = c.unmodelled or Unmodelled(0.0, 0.0)
    return Unmodelled(whole.along, float(np.sqrt(whole.across**2 + max(float(np.mean(square)), 0.0) / 2)))


def _with_residual(c: Calibration) -> Calibration:
    """In the recording's own poses. How well it would do without one of them
    nobody asked."""
    used = [p for p in c.poses if p.used]
    u = np.array([p.pose.mean for p in used])
    off = c.sensor.magnitude(u, c.covariates_of([p.pose for p in used]))[0] - c.reference
    largest, floor = float(np.max(np.abs(off))), c.residual.noise_floor_g
    return replace(c, residual=Residual(rms(off), largest, None, floor, None))


def _readings(c: Calibration, logged: Mapping[str, Floats]) -> tuple[Floats, Mapping[str, Floats]]:
    """(m,3) specific forces all over the sphere under the conditions that a
    unit in use meets: logged channels as they were in some of the poses, every
    clock at the moment, everything else at its reference."""
    up = spiral(SPHERE) * c.reference
    in_use = at_moment(c.channel_reference, 1, c.moment)
    poses = [p.pose for p in c.poses if p.used]
    if poses:
        logged = {n: v for n, v in c.covariates_of(poses).items() if not is_derived(n)}
    else:
        logged = {n: np.asarray(v) - c.channel_reference[n] for n, v in logged.items() if n in c.channel_reference}
    by_first = np.argsort(next(iter(logged.values())), kind="stable") if logged else np.zeros(1, dtype=int)
    some = by_first[np.linspace(0, len(by_first) - 1, COVARIATES).astype(int)] if logged else by_first
    covariates = {n: logged[n][some] if n in logged else np.repeat(v, len(some)) for n, v in in_use.items()}
    return np.tile(up, (len(some), 1)), {n: np.repeat(v, len(up)) for n, v in covariates.items()}


def _gain(by_parameters: Floats) -> Floats:
    size = np.maximum(np.linalg.norm(by_parameters, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(by_parameters / size, rcond=1e-9) / size[:, None])
