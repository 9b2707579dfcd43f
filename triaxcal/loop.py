"""Close the loop: is anything left beyond noise, which effect is it, and what does the error become with it.

A raw residual correlates with the wrong candidate nearly always, because the fit has absorbed part of the right one.
So the candidates' columns are first projected off those of the model (Frisch–Waugh–Lovell), and what remains is
tested against the noise inside the poses (pure error).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, channels_of, conditions
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import TIME, Effect
from triaxcal.errors import InvalidData, Refused
from triaxcal.fit import Problem, State, fit, linearise, problem_of, solve, start
from triaxcal.poses import Pose
from triaxcal.sensor import Sensor
from triaxcal.visibility import is_visible, projected

FAMILYWISE = 0.01
"""Probability of any false finding on data with nothing inside."""
EFFECTS_MOST = 4
P_LEAST = 1e-300


@dataclass(frozen=True)
class Finding:
    """An effect that the data show. ``coefficients`` name → (value, standard error, unit).

    ``verdict`` is "adopted" where the name is earned, "confounded" where ``alternatives`` fit as well.
    """

    effect: str
    verdict: str
    p_value: float
    coefficients: Mapping[str, tuple[float, float, str]]
    alternatives: tuple[str, ...]
    reason: str
    remedy: str


@dataclass(frozen=True)
class Unexplained:
    """What is left. ``rms_g`` is its size beyond noise; ``lead`` the best hint at what it may be."""

    significant: bool
    p_value: float | None
    rms_g: float
    lead: str


@dataclass(frozen=True)
class HeldOut:
    """Errors of the magnitude in poses that no fit saw, in g."""

    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float
    poses: int


@dataclass(frozen=True)
class Loop:
    """The closed loop: the linear calibration, the extended one, and what lies between."""

    before: Calibration
    after: Calibration
    findings: tuple[Finding, ...]
    unexplained: Unexplained
    held_out: HeldOut | None
    advice: tuple[str, ...]


@dataclass(frozen=True)
class _Candidate:
    effect: Effect
    rank: int
    chi2: float
    state: State


def diagnose(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    check: Sequence[Pose] | None = None,
    catalogue: Sequence[Effect] = CATALOGUE,
) -> Loop:
    """Find and add the effects that still poses show beyond the linear model.

    Raises as `triaxcal.fit.fit` does. ``check`` are poses of another recording, for the held-out error.
    """
    before = fit(poses, signs=signs, reference=reference)
    problem = problem_of(poses, signs=signs, reference=reference)
    linear = solve(problem, start(problem, poses, signs), ())
    seen = [e for e in catalogue if is_visible(problem, linear, e)]
    search = _Search(problem, poses, signs, reference, seen, before)
    adopted = search.run(linear)
    after = search.best
    blind = tuple(e.name for e in catalogue if e not in seen)
    findings = tuple(search.finding(e, adopted) for e in adopted)
    unexplained = _unexplained(after, search)
    return Loop(
        before=before.with_blind_to(blind),
        after=after.with_blind_to(blind),
        findings=findings,
        unexplained=unexplained,
        held_out=_held_out(before, after, check) if check is not None else None,
        advice=tuple(_advice(findings, unexplained, blind)),
    )


class _Search:
    """Forward by information criterion, backward by significance; every step refits the whole model."""

    def __init__(
        self,
        problem: Problem,
        poses: Sequence[Pose],
        signs: Sequence[float],
        reference: float,
        seen: Sequence[Effect],
        before: Calibration,
    ) -> None:
        self.problem, self.poses, self.signs, self.reference = problem, poses, signs, reference
        self.seen = seen
        self.before = self.best = before
        self.pure = max(float(sum(min(p.dof, 1e6) for p in poses)), 1.0)
        self.p_values: dict[str, float] = {}
        self.passed_over: dict[str, str] = {}

    def chi2(self, state: State) -> float:
        r, _, s = linearise(self.problem, state)
        return float(np.sum((r / s) ** 2))

    def with_effects(self, linear: State, effects: Sequence[Effect]) -> State:
        return solve(self.problem, State(linear.theta[:9], ()), tuple(effects))

    def run(self, linear: State) -> list[Effect]:
        self.linear = linear
        adopted: list[Effect] = []
        now = linear
        while len(adopted) < EFFECTS_MOST:
            candidates = self._candidates(now, adopted)
            if not candidates:
                break
            best = min(candidates, key=lambda c: c.chi2 + c.rank * np.log(len(self.poses)))
            p = self.p_value(self.chi2(now), best.chi2, best.rank, best.state)
            p_family = min(1.0, p * len(self.seen))
            if p_family >= FAMILYWISE:
                self.passed_over[best.effect.name] = f"p = {p_family:.2g}"
                break
            trial = self._fitted([*adopted, best.effect])
            if trial is None or not _improves(trial, self.best):
                self.passed_over[best.effect.name] = "it does not lower the cross-validated error"
                break
            adopted.append(best.effect)
            self.p_values[best.effect.name] = p_family
            self.best, now = trial, best.state
        return self._pruned(adopted)

    def _candidates(self, now: State, adopted: list[Effect]) -> list[_Candidate]:
        out = []
        for effect in self.seen:
            rank = len(projected(self.problem, self.linear, effect, adopted)) if effect not in adopted else 0
            if not rank or (rank < len(effect.coefficients) and not adopted):
                continue
            if len(self.poses) - len(now.theta) - len(effect.coefficients) < 1:
                continue
            try:
                state = self.with_effects(self.linear, [*adopted, effect])
            except Refused:
                continue
            out.append(_Candidate(effect, rank, self.chi2(state), state))
        return out

    def p_value(self, before: float, after: float, rank: int, state: State) -> float:
        """Of a drop of chi-square: against the noise, and against what is left where more than noise is left."""
        p = float(stats.f.sf(max(before - after, 0.0) / rank, rank, self.pure))
        left = len(self.poses) - len(state.theta)
        if left > 0 and stats.f.sf(after / left, left, self.pure) < FAMILYWISE:
            p = max(p, float(stats.f.sf(max(before - after, 0.0) / rank / (after / left), rank, left)))
        return max(p, P_LEAST)

    def _fitted(self, effects: Sequence[Effect]) -> Calibration | None:
        try:
            return fit(self.poses, signs=self.signs, reference=self.reference, effects=effects)
        except Refused:
            return None

    def _pruned(self, adopted: list[Effect]) -> list[Effect]:
        """Without those that the later ones made needless: drift that had passed as nonlinearity, say."""
        for effect in list(adopted):
            rest = [e for e in adopted if e is not effect]
            if rest and self.given(effect, rest) * len(self.seen) >= FAMILYWISE:
                without = self._fitted(rest)
                if without is not None:
                    adopted, self.best = rest, without
        return adopted

    def given(self, effect: Effect, others: Sequence[Effect]) -> float:
        """p of an effect when the others are in the model already; 1 where it has nothing to add to them."""
        rank = len(projected(self.problem, self.linear, effect, others))
        if not rank:
            return 1.0
        try:
            both = self.with_effects(self.linear, [*others, effect])
            alone = self.with_effects(self.linear, others)
        except Refused:
            return 1.0
        return self.p_value(self.chi2(alone), self.chi2(both), rank, both)

    def alternatives(self, effect: Effect, adopted: list[Effect]) -> tuple[str, ...]:
        """Effects that would do as well in its place: with one of them in the model, it has nothing to add."""
        rest = [e for e in adopted if e is not effect]
        out = []
        for other in self.seen:
            if other in adopted:
                continue
            contains = not len(projected(self.problem, self.linear, effect, [*rest, other]))
            larger = len(other.coefficients) > len(effect.coefficients)
            if not (contains and larger) and self.given(effect, [*rest, other]) > FAMILYWISE:
                out.append(other.name)
        return tuple(out)

    def finding(self, effect: Effect, adopted: list[Effect]) -> Finding:
        alternatives = self.alternatives(effect, adopted)
        errors = dict(zip(self.best.parameters, self.best.standard_errors, strict=True))
        values = dict(zip(self.best.parameters, self.best.values, strict=True))
        rest = self._fitted([e for e in adopted if e is not effect])
        without = rest.residual if rest else self.before.residual
        p = self.p_values[effect.name]
        reason = (
            f"with it the cross-validated error falls from {_micro(without.cross_validated_rms_g)} to "
            f"{_micro(self.best.residual.cross_validated_rms_g)} (noise floor "
            f"{_micro(self.best.residual.noise_floor_g)}); familywise p {_probability(p)}"
        )
        if alternatives:
            reason += f"; {', '.join(alternatives)} would do as well on these poses"
        return Finding(
            effect=effect.name,
            verdict="confounded" if alternatives else "adopted",
            p_value=p,
            coefficients={
                c.name: (values[f"{effect.name}.{c.name}"], errors[f"{effect.name}.{c.name}"], c.unit)
                for c in effect.coefficients
            },
            alternatives=alternatives,
            reason=reason,
            remedy=effect.remedy,
        )


def _improves(trial: Calibration, best: Calibration) -> bool:
    new, old = trial.residual.cross_validated_rms_g, best.residual.cross_validated_rms_g
    return new is not None and (old is None or new < old)


def _micro(value: float | None) -> str:
    return "unknown" if value is None else f"{value * 1e6:.3g} µg"


def _probability(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1e}"


def _unexplained(after: Calibration, search: _Search) -> Unexplained:
    residual = after.residual
    p = residual.lack_of_fit_p
    significant = p is not None and p < FAMILYWISE
    beyond = float(np.sqrt(max(residual.rms_g**2 - residual.noise_floor_g**2, 0.0)))
    return Unexplained(significant, p, beyond, _lead(after, search) if significant else "")


def _lead(after: Calibration, search: _Search) -> str:
    worst = max(after.poses, key=lambda p: abs(p.studentized))
    squares = np.array([p.studentized**2 for p in after.poses])
    parts = []
    if worst.studentized**2 > 0.5 * squares.sum():
        parts.append(
            f"most of it is one pose, at {worst.pose.start_s:.1f} s ({worst.residual_g * 1e6:+.3g} µg): was it still?"
        )
    for name, why in search.passed_over.items():
        parts.append(f"the nearest effect is {name}, not adopted: {why}")
    miss = np.array([p.residual_g for p in after.poses])
    for name, values in search.problem.channels.items():
        if np.ptp(values) > 0:
            r = float(np.corrcoef(values, miss)[0, 1])
            if abs(r) > 0.6:
                parts.append(f"it goes with {'time' if name == TIME else name} (correlation {r:+.2f})")
    return "; ".join(parts) or "no candidate comes near, and no pose or channel stands out"


def _held_out(before: Calibration, after: Calibration, check: Sequence[Pose]) -> HeldOut:
    """Raises InvalidData where the check poses lack a channel that the effects need."""
    if not check:
        raise InvalidData("the check recording has no still pose")
    errors = [
        magnitude_errors(c.sensor, check, channel_reference=c.channel_reference, reference=c.reference)
        for c in (before, after)
    ]
    return HeldOut(_rms(errors[0][0]), _rms(errors[1][0]), _rms(errors[1][1]), len(check))


def magnitude_errors(
    sensor: Sensor, poses: Sequence[Pose], *, channel_reference: Mapping[str, float], reference: float
) -> tuple[Floats, Floats]:
    """|a| − reference (n,) of poses under a sensor's model, and its standard error (n,) from their noise.

    The poses are of another recording than the model's, whose clock is its own: effects of time count as at their
    reference. Raises InvalidData where a channel that the effects need is missing.
    """
    channels = channels_of(list(poses))
    missing = [n for n in channel_reference if n not in channels]
    if missing:
        raise InvalidData(f"the poses have no channel {', '.join(missing)}, which the calibration needs")
    channels[TIME] = np.full(len(poses), channel_reference.get(TIME, 0.0))
    u = np.array([p.mean for p in poses])
    held = conditions(channels, channel_reference)
    length, by_u = sensor.magnitude(u, held)
    covariance = np.array([p.covariance for p in poses])
    return length - reference, np.sqrt(np.einsum("ni,nij,nj->n", by_u, covariance, by_u))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _advice(
    findings: Sequence[Finding],
    unexplained: Unexplained,
    blind: Sequence[str],
) -> list[str]:
    out = [f"{f.effect}: {f.remedy}" for f in findings if f.verdict == "adopted"]
    for f in findings:
        if f.verdict == "confounded":
            out.append(
                f"{f.effect} cannot be told from {', '.join(f.alternatives)} here: record again with the poses in "
                "another order, some of them repeated at the end, and with more directions"
            )
    if unexplained.significant:
        out.append("something is left that no candidate explains: look at the lead, and record more poses")
    if blind:
        out.append(
            f"these poses cannot show {', '.join(blind)}: too few directions, or no such channel, or it stood still"
        )
    return out
