"""Biases anew, everything else kept: a calibration that is brought up to date by
a few still poses of a later day.

From day to day mostly the bias changes. The parameters of today are those of
the earlier calibration, off by its errors and by what changes from recording to
recording; |a| in the poses is an observation of all of them. The biases become
their mean given the poses, and the other parameters stay as they are, with
their uncertainty: a Schmidt–Kalman update, in which they are "considered"
(Schmidt 1966, in Advances in Control Systems 3; Jazwinski 1970, section 8.4).
That bias is the best one beside kept scale factors: over the sphere errors of
the two are orthogonal in |a|.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.distributions import chi2_sf
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import DURATION, SINCE_START, TIME
from triaxcal.errors import NotStill, Refused
from triaxcal.estimate.calibration import (
    BiasUpdate,
    Calibration,
    HoldsAt,
    Origin,
    Residual,
    pose_results,
    studentized,
)
from triaxcal.estimate.caution import BirgeRatio, Caution, FaultyPosesExcluded
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.model.bias_directions import (
    DILUTION_LIMIT,
    LEAST,
    bias_dilution,
    determined,
    distinct_directions,
    first_distinct,
    wanted_for_biases,
)
from triaxcal.model.moment import Moment
from triaxcal.number_format import number_of, plain
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, SIGNIFICANT, lack_of_fit_p, within_pose_dof
from triaxcal.poses.pose import Pose
from triaxcal.rounding import probability
from triaxcal.uncertainty.next_recording import START_TO_START
from triaxcal.uncertainty.thermal import SENSITIVITY_PER_K

SCALE_FACTOR_SHARE = 0.1
"""By how much the scale factors change from recording to recording, relatively,
of what the biases change by, in references: the eight sensors of MIMU4444 came
back by 160 to 220 ppm where their biases did by 2 mg."""
UNFIT = 1e-4
"""Probability of poses as far from kept scale factors below which the update is
refused. Smaller than `SIGNIFICANT`, at which errors are raised: a refusal costs
a whole calibration."""
UNLIKE = 0.05
"""A bias that moved by such a share of the reference is another unit's, or the
outputs are in another unit: 60 K away, the sensitivities of mass-market data
sheets make 0.035."""
STEPS_MOST, CONVERGED = 50, 1e-13
"""Of Gauss and Newton; relative to the reference. A few do."""


@dataclass(frozen=True)
class Earlier:
    """What is known of a unit from before the poses. ``covariance`` (9+p,9+p) is
    of the parameters of ``calibration``; what is not a number there is not
    known.

    In the unit of the reference: ``scatter_g`` is a standard deviation of |a|
    that every pose of it had beside its noise, ``noise_g`` what stands for the
    noise of a pose that does not know its own, ``start_to_start`` the standard
    deviation of |a| from recording to recording, None where nobody said;
    ``measured``, or assumed. ``temperatures_c`` are the lowest and the highest
    temperature of its poses, None where they are not known. The ``linear_only``
    one is updated too.
    """

    calibration: Calibration
    covariance: Floats
    scatter_g: float = 0.0
    noise_g: float = float("nan")
    start_to_start: float | None = None
    measured: bool = False
    temperatures_c: tuple[float, float] | None = None
    origin: Origin = field(default_factory=Origin)
    linear_only: Earlier | None = None


@dataclass(frozen=True)
class BiasMoved(Caution):
    """The biases moved by ``shift``, where ``expected`` is the standard
    deviation by which they do, both of |a| over the sphere and in references
    (probability ``p``)."""

    shift: float
    expected: float
    p: float


def updated_biases(poses: Sequence[Pose], earlier: Earlier, *, first: int | None = None) -> Calibration:
    """``earlier`` with three biases by still poses of a later recording: by the
    ``first`` so many distinct ones, or by all.

    Raises Refused where the poses cannot carry three biases, or do not fit what
    is kept; InvalidData where a channel that the effects need is missing.
    """
    c = earlier.calibration
    require_known(earlier)
    sound = [p for p in poses if not p.fault]
    _require_changes(sound)
    used = _chosen(sound, c, first)
    used = with_unexplained_creep(used, c, elsewhere=True)
    update = _Update(used, earlier)
    found = update.calibration(poses)
    if earlier.linear_only is None:
        return found
    try:
        linear_only = updated_biases(poses, earlier.linear_only, first=first)
    except Refused:  # which is why there are effects
        return found
    return replace(found, linear_only=linear_only)


def require_known(earlier: Earlier) -> None:
    """Raises Refused where a calibration does not say how well its parameters
    are known."""
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
    """The poses that are to be used. Raises Refused where they do not determine
    three biases."""
    up = _up(poses, c)
    if not np.isfinite(up).all():
        raise Refused("the calibration and the readings of these poses give no finite magnitude")
    rows = list(range(len(poses))) if first is None else first_distinct(up, first)
    up = up[rows]
    many = distinct_directions(up)
    if many < LEAST:
        short = number_of(many, "distinct still pose")
        raise Refused(f"{short}; three biases need at least {LEAST}, 4 are better", wanted=wanted_for_biases(up))
    if not determined(up):
        raise Refused(
            f"{many} distinct still poses do not determine three biases: some combination of them would be "
            f"{bias_dilution(up):.3g} times as uncertain as one pose (limit {DILUTION_LIMIT:g})",
            wanted=wanted_for_biases(up),
        )
    return [poses[i] for i in rows]


@dataclass(frozen=True)
class _ByPosesAlone:
    """The ``shift`` (3,) of the biases by generalised least squares, without
    what is known of it before, its covariance ``variance`` (3,3), and the sum
    of squares that it leaves."""

    shift: Floats
    variance: Floats
    chi2: float


class _Update:
    """The parameters p = (scale factors, angles, biases, effects) of today are
    p₀ + d with d ~ N(0, C + Q): C of the earlier calibration, Q of what changes
    from recording to recording. A pose observes 0 = |a|(p₀ + d) − g + e."""

    def __init__(self, poses: Sequence[Pose], earlier: Earlier) -> None:
        c = earlier.calibration
        self.poses, self.earlier = poses, earlier
        self.u = np.array([p.mean for p in poses])
        self.covariates = _covariates(poses, c)
        noise_covariance = np.array([p.covariance for p in poses])
        # R: the noise of each pose along the measured vector, and what the
        # residuals of the earlier calibration showed beside noise.
        _, by_u = c.sensor.magnitude(self.u, self.covariates)
        self.noise = np.sqrt(np.einsum("ni,nij,nj->n", by_u, noise_covariance, by_u))
        unknown = np.array([p.dof <= 0 for p in poses])
        if unknown.any() and not np.isfinite(earlier.noise_g):
            raise Refused("neither these poses nor the calibration say how large the noise of a pose is")
        self.noise = np.where(unknown, earlier.noise_g, self.noise)
        self.variance = self.noise**2 + earlier.scatter_g**2
        self.pure_dof = within_pose_dof(poses)
        self.begin_miss = self._miss(c.sensor.bias)
        known = START_TO_START * c.reference if earlier.start_to_start is None else earlier.start_to_start
        self.start_to_start = known
        bias, relative = self._changes(known)
        self.alone = self._by_poses_alone(relative)
        # How far the biases went tells too: a unit that moved by more than was
        # expected is not pulled back by the expectation.
        went = self.alone.shift @ self.alone.shift - np.trace(self.alone.variance)
        self.since = self._since(max(bias, float(np.sqrt(max(went, 0.0) / 3))), relative)

    def _miss(self, bias: Floats) -> Floats:
        sensor = replace(self.earlier.calibration.sensor, bias=bias)
        miss = sensor.magnitude(self.u, self.covariates)[0] - self.earlier.calibration.reference
        if not np.isfinite(miss).all():
            raise NotStill("the biases ran away")
        return miss

    def _jacobian(self, bias: Floats) -> Floats:
        sensor = replace(self.earlier.calibration.sensor, bias=bias)
        return sensor.radius_by_parameters(self.u, self.covariates)

    def _changes(self, start_to_start: float) -> tuple[float, float]:
        """By how much biases, and scale factors relatively, change from one
        recording to another.

        A calibration without thermal effects holds at the temperatures of its
        poses: beyond them all changes by what a kelvin usually makes.
        """
        g, kelvin = self.earlier.calibration.reference, self._kelvin_away()
        bias = np.hypot(start_to_start, SENSITIVITY_PER_K["temperature_bias"] * kelvin * g)
        relative = SCALE_FACTOR_SHARE * start_to_start / g
        return float(bias), float(np.hypot(relative, SENSITIVITY_PER_K["temperature_scale_factor"] * kelvin))

    def _since(self, bias: float, relative: float) -> Floats:
        """Q (9+p,9+p)."""
        q = np.zeros(len(self.earlier.covariance))
        q[:3], q[6:9] = self.earlier.calibration.sensor.scale_factor * relative, bias
        return np.diag(q**2)

    def _kelvin_away(self) -> float:
        """How far the poses are from the temperatures of the earlier ones, in
        the mean; 0 where thermal effects are modelled, or nothing is logged."""
        then = self.earlier.temperatures_c
        now = np.array([p.channels.get(TEMPERATURE, np.nan) for p in self.poses])
        modelled = any(TEMPERATURE in effect.needs for effect, _ in self.earlier.calibration.sensor.effects)
        away = 0.0 if then is None or modelled else float(np.mean(np.abs(now - np.clip(now, *then))))
        return away if np.isfinite(away) else 0.0

    def _by_poses_alone(self, relative: float) -> _ByPosesAlone:
        kept = self.earlier.covariance + self._since(0.0, relative)
        begin = bias = self.earlier.calibration.sensor.bias
        J = np.where(_is_bias(len(kept)), 0.0, self._jacobian(begin))
        inverse = np.linalg.inv(np.diag(self.variance) + J @ kept @ J.T)
        for _ in range(STEPS_MOST):
            J = self._jacobian(bias)[:, 6:9]
            variance = np.linalg.inv(J.T @ inverse @ J)
            step = -variance @ J.T @ inverse @ self._miss(bias)
            bias = bias + step
            if np.max(np.abs(step)) <= CONVERGED * self.earlier.calibration.reference:
                break
        left = self._miss(bias)
        return _ByPosesAlone(bias - begin, variance, float(left @ inverse @ left))

    def calibration(self, all_poses: Sequence[Pose]) -> Calibration:
        c, n = self.earlier.calibration, len(self.poses)
        p, raised = self._fits()
        prior = self.earlier.covariance + self.since
        begin = bias = c.sensor.bias
        for _ in range(STEPS_MOST):
            J = self._jacobian(bias)
            gain = prior @ J.T @ np.linalg.inv(J @ prior @ J.T + np.diag(self.variance))
            moved = begin + gain[6:9] @ (J[:, 6:9] @ (bias - begin) - self._miss(bias))
            step, bias = moved - bias, moved
            if np.max(np.abs(step)) <= CONVERGED * c.reference:
                break
        shift = bias - begin
        if not np.max(np.abs(shift)) < UNLIKE * c.reference:
            share = plain(float(np.max(np.abs(shift))) / c.reference, 2)
            raise Refused(
                f"a bias would move by {share} of the reference: is it another unit, or are signs, order or unit of "
                "its outputs others?"
            )
        # Kept parameters are not moved: their rows of the gain are zero. The
        # errors of all that results, by their source (Joseph's form).
        gain = np.where(_is_bias(len(gain))[:, None], gain, 0.0)
        rest = np.eye(len(gain)) - gain @ J
        covariances = {
            "noise": (gain * self.noise**2) @ gain.T,
            "scatter": gain @ gain.T * self.earlier.scatter_g**2,
            "lack_of_fit": (gain * self.variance) @ gain.T * (raised**2 - 1),
            "kept": rest @ self.earlier.covariance @ rest.T,
            "since": rest @ self.since @ rest.T,
        }
        covariances = {name: v for name, v in covariances.items() if np.any(v)}
        covariance = sum(covariances.values(), start=np.zeros_like(prior))
        sensor = replace(c.sensor, bias=bias)
        miss = self._miss(bias)
        leverage = np.clip(np.einsum("np,pn->n", J, gain), 0.0, 1.0)
        error = np.sqrt(self.variance) * raised
        up = sensor.up(self.u, self.covariates)
        expected = np.sqrt(np.diag(prior)[6:9])
        update = BiasUpdate(
            earlier=self.earlier.origin,
            covariances=covariances,
            before=Residual.of(self.begin_miss, self.noise),
            before_residual_g=self.begin_miss,
            shift=shift,
            shift_error=expected,
            scatter_g=self.earlier.scatter_g,
            start_to_start=self.start_to_start,
            measured=self.earlier.measured,
        )
        alone = miss / np.maximum(1 - leverage, 1e-9)
        crossed = float(np.sqrt(np.mean(alone**2))) if np.all(leverage < 1 - 1e-6) else None
        directions = J[:, 6:9] / np.linalg.norm(J[:, 6:9], axis=1, keepdims=True)
        results = pose_results(
            self.poses, up, miss, self.noise, studentized(miss, error, leverage), leverage, total=error
        )
        return Calibration(
            sensor=sensor,
            covariance=covariance,
            reference=c.reference,
            channel_reference=dict(c.channel_reference),
            residual=Residual.of(miss, self.noise, cross_validated_rms_g=crossed, lack_of_fit_p=p),
            poses=results,
            condition=float(np.linalg.cond(directions)),
            dilution=bias_dilution(directions),
            birge_ratio=raised,
            dof=max(n - 3.0, 1.0) if raised > 1 else max(self.pure_dof, 1.0),
            shape_errors=dict(c.shape_errors),
            blind_to=c.blind_to,
            cautions=tuple(self._cautions(all_poses, shift, raised)),
            weights=dict(c.weights),
            holds_at=self._holds_at(),
            update=update,
        )

    def _fits(self) -> tuple[float | None, float]:
        """The probability of what the poses leave beside three biases, and by
        what that raises the errors of the poses. Raises Refused where it is too
        small for what is kept."""
        left = len(self.poses) - 3
        p = probability(lack_of_fit_p(self.alone.chi2, left, self.pure_dof if self.pure_dof >= 1 else 1e6))
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

    def _cautions(self, all_poses: Sequence[Pose], shift: Floats, raised: float) -> Iterator[Caution]:
        c = self.earlier.calibration
        if faulty := tuple((p.began, p.fault) for p in all_poses if p.fault):
            yield FaultyPosesExcluded(faulty)
        if raised > 1:
            yield BirgeRatio(raised)
        expected = self.start_to_start
        p = probability(float(chi2_sf(float(shift @ shift) / max(expected, 1e-300) ** 2, 3)))
        if p is not None and p < LACK_OF_FIT:
            yield BiasMoved(float(np.linalg.norm(shift)) / np.sqrt(3) / c.reference, expected / c.reference, p)

    def _holds_at(self) -> HoldsAt | None:
        """Effects of time are those of the earlier recording, at its moment;
        without them the biases are the mean over the poses."""
        c = self.earlier.calibration
        timed = any({TIME, SINCE_START, DURATION} & set(effect.needs) for effect, _ in c.sensor.effects)
        return c.holds_at if timed else HoldsAt.of(self.poses, Moment.MEAN)


def _is_bias(n: int) -> Bools:
    """(n,) which parameters are biases."""
    rows = np.zeros(n, dtype=bool)
    rows[6:9] = True
    return rows
