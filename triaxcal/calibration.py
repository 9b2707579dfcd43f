"""The values that a fit gives: complete, with every reason not to trust them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME
from triaxcal.errors import InvalidData
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor


@dataclass(frozen=True)
class Residual:
    """How well the magnitude comes out, in units of the reference vector (g).

    ``noise_floor_g`` is the rms of the standard errors of the pose means along the measured vector, from the scatter
    inside the poses alone; ``lack_of_fit_p`` the probability of residuals as large as these if the model were
    complete and that noise were all.
    """

    rms_g: float
    max_abs_g: float
    cross_validated_rms_g: float | None
    noise_floor_g: float
    lack_of_fit_p: float | None


@dataclass(frozen=True)
class PoseResult:
    """One pose under the fit. ``direction`` (3,) is up in the sensor's frame; ``residual_g`` is |a| − reference."""

    pose: Pose
    direction: Floats
    residual_g: float
    standard_error_g: float
    studentized: float
    leverage: float
    used: bool = True


@dataclass(frozen=True)
class Calibration:
    """A fitted sensor. ``covariance`` is of `parameters`, in that order.

    ``reference`` is the magnitude of the reference vector; ``channel_reference`` the values from which the effects'
    conditions are counted; ``inflation`` is the factor on the standard errors by which residuals exceed the noise:
    at least 1, unless no pose knows its noise (then the residuals alone set it). ``dof`` are the effective degrees of
    freedom behind the standard errors.
    """

    sensor: Sensor
    covariance: Floats
    reference: float
    channel_reference: Mapping[str, float]
    residual: Residual
    poses: tuple[PoseResult, ...]
    condition: float
    dilution: float
    inflation: float
    dof: float
    blind_to: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def terms(self) -> tuple[str, ...]:
        return ("linear", *(effect.name for effect, _ in self.sensor.effects))

    @property
    def parameters(self) -> tuple[str, ...]:
        linear = [f"{group}.{axis}" for group in ("scale_factor", "misalignment", "bias") for axis in "xyz"]
        return (*linear, *(f"{e.name}.{c.name}" for e, _ in self.sensor.effects for c in e.coefficients))

    @property
    def values(self) -> Floats:
        """Of `parameters`."""
        s = self.sensor
        return np.concatenate([s.scale_factor, s.misalignment, s.bias, *(c for _, c in s.effects)])

    @property
    def standard_errors(self) -> Floats:
        """Of `parameters`."""
        return np.sqrt(np.diag(self.covariance))

    def coverage_factor(self, level: float = 0.95) -> float:
        """By what a standard error is multiplied for an interval that holds the truth with probability ``level``.

        Student's t for `dof`, as JCGM 100, G.3, has it. Raises InvalidData for a level outside 0 to 1.
        """
        if not 0 < level < 1:
            raise InvalidData(f"a level of confidence lies between 0 and 1, not at {level}")
        return float(stats.t.ppf((1 + level) / 2, self.dof))

    def interval(self, level: float = 0.95) -> tuple[Floats, Floats]:
        """Lower and upper ends for `parameters`, each of which holds its truth with probability ``level``."""
        half = self.coverage_factor(level) * self.standard_errors
        return self.values - half, self.values + half

    def specific_force(self, readings: Floats, channels: Mapping[str, Floats]) -> Floats:
        """a (n,3) for readings (n,3) in output units and the channels (n,) that the effects need.

        Raises KeyError for a channel that is not there; time stands under ``t_s``.
        """
        return self.sensor.specific_force(readings, conditions(channels, self.channel_reference))

    def with_blind_to(self, effects: tuple[str, ...]) -> Calibration:
        return replace(self, blind_to=effects)


def conditions(channels: Mapping[str, Floats], reference: Mapping[str, float]) -> dict[str, Floats]:
    """Deviations of the channels from their references; a channel with no reference is left out."""
    return {name: np.asarray(channels[name]) - value for name, value in reference.items() if name in channels}


def channels_of(poses: list[Pose] | tuple[Pose, ...]) -> dict[str, Floats]:
    """The channels' means by pose, (n,) each, with the time of each pose."""
    shared = set.intersection(*(set(p.channels) for p in poses)) if poses else set()
    out = {name: np.array([p.channels[name] for p in poses]) for name in sorted(shared)}
    out[TIME] = np.array([p.t_s for p in poses])
    return out


def conditions_elsewhere(poses: Sequence[Pose], reference: Mapping[str, float]) -> dict[str, Floats]:
    """`conditions` of poses of another recording than that which ``reference`` is of, whose clock is its own: effects
    of time count as at their reference. Raises InvalidData where a channel is missing.
    """
    channels = channels_of(list(poses))
    missing = [n for n in reference if n not in channels]
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(missing)}, which the calibration needs")
    channels[TIME] = np.full(len(poses), reference.get(TIME, 0.0))
    return conditions(channels, reference)
