"""Close the loop: is anything left beyond noise, which effect is it, and what does the error become with it.

A raw residual correlates with the wrong candidate nearly always, because the fit has absorbed part of the right one.
So the candidates' columns are first projected off those of the model (Frisch–Waugh–Lovell), and what remains is
tested against the noise inside the poses (pure error).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.calibration import Calibration, PoseResult
from triaxcal.conditions import channels_of
from triaxcal.creep import with_creep_left, without_creep
from triaxcal.description import described
from triaxcal.effects import catalogue_for
from triaxcal.effects.contract import Effect
from triaxcal.effects.part import Part
from triaxcal.effects.plugins import plugins
from triaxcal.errors import Refused
from triaxcal.findings import Finding, advice_of, description_of, finding_of, the_poses, why_not_shown
from triaxcal.fit import fit, with_faulty
from triaxcal.held_out import HeldOut, better_of, held_out
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.runs import by_run, expected_of
from triaxcal.search import NEAR, NO_LOWER, Search, alternatives, compared
from triaxcal.search.candidates import Ground, faults_of, still_conditions
from triaxcal.start import problem_of, start, with_history
from triaxcal.unexplained import SIGNIFICANT, Unexplained, hints_of, spoiled_or, unexplained_of

ANYTHING = 5
"""An effect beside others, with so many alternatives, is none."""
SPOILED = 0.02
"""Of so many poses something spoils one, as far as nothing is known of them."""
OPEN = 6.0
"""Poses are left out as spoiled for certain where every effect is worse by so much, in deviance: odds of 20 to 1."""
ROUNDS_MOST = 3
"""Effects and spoiled poses are sought in turn so often."""


@dataclass(frozen=True)
class Loop:
    """The closed loop: the linear calibration, the extended one, and what lies between."""

    before: Calibration
    after: Calibration
    findings: tuple[Finding, ...]
    unexplained: Unexplained
    held_out: HeldOut | None
    advice: tuple[str, ...]
    search: Search | None = field(default=None, repr=False, compare=False)
    """That which found it, for further questions."""


def diagnose(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    check: Sequence[Pose] | None = None,
    catalogue: Sequence[Effect] | None = None,
    empirical: bool = False,
) -> Loop:
    """Find and add the effects that still poses show beyond the linear model.

    ``catalogue`` are the effects to look for: all that are known for these poses' channels where it is None. ``check``
    are poses of another recording, for the held-out error. ``empirical``: what no effect explains is described by a
    smooth term, where that helps poses that it was not fitted to. Raises as `triaxcal.fit.fit` does.
    """
    sound = [p for p in poses if not p.fault]
    if check is not None:
        check = [p for p in check if not p.fault]
    if len(sound) < len(poses):
        loop = diagnose(sound, signs=signs, reference=reference, check=check, catalogue=catalogue, empirical=empirical)
        return replace(
            loop,
            before=with_faulty(loop.before, poses),
            after=with_faulty(loop.after, poses),
            findings=tuple(replace(f, step=with_faulty(f.step, poses)) for f in loop.findings),
        )
    linear = fit(poses, signs=signs, reference=reference)
    moving = set(channels_of(poses)) - still_conditions(poses)
    effects = by_run(catalogue_for(moving) if catalogue is None else catalogue, poses)
    # What moves the bias also makes poses creep: to the search that is no error of their means.
    quiet = without_creep(poses)
    found = _explained(quiet, _aside(linear), signs, reference, effects)
    search, given = found.search, _Given(poses, signs, reference, found.aside)
    before, steps = linear, [linear]
    # Poses in which |a| itself creeps are something that is left, not an excuse for it.
    if found.adopted:
        model = replace(given, poses=quiet).fit(found.adopted)
        before = given.fit(())
        given = replace(given, poses=with_creep_left(poses, model))
        steps = [given.fit(found.adopted[:count]) for count in range(1, len(found.adopted) + 1)]
        # The search has asked this of poses without their creep.
        if not compared(steps[-1], before).lower:
            found.linear.passed_over[" with ".join(e.name for e in found.adopted)] = NO_LOWER
            found = replace(found, adopted=[])
            given, before, steps = replace(given, poses=poses), linear, [linear]
    if not found.adopted:
        # What is left is asked of the poses that the calibration is of.
        model = fit(quiet, signs=signs, reference=reference, aside=_aside(linear))
        search = found.linear
        search.settle_on(search.linear)
    p = search.anything_p(search.found)
    unexplained = unexplained_of(model, search.passed_over, p, search.nearest(), hints_of(search))
    aside = [p for p in before.poses if not p.used]
    rivals = _names(found.rivals) if not found.adopted else []
    if aside and rivals and not unexplained.significant and found.whole_p is not None and found.whole_p < SIGNIFICANT:
        whole = fit(quiet, signs=signs, reference=reference, aside=())
        unexplained = spoiled_or(whole, found.whole_p, aside, rivals)
    smooth, undescribed = described(steps[-1], unexplained, signs) if empirical else (None, "")
    after = smooth or steps[-1]
    findings: list[Finding] = []
    for effect, step in zip(found.adopted, steps, strict=False):
        others = [e for e in found.adopted if e is not effect]
        without = given.tried(others) if others else before
        spoiled = () if findings else tuple(poses[i].at for i in found.spoiled)
        findings.append(finding_of(search, effect, (without, steps[-1]), after, step, found.rivals, spoiled))
    if smooth is not None:
        findings.append(description_of(smooth, steps[-1]))
        unexplained = unexplained_of(smooth, search.passed_over)
    faulty = faults_of(Ground.at(search.problem, search.linear.state), effects)
    shown = search.full | faulty.keys() | {e.name for e in found.adopted if not isinstance(e, Part)}
    blind = {e.name: why_not_shown(search, e) for e in effects if e.name not in shown}
    if catalogue is None:
        faulty = dict(plugins()[1]) | faulty
    held = None
    if check is not None:
        instead = {n: given.tried(effects) for f in findings for n, effects in f.instead.items()}
        held = held_out(before, after, check, {n: c for n, c in instead.items() if c is not None})
    advice = advice_of(findings, unexplained, undescribed, blind, faulty)
    return Loop(
        before=before.with_blind_to(tuple(blind)),
        after=after.with_blind_to(tuple(blind)),
        findings=tuple(findings),
        unexplained=unexplained,
        held_out=held,
        advice=tuple(_again(aside, rivals) + advice + better_of(held)),
        search=search,
    )


@dataclass(frozen=True)
class _Given:
    """Poses, and how they are fitted whatever the effects."""

    poses: Sequence[Pose]
    signs: Sequence[float]
    reference: float
    aside: tuple[int, ...]

    def fit(self, effects: Sequence[Effect]) -> Calibration:
        return fit(self.poses, signs=self.signs, reference=self.reference, effects=effects, aside=self.aside)

    def tried(self, effects: Sequence[Effect]) -> Calibration | None:
        """None where the poses cannot carry it."""
        try:
            return self.fit(effects)
        except Refused:
            return None


@dataclass(frozen=True)
class _Found:
    """What the search found with so many poses left out."""

    search: Search
    adopted: list[Effect]
    aside: tuple[int, ...]
    linear: Search
    """That with those poses left out which the linear fit leaves out."""
    rivals: tuple[tuple[Effect, ...], ...] = ()
    """Effects that explain as much with other poses left out."""
    spoiled: tuple[int, ...] = ()
    """Poses that explain as much without any effect, were they spoiled."""
    whole_p: float | None = None
    """Where poses were left out: the probability of what the linear model leaves of all of them."""


def _again(aside: Sequence[PoseResult], rivals: Sequence[str]) -> list[str]:
    """What to take again: poses left out as spoiled, and what would explain as much without that."""
    if not aside:
        return []
    advice = f"take again {the_poses([p.pose.at for p in aside])}: left out as spoiled"
    if rivals:
        advice += f", but {' or '.join(rivals)} would explain as much; if it comes out the same, nothing spoiled it"
    return [advice]


def _names(rivals: Sequence[Sequence[Effect]]) -> list[str]:
    return list(dict.fromkeys(e.name for effects in rivals for e in effects))


def _aside(c: Calibration) -> tuple[int, ...]:
    return tuple(i for i, p in enumerate(c.poses) if not p.used)


def _explained(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    effects: Sequence[Effect],
) -> _Found:
    """The best explanation by effects, spoiled poses, or both; ``aside`` are those that the linear fit leaves out."""
    asked = [(), aside, _aside(fit(poses, signs=signs, reference=reference))]
    # What looks like spoiled poses may be an effect that the linear model lacks.
    tried = [_tried(poses, rows, signs, reference, effects) for rows in dict.fromkeys(asked)]
    trials = [t for t in tried if t is not None]
    first = trials[0].search
    # Nothing, or much, may be made of an effect and a spoiled pose that hide each other.
    unsure = len(trials[0].adopted) != 1 and first.left_over(first.linear)
    if unsure and not trials[0].aside and (row := first.spoiled_beside()) is not None:
        trials += [t for t in [_tried(poses, (row,), signs, reference, effects)] if t is not None]
    found = min(trials, key=lambda trial: _criterion(trial, len(poses)))
    for _ in range(ROUNDS_MOST):
        # Beside an effect a spoiled pose may not have shown; with the effect in the model it does.
        again = _aside(fit(poses, signs=signs, reference=reference, effects=found.adopted))
        if again == found.aside or not found.adopted:
            break
        other = _tried(poses, again, signs, reference, effects)
        if other is None or _criterion(other, len(poses)) >= _criterion(found, len(poses)):
            break
        trials.append(other)
        found = other
    near = _criterion(found, len(poses)) + (NEAR if found.adopted else OPEN)
    others = [t for t in trials if t.aside != found.aside]
    rivals: list[tuple[Effect, ...]] = []
    for t in others:
        models = [t.search.found, *t.search.singles_from(t.search.linear)]
        price = _criterion(t, len(poses)) - t.search.score(t.search.found)
        rivals += [m.effects for m in models if m.effects and t.search.score(m) + price < near]
    without = [t for t in others if found.adopted and not t.adopted and _criterion(t, len(poses)) < near]
    spoiled = min(without, key=lambda t: _criterion(t, len(poses))).aside if without else ()
    linear = next((t.search for t in trials if t.aside == aside), found.search)
    whole_p = first.anything_p(first.linear) if aside and not trials[0].aside else None
    return replace(found, linear=linear, rivals=tuple(rivals), spoiled=spoiled, whole_p=whole_p)


def _tried(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    effects: Sequence[Effect],
) -> _Found | None:
    """None where the poses that are left cannot carry the linear model."""
    try:
        return _searched(poses, aside, signs, reference, effects)
    except Refused:
        return None


def _searched(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    catalogue: Sequence[Effect],
) -> _Found:
    before = fit(poses, signs=signs, reference=reference, aside=aside)
    kept = [p for i, p in enumerate(poses) if i not in aside]
    problem = problem_of(kept, signs=signs, reference=reference)
    linear = solve(problem, start(problem, kept, signs), ())
    problem = with_history(problem, kept, linear.sensor(problem))
    search = Search(problem, kept, signs, reference, catalogue, before, linear)
    other = copy(search)
    other.passed_over = {}
    adopted = search.run()
    expected = [e for e in expected_of(kept) if e.name in search.full]
    # What is nearly always there: beside it others show that neither alone nor in pairs would have.
    if expected and len(other.run(expected)) > 1 and other.score(other.found) < search.score(search.found):
        search, adopted = other, list(other.found.effects)
    return _Found(search, adopted if expected else _without_fillers(search), aside, search)


def _without_fillers(search: Search) -> list[Effect]:
    """The effects found, but where one of several could be almost anything: then it only fills what no effect explains,
    and what stands beside it has to earn its place without it."""
    now = search.found
    while len(now.effects) > 1:
        filler = next((e for e in reversed(now.effects) if len(alternatives(search, e, now)) >= ANYTHING), None)
        if filler is None:
            break
        search.passed_over[filler.name] = "almost any effect would do as well"
        rest = search.model([e for e in now.effects if e is not filler])
        now = rest if rest is not None and search.earned_all(rest) else search.linear
    return list(now.effects) if now is search.found else search.settle_on(now)


def _criterion(found: _Found, n: int) -> float:
    """The score of a model, where a pose left out costs a parameter and how seldom one is spoiled."""
    return found.search.score(found.search.found) + len(found.aside) * float(np.log(n) + 2 * np.log(1 / SPOILED - 1))
