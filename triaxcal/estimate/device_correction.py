"""The coefficients of a device's own correction that follow a calibration as nearly
as its registers allow.

A device with fewer registers than a calibration has parameters makes a wrong
magnitude even with the best values in them. The fit minimises the rms of
``|y| / output_per_g − reference`` over the sphere and the temperatures of the poses,
starting at what the device holds; coefficients without a register keep their value,
and so does what |a| does not show, a rotation of the whole matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.effects import effect_of
from triaxcal.effects.contract import Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import COVARIATES, Calibration, Reduced, projected, readings_in_use
from triaxcal.model.correction import DIAGONAL, OFFSETS, LinearCorrection
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose

TEMPERATURE = "temp_c"
THERMAL_SPAN_K = 2.0
"""Coefficients of temperature keep their values where the poses span less: one that
is fitted to so little extrapolates the noise to the temperatures of use."""
STEPS_MOST = 50
"""Of Gauss and Newton. From a blank device, whose scale factors are wrong by a tenth,
it takes six."""
CONVERGED = 1e-12
"""Of the rms, relative to the reference."""


@dataclass(frozen=True)
class DeviceCorrection:
    """``correction`` has the values for the registers ``free``, before rounding;
    ``held`` is what the device had. All errors are of |a| in the unit of the
    reference, over the sphere and the temperatures of the poses: ``left_rms`` and
    ``left_largest`` remain because of coefficients that have no register, ``own_rms``
    is the error under ``held``. ``uncertainty`` is the standard one of |a| from
    the covariance of the calibration. ``equivalent`` makes the same |a| as the
    correction, up to the order of a coefficient's square."""

    correction: LinearCorrection
    held: LinearCorrection
    free: tuple[str, ...]
    left_rms: float
    left_largest: float
    own_rms: float
    uncertainty: float
    reference: float
    equivalent: Reduced
    u: Floats
    temperature_c: Floats

    def rounding_rms(self, rounded: LinearCorrection) -> float:
        """rms change of |a| over the sphere by rounding the coefficients to
        ``rounded``."""
        exact = self.correction.magnitude(self.u, self.temperature_c)
        return rms(rounded.magnitude(self.u, self.temperature_c) - exact)

    def predicted_rms(self, rounded: LinearCorrection) -> float:
        """The device's error of |a| with the rounded coefficients: what remains over
        the sphere, and the uncertainty of the calibration."""
        off = rounded.magnitude(self.u, self.temperature_c) - self.reference
        return float(np.hypot(rms(off), self.uncertainty))

    def better(self, rounded: LinearCorrection) -> bool:
        """Whether the rounded coefficients beat those that the device holds by more
        than the prediction can be wrong."""
        return self.predicted_rms(rounded) + self.uncertainty < self.own_rms


def device_correction(
    c: Calibration,
    held: LinearCorrection,
    free: Sequence[str],
    logged: Mapping[str, Floats] | None = None,
) -> DeviceCorrection:
    """The correction nearest to the calibration ``c`` of u that a device can hold.
    ``free`` are the coefficients that have a register. ``logged`` as in
    `triaxcal.estimate.reduced`.

    Raises Refused if no correction of this kind follows |a| at all: the device does
    something else with its registers."""
    u, covariates, temperature_c = _in_use(c, logged or {})
    names = _determined(free, temperature_c)
    # Gauss–Newton from the values that are held; steps of least norm leave what |a|
    # does not show as it is.
    best, off = held, held.magnitude(u, temperature_c) - c.reference
    for _ in range(STEPS_MOST):
        step = -_gain(best.by_coefficients(names, u, temperature_c)) @ off
        best, off, before = _shortened(best, names, step, u, temperature_c, c.reference, off)
        if before - rms(off) <= CONVERGED * c.reference:
            break
    if not np.isfinite(off).all() or rms(off) > c.reference / 2:
        raise Refused("no values of the device's registers make its output follow gravity: does its profile say "
                      "what it does with them? See [correction]")  # fmt: skip
    # What an error of the calibration becomes in the coefficients, and in |a|.
    by_free = best.by_coefficients(names, u, temperature_c)
    through = _gain(by_free) @ c.sensor.radius_by_parameters(u, covariates)
    of_magnitude = by_free @ through
    variance = np.einsum("np,pq,nq->n", of_magnitude, c.covariance, of_magnitude, optimize=True)
    return DeviceCorrection(
        correction=best,
        held=held,
        free=tuple(free),
        left_rms=rms(off),
        left_largest=float(np.max(np.abs(off))),
        own_rms=rms(held.magnitude(u, temperature_c) - c.reference),
        uncertainty=float(np.sqrt(max(float(np.mean(variance)), 0.0))),
        reference=c.reference,
        equivalent=_equivalent(c, best, u, covariates, of_magnitude, rms(off)),
        u=u,
        temperature_c=temperature_c,
    )


def uncorrected(poses: Sequence[Pose], held: LinearCorrection) -> list[Pose]:
    """Poses of y as poses of u, the reading before the correction ``held``. Raises
    Refused where the output does not tell the reading, or the correction depends on
    the temperature and that was not logged."""
    if held.thermal and any(TEMPERATURE not in p.channels for p in poses):
        raise Refused(
            f"the device corrects by temperature, and the readings have no channel {TEMPERATURE}: its correction "
            "cannot be removed from them"
        )
    found: list[Pose] = []
    for p in poses:
        t = np.array([p.channels.get(TEMPERATURE, held.reference_c)])
        (mean,), (by_y,) = held.before(p.mean[None], t)
        length = np.linalg.norm(by_y @ p.mean) / max(float(np.linalg.norm(p.mean)), 1e-300)
        # The pose before had about the same temperature.
        previous = None if p.before is None else held.before(p.before[None], t)[0][0]
        found.append(
            replace(
                p,
                mean=mean,
                covariance=by_y @ p.covariance @ by_y.T,
                creep=by_y @ p.creep,
                slope=by_y @ p.slope,
                slope_error=p.slope_error * float(length),
                before=previous,
                scatter=(by_y**2) @ p.scatter,
            )
        )
    return found


def _in_use(c: Calibration, logged: Mapping[str, Floats]) -> tuple[Floats, Mapping[str, Floats], Floats]:
    """Readings u (n,3) of the calibrated sensor all over the sphere, their covariates,
    and their temperatures (n,) in °C; those are 0 where nobody logged them."""
    up, covariates = readings_in_use(c, logged)
    poses = [p.pose for p in c.poses if p.used]
    if TEMPERATURE in covariates:
        temperature_c = covariates[TEMPERATURE] + c.channel_reference[TEMPERATURE]
    elif poses and all(TEMPERATURE in p.channels for p in poses):
        # The sensor does not depend on it; the device's correction may.
        sorted_c = np.sort([p.channels[TEMPERATURE] for p in poses])
        some = sorted_c[np.linspace(0, len(poses) - 1, COVARIATES).astype(int)]
        up, temperature_c = np.tile(up, (len(some), 1)), np.repeat(some, len(up))
        covariates = {name: np.tile(values, len(some)) for name, values in covariates.items()}
    else:
        temperature_c = np.full(len(up), float(np.mean(logged[TEMPERATURE])) if TEMPERATURE in logged else 0.0)
    return c.sensor.output(up, covariates), covariates, temperature_c


def _determined(free: Sequence[str], temperature_c: Floats) -> tuple[str, ...]:
    """The free coefficients that the temperatures can tell."""
    wide = float(np.ptp(temperature_c)) >= THERMAL_SPAN_K
    return tuple(name for name in free if wide or not name.endswith((".t1", ".t2")))


def _shortened(
    at: LinearCorrection, names: tuple[str, ...], step: Floats, u: Floats, temperature_c: Floats,
    reference: float, off: Floats,
) -> tuple[LinearCorrection, Floats, float]:  # fmt: skip
    """The step, halved until it improves the rms; with the errors after it, and the
    rms before."""
    before = rms(off)
    for _ in range(20):
        moved = at.moved(names, step)
        after = moved.magnitude(u, temperature_c) - reference
        if rms(after) < before:
            return moved, after, before
        step = step / 2
    return at, off, before


def _gain(by_coefficients: Floats) -> Floats:
    # Pseudo-inverse with columns of length one.
    size = np.maximum(np.linalg.norm(by_coefficients, axis=0), 1e-300)
    return np.asarray(np.linalg.pinv(by_coefficients / size, rcond=1e-9) / size[:, None])


def _equivalent(
    c: Calibration, found: LinearCorrection, u: Floats, covariates: Mapping[str, Floats], of_magnitude: Floats,
    left: float,
) -> Reduced:  # fmt: skip
    """A calibration with a sensor that makes the same |a| as the correction."""
    at_c = c.channel_reference.get(TEMPERATURE, found.reference_c)
    (matrix,), (offset,) = found.of(np.array([at_c]))
    a_by_u = matrix / found.output_per_g
    centre = np.linalg.solve(matrix, offset) if found.after else offset
    # |A (u − c)| = |U (u − c)| with A = Q U, U upper triangular; its signs are those of
    # the scale factors.
    _, upper = np.linalg.qr(a_by_u)
    upper = np.sign(np.diag(upper) * c.sensor.scale_factor)[:, None] * upper
    u_by_a = np.linalg.inv(upper)
    k = np.diag(u_by_a).copy()
    axes = u_by_a / k[:, None]
    effects = _thermal_effects(found, at_c, k) if TEMPERATURE in c.channel_reference else ()
    sensor = Sensor(k, np.array([axes[1, 2], axes[0, 2], axes[0, 1]]), centre / k, effects)
    through = _gain(sensor.radius_by_parameters(u, covariates)) @ of_magnitude
    return Reduced(projected(c, sensor, through, u, covariates), left)


def _thermal_effects(found: LinearCorrection, at_c: float, k: Floats) -> tuple[tuple[Effect, Floats], ...]:
    """What the device corrects by temperature, as effects of the sensor."""
    dt = at_c - found.reference_c
    first = np.array([found.values.get(f"{n}.t1", 0.0) + 2 * dt * found.values.get(f"{n}.t2", 0.0) for n in OFFSETS])
    second = np.array([found.values.get(f"{n}.t2", 0.0) for n in OFFSETS])
    diagonal = np.array([found.values.get(n, 0.0) for n in DIAGONAL])
    slope = np.array([found.values.get(f"{n}.t1", 0.0) for n in DIAGONAL])
    if found.after:  # the offset is in units of y
        first, second = first / diagonal, second / diagonal
    bias = {axis: float(v) for axis, v in zip("xyz", first / k, strict=True)}
    bend = {f"quadratic_{axis}": float(v) for axis, v in zip("xyz", second / k, strict=True)}
    scale = {axis: float(v) for axis, v in zip("xyz", -slope / diagonal, strict=True)}
    effects = []
    if any(bend.values()):
        effects.append(effect_of("temperature_bias_quadratic", {f"linear_{a}": v for a, v in bias.items()} | bend))
    elif any(bias.values()):
        effects.append(effect_of("temperature_bias", bias))
    if any(scale.values()):
        effects.append(effect_of("temperature_scale_factor", scale))
    return tuple(effects)
