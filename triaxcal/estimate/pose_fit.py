"""The weighted maximum-likelihood fit of a triad's model to still poses: selection of
the poses, and use of the slopes inside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import f_sf
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import Effect, lag_in
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import (
    Calibration,
    Caution,
    ExcludedPose,
    Exclusion,
    FaultyPosesExcluded,
    OutlierSetsTied,
    OutliersExcluded,
    PoseResult,
    PosesExcludedByCaller,
    ReferenceEpoch,
    UnknownHistoryExcluded,
)
from triaxcal.estimate.creep import slopes_p, with_slopes
from triaxcal.estimate.fit_assessment import Excess, concluded
from triaxcal.estimate.initial_estimate import started_problem
from triaxcal.estimate.likelihood import Problem, State, linearise, solve
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.covariates import of_unknown_history
from triaxcal.poses.degrees_of_freedom import combined_dof, pose_dof, within_pose_dof
from triaxcal.poses.pose import Pose

# Outliers among the poses: a knock, a hand on the table, a unit that was not at
# rest.

ALARM = 0.005
"""Probability that a clean set loses a pose, or a pair."""
LEFT_LEAST = 3
"""Degrees of freedom that must remain: with fewer, nothing is left to test a pose
by."""
TIED = 2.2
"""Sets whose chi-squares differ by less than this per pose (a likelihood ratio of 3)
are tied."""
LEAST = 6.0
"""Poses that are off by fewer standard errors stay in: the cause may be a stand of
poor repeatability."""
EXCESS = 0.003
"""Probability of the remaining residuals below which they show excess variance over
the noise."""
DOUBT = 0.01
"""Probability above which a pose does not stand out from the others' residuals."""
PAIRED_MOST = 300
"""Number of poses that are tried in pairs. In larger sets an outlier hardly ever
masks another."""
FREE_LEAST = 1e-6
"""Poses with a smaller diagonal element of (1 − H) determine a parameter alone and
cannot be tested."""


@dataclass(frozen=True)
class OutlierSet:
    """``rows`` are outliers. In addition, one set of ``tied`` is: these sets of rows
    explain the data equally well.

    The rows are ``doubtful`` where only the noise inside the poses excludes them and
    they do not stand out from the other residuals: the repeatability of all poses may
    be worse than their noise.
    """

    rows: tuple[int, ...] = ()
    tied: tuple[tuple[int, ...], ...] = ()
    doubtful: bool = False


@dataclass(frozen=True)
class _DeletionDiagnostics:
    """Single- and pair-deletion statistics of a linear fit (Cook and Weisberg 1982).

    ``residuals`` (n,) are in units of the poses' standard errors; ``q`` (n,p) has
    orthonormal columns with q qᵀ = H, the hat matrix. ``dof`` (n,) are the degrees of
    freedom of each standard error, ``pure_dof`` those of all together; zero where the
    noise is not known.
    """

    residuals: Floats
    q: Floats
    residual_dof: int
    dof: Floats
    pure_dof: float

    @property
    def chi2(self) -> float:
        return float(self.residuals @ self.residuals)

    def singles(self) -> tuple[Ints, Floats]:
        """Rows (n,1), and the reduction in chi-square (n,) by deletion of each."""
        # Deleting row i lowers chi-square by e_i² / (1 − h_ii).
        share = 1 - (self.q**2).sum(axis=1)
        taken = np.where(share > FREE_LEAST, self.residuals**2 / np.maximum(share, FREE_LEAST), 0.0)
        return np.arange(len(self.residuals))[:, None], taken

    def pairs(self) -> tuple[Ints, Floats]:
        """Pairs of rows (m,2) among those with the largest single reduction, and the
        reduction in chi-square (m,) by deletion of each pair."""
        rows = np.sort(np.argsort(-self.singles()[1], kind="stable")[:PAIRED_MOST])
        free = self.free(rows)
        # Deleting rows i, j lowers chi-square by eᵀ (1 − H)ᵢⱼ⁻¹ e, with the 2×2 block
        # of 1 − H.
        first, second = np.triu_indices(len(rows), 1)
        a, b, c = free[first, first], free[second, second], free[first, second]
        i, j = rows[first], rows[second]
        r, s = self.residuals[i], self.residuals[j]
        # Pairs with a singular block determine a parameter together: not testable.
        determinant = a * b - c**2
        sound = determinant > FREE_LEAST * np.maximum(a, b)
        taken = (b * r**2 - 2 * c * r * s + a * s**2) / np.where(sound, determinant, 1.0)
        return np.stack([i, j], axis=1), np.where(sound, taken, 0.0)

    def deleted_residuals(self, rows: Ints) -> Floats:
        """Residuals of the poses in ``rows`` from the fit to the others: (1 − H)⁻¹
        e."""
        return np.linalg.solve(self.free(rows), self.residuals[rows])

    def free(self, rows: Ints) -> Floats:
        """The block of (1 − H) for ``rows``."""
        return np.eye(len(rows)) - self.q[rows] @ self.q[rows].T

    def excess(self, after: float, left: int) -> float:
        """Reduced chi-square of the rest (``after`` in ``left`` degrees of freedom)
        where it exceeds the noise significantly, else 1."""
        known = self.pure_dof >= 1
        return 1.0 if known and f_sf(after / left, left, self.pure_dof) >= EXCESS else after / left

    def by_rest(self, taken: float, size: int) -> float:
        """F-test probability that ``size`` rows reduce chi-square by ``taken``,
        against the residuals of the rest alone."""
        after, left = max(self.chi2 - taken, 1e-300), self.residual_dof - size
        return float(f_sf(taken / size / (after / left), size, left))

    def p(self, taken: float, rows: Ints, before: float, left: int) -> float:
        """Probability that ``rows`` reduce the chi-square ``before`` by ``taken``:
        the larger of the F-tests against the noise and against the rest, where the
        rest exceeds the noise."""
        size = len(rows)
        # Excess of the rest over the noise, after the deletion.
        after, left_after = max(before - taken, 0.0), left - size
        excess = self.excess(after, left_after)
        # F-test against the noise inside the poses, then against the rest.
        dof = float(self.dof[rows].min())
        p = float(f_sf(taken / size, size, dof)) if dof >= 1 else 0.0
        if excess != 1.0:
            p = max(p, float(f_sf(taken / size / excess, size, left_after)))
        return max(p, 1e-300) * (1 + 1e-9 * after)  # of two that are beyond doubt, the one that leaves less


def outlier_set(r: Floats, J: Floats, dof: Floats, pure_dof: float) -> OutlierSet:
    """At most two rows that are outliers; often none.

    ``r`` (n,) residuals and ``J`` (n,p) their derivatives, both in units of each
    pose's standard error; ``dof`` (n,) degrees of freedom of these, ``pure_dof`` of
    all together.
    """
    # Residuals after projection off the column space of J.
    n, parameters = J.shape
    left = n - parameters
    q, _ = np.linalg.qr(J)
    judge = _DeletionDiagnostics(r - q @ (q.T @ r), q, left, dof, pure_dof)
    best, best_p = OutlierSet(), ALARM
    # Test the best single row, then the best pair, each with a Bonferroni factor for
    # the number of candidates.
    for size, (rows, taken) in enumerate((judge.singles(), judge.pairs()), 1):
        if left - size < LEFT_LEAST:
            break
        most = int(np.argmax(taken))
        p = min(1.0, judge.p(float(taken[most]), rows[most], judge.chi2, left) * len(rows))
        if p < best_p and _each_stands_alone(judge, rows[most], float(taken[most])):
            best, best_p = _unless_tied(judge, rows, taken), p
    return best


def not_as_predicted(r: Floats, J: Floats, pure_dof: float, rows: Sequence[int]) -> tuple[int, ...]:
    """Those of ``rows`` with an unknown covariate of their own whose residual shows
    it: deletion reduces chi-square by more than the penalty ln n of one coefficient
    (BIC). Arguments as in `outlier_set`."""
    n, parameters = J.shape
    q, _ = np.linalg.qr(J)
    judge = _DeletionDiagnostics(r - q @ (q.T @ r), q, n - parameters, np.zeros(n), pure_dof)
    _, taken = judge.singles()
    if judge.residual_dof < 2:
        return ()
    return tuple(i for i in rows if taken[i] > np.log(n) * judge.excess(judge.chi2 - taken[i], judge.residual_dof - 1))


def _unless_tied(judge: _DeletionDiagnostics, rows: Ints, taken: Floats) -> OutlierSet:
    # Sets within the tie limit of the best one.
    size = rows.shape[1]
    most = float(taken.max())
    excess = judge.excess(max(judge.chi2 - most, 0.0), judge.residual_dof - size)
    near = rows[taken >= most - TIED * size * excess]
    sets = tuple(tuple(int(i) for i in row) for row in near)
    # Rows that all tied sets share are certain; the remainders stay as alternatives.
    certain = tuple(sorted(set.intersection(*map(set, sets))))
    tied = tuple(tuple(i for i in each if i not in certain) for each in sets) if len(sets) > 1 else ()
    # Doubtful where the rest alone, without the known noise, would not exclude them.
    doubtful = judge.by_rest(most, size) * len(rows) > DOUBT
    return OutlierSet(certain, tied, bool(certain) and doubtful)


def _each_stands_alone(judge: _DeletionDiagnostics, rows: Ints, both: float) -> bool:
    """Whether each row is off by enough standard errors, and either row of a pair
    would be an outlier without the other."""
    # Smallest deleted residual, in units of noise and excess.
    excess = judge.excess(max(judge.chi2 - both, 0.0), judge.residual_dof - len(rows))
    if np.min(np.abs(judge.deleted_residuals(rows))) < LEAST * np.sqrt(excess):
        return False
    if len(rows) == 1:
        return True
    # Each of a pair against the data without the other.
    _, singles = judge.singles()
    for one, other in (rows, rows[::-1]):
        alone = float(singles[other])
        if judge.p(both - alone, np.array([one]), judge.chi2 - alone, judge.residual_dof - 1) * len(singles) > ALARM:
            return False
    return True


# Excluded poses: their selection, and their entries in the calibration.

OUTLIER_ROUNDS = 4
"""The search is repeated without the outliers found, because large ones bend the fit
beyond the linear approximation; it ends once the set stays the same. The last set
stands."""


def outliers_among(problem: Problem, state: State, poses: Sequence[Pose]) -> OutlierSet:
    """Indices of outliers, from the fit to all poses.

    The search is repeated on the fit without the outliers found until the set stays
    the same: a pose off by a thousand times its noise invalidates the linear
    approximation. The excess variance of the remaining poses counts for all: by the
    noise alone the quietest poses would look like outliers.
    """
    own, together = pose_dof(poses), within_pose_dof(poses)
    dof, pure, judged, found = own, together, problem, OutlierSet()
    for _ in range(OUTLIER_ROUNDS):
        # Test all poses under the present fit and noise.
        r, J, s = linearise(judged, state)
        again = outlier_set(r / s, J / s[:, None], dof, pure)
        if again.rows == found.rows:
            return again
        found = again
        # Fit the rest, and estimate its excess variance.
        rest: Ints = np.delete(np.arange(len(poses)), found.rows)
        others, left = problem.only(rest), len(rest) - len(state.theta)
        state = solve(others, state, state.effects)
        judged = replace(problem, excess=Excess.estimated(linearise(others, state), len(rest), left, together).excess_g)
        # Degrees of freedom of noise plus excess (Welch–Satterthwaite).
        share = judged.excess**2 / linearise(judged, state)[2] ** 2
        dof, pure = combined_dof(share, left, own), float(combined_dof(share.mean(), left, together))
    return found


def with_unknown_history(
    problem: Problem, state: State, poses: Sequence[Pose], excluded: tuple[int, ...]
) -> tuple[int, ...]:
    """Further poses to exclude: poses of unknown history whose residuals contradict
    the assumption that the unit rested there before."""
    if not (unknown := set(of_unknown_history(poses, state.effects)) - set(excluded)):
        return ()
    # Fit the rest and test the poses of unknown history alone.
    rest: Ints = np.delete(np.arange(len(poses)), excluded)
    problem = problem.only(rest)
    r, J, s = linearise(problem, solve(problem, state, state.effects))
    rows = [k for k, i in enumerate(rest) if i in unknown]
    found = not_as_predicted(r / s, J / s[:, None], within_pose_dof([poses[i] for i in rest]), rows)
    return tuple(int(rest[k]) for k in found)


def with_faulty(calibration: Calibration, poses: Sequence[Pose]) -> Calibration:
    """A calibration from the sound poses, completed by the faulty ones among its
    results and a caution."""
    faulty = [i for i, p in enumerate(poses) if p.fault]
    if not faulty:
        return calibration
    caution = FaultyPosesExcluded(tuple((poses[i].began, poses[i].fault) for i in faulty))
    results, _ = _among(calibration, poses, dict.fromkeys(faulty, Exclusion.FAULT))
    return replace(calibration, poses=results, cautions=(caution, *calibration.cautions))


def _among(
    calibration: Calibration, poses: Sequence[Pose], reasons: Mapping[int, Exclusion]
) -> tuple[tuple[PoseResult, ...], list[PoseResult]]:
    """The pose results of a calibration, with those of further excluded poses
    inserted by row; and the inserted ones."""
    u = np.array([p.mean for p in poses])
    covariates = calibration.covariates_of(poses)
    length, by_u = calibration.sensor.magnitude(u, covariates)
    a = calibration.sensor.specific_force(u, covariates)
    # An excluded pose has leverage 0; its residual is divided by noise and excess.
    results, added = list(calibration.poses), []
    for i, reason in sorted(reasons.items()):
        noise = float(np.sqrt(by_u[i] @ poses[i].covariance @ by_u[i]))
        error = float(np.hypot(noise, calibration.excess_g))
        miss = float(length[i] - calibration.reference)
        added.append(PoseResult(poses[i], a[i] / np.linalg.norm(a[i]), miss, noise, miss / error, 0.0, reason, error))
        results.insert(i, added[-1])
    return tuple(results), added


def with_excluded(
    calibration: Calibration, poses: Sequence[Pose], rows: Sequence[int], verdict: OutlierSet, why: Exclusion
) -> Calibration:
    """The calibration with the excluded poses among its results, in order of time,
    and cautions that name them. The reason is the unknown history where an effect
    needs it, else ``why``."""
    unknown = of_unknown_history(poses, [e for e, _ in calibration.sensor.effects]) if why != Exclusion.CALLER else ()
    results, added = _among(calibration, poses, {i: Exclusion.UNKNOWN_HISTORY if i in unknown else why for i in rows})

    def those(reason: Exclusion) -> tuple[ExcludedPose, ...]:
        return tuple(ExcludedPose(p.pose.began, p.studentized) for p in added if p.excluded == reason)

    cautions: list[Caution] = []
    if excused := those(Exclusion.UNKNOWN_HISTORY):
        cautions.append(UnknownHistoryExcluded(excused))
    if wanted := those(Exclusion.CALLER):
        cautions.append(PosesExcludedByCaller(wanted))
    if outliers := those(Exclusion.OUTLIER):
        cautions.append(OutliersExcluded(outliers, verdict.doubtful, calibration.excess_g / calibration.reference))
    return replace(calibration, poses=results, cautions=(*cautions, *calibration.cautions))


def with_tied_sets(calibration: Calibration, poses: Sequence[Pose], verdict: OutlierSet) -> Calibration:
    """The calibration with a caution of tied sets, one of which holds the
    outliers."""
    if not verdict.tied:
        return calibration
    tied = OutlierSetsTied(tuple(tuple(poses[i].began for i in rows) for rows in verdict.tied))
    return replace(calibration, cautions=(tied, *calibration.cautions))


CONTRADICTED = 0.01
"""p of the slopes within the poses below which the slopes are not used."""


def fit(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    effects: Sequence[Effect] = (),
    excluded: Sequence[int] | None = None,
    why: Exclusion = Exclusion.CALLER,
) -> Calibration:
    """Fit the linear model, and the effects given, to still poses.

    ``signs`` (3,) of the scale factors, which |a| does not show. ``reference`` is the
    magnitude of the reference vector. ``excluded`` are indices of poses to exclude
    for the reason ``why``. Where it is None, outliers are found and excluded, and so
    is a first pose of unknown history where an effect depends on the previous pose.
    Poses with a fault are always excluded. Raises Refused where the poses cannot
    carry the parameters, InvalidData where a channel that an effect needs is missing.
    """
    # Faulty poses never enter: fit the sound ones and add the faulty to the results.
    sound = [i for i, p in enumerate(poses) if not p.fault]
    if len(sound) < len(poses):
        among = None if excluded is None else [k for k, i in enumerate(sound) if i in excluded]
        kept = [poses[i] for i in sound]
        sound_fit = fit(kept, signs=signs, reference=reference, effects=effects, excluded=among, why=why)
        return replace(with_faulty(sound_fit, poses), holds_at=ReferenceEpoch.of(poses))
    # Closed form with all poses, then the selection of poses.
    whole, begin = started_problem(poses, signs=signs, reference=reference, effects=effects)
    _require_channels(whole, effects)
    if excluded is None:
        chosen = _found_by_residuals(whole, begin, poses, effects)
        why = Exclusion.OUTLIER
    else:
        chosen = _Excluded(OutlierSet(tuple(sorted(excluded))))
    kept, problem, by_means = list(poses), whole, chosen.by_means
    # Start anew with the remaining poses.
    if chosen.rows:
        kept = [p for i, p in enumerate(poses) if i not in chosen.rows]
        problem, begin = started_problem(kept, signs=signs, reference=reference, effects=effects)
        by_means = None
    # Doubtful outliers stay in when the pose-to-pose scatter is estimated.
    known = np.setdiff1d(np.arange(len(poses)), chosen.of_unknown_history)
    judged = whole.only(known) if chosen.outliers.doubtful else None
    # Solve, and state covariance, residuals and cautions.
    calibration = concluded(*_solved(problem, kept, begin, effects, by_means), kept, judged)
    if chosen.rows:
        calibration = with_excluded(calibration, poses, chosen.rows, chosen.outliers, why)
    return replace(with_tied_sets(calibration, poses, chosen.outliers), holds_at=ReferenceEpoch.of(poses))


def _require_channels(problem: Problem, effects: Sequence[Effect]) -> None:
    missing = {n for e in effects for n in e.needs if n not in problem.channel_reference and lag_in(n) is None}
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(sorted(missing))}, which the effects need")


@dataclass(frozen=True)
class _Excluded:
    """The poses that a fit excludes, by row: ``outliers``, and those
    ``of_unknown_history``. ``by_means`` is the fit to the means of all poses, where
    there was one."""

    outliers: OutlierSet
    of_unknown_history: tuple[int, ...] = ()
    by_means: State | None = None

    @property
    def rows(self) -> tuple[int, ...]:
        return tuple(sorted((*self.outliers.rows, *self.of_unknown_history)))


def _found_by_residuals(problem: Problem, begin: State, poses: Sequence[Pose], effects: Sequence[Effect]) -> _Excluded:
    if len(poses) <= 9 + sum(len(e.coefficients) for e in effects):  # nothing is left to tell them by
        return _Excluded(OutlierSet())
    by_means = solve(problem, begin, tuple(effects))
    outliers = outliers_among(problem, by_means, poses)
    unknown = with_unknown_history(problem, by_means, poses, outliers.rows)
    if set(outliers.rows) <= set(of_unknown_history(poses, effects)):
        outliers = replace(outliers, doubtful=False)  # that it is off says nothing of how well poses come back
    return _Excluded(outliers, unknown, by_means)


def _solved(
    problem: Problem, poses: Sequence[Pose], begin: State, effects: Sequence[Effect], by_means: State | None
) -> tuple[Problem, State]:
    """The problem that was fitted and its solution: pose means (``by_means``, where
    already known), together with the slopes inside the poses where both agree.

    Slopes that disagree follow something else, or the effect acts later than its
    channel.
    """
    # Fit means and slopes together, where slopes are known.
    both = with_slopes(problem, poses, effects)
    contradicted = False
    if both is not None:
        try:
            state = solve(both, begin, tuple(effects))
        except (Refused, EffectFault):  # an effect may be known at the means alone
            state = None
        # Test of the slopes' residuals against the fit.
        contradicted = state is not None and slopes_p(both, state, within_pose_dof(poses)) < CONTRADICTED
        if state is not None and not contradicted:
            return both, state
    # Else the means alone.
    state = by_means or solve(problem, begin, tuple(effects))
    # Means without degrees of freedom agree with any model; contradicting slopes
    # are then the only evidence against it.
    if len(state.theta) > len(poses) - contradicted:
        raise Refused(f"{len(poses)} poses cannot carry {len(state.theta)} parameters")
    return problem, state


# Poses of which only the means are known, as in publications and from old test
# benches.

NOISE_FIRST = 1e-4
"""Initial noise as a share of the outputs' size, far below the change by
orientation."""
ROUNDS, SETTLED = 10, 0.05
"""The noise is estimated until it changes by a smaller share; two or three rounds
suffice."""


def poses_of_means(
    u: Floats,
    t_s: Floats | None = None,
    standard_errors: Floats | None = None,
    channels: Mapping[str, Floats] | None = None,
) -> list[Pose]:
    """One pose a row: ``u`` (n,3) means in output units, ``t_s`` (n,) times in
    seconds (one pose a second where not given), ``standard_errors`` (n,3) of the
    means in output units.

    Without standard errors the noise is the residual of the linear model, equal on
    all axes, with the degrees of freedom of the fit. Then no lack of fit can show,
    and an effect shows only against the other poses. Raises Refused where no degree
    of freedom is left, InvalidData for bad standard errors.
    """
    n = len(u)
    if standard_errors is not None and not (np.isfinite(standard_errors).all() and (standard_errors > 0).all()):
        raise InvalidData("standard errors of pose means have to be positive")
    size = float(np.sqrt(np.mean(u**2))) if n else 0.0
    variances = np.full((n, 3), (NOISE_FIRST * size) ** 2) if standard_errors is None else standard_errors**2
    times = np.arange(n, dtype=float) if t_s is None else t_s - t_s[:1]
    poses = [
        Pose(
            float(times[i]),
            float(times[i]),
            1,
            u[i],
            np.diag(variances[i]),
            float("inf"),
            channels={name: float(values[i]) for name, values in (channels or {}).items()},
            before=None if i == 0 else u[i - 1],
        )
        for i in range(n)
    ]
    return poses if standard_errors is not None else _with_noise_of_residuals(poses)


def _with_noise_of_residuals(poses: Sequence[Pose]) -> list[Pose]:
    if len(poses) <= LINEAR:
        raise Refused(
            f"{len(poses)} pose means without standard errors: nine parameters leave nothing to tell the noise by; "
            f"{LINEAR + 1} or more are needed"
        )
    # Alternate: fit with the present noise, then estimate it from the residuals as σ² =
    # Σ r² k² / (n − 9).
    before = 0.0
    for _ in range(ROUNDS):
        found = fit(poses)
        used = sum(p.excluded is None for p in found.poses)
        if used <= LINEAR:
            raise Refused(f"{used} pose means that agree leave nothing to tell the noise by")
        gain = float(np.sqrt(np.mean(found.sensor.scale_factor**2)))
        variance = (found.residual.rms_g * gain) ** 2 * used / (used - LINEAR)
        left = float(used - LINEAR)
        poses = [replace(p, covariance=variance * np.eye(3), dof=left, shared_dof=left) for p in poses]
        if abs(np.sqrt(variance) - before) < SETTLED * before:
            break
        before = float(np.sqrt(variance))
    return list(poses)
