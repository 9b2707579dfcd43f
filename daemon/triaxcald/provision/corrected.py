"""Does a device's corrected output follow its own registers? Values alone, no
I/O."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import effect_of
from triaxcal.errors import Refused
from triaxcal.model.sensor import Sensor
from triaxcal_drivers.profile import Profile
from triaxcald.provision.image import REFERENCE_ROLE
from triaxcald.provision.plausible import Doubt
from triaxcald.provision.snapshot import Snapshot

TOLERANCE_G = 0.01
"""Wrong word order, axes, signs or conventions make errors of the size of the
bias at least; rounding, and an order of correction other than ours, make ones
of the size of a product of two small coefficients."""
LEAST = 3
"""So few samples or poses say nothing."""


def sensor_in(profile: Profile, snapshot: Snapshot) -> tuple[Sensor, float] | None:
    """The sensor that the registers describe, and its reference temperature in
    °C; None where they describe none."""
    held = {r.role: profile.decode(n, snapshot.raw[n]) for n, r in profile.registers.items() if n in snapshot.raw}
    linear = [[held.get(f"{name}.{axis}") for axis in "xyz"] for name in ("scale_factor", "misalignment", "bias")]
    if any(value is None or not np.isfinite(value) for values in linear for value in values):
        return None
    scale_factor, misalignment, bias = (np.array(values, dtype=float) for values in linear)
    if not scale_factor.all():
        return None
    effects: dict[str, dict[str, float]] = {}
    for role, value in held.items():
        name, dot, coefficient = (role or "").partition(".")
        if dot and name not in ("scale_factor", "misalignment", "bias"):
            effects.setdefault(name, {})[coefficient] = value
    found = [effect_of(name, values) for name, values in effects.items() if any(values.values())]
    return Sensor(scale_factor, misalignment, bias, tuple(found)), held.get(REFERENCE_ROLE, 0.0)


def departure_g(
    profile: Profile, snapshot: Snapshot, readings: Floats, corrected: Floats, channels: Mapping[str, Floats]
) -> float | None:
    """Median distance in g of the ``corrected`` output (n,3) from what the
    registers make of the ``readings`` (n,3) of the same moments; ``channels``
    (n,) each. None where that cannot be told."""
    if len(readings) < LEAST or (described := sensor_in(profile, snapshot)) is None:
        return None
    sensor, reference_c = described
    covariates = {"temp_c": channels["temp_c"] - reference_c} if "temp_c" in channels else {}
    if any(need not in covariates for effect, _ in sensor.effects for need in effect.needs):
        return None
    try:
        expected = sensor.specific_force(readings, covariates)
    except Refused:
        return None
    return float(np.median(np.linalg.norm(corrected - expected, axis=1)))


def doubt_of_departure(off_g: float | None) -> list[Doubt]:
    if off_g is None or off_g <= TOLERANCE_G:
        return []
    return [Doubt("corrected_output", "", off_g, 0.0, TOLERANCE_G)]
