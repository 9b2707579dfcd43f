"""The weighted maximum-likelihood fit of a triad's model to still poses.

Every pose says that ``|a| = reference``; its attitude is a nuisance. With the attitude profiled out, the likelihood
of a pose is that of ``r = |a(u)| − reference`` with the variance that the noise of its mean has along the gradient
of r. What this neglects is of the order of the noise squared.

The parameters of the search are ``v = D x − w`` (x the outputs scaled to the range of the data), the three angles
and the effects' coefficients; all derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from triaxcal.arrays import Floats, Ints
from triaxcal.calibration import Calibration, PoseResult, Residual, channels_of, conditions
from triaxcal.effects.contract import Effect
from triaxcal.ellipsoid import closed_form, coefficients
from triaxcal.errors import InvalidData, Refused
from triaxcal.outliers import Spoiled, spoiled
from triaxcal.plan import dilution, distinct, linear_design, most_wanted
from triaxcal.poses import Pose
from triaxcal.sensor import Sensor

DILUTION_LIMIT = 100.0
"""Above this a set of poses is refused: some combination of parameters is a hundred times worse than one pose."""
DILUTION_WARNING = 10.0
NOISE_LIMIT = 0.1
"""Poses are refused where noise alone, times the dilution, is this share of the reference."""
POSES_LEAST = 9
SPOILED_ROUNDS = 4
NOT_STILL = "the poses do not look like those of one still triad"
STEPS_MOST = 60
CONVERGED = 1e-12
"""Relative step at which the search ends; the noise of any real pose is a million times larger."""


@dataclass(frozen=True)
class Problem:
    """Poses as arrays, scaled. ``u`` (n,3), ``covariance`` (n,3,3) of the means, ``channels`` (n,) each."""

    u: Floats
    covariance: Floats
    channels: Mapping[str, Floats]
    channel_reference: Mapping[str, float]
    middle: Floats
    half: Floats
    signs: Floats
    reference: float

    @property
    def conditions(self) -> dict[str, Floats]:
        return conditions(self.channels, self.channel_reference)

    def only(self, rows: Ints | slice) -> Problem:
        """The same problem with some of its poses."""
        return Problem(
            self.u[rows],
            self.covariance[rows],
            {n: v[rows] for n, v in self.channels.items()},
            self.channel_reference,
            self.middle,
            self.half,
            self.signs,
            self.reference,
        )


@dataclass(frozen=True)
class State:
    """A point of the search: ``theta`` (9 + p,) as D (3), w (3), angles (3), effects' coefficients."""

    theta: Floats
    effects: tuple[Effect, ...]

    def sensor(self, problem: Problem) -> Sensor:
        D, w, angles = self.theta[:3], self.theta[3:6], self.theta[6:9]
        pairs = []
        at = 9
        for effect in self.effects:
            pairs.append((effect, self.theta[at : at + len(effect.coefficients)]))
            at += len(effect.coefficients)
        return Sensor(problem.half / D, angles, w + problem.middle * D / problem.half, tuple(pairs))


def problem_of(poses: Sequence[Pose], *, signs: Sequence[float] = (1, 1, 1), reference: float = 1.0) -> Problem:
    """Raises InvalidData, Refused where there are fewer than nine poses."""
    if len(poses) < POSES_LEAST:
        raise Refused(
            f"{len(poses)} still poses; nine parameters need at least {POSES_LEAST}, 14 or 26 are better",
            wanted=_wanted_for(poses, signs),
        )
    u = np.array([p.mean for p in poses])
    low, high = u.min(axis=0), u.max(axis=0)
    flat = [axis for axis, same in zip("xyz", high - low <= 0, strict=True) if same]
    if flat:
        raise Refused(f"the output of axis {', '.join(flat)} never changes; it cannot be calibrated")
    if not all(s in (1, -1) for s in signs):
        raise InvalidData(f"signs must be +1 or −1, not {signs}")
    if not (np.isfinite(reference) and reference > 0):
        raise InvalidData(f"the reference must be a positive number, not {reference}")
    channels = channels_of(list(poses))
    return Problem(
        u=u,
        covariance=np.array([p.covariance for p in poses]),
        channels=channels,
        channel_reference={n: _round(float(np.mean(v))) for n, v in channels.items() if np.isfinite(v).all()},
        middle=(low + high) / 2,
        half=(high - low) / 2,
        signs=np.asarray(signs, dtype=float),
        reference=reference,
    )


def _round(value: float) -> float:
    """To a tenth, so that a reference temperature reads well and fits a float32 register."""
    return round(value, 1)


def fit(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    effects: Sequence[Effect] = (),
    aside: Sequence[int] | None = None,
) -> Calibration:
    """Fit the linear model, and the effects given, to still poses.

    ``signs`` (3,) of the scale factors, which |a| does not show. ``aside`` are indices of poses to leave out; where it
    is None, poses that something spoiled are found and left out (`triaxcal.outliers`). Raises Refused where the poses
    cannot carry the parameters, InvalidData where a channel that an effect needs is not there.
    """
    everything = problem_of(poses, signs=signs, reference=reference)
    missing = {n for e in effects for n in e.needs if n not in everything.channel_reference}
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(sorted(missing))}, which the effects need")
    begin = start(everything, poses, signs)
    verdict = _spoiled(everything, begin, tuple(effects), poses) if aside is None else Spoiled(tuple(sorted(aside)))
    found = verdict.rows
    kept = [p for i, p in enumerate(poses) if i not in found]
    problem = problem_of(kept, signs=signs, reference=reference) if found else everything
    if found:
        begin = start(problem, kept, signs)
    calibration = _conclude(problem, kept, solve(problem, begin, tuple(effects)))
    if verdict.rivals:
        sets = " or ".join(" and ".join(f"{poses[i].start_s:.1f} s" for i in rows) for rows in verdict.rivals)
        warning = f"some poses were spoiled, and these cannot be told from each other, so none is left out: {sets}"
        return replace(calibration, warnings=(warning, *calibration.warnings))
    return _with_aside(calibration, poses, found) if found else calibration


def _spoiled(problem: Problem, begin: State, effects: tuple[Effect, ...], poses: Sequence[Pose]) -> Spoiled:
    """Indices of spoiled poses. Sought anew without those found, until the same are found again.

    A pose spoiled by a thousand times its noise bends the fit so far that linear reckoning is off.
    """
    pure = max(float(sum(min(p.dof, 1e6) for p in poses)), 1.0)
    found = Spoiled()
    for _ in range(SPOILED_ROUNDS):
        rest: Ints = np.delete(np.arange(len(poses)), found.rows)
        r, J, s = linearise(problem, solve(problem.only(rest), begin, effects))
        again = spoiled(r / s, J / s[:, None], pure)
        if again == found:
            break
        found = again
    return found


def _with_aside(calibration: Calibration, poses: Sequence[Pose], aside: Sequence[int]) -> Calibration:
    """The calibration with the poses left out among its results, in order of time, and a warning that names them."""
    held = channels_of(list(poses))
    u = np.array([p.mean for p in poses])
    conditioned = conditions(held, calibration.channel_reference)
    length, by_u = calibration.sensor.magnitude(u, conditioned)
    a = calibration.sensor.specific_force(u, conditioned)
    results = list(calibration.poses)
    names = []
    for i in aside:
        error = float(np.sqrt(by_u[i] @ poses[i].covariance @ by_u[i]))
        miss = float(length[i] - calibration.reference)
        results.insert(i, PoseResult(poses[i], a[i] / np.linalg.norm(a[i]), miss, error, miss / error, 0.0, used=False))
        names.append(f"at {poses[i].start_s:.1f} s ({miss / error:+.0f} standard errors)")
    warning = f"left out as spoiled: the pose {', the pose '.join(names)}"
    return replace(calibration, poses=tuple(results), warnings=(warning, *calibration.warnings))


def start(problem: Problem, poses: Sequence[Pose], signs: Sequence[float]) -> State:
    """The closed form as a starting point, after it is sure that the poses can carry nine parameters."""
    x = (problem.u - problem.middle) / problem.half
    rough = x / np.linalg.norm(x, axis=1, keepdims=True)
    try:
        A, c = closed_form(problem.u)
        a = (problem.u - c) @ A.T
        spread = dilution(a, linear_design(a / np.linalg.norm(a, axis=1, keepdims=True), x))
    except Refused as e:
        raise Refused(f"{e}; {_count(rough)}", wanted=_wanted_for(poses, signs)) from None
    k, angles, b = coefficients(A * problem.reference, c)
    ax, ay, az = angles
    sx, sy, sz = problem.signs
    D = problem.signs * problem.half / k
    w = problem.signs * b - problem.middle * D / problem.half
    state = State(np.concatenate([D, w, [ax * sy * sz, ay * sx * sz, az * sx * sy]]), ())
    noise = float(np.sqrt(np.mean(linearise(problem, state)[2] ** 2))) / problem.reference
    known = spread * noise < NOISE_LIMIT
    if not spread < DILUTION_LIMIT:
        raise Refused(
            f"the poses cannot carry nine parameters: some combination of them would be {spread:.3g} times as "
            f"uncertain as one pose (limit {DILUTION_LIMIT:g}); {_count(a)}",
            wanted=_labels(a * problem.signs) if known else _wanted_for(poses, signs),
        )
    if not known:
        raise Refused(
            f"the poses cannot carry nine parameters: they differ by little more than their noise; {_count(a)}",
            wanted=_wanted_for(poses, signs),
        )
    return state


def _count(a: Floats) -> str:
    return f"{len(a)} poses in {distinct(a)} distinct directions"


def _wanted_for(poses: Sequence[Pose], signs: Sequence[float]) -> tuple[str, ...]:
    """The poses that would mend a set, as far as its directions can be told without a fit."""
    if not poses:
        return _labels(np.zeros((0, 3)))
    u = np.array([p.mean for p in poses])
    middle = (u.max(axis=0) + u.min(axis=0)) / 2
    # Without a scale an axis that hardly moved would look like one that swung from end to end.
    half = float(np.max((u.max(axis=0) - u.min(axis=0)) / 2))
    error = float(np.sqrt(np.mean([np.trace(p.covariance) for p in poses])))
    if half <= error / NOISE_LIMIT:
        return _labels(np.zeros((0, 3)))
    return _labels((u - middle) / half * np.asarray(signs) + 1e-12)


def _labels(a: Floats) -> tuple[str, ...]:
    return tuple(label for label, _ in most_wanted(a))


def solve(problem: Problem, state: State, effects: tuple[Effect, ...], steps: int = STEPS_MOST) -> State:
    """Gauss–Newton with halved steps; the weights follow the gradient of r from step to step.

    Raises Refused where it does not converge within the limit (with ``steps`` at its default).
    """
    extra = sum(len(e.coefficients) for e in effects) - (len(state.theta) - 9)
    theta = np.concatenate([state.theta, np.zeros(max(extra, 0))])
    for _ in range(steps):
        r, J, s = linearise(problem, State(theta, effects))
        if not (np.isfinite(J).all() and np.isfinite(r).all()):
            raise Refused(f"the fit ran away; {NOT_STILL}")
        norm = np.linalg.norm(J / s[:, None], axis=0)
        norm[norm == 0] = 1.0
        step = -np.linalg.lstsq(J / s[:, None] / norm, r / s, rcond=1e-14)[0] / norm
        cost = float(np.sum((r / s) ** 2))
        scale = 1.0
        for _ in range(12):
            trial, _, _ = linearise(problem, State(theta + scale * step, effects), jacobian=False)
            if np.sum((trial / s) ** 2) <= cost * (1 + 1e-9) + 1e-12:
                break
            scale /= 2
        theta = theta + scale * step
        size = np.linalg.norm(step * norm) / max(float(np.linalg.norm(theta * norm)), 1e-300)
        if size < CONVERGED:
            return State(theta, effects)
    if steps == STEPS_MOST and size > 1e-9:
        raise Refused(f"the fit did not converge in {STEPS_MOST} steps (last relative step {size:.1e}); {NOT_STILL}")
    return State(theta, effects)


def linearise(problem: Problem, state: State, jacobian: bool = True) -> tuple[Floats, Floats, Floats]:
    """Residuals r (n,), their derivatives by theta (n, 9+p), their standard errors from the poses' noise (n,)."""
    sensor = state.sensor(problem)
    held = problem.conditions
    x = (problem.u - problem.middle) / problem.half
    s = sensor.along_axes(problem.u, held)
    inverse_axes = np.linalg.inv(sensor.axes)
    a = s @ inverse_axes.T
    length = np.linalg.norm(a, axis=1)
    r = length - problem.reference
    if not jacobian:
        return r, np.empty((0, 0)), np.empty(0)
    by_s = (a / length[:, None]) @ inverse_axes
    E = sensor.departure_slope(s, held) + np.eye(3)
    by_v = np.linalg.solve(E.transpose(0, 2, 1), by_s[..., None])[..., 0]
    angles = -np.stack([by_s[:, 1] * a[:, 2], by_s[:, 0] * a[:, 2], by_s[:, 0] * a[:, 1]], axis=1)
    effects = [-np.einsum("ni,nip->np", by_v, e.basis(s, held)) for e in state.effects]
    J = np.concatenate([by_v * x, -by_v, angles, *effects], axis=1)
    by_u = by_v / sensor.scale_factor
    variance = np.einsum("ni,nij,nj->n", by_u, problem.covariance, by_u)
    # Poses without any scatter (made up, or below the resolution) would otherwise weigh infinitely.
    return r, J, np.sqrt(np.maximum(variance, (1e-12 * problem.reference) ** 2))


def _conclude(problem: Problem, poses: Sequence[Pose], state: State) -> Calibration:
    r, J, s = linearise(problem, state)
    n, p = J.shape
    q, _ = np.linalg.qr(J / s[:, None])
    leverage = np.clip((q**2).sum(axis=1), 0.0, 1.0)
    free = np.sqrt(np.maximum(1 - leverage, 0.0))
    studentized = np.where(free > 1e-6, r / s / np.maximum(free, 1e-6), 0.0)
    chi2 = float(np.sum((r / s) ** 2))
    left = n - p
    lack_of_fit_p = pure_error_p(chi2, left, poses) if left > 0 else None
    inflation = max(1.0, float(np.sqrt(chi2 / left))) if lack_of_fit_p is not None and lack_of_fit_p < 0.05 else 1.0
    crossed = cross_validated(problem, state, leverage)
    sensor = state.sensor(problem)
    direction = sensor.specific_force(problem.u, problem.conditions)
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    design = linear_design(direction, (problem.u - problem.middle) / problem.half)
    spread = dilution(direction, design)
    if not spread < DILUTION_LIMIT:
        # No scale factor and a bias of one reference fit anything: |a| is right everywhere and means nothing.
        raise Refused(f"the fit ran away, to a dilution of {spread:.3g}; {NOT_STILL}")
    norms = np.linalg.norm(J / s[:, None], axis=0)
    residual = Residual(
        rms_g=float(np.sqrt(np.mean(r**2))),
        max_abs_g=float(np.max(np.abs(r))),
        cross_validated_rms_g=crossed,
        noise_floor_g=float(np.sqrt(np.mean(s**2))),
        lack_of_fit_p=lack_of_fit_p,
    )
    calibration = Calibration(
        sensor=sensor,
        covariance=_covariance(problem, state, J / s[:, None]) * inflation**2,
        reference=problem.reference,
        channel_reference={c: problem.channel_reference[c] for e in state.effects for c in e.needs},
        residual=residual,
        poses=tuple(
            PoseResult(pose, direction[i], float(r[i]), float(s[i]), float(studentized[i]), float(leverage[i]))
            for i, pose in enumerate(poses)
        ),
        condition=float(np.linalg.cond(J / s[:, None] / np.maximum(norms, 1e-300))),
        dilution=spread,
        inflation=inflation,
    )
    return replace(calibration, warnings=tuple(_warnings(calibration)))


def pure_error_p(chi2: float, left: int, poses: Sequence[Pose]) -> float:
    """Probability of a sum of squares this large in ``left`` degrees of freedom, from the poses' own noise."""
    pure = float(np.sum([min(p.dof, 1e6) for p in poses]))
    return float(stats.f.sf(chi2 / left, left, max(pure, 1.0)))


def _covariance(problem: Problem, state: State, weighted: Floats) -> Floats:
    """Of scale factor, misalignment, bias and the effects' coefficients, from the weighted Jacobian."""
    norms = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
    inverse = np.linalg.pinv((weighted / norms).T @ (weighted / norms), rcond=1e-14)
    theta = inverse / np.outer(norms, norms)
    D = state.theta[:3]
    n = len(state.theta)
    G = np.eye(n)
    G[0:9, 0:9] = 0
    for i in range(3):
        G[i, i] = -problem.half[i] / D[i] ** 2  # k = h / D
        G[3 + i, 6 + i] = 1  # angles
        G[6 + i, 3 + i] = 1  # b = w + m D / h
        G[6 + i, i] = problem.middle[i] / problem.half[i]
    return np.asarray(G @ theta @ G.T)


def cross_validated(problem: Problem, state: State, leverage: Floats) -> float | None:
    """rms of each pose's |a| − reference under a fit to all the others; None where a pose alone carries a parameter."""
    n = len(problem.u)
    if n <= len(state.theta) or np.max(leverage) > 1 - 1e-6:
        return None
    squares = 0.0
    for i in range(n):
        rest: Ints = np.delete(np.arange(n), i)
        without = solve(problem.only(rest), state, state.effects, steps=3)
        miss, _, _ = linearise(problem.only(slice(i, i + 1)), without, jacobian=False)
        squares += float(miss[0] ** 2)
    return float(np.sqrt(squares / n))


def _warnings(c: Calibration) -> list[str]:
    out = []
    if c.dilution > DILUTION_WARNING:
        labels = ", ".join(label for label, _ in most_wanted(np.array([p.direction for p in c.poses])))
        out.append(
            f"the poses are poorly spread: some combination of parameters is {c.dilution:.3g} times as uncertain as "
            f"one pose; add {labels}"
        )
    left = len(c.poses) - len(c.parameters)
    if left < 3:
        out.append(f"{len(c.poses)} poses for {len(c.parameters)} parameters: the residual proves little")
    worst = max(c.poses, key=lambda p: p.leverage)
    if worst.leverage > 0.95:
        out.append(f"the pose at {worst.pose.start_s:.1f} s alone carries a parameter (leverage {worst.leverage:.2f})")
    if c.inflation > 1:
        out.append(
            f"residuals are {c.inflation:.1f} times what the noise explains; the standard errors are raised by that"
        )
    creeping = [p for p in c.poses if np.any(p.pose.creep)]
    if creeping:
        out.append(f"{len(creeping)} poses creep; the first at {creeping[0].pose.start_s:.1f} s")
    return out
