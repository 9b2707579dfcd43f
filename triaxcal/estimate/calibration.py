"""The values that a fit gives: complete, with every reason not to trust them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.distributions import t_ppf
from triaxcal.effects.contract import SINCE_START, TIME
from triaxcal.errors import InvalidData
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import channels_of, covariates, covariates_elsewhere, of_moment, of_readings, with_scale
from triaxcal.poses.pose import Pose, PoseStart

# Reasons not to trust a result, as values with their figures. `triaxcal.text` says
# them in English.


@dataclass(frozen=True)
class Caution:
    """A reason not to trust a result in full."""


@dataclass(frozen=True)
class ExcludedPose:
    """A pose that a fit excludes, when it began and how many standard errors
    off it is."""

    began: PoseStart
    studentized: float


@dataclass(frozen=True)
class FaultyPosesExcluded(Caution):
    """The outputs did not follow the acceleration; ``faults`` by data-quality
    name."""

    faults: tuple[tuple[PoseStart, str], ...]


@dataclass(frozen=True)
class UnknownHistoryExcluded(Caution):
    """An effect goes with the pose before, which nobody knows."""

    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class PosesExcludedByCaller(Caution):
    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class OutliersExcluded(Caution):
    """``doubtful``: the other residuals leave it open whether all poses repeat
    less well than their noise says, and the standard errors allow for that, by
    ``excess`` (in the reference) where it is not 0."""

    poses: tuple[ExcludedPose, ...]
    doubtful: bool
    excess: float


@dataclass(frozen=True)
class OutlierSetsTied(Caution):
    """Any of these sets of poses may be outliers, or something else acts; none
    is excluded."""

    sets: tuple[tuple[PoseStart, ...], ...]


@dataclass(frozen=True)
class PoorSpread(Caution):
    """Some combination of parameters is ``dilution`` times as uncertain as one
    pose; poses ``wanted`` would mend it."""

    dilution: float
    wanted: tuple[str, ...]


@dataclass(frozen=True)
class FewPoses(Caution):
    poses: int
    parameters: int


@dataclass(frozen=True)
class HighLeverage(Caution):
    """One pose alone determines a parameter."""

    began: PoseStart
    leverage: float


@dataclass(frozen=True)
class ExcessVariance(Caution):
    """Residuals show an ``excess`` standard deviation of |a|, in the reference,
    that every pose has beside its noise; the standard errors allow for it."""

    excess: float


@dataclass(frozen=True)
class BirgeRatio(Caution):
    """Residuals are ``ratio`` times what noise explains, which raises the
    standard errors. ``attitudes``: what noise and the error of the attitudes
    explain."""

    ratio: float
    attitudes: bool = False


@dataclass(frozen=True)
class ResidualsTooSmall(Caution):
    """Residuals are smaller than noise and creep explain: the standard errors
    are too large rather than too small."""


@dataclass(frozen=True)
class Residual:
    """How well the magnitude comes out, in units of the reference vector (g).

    ``noise_floor_g`` is the rms of the standard errors of the pose means along
    the measured vector, from the scatter inside the poses alone;
    ``lack_of_fit_p`` the probability of residuals at least as large as these if the
    model were complete and that noise were all. ``weighted_rms`` is the rms of
    the residuals over those standard errors, and ``reduced_chi2`` their sum of
    squares over the degrees of freedom that the model leaves; None where nobody
    knows them.
    """

    rms_g: float
    max_abs_g: float
    cross_validated_rms_g: float | None
    noise_floor_g: float
    lack_of_fit_p: float | None
    weighted_rms: float | None = None
    reduced_chi2: float | None = None

    @classmethod
    def of(
        cls,
        misses: Floats,
        noise: Floats,
        *,
        cross_validated_rms_g: float | None = None,
        lack_of_fit_p: float | None = None,
        left: float | None = None,
    ) -> Residual:
        """Of the poses that a fit used: ``misses`` (n,) of |a| and the standard
        errors (n,) of their noise; ``left`` are the degrees of freedom that the
        model leaves."""
        weighted = rms(misses / noise) if (noise > 0).all() else None
        chi2 = len(misses) * weighted**2 / left if weighted is not None and left is not None and left > 0 else None
        largest = float(np.max(np.abs(misses)))
        return cls(rms(misses), largest, cross_validated_rms_g, rms(noise), lack_of_fit_p, weighted, chi2)


@dataclass(frozen=True)
class HoldsAt:
    """The moment for which effects of time are evaluated in another recording,
    whose clock is its own.

    ``t_s`` in seconds from the first sample of the recording that was fitted,
    of the last one where these are several; ``time_s`` the same as the
    covariate `TIME` counts it, which of several recordings is from the middle
    of each.
    """

    moment: Moment
    t_s: float
    time_s: float

    @classmethod
    def of(cls, poses: Sequence[Pose], at: Moment | float = Moment.END) -> HoldsAt | None:
        """None where there are no poses. A number is a moment in seconds.
        Raises InvalidData for one before the start."""
        if not poses:
            return None
        last = max(p.run.index for p in poses)
        own = [p for p in poses if p.run.index == last]
        if not isinstance(at, Moment):
            if not 0 <= at < np.inf:
                raise InvalidData(f"a calibration holds at a moment of its recording, not at {at:g} s")
            moment, t_s = Moment.SECONDS, float(at)
        elif at is Moment.END:
            moment, t_s = at, max(p.end_s for p in own)
        else:
            moment, t_s = Moment.MEAN, float(np.mean([p.t_s for p in own]))
        return cls(moment, t_s, t_s - own[0].run.middle_s)

    @property
    def clocks(self) -> tuple[float, float]:
        """As `triaxcal.poses.covariates.of_moment` has it."""
        return self.t_s, self.time_s


class Exclusion(StrEnum):
    """Why a fit does not use a pose."""

    FAULT = "fault"
    """Its samples have one (`Pose.fault`)."""
    OUTLIER = "outlier"
    CALLER = "caller"
    """The caller wanted it so."""
    UNKNOWN_HISTORY = "unknown_history"
    """An effect goes with the pose before, and nobody knows that one: this one
    need not be taken again."""


@dataclass(frozen=True)
class PoseResult:
    """One pose under the fit. ``direction`` (3,) is up in the sensor's frame;
    ``residual_g`` is |a| − reference; ``standard_error_g`` that of its noise,
    ``total_standard_error_g`` with what residuals show beyond noise, where that
    is known.
    """

    pose: Pose
    direction: Floats
    residual_g: float
    standard_error_g: float
    studentized: float
    leverage: float
    excluded: Exclusion | None = None
    total_standard_error_g: float | None = None
    outlier_probability: float | None = None
    """None where nobody asked."""

    @property
    def error_g(self) -> float:
        """The standard error by all that is known."""
        return self.standard_error_g if self.total_standard_error_g is None else self.total_standard_error_g

    @property
    def used(self) -> bool:
        return self.excluded is None


def pose_results(
    poses: Sequence[Pose],
    direction: Floats,
    misses: Floats,
    noise: Floats,
    studentized: Floats,
    leverage: Floats,
    *,
    total: Floats | None = None,
    excluded: Mapping[int, Exclusion] | None = None,
) -> tuple[PoseResult, ...]:
    """Of arrays with a row for each pose; ``total`` are the standard errors
    with what residuals show beyond noise, ``excluded`` has the reasons by row."""
    reasons = excluded or {}
    return tuple(
        PoseResult(
            pose,
            direction[i],
            float(misses[i]),
            float(noise[i]),
            float(studentized[i]),
            float(leverage[i]),
            reasons.get(i),
            None if total is None else float(total[i]),
        )
        for i, pose in enumerate(poses)
    )


def studentized(misses: Floats, error: Floats, leverage: Floats, least: float = 1e-6) -> Floats:
    """(n,) residuals over their own standard errors; 0 where a pose leaves less
    than the share ``least`` of its error to show as a residual."""
    free = np.sqrt(np.maximum(1 - leverage, 0.0))
    return np.where(free > least, misses / error / np.maximum(free, least), 0.0)


@dataclass(frozen=True)
class Origin:
    """What a calibration was made from, by name and digest; empty where nobody
    said."""

    calibration: str = ""
    sha256: str = ""
    recording: str = ""


@dataclass(frozen=True)
class BiasUpdate:
    """What a calibration of which the biases alone are new
    (`triaxcal.inputs.bias_update`) has of the ``earlier`` one.

    ``covariances`` (9+p,9+p) of the parameters by their source add up to that
    of the calibration. ``before`` is how well the magnitude came out in the
    poses under the earlier one, ``shift`` (3,) what the biases moved by,
    ``shift_error`` (3,) the standard deviations by which they were expected to.
    ``scatter_g`` is a standard deviation of |a| that every pose of the unit has
    beside its noise, known by ``scatter_dof`` degrees of freedom;
    ``start_to_start`` that from one recording to another, ``measured`` or
    assumed. All in the unit of the reference.
    """

    earlier: Origin
    covariances: Mapping[str, Floats]
    before: Residual
    before_residual_g: Floats
    shift: Floats
    shift_error: Floats
    scatter_g: float
    scatter_dof: float
    start_to_start: float
    measured: bool


@dataclass(frozen=True)
class Unmodelled:
    """Standard deviations, in units of the reference, of what acts on a reading
    and no parameter describes: of |a| (``along`` the measured vector), and of
    each component across it, which |a| does not show. rms over the sphere."""

    along: float
    across: float


@dataclass(frozen=True)
class Calibration:
    """A fitted sensor. ``covariance`` is of `parameters`, in that order.

    ``reference`` is the magnitude of the reference vector;
    ``channel_reference`` the values from which the effects' covariates are
    counted. Residuals that exceed the noise raise the standard errors: by a
    factor on all errors, ``birge_ratio``, at least 1 unless no pose knows its
    noise (then the residuals alone set it); or by ``excess_g``, a standard
    deviation of |a| that every pose has beside its noise
    (`triaxcal.estimate.fit_assessment`). ``dof`` are the effective degrees of freedom
    behind the standard errors. ``shape_errors`` are standard errors of the
    effects' shapes, by "effect.name". ``slopes``: how |a| goes inside the poses
    was fitted along with their means. ``weights`` is the probability of each
    effect where the coefficients are means over all that may act. Then
    ``prior_sd`` (p,) are the standard deviations of the coefficients before the
    poses were seen, and ``thermal`` (9+p,9+p) is the part of the covariance
    that thermal effects make which the model has not. ``unmodelled`` is beside
    the covariance: None where nobody asked, or nothing acts. ``holds_at`` None:
    effects of time count as long after the start, as in documents of 0.1.
    ``linear_only`` is the linear model fitted by itself, where there are
    effects and somebody asked for it. ``update`` is what it has of an earlier
    calibration of which it keeps all but the biases.
    """

    sensor: Sensor
    covariance: Floats
    reference: float
    channel_reference: Mapping[str, float]
    residual: Residual
    poses: tuple[PoseResult, ...]
    condition: float
    dilution: float
    birge_ratio: float
    dof: float
    excess_g: float = 0.0
    shape_errors: Mapping[str, float] = field(default_factory=dict)
    slopes: bool = False
    blind_to: tuple[str, ...] = ()
    cautions: tuple[Caution, ...] = ()
    weights: Mapping[str, float] = field(default_factory=dict)
    prior_sd: Floats | None = field(default=None, repr=False)
    thermal: Floats | None = field(default=None, repr=False)
    unmodelled: Unmodelled | None = None
    holds_at: HoldsAt | None = None
    linear_only: Calibration | None = field(default=None, repr=False)
    update: BiasUpdate | None = field(default=None, repr=False)

    @property
    def moment(self) -> tuple[float, float] | None:
        """`holds_at` as `triaxcal.poses.covariates.of_moment` has it."""
        return None if self.holds_at is None else self.holds_at.clocks

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

    def coefficients_of(self, name: str) -> dict[str, tuple[float, float | None, str]]:
        """name → (value, standard error, unit) of the coefficients of the
        effect of that name, and of its shape.

        The standard error is None where the poses do not tell it. That of the
        moment of a step holds that it may have been anywhere between two poses.
        Raises KeyError for an effect that is not in the model.
        """
        errors = dict(zip(self.parameters, self.standard_errors, strict=True))
        effect, q = {e.name: (e, q) for e, q in self.sensor.effects}[name]
        out: dict[str, tuple[float, float | None, str]] = {
            c.name: (float(v), float(errors[f"{name}.{c.name}"]), c.unit)
            for c, v in zip(effect.coefficients, q, strict=True)
        }
        for name, (value, unit) in effect.shape.items():
            out[name] = (value, self.shape_errors.get(f"{effect.name}.{name}"), unit)
        return out

    def coverage_factor(self, level: float = 0.95) -> float:
        """By what a standard error is multiplied for an interval that holds the
        truth with probability ``level``.

        Student's t for `dof`, as JCGM 100, G.3, has it. Raises InvalidData for
        a level outside 0 to 1.
        """
        if not 0 < level < 1:
            raise InvalidData(f"a level of confidence lies between 0 and 1, not at {level}")
        return float(t_ppf((1 + level) / 2, self.dof))

    def interval(self, level: float = 0.95) -> tuple[Floats, Floats]:
        """Lower and upper ends for `parameters`, each of which holds its truth
        with probability ``level``."""
        half = self.coverage_factor(level) * self.standard_errors
        return self.values - half, self.values + half

    def specific_force(self, readings: Floats, channels: Mapping[str, Floats]) -> Floats:
        """a (n,3) of single readings (n,3) in output units, with the
        ``channels`` (n,) that are known of them. Raises Refused where the model
        has no inverse there."""
        covariates, _ = self.covariates_of_readings(len(readings), channels)
        return self.sensor.specific_force(readings, covariates)

    def covariates_of_readings(
        self, n: int, channels: Mapping[str, Floats], t_s: Floats | None = None
    ) -> tuple[dict[str, Floats], tuple[str, ...]]:
        """Of n single readings with the ``channels`` (n,) that are known of
        them: and the covariates that are needed and not known, which count as
        at their reference. Effects of time at the times ``t_s`` (n,) of the
        recording that was fitted, at `holds_at` where that is None."""
        if t_s is None:
            clocks: Mapping[str, Floats | float] = of_moment(self.channel_reference, self.moment)
        else:
            offset = self.holds_at.t_s - self.holds_at.time_s if self.holds_at else 0.0
            clocks = {SINCE_START: t_s, TIME: t_s - offset}
        return of_readings(channels, self.channel_reference, n, clocks)

    def covariates_of(self, poses: Sequence[Pose]) -> dict[str, Floats]:
        """Of poses of the recording that it was fitted to. Effects of time of an
        earlier recording count as at `holds_at` in those of an `update`."""
        if self.update is not None:
            return covariates_elsewhere(
                poses, self.channel_reference, self.sensor.scale_factor, self.sensor.bias, self.moment
            )
        known = channels_of(poses, self.channel_reference)
        channels = with_scale(known, poses, self.sensor.scale_factor, self.sensor.bias)
        return covariates(channels, self.channel_reference)

    def with_blind_to(self, effects: tuple[str, ...]) -> Calibration:
        return replace(self, blind_to=effects)
