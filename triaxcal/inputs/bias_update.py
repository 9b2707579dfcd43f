"""Bias update: new biases from a few still poses of a later day, everything else
kept.

From day to day mostly the bias changes. The present parameters are those of the
earlier calibration, with its errors and with changes from recording to recording; |a|
in the poses observes all of them. The biases become their mean given the poses; the
other parameters stay, with their uncertainty: a Schmidt–Kalman update, in which they
are "considered" (Schmidt 1966, in Advances in Control Systems 3; Jazwinski 1970,
section 8.4). This bias is optimal for the kept scale factors: over the sphere, errors
of both are orthogonal in |a|.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Bools, Floats, rms
from triaxcal.distributions import DOF_MOST, chi2_sf
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import SINCE_START, TIME
from triaxcal.errors import NotStill, Refused
from triaxcal.estimate.calibration import (
    BiasUpdate,
    BirgeRatio,
    Calibration,
    Caution,
    FaultyPosesExcluded,
    Origin,
    PoseResult,
    ReferenceEpoch,
    Residual,
    pose_results,
    studentized,
)
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.model.directions import (
    BIAS_DILUTION_LIMIT,
    BIAS_POSES,
    bias_dilution,
    determined,
    distinct_directions,
    first_distinct,
    wanted_for_biases,
)
from triaxcal.model.samples import Moment
from triaxcal.number_format import number_of, plain
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, SIGNIFICANT, lack_of_fit_p, within_pose_dof
from triaxcal.poses.pose import Pose
from triaxcal.rounding import probability
from triaxcal.uncertainty.combined import START_TO_START
from triaxcal.uncertainty.components import SENSITIVITY_PER_K

SCALE_FACTOR_SHARE = 0.1
"""Relative change of the scale factors from recording to recording, as a share of
that of the biases in references: the eight sensors of MIMU4444 repeated within 160 to
220 ppm, and within 2 mg for the biases."""
UNFIT = 1e-4
"""Probability of the poses under the kept scale factors below which the update is
refused. Smaller than `SIGNIFICANT`, at which errors are raised: a refusal costs a
whole calibration."""
UNLIKE = 0.05
"""Change of a bias, in references, that indicates another unit or another unit of the
outputs: over 60 K, the sensitivities of mass-market data sheets give 0.035."""
STEPS_MOST, CONVERGED = 50, 1e-13
"""Gauss–Newton steps, and their relative size at the end; a few suffice."""


@dataclass(frozen=True)
class Earlier:
    """Knowledge of a unit before the poses. ``covariance`` (9+p,9+p) is that of the
    parameters of ``calibration``; NaN where not known.

    In the unit of the reference: ``scatter_g`` is the standard deviation of |a| from
    pose to pose in excess of the noise, ``noise_g`` replaces the noise of a pose that
    does not know its own, ``start_to_start`` is the standard deviation of |a| from
    recording to recording, None where not stated; ``measured``, or assumed.
    ``residual_dof`` are the degrees of freedom of the scatter, 0 where it has none.
    ``temperatures_c`` are the lowest and the highest temperature of its poses, None
    where not known. ``linear_only`` is updated too.
    """

    calibration: Calibration
    covariance: Floats
    scatter_g: float = 0.0
    residual_dof: float = 0.0
    noise_g: float = float("nan")
    start_to_start: float | None = None
    measured: bool = False
    temperatures_c: tuple[float, float] | None = None
    origin: Origin = field(default_factory=Origin)
    linear_only: Earlier | None = None


@dataclass(frozen=True)
class BiasMoved(Caution):
    """The biases changed by ``shift``, with an ``expected`` standard deviation, both
    of |a| over the sphere and in references (probability ``p``)."""

    shift: float
    expected: float
    p: float


def updated_biases(poses: Sequence[Pose], earlier: Earlier, *, first: int | None = None) -> Calibration:
    """``earlier`` with three biases from still poses of a later recording: from the
    ``first`` so many distinct ones, or from all.

    Raises Refused where the poses cannot carry three biases, or do not fit the kept
    parameters; InvalidData where a channel that the effects need is missing.
    """
    require_known(earlier)
    sound = [p for p in poses if not p.fault]
    _require_changes(sound)
    try:
        with np.errstate(all="ignore"):  # numbers out of a file may be any
            chosen = _chosen(sound, earlier.calibration, first)
            used = with_unexplained_creep(chosen, earlier.calibration, elsewhere=True)
            found = _Update(used, earlier).calibration(poses)
    except np.linalg.LinAlgError:
        raise NotStill("the biases ran away") from None
    if not np.isfinite(found.covariance).all():
        raise NotStill("the biases ran away")
    if earlier.linear_only is None:
        return found
    try:
        linear_only = updated_biases(poses, earlier.linear_only, first=first)
    except Refused:  # which is why there are effects
        return found
    return replace(found, linear_only=linear_only)


def require_known(earlier: Earlier) -> None:
    """Raises Refused where a calibration does not state the uncertainty of its
    parameters."""
    if not np.isfinite(earlier.covariance).all():
        raise Refused("the calibration does not say how uncertain its parameters are, so that nothing can be kept")


def _require_changes(poses: Sequence[Pose]) -> None:
    u = np.array([p.mean for p in poses])
    flat = [axis for axis, span in zip("xyz", np.ptp(u, axis=0), strict=True) if span <= 0] if len(u) > 1 else []
    if flat:
        raise Refused(f"the output of axis {', '.join(flat)} never changes; it cannot be calibrated")


def _up(poses: Sequence[Pose], c: Calibration) -> Floats:
    """(n,3) directions of up under a calibration."""
    if not poses:
        return np.zeros((0, 3))
    return c.sensor.up(np.array([p.mean for p in poses]), _covariates(poses, c))


def _covariates(poses: Sequence[Pose], c: Calibration) -> dict[str, Floats]:
    sensor = c.sensor
    return covariates_elsewhere(poses, c.channel_reference, sensor.scale_factor, sensor.bias, c.moment)


def _chosen(poses: Sequence[Pose], c: Calibration, first: int | None) -> list[Pose]:
    """The poses of the update. Raises Refused where they do not determine three
    biases."""
    up = _up(poses, c)
    if not np.isfinite(up).all():
        raise Refused("the calibration and the readings of these poses give no finite magnitude")
    rows = list(range(len(poses))) if first is None else first_distinct(up, first)
    up = up[rows]
    many = distinct_directions(up)
    if many < BIAS_POSES:
        short = number_of(many, "distinct still pose")
        raise Refused(f"{short}; three biases need at least {BIAS_POSES}, 4 are better", wanted=wanted_for_biases(up))
    if not determined(up):
        raise Refused(
            f"{many} distinct still poses do not determine three biases: some combination of them would be "
            f"{bias_dilution(up):.3g} times as uncertain as one pose (limit {BIAS_DILUTION_LIMIT:g})",
            wanted=wanted_for_biases(up),
        )
    return [poses[i] for i in rows]


@dataclass(frozen=True)
class _ByPosesAlone:
    """The ``shift`` (3,) of the biases by generalised least squares without a prior,
    and its covariance ``variance`` (3,3); the residuals of |a| in the poses, ``miss``
    (n,), with ``chi2`` in units of errors of ``dof`` degrees of freedom."""

    shift: Floats
    variance: Floats
    miss: Floats
    chi2: float
    dof: float


class _Update:
    """The present parameters p = (scale factors, angles, biases, effects) are p₀ + d
    with d ~ N(0, C + Q): C of the earlier calibration, Q of the changes from
    recording to recording. A pose observes 0 = |a|(p₀ + d) − g + e."""

    def __init__(self, poses: Sequence[Pose], earlier: Earlier) -> None:
        self.poses, self.earlier, self.c = poses, earlier, earlier.calibration
        self.u, self.covariates = np.array([p.mean for p in poses]), _covariates(poses, self.c)
        self.noise = self._noise()
        # R: noise of each pose along the measured vector, and pose-to-pose scatter.
        self.variance = self.noise**2 + earlier.scatter_g**2
        self.pure_dof = within_pose_dof(poses)
        stated = earlier.start_to_start
        self.start_to_start = START_TO_START * self.c.reference if stated is None else stated
        self.expected, relative = self._changes()
        self.alone = self._by_poses_alone(relative)
        # The observed shift enters too: a unit that moved further than expected is not
        # pulled back by the expectation.
        went = self.alone.shift @ self.alone.shift - np.trace(self.alone.variance)
        self.since = self._since(max(self.expected, float(np.sqrt(max(went, 0.0) / 3))), relative)

    def _noise(self) -> Floats:
        """(n,) standard errors of |a| by the noise of the poses."""
        covariance = np.array([p.covariance for p in self.poses])
        _, by_u = self.c.sensor.magnitude(self.u, self.covariates)
        unknown = np.array([p.dof <= 0 for p in self.poses])
        if unknown.any() and not np.isfinite(self.earlier.noise_g):
            raise Refused("neither these poses nor the calibration say how large the noise of a pose is")
        return np.where(unknown, self.earlier.noise_g, np.sqrt(np.einsum("ni,nij,nj->n", by_u, covariance, by_u)))

    def _miss(self, bias: Floats) -> Floats:
        """(n,) |a| less the reference."""
        miss = replace(self.c.sensor, bias=bias).magnitude(self.u, self.covariates)[0] - self.c.reference
        if not np.isfinite(miss).all():
            raise NotStill("the biases ran away")
        return miss

    def _jacobian(self, bias: Floats) -> Floats:
        """(n,9+p) derivatives of |a| by the parameters."""
        return replace(self.c.sensor, bias=bias).radius_by_parameters(self.u, self.covariates)

    def _changes(self) -> tuple[float, float]:
        """Standard deviations of the changes of the biases, and of the relative
        changes of the scale factors, from one recording to another.

        A calibration without thermal effects holds at the temperatures of its poses:
        beyond them typical sensitivities per kelvin are added.
        """
        g, kelvin = self.c.reference, self._kelvin_away()
        bias = np.hypot(self.start_to_start, SENSITIVITY_PER_K["temperature_bias"] * kelvin * g)
        relative = SCALE_FACTOR_SHARE * self.start_to_start / g
        return float(bias), float(np.hypot(relative, SENSITIVITY_PER_K["temperature_scale_factor"] * kelvin))

    def _kelvin_away(self) -> float:
        """Mean distance of the poses from the earlier temperatures; 0 where thermal
        effects are modelled, or nothing is logged."""
        then = self.earlier.temperatures_c
        now = np.array([p.channels.get(TEMPERATURE, np.nan) for p in self.poses])
        modelled = any(TEMPERATURE in effect.needs for effect, _ in self.c.sensor.effects)
        away = 0.0 if then is None or modelled else float(np.mean(np.abs(now - np.clip(now, *then))))
        return away if np.isfinite(away) else 0.0

    def _since(self, bias: float, relative: float) -> Floats:
        """Q (9+p,9+p)."""
        q = np.zeros(len(self.earlier.covariance))
        q[:3], q[6:9] = self.c.sensor.scale_factor * relative, bias
        return np.diag(q**2)

    def _by_poses_alone(self, relative: float) -> _ByPosesAlone:
        begin = bias = self.c.sensor.bias
        # Errors of the kept parameters correlate the residuals of the poses.
        kept = self.earlier.covariance + self._since(0.0, relative)
        J = np.where(_is_bias(len(kept)), 0.0, self._jacobian(begin))
        inverse = np.linalg.inv(np.diag(self.variance) + J @ kept @ J.T)
        # Gauss–Newton for the biases, by generalised least squares.
        for _ in range(STEPS_MOST):
            J = self._jacobian(bias)[:, 6:9]
            variance = np.linalg.inv(J.T @ inverse @ J)
            step = -variance @ J.T @ inverse @ self._miss(bias)
            bias = bias + step
            if np.max(np.abs(step)) <= CONVERGED * self.c.reference:
                break
        # Degrees of freedom: the noise comes from these poses, the scatter from the
        # residuals of the earlier calibration.
        left, miss = self.earlier.residual_dof, self._miss(bias)
        dof = 1 / (1 / (self.pure_dof if self.pure_dof >= 1 else DOF_MOST) + (1 / left if left > 0 else 0.0))
        return _ByPosesAlone(bias - begin, variance, miss, float(miss @ inverse @ miss), dof)

    def _fits(self) -> tuple[float | None, float]:
        """Probability of the residuals after three biases, and the factor by which
        they raise the errors of the poses. Raises Refused where it is too small for
        the kept parameters."""
        off = max(float(np.max(np.abs(self.alone.shift))), rms(self.alone.miss)) / self.c.reference
        if not off < UNLIKE:
            raise Refused(
                f"biases would move, or |a| stays off, by {plain(off, 2)} of the reference: is it another unit, or are "
                "signs, order or unit of its outputs others?"
            )
        left = len(self.poses) - 3
        p = probability(lack_of_fit_p(self.alone.chi2, left, self.alone.dof))
        if p is None or p >= SIGNIFICANT:
            return p, 1.0
        ratio = float(np.sqrt(self.alone.chi2 / left))
        if p < UNFIT:
            raise Refused(
                f"scale factors and misalignments of the calibration no longer fit: beside three biases the poses are "
                f"off by {plain(ratio, 2)} times what noise, its uncertainty and changes from recording to recording "
                f"make (probability {plain(p, 1)}); record a whole set of poses and fit it anew"
            )
        return p, max(ratio, 1.0)

    def _estimated(self, prior: Floats) -> tuple[Floats, Floats, Floats]:
        """The biases (3,) given the poses, derivatives of |a| by the parameters there
        (n,9+p), and the gain (9+p,n), zero for kept parameters."""
        begin = bias = self.c.sensor.bias
        # Iterated Kalman update: K = (C + Q) Jᵀ (J (C + Q) Jᵀ + R)⁻¹.
        for _ in range(STEPS_MOST):
            J = self._jacobian(bias)
            gain = prior @ J.T @ np.linalg.inv(J @ prior @ J.T + np.diag(self.variance))
            moved = begin + gain[6:9] @ (J[:, 6:9] @ (bias - begin) - self._miss(bias))
            step, bias = moved - bias, moved
            if np.max(np.abs(step)) <= CONVERGED * self.c.reference:
                break
        # Schmidt: only the biases are updated.
        return bias, J, np.where(_is_bias(len(gain))[:, None], gain, 0.0)

    def _covariances(self, J: Floats, gain: Floats, raised: float) -> dict[str, Floats]:
        """Covariances of all parameters by source, in Joseph's form, which holds for
        any gain."""
        rest = np.eye(len(gain)) - gain @ J
        found = {
            "noise": (gain * self.noise**2) @ gain.T,
            "scatter": gain @ gain.T * self.earlier.scatter_g**2,
            "lack_of_fit": (gain * self.variance) @ gain.T * (raised**2 - 1),
            "kept": rest @ self.earlier.covariance @ rest.T,
            "since": rest @ self.since @ rest.T,
        }
        return {name: v for name, v in found.items() if np.any(v)}

    def calibration(self, all_poses: Sequence[Pose]) -> Calibration:
        """The updated calibration, with a caution for the faulty ones of all given
        poses."""
        p, raised = self._fits()
        bias, J, gain = self._estimated(self.earlier.covariance + self.since)
        covariances = self._covariances(J, gain, raised)
        miss, shift = self._miss(bias), bias - self.c.sensor.bias
        leverage = np.clip(np.einsum("np,pn->n", J, gain), 0.0, 1.0)
        up = replace(self.c.sensor, bias=bias).up(self.u, self.covariates)
        return replace(
            self.c,
            sensor=replace(self.c.sensor, bias=bias),
            covariance=sum(covariances.values(), start=np.zeros_like(self.since)),
            residual=self._residual(miss, leverage, p),
            poses=self._results(up, miss, leverage, raised),
            condition=float(np.linalg.cond(up)),
            dilution=bias_dilution(up),
            birge_ratio=raised,
            dof=max(len(self.poses) - 3.0, 1.0) if raised > 1 else max(self.pure_dof, 1.0),
            cautions=tuple(self._cautions(all_poses, shift, raised)),
            holds_at=self._holds_at(),
            slopes=False,
            excess_g=0.0,
            prior_sd=None,
            thermal=None,
            linear_only=None,
            update=self._update(covariances, shift),
        )

    def _residual(self, miss: Floats, leverage: Floats, p: float | None) -> Residual:
        alone = miss / np.maximum(1 - leverage, 1e-9)  # of each pose under all others
        crossed = rms(alone) if np.all(leverage < 1 - 1e-6) else None
        return Residual.of(miss, self.noise, cross_validated_rms_g=crossed, lack_of_fit_p=p)

    def _results(self, up: Floats, miss: Floats, leverage: Floats, raised: float) -> tuple[PoseResult, ...]:
        error = np.sqrt(self.variance) * raised
        off = studentized(miss, error, leverage)
        return pose_results(self.poses, up, miss, self.noise, off, leverage, total=error)

    def _update(self, covariances: dict[str, Floats], shift: Floats) -> BiasUpdate:
        before = self._miss(self.c.sensor.bias)
        return BiasUpdate(
            earlier=self.earlier.origin,
            covariances=covariances,
            before=Residual.of(before, self.noise),
            before_residual_g=before,
            shift=shift,
            shift_error=np.sqrt(np.diag(self.earlier.covariance)[6:9] + self.expected**2),
            scatter_g=self.earlier.scatter_g,
            scatter_dof=self.earlier.residual_dof,
            start_to_start=self.start_to_start,
            measured=self.earlier.measured,
        )

    def _cautions(self, all_poses: Sequence[Pose], shift: Floats, raised: float) -> Iterator[Caution]:
        if faulty := tuple((p.began, p.fault) for p in all_poses if p.fault):
            yield FaultyPosesExcluded(faulty)
        if raised > 1:
            yield BirgeRatio(raised)
        p = probability(float(chi2_sf(float(shift @ shift) / max(self.expected, 1e-300) ** 2, 3)))
        if p is not None and p < LACK_OF_FIT:
            g = self.c.reference
            yield BiasMoved(float(np.linalg.norm(shift)) / np.sqrt(3) / g, self.expected / g, p)

    def _holds_at(self) -> ReferenceEpoch | None:
        """Effects of time keep the earlier epoch; without them the biases are the
        mean over the poses."""
        timed = any({TIME, SINCE_START} & set(effect.needs) for effect, _ in self.c.sensor.effects)
        return self.c.holds_at if timed else ReferenceEpoch.of(self.poses, Moment.MEAN)


def _is_bias(n: int) -> Bools:
    """(n,) which parameters are biases."""
    rows = np.zeros(n, dtype=bool)
    rows[6:9] = True
    return rows
