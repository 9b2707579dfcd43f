"""The result of a fit, with every reason to distrust it, and its projection onto the
effects that a device can hold.

A device corrects by its registers alone. It holds the whole correction at one
moment, projected onto its own terms: the contribution of an effect that it lacks
over the sphere goes into the nine parameters and the effects that it has, as far
as these can take it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.distributions import t_ppf
from triaxcal.effects.contract import SINCE_START, TIME, Effect, is_derived
from triaxcal.errors import InvalidData
from triaxcal.model.directions import spiral
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import (
    at_moment,
    channels_of,
    covariates,
    covariates_elsewhere,
    of_moment,
    of_readings,
    with_scale,
)
from triaxcal.poses.pose import Pose, PoseStart

# Reasons to distrust a result, as values with their figures; `triaxcal.text` has
# the sentences.


@dataclass(frozen=True)
class Caution:
    """A reason to distrust a part of a result."""


@dataclass(frozen=True)
class ExcludedPose:
    """A pose that a fit excludes, its beginning, and its studentized residual."""

    began: PoseStart
    studentized: float


@dataclass(frozen=True)
class FaultyPosesExcluded(Caution):
    """The outputs did not follow the acceleration; ``faults`` by data-quality
    name."""

    faults: tuple[tuple[PoseStart, str], ...]


@dataclass(frozen=True)
class UnknownHistoryExcluded(Caution):
    """An effect depends on the previous pose, which is not known."""

    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class PosesExcludedByCaller(Caution):
    poses: tuple[ExcludedPose, ...]


@dataclass(frozen=True)
class OutliersExcluded(Caution):
    """``doubtful``: by the other residuals, the repeatability of all poses may be
    worse than their noise; the standard errors allow for that by ``excess`` (in the
    reference), where it is not 0."""

    poses: tuple[ExcludedPose, ...]
    doubtful: bool
    excess: float


@dataclass(frozen=True)
class OutlierSetsTied(Caution):
    """Each of these sets of poses explains the data equally well as outliers; none is
    excluded."""

    sets: tuple[tuple[PoseStart, ...], ...]


@dataclass(frozen=True)
class PoorSpread(Caution):
    """Some combination of parameters is ``dilution`` times as uncertain as one pose;
    the poses ``wanted`` would reduce it."""

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
    """Residuals show an ``excess`` standard deviation of |a| over the noise of the
    poses, in the reference; the standard errors allow for it."""

    excess: float


@dataclass(frozen=True)
class BirgeRatio(Caution):
    """Residuals are ``ratio`` times as large as expected from noise, which raises the
    standard errors. ``attitudes``: the error of the attitudes is part of the
    expectation."""

    ratio: float
    attitudes: bool = False


@dataclass(frozen=True)
class ResidualsTooSmall(Caution):
    """Residuals are smaller than noise and creep explain: the standard errors
    are too large rather than too small."""


@dataclass(frozen=True)
class Residual:
    """Residuals of |a|, in units of the reference vector (g).

    ``noise_floor_g`` is the rms of the standard errors of the pose means along the
    measured vector, from the scatter inside the poses alone; ``lack_of_fit_p`` is the
    probability of residuals at least as large under a complete model and that noise.
    ``weighted_rms`` is the rms of the residuals over those standard errors,
    ``reduced_chi2`` their sum of squares over the degrees of freedom of the model;
    None where not known.
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
        """The residual of the poses that a fit used: ``misses`` (n,) of |a|, standard
        errors (n,) of their noise, and the residual degrees of freedom ``left``."""
        weighted = rms(misses / noise) if (noise > 0).all() else None
        chi2 = len(misses) * weighted**2 / left if weighted is not None and left is not None and left > 0 else None
        largest = float(np.max(np.abs(misses)))
        return cls(rms(misses), largest, cross_validated_rms_g, rms(noise), lack_of_fit_p, weighted, chi2)


@dataclass(frozen=True)
class ReferenceEpoch:
    """The reference epoch: the moment at which effects of time are evaluated in
    another recording, whose clock is its own.

    ``t_s`` counts in seconds from the first sample of the fitted recording (the last
    of several); ``time_s`` is the same moment as the covariate `TIME`, which counts
    from the middle of each of several recordings.
    """

    moment: Moment
    t_s: float
    time_s: float

    @classmethod
    def of(cls, poses: Sequence[Pose], at: Moment | float = Moment.END) -> ReferenceEpoch | None:
        """The epoch of a set of poses; None where there are none. A number ``at`` is
        a moment in seconds. Raises InvalidData for one before the start."""
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
        """(`t_s`, `time_s`), as `triaxcal.poses.covariates.of_moment` takes them."""
        return self.t_s, self.time_s


class Exclusion(StrEnum):
    """Why a fit does not use a pose."""

    FAULT = "fault"
    """Its samples have a fault (`Pose.fault`)."""
    OUTLIER = "outlier"
    CALLER = "caller"
    """Excluded by the caller."""
    UNKNOWN_HISTORY = "unknown_history"
    """An effect depends on the previous pose, which is not known. The pose itself
    need not be repeated."""


@dataclass(frozen=True)
class PoseResult:
    """One pose under the fit. ``direction`` (3,) is up in the sensor's frame;
    ``residual_g`` is |a| − reference; ``standard_error_g`` comes from its noise
    alone, ``total_standard_error_g`` includes the excess variance, where known."""

    pose: Pose
    direction: Floats
    residual_g: float
    standard_error_g: float
    studentized: float
    leverage: float
    excluded: Exclusion | None = None
    total_standard_error_g: float | None = None
    outlier_probability: float | None = None
    """None where it was not computed."""

    @property
    def error_g(self) -> float:
        """The standard error with all known contributions."""
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
    """Pose results from arrays with a row for each pose; ``total`` are the standard
    errors with excess variance, ``excluded`` the reasons by row."""
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
    """(n,) residuals over their own standard errors, r / (s √(1 − h)); 0 where 1 − h
    is too small: √(1 − h) of ``least`` or less."""
    free = np.sqrt(np.maximum(1 - leverage, 0.0))
    return np.where(free > least, misses / error / np.maximum(free, least), 0.0)


@dataclass(frozen=True)
class Origin:
    """Sources of a calibration by name and digest; empty where not known."""

    calibration: str = ""
    sha256: str = ""
    recording: str = ""


@dataclass(frozen=True)
class BiasUpdate:
    """Data of the ``earlier`` calibration of which only the biases were renewed
    (`triaxcal.inputs.bias_update`).

    ``covariances`` (9+p,9+p) of the parameters by source add up to that of the
    calibration. ``before`` is the residual of the poses under the earlier
    calibration, ``shift`` (3,) the change of the biases, ``shift_error`` (3,) its
    expected standard deviation. ``scatter_g`` is the standard deviation of |a| from
    pose to pose in excess of the noise, with ``scatter_dof`` degrees of freedom;
    ``start_to_start`` that from one recording to another, ``measured`` or assumed.
    All in the unit of the reference.
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
    """Standard deviations, in units of the reference, of unmodelled contributions to
    a reading: to |a| (``along`` the measured vector), and to each component across
    it, which |a| does not show. Rms over the sphere."""

    along: float
    across: float


@dataclass(frozen=True)
class Calibration:
    """A fitted sensor. ``covariance`` is that of `parameters`, in this order.

    ``reference`` is the magnitude of the reference vector; ``channel_reference`` are
    the zero points of the effects' covariates. Residuals in excess of the noise raise
    the standard errors: by ``birge_ratio``, a factor on all errors, at least 1 unless
    no pose knows its noise (then the residuals alone set it); or by ``excess_g``, a
    standard deviation of |a| added to the noise of every pose
    (`triaxcal.estimate.fit_assessment`). ``dof`` are the effective degrees of freedom
    of the standard errors. ``shape_errors`` are standard errors of the effects'
    shapes, by "effect.name". ``slopes``: slopes inside the poses were fitted together
    with the means.

    ``weights`` are the probabilities of the effects in a model average. Then
    ``prior_sd`` (p,) are the prior standard deviations of the coefficients, and
    ``thermal`` (9+p,9+p) is the part of the covariance due to thermal effects that
    the model lacks. ``unmodelled`` is independent of the covariance; None where it
    was not estimated or nothing acts. ``holds_at`` None: effects of time count from
    the start, as in documents of 0.1. ``linear_only`` is the linear model fitted by
    itself, where it was requested and there are effects. ``update`` describes a bias
    update of an earlier calibration.
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
    holds_at: ReferenceEpoch | None = None
    linear_only: Calibration | None = field(default=None, repr=False)
    update: BiasUpdate | None = field(default=None, repr=False)

    @property
    def moment(self) -> tuple[float, float] | None:
        """`holds_at` as `triaxcal.poses.covariates.of_moment` takes it."""
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
        """(9+p,) values of `parameters`."""
        s = self.sensor
        return np.concatenate([s.scale_factor, s.misalignment, s.bias, *(c for _, c in s.effects)])

    @property
    def standard_errors(self) -> Floats:
        """(9+p,) standard errors of `parameters`."""
        return np.sqrt(np.diag(self.covariance))

    def coefficients_of(self, name: str) -> dict[str, tuple[float, float | None, str]]:
        """name → (value, standard error, unit) of the coefficients of an effect, and
        of its shape.

        The standard error is None where the poses do not determine it. That of the
        moment of a step covers all moments between two poses. Raises KeyError for an
        effect that is not in the model.
        """
        # Linear coefficients with the errors of the fit, then shapes with their own.
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
        """Factor on a standard error for an interval of confidence ``level``:
        Student's t for `dof` (JCGM 100, G.3). Raises InvalidData for a level outside
        0 to 1."""
        if not 0 < level < 1:
            raise InvalidData(f"a level of confidence lies between 0 and 1, not at {level}")
        return float(t_ppf((1 + level) / 2, self.dof))

    def interval(self, level: float = 0.95) -> tuple[Floats, Floats]:
        """Lower and upper ends for `parameters`, each of which holds its truth
        with probability ``level``."""
        half = self.coverage_factor(level) * self.standard_errors
        return self.values - half, self.values + half

    def specific_force(self, readings: Floats, channels: Mapping[str, Floats]) -> Floats:
        """a (n,3) in g, in the sensor's frame, of single readings (n,3) in output
        units with their ``channels`` (n,). Raises Refused where the model has no
        inverse."""
        covariates, _ = self.covariates_of_readings(len(readings), channels)
        return self.sensor.specific_force(readings, covariates)

    def covariates_of_readings(
        self, n: int, channels: Mapping[str, Floats], t_s: Floats | None = None
    ) -> tuple[dict[str, Floats], tuple[str, ...]]:
        """Covariates of n single readings with the ``channels`` (n,), and the names
        of needed covariates that are missing and count as at their reference. Effects
        of time are evaluated at ``t_s`` (n,) of the fitted recording, or at
        `holds_at` where that is None."""
        if t_s is None:
            clocks: Mapping[str, Floats | float] = of_moment(self.channel_reference, self.moment)
        else:
            offset = self.holds_at.t_s - self.holds_at.time_s if self.holds_at else 0.0
            clocks = {SINCE_START: t_s, TIME: t_s - offset}
        return of_readings(channels, self.channel_reference, n, clocks)

    def covariates_of(self, poses: Sequence[Pose]) -> dict[str, Floats]:
        """Covariates of poses of the fitted recording. After a bias `update`, effects
        of time of the earlier recording are evaluated at `holds_at`."""
        if self.update is not None:
            return covariates_elsewhere(
                poses, self.channel_reference, self.sensor.scale_factor, self.sensor.bias, self.moment
            )
        known = channels_of(poses, self.channel_reference)
        channels = with_scale(known, poses, self.sensor.scale_factor, self.sensor.bias)
        return covariates(channels, self.channel_reference)

    def with_blind_to(self, effects: tuple[str, ...]) -> Calibration:
        return replace(self, blind_to=effects)


# The projection of a calibration onto the effects that a device can hold.

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
    up, covariates = readings_in_use(c, logged or {})
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
    return Reduced(projected(c, sensor, through, u, covariates), rms(off))


def projected(
    c: Calibration, sensor: Sensor, through: Floats, u: Floats, covariates: Mapping[str, Floats]
) -> Calibration:
    """The calibration ``c`` with another ``sensor``, whose parameters have the errors
    ``through`` (9+q,9+p) times those of ``c``. ``u`` (n,3) are readings all over the
    sphere, under the ``covariates``."""
    kept = [effect for effect, _ in sensor.effects]
    names = {effect.name for effect in kept}
    needed = {name for effect in kept for name in effect.needs}
    # Prior standard deviations of the coefficients that both have.
    prior_sd = {} if c.prior_sd is None else dict(zip(c.parameters[9:], c.prior_sd, strict=True))
    coefficients = [f"{effect.name}.{q.name}" for effect in kept for q in effect.coefficients]
    known = c.prior_sd is not None and {*coefficients} <= {*prior_sd}
    calibration = replace(
        c,
        sensor=sensor,
        covariance=through @ c.covariance @ through.T,
        thermal=None if c.thermal is None else through @ c.thermal @ through.T,
        prior_sd=np.array([prior_sd[n] for n in coefficients]) if known else None,
        weights={name: p for name, p in c.weights.items() if name in names},
        unmodelled=_unmodelled(c, sensor, through, u, covariates),
        channel_reference={name: v for name, v in c.channel_reference.items() if name in needed},
        update=None if c.update is None else _update(c.update, through),
    )
    return _with_residual(calibration) if c.poses else calibration


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


def readings_in_use(c: Calibration, logged: Mapping[str, Floats]) -> tuple[Floats, Mapping[str, Floats]]:
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
