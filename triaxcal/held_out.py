"""Errors of the magnitude in poses of another recording, which no fit saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration
from triaxcal.conditions import conditions_elsewhere
from triaxcal.creep import with_creep_left
from triaxcal.errors import InvalidData
from triaxcal.figures import micro_g
from triaxcal.poses.pose import Pose
from triaxcal.search import NEAR, deviance
from triaxcal.sensor import Sensor


@dataclass(frozen=True)
class HeldOut:
    """In g."""

    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float
    """What the noise of these poses leaves, with so much of their creep as the extended model does not explain."""
    poses: int
    instead: Mapping[str, float] = field(default_factory=dict)
    """``after_rms_g`` with an alternative in the place of its finding, by name."""
    better: tuple[str, ...] = ()
    """The alternatives whose errors are clearly smaller, as far as these are near the smallest, that first."""
    none_better: bool = False
    """Whether the model before does clearly better than that after, and no alternative better than it."""


def held_out(
    before: Calibration, after: Calibration, check: Sequence[Pose], instead: Mapping[str, Calibration]
) -> HeldOut:
    """``instead`` are the models with an alternative in the place of its finding, by name. Raises InvalidData where
    there is no check pose, or where these lack a channel that the effects need.
    """
    if not check:
        raise InvalidData("the check recording has no still pose")
    try:
        first, last = _errors(before, check), _errors(after, with_creep_left(check, after, elsewhere=True))
    except InvalidData as e:
        raise InvalidData(f"the check recording: {e}") from e
    errors = {}
    for name, model in instead.items():
        try:
            errors[name] = _errors(model, with_creep_left(check, model, elsewhere=True))
        except InvalidData:  # a channel is not logged there
            continue
    rms = {name: _rms(miss) for name, (miss, _) in errors.items()}
    misfit = {name: _deviance(*found) for name, found in errors.items()}
    most = min([_deviance(*last), *(m + 2 * NEAR for m in misfit.values())]) - NEAR  # near the best, far from the last
    linear = _deviance(first[0], last[1])
    none_better = linear < min([_deviance(*last) - NEAR, *misfit.values()]) and _rms(first[0]) < _rms(last[0])
    better = [] if none_better else sorted((n for n, m in misfit.items() if m < most), key=lambda n: rms[n])
    return HeldOut(_rms(first[0]), _rms(last[0]), _rms(last[1]), len(check), rms, tuple(better), none_better)


def better_of(held: HeldOut | None) -> list[str]:
    """Advice where the check recording speaks for an alternative, or for no effect at all."""
    if held is not None and held.none_better:
        return [
            f"in the check recording no effect does better than the linear model ({micro_g(held.before_rms_g)}, with "
            f"what was found {micro_g(held.after_rms_g)}): diagnose both recordings together"
        ]
    if held is None or not held.better:
        return []
    named = " or ".join(f"{name} ({micro_g(held.instead[name])})" for name in held.better)
    return [
        f"the check recording speaks for {named} rather than what is in the model ({micro_g(held.after_rms_g)}): "
        "diagnose both recordings together"
    ]


def magnitude_errors(
    sensor: Sensor,
    poses: Sequence[Pose],
    *,
    channel_reference: Mapping[str, float],
    reference: float,
    moment: tuple[float, float] | None = None,
) -> tuple[Floats, Floats]:
    """|a| − reference (n,) of poses under a sensor's model, and its standard error (n,) from their noise.

    The poses are of another recording than the model's, whose clock is its own: effects of time count as at one
    ``moment`` (`triaxcal.conditions.of_moment`). Raises InvalidData where a channel that the effects need is missing.
    """
    u = np.array([p.mean for p in poses])
    held = conditions_elsewhere(poses, channel_reference, sensor.scale_factor, sensor.bias, moment)
    length, by_u = sensor.magnitude(u, held)
    covariance = np.array([p.covariance for p in poses])
    return length - reference, np.sqrt(np.einsum("ni,nij,nj->n", by_u, covariance, by_u))


def _errors(c: Calibration, poses: Sequence[Pose]) -> tuple[Floats, Floats]:
    return magnitude_errors(
        c.sensor, poses, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
    )


def _deviance(miss: Floats, error: Floats) -> float:
    return float(deviance(np.array(np.sum((miss / error) ** 2)), len(miss)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
