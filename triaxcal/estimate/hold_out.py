"""Errors of the magnitude in poses of another recording, which no fit saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.pose import Pose

CLEARLY = 2.0
"""Standard errors of the mean difference of the squared errors: a limit that chance
exceeds in one recording of forty."""


class Contradiction(StrEnum):
    UNCERTAINTY = "uncertainty"
    """The error is larger than the uncertainty that was stated."""
    CORRECTION = "correction"
    """The linear calibration is better than the one with effects."""


@dataclass(frozen=True)
class HoldOut:
    """Errors of |a| in the poses of another recording, in the unit of the
    reference."""

    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float
    """Noise of these poses, with that part of their creep which the extended model
    does not explain."""
    poses: int
    worse: bool = False
    """Whether the linear calibration is clearly better in these poses."""

    def contradicts(self, another_day: float) -> Contradiction | None:
        """The statement of the calibration that these poses contradict, or None;
        ``another_day`` is its expanded uncertainty on another day."""
        # An rms is compared with an expanded uncertainty, which is two standard ones.
        if np.sqrt(max(self.after_rms_g**2 - self.noise_floor_g**2, 0.0)) > another_day:
            return Contradiction.UNCERTAINTY
        return Contradiction.CORRECTION if self.worse else None


def held_out(before: Calibration, after: Calibration, check: Sequence[Pose]) -> HoldOut:
    """Compare both calibrations in the ``check`` poses. Raises InvalidData where
    there is no check pose, or where these lack a channel that the effects need."""
    if not check:
        raise InvalidData("the check recording has no still pose")
    try:
        first, last = _errors(before, check), _errors(after, with_unexplained_creep(check, after, elsewhere=True))
    except InvalidData as e:
        raise InvalidData(f"the check recording: {e}") from e
    # Paired comparison: mean difference of the squared errors over its standard error.
    more = last[0] ** 2 - first[0] ** 2
    worse = len(more) > 1 and float(more.mean()) > CLEARLY * float(more.std(ddof=1)) / np.sqrt(len(more))
    return HoldOut(rms(first[0]), rms(last[0]), rms(last[1]), len(check), bool(worse))


def magnitude_errors(
    sensor: Sensor,
    poses: Sequence[Pose],
    *,
    channel_reference: Mapping[str, float],
    reference: float,
    moment: tuple[float, float] | None = None,
) -> tuple[Floats, Floats]:
    """|a| − reference (n,) of poses under a sensor's model, and its standard error
    (n,) from their noise √(gᵀ Σ g).

    The poses are of another recording than the model's, whose clock is its own:
    effects of time are evaluated at one ``moment``
    (`triaxcal.poses.covariates.of_moment`). Raises InvalidData where a channel that
    the effects need is missing.
    """
    u = np.array([p.mean for p in poses])
    covariates = covariates_elsewhere(poses, channel_reference, sensor.scale_factor, sensor.bias, moment)
    length, by_u = sensor.magnitude(u, covariates)
    covariance = np.array([p.covariance for p in poses])
    return length - reference, np.sqrt(np.einsum("ni,nij,nj->n", by_u, covariance, by_u))


def _errors(c: Calibration, poses: Sequence[Pose]) -> tuple[Floats, Floats]:
    return magnitude_errors(
        c.sensor, poses, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
    )
