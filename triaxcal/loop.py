"""Close the loop: is anything left beyond noise, which effect is it, and what does the error become with it.

A raw residual correlates with the wrong candidate nearly always, because the fit has absorbed part of the right one.
So the candidates' columns are first projected off those of the model (Frisch–Waugh–Lovell), and what remains is
tested against the noise inside the poses (pure error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from triaxcal.aside import with_faulty
from triaxcal.calibration import Calibration, Exclusion, HoldsAt, PoseResult
from triaxcal.conditions import channels_of
from triaxcal.creep import with_creep_left, without_creep
from triaxcal.description import described
from triaxcal.effects import catalogue_for
from triaxcal.effects.contract import Effect
from triaxcal.effects.part import Part
from triaxcal.effects.plugins import EffectFault, plugins
from triaxcal.errors import Refused
from triaxcal.explanation import Explanation, explained, left_out
from triaxcal.extrapolation import extrapolated
from triaxcal.figures import the_poses
from triaxcal.findings import Finding, advice_of, description_of, finding_of, why_not_shown
from triaxcal.held_out import HeldOut, better_of, held_out
from triaxcal.moment import Moment
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.pure_error import LACK_OF_FIT
from triaxcal.runs import by_run
from triaxcal.search import FAMILYWISE, NO_LOWER, Search, coincidence, coincidence_of_spoiled, compared
from triaxcal.search.candidates import Ground, faults_of, still_conditions
from triaxcal.unexplained import (
    NAMELESS,
    Unexplained,
    beyond_noise,
    hints_of,
    moving_inside,
    or_named,
    spoiled_or,
    unexplained_of,
)

SAME = "what comes out the same was not spoiled"


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
    at: Moment | float = Moment.END,
) -> Loop:
    """Find and add the effects that still poses show beyond the linear model.

    ``catalogue`` are the effects to look for: all that are known for these poses' channels where it is None. ``check``
    are poses of another recording, for the held-out error. ``empirical``: what no effect explains is described by a
    smooth term, where that helps poses that it was not fitted to. ``at`` is the moment of the recording for which the
    calibration holds elsewhere: a number in seconds from the first sample. Raises as `triaxcal.pose_fit.fit` does.
    """
    return _diagnosed(poses, signs, reference, check, catalogue, empirical, HoldsAt.of(poses, at))


def _diagnosed(
    poses: Sequence[Pose],
    signs: Sequence[float],
    reference: float,
    check: Sequence[Pose] | None,
    catalogue: Sequence[Effect] | None,
    empirical: bool,
    moment: HoldsAt | None,
) -> Loop:
    sound = [p for p in poses if not p.fault]
    if check is not None:
        check = [p for p in check if not p.fault]
    if len(sound) < len(poses):
        loop = _diagnosed(sound, signs, reference, check, catalogue, empirical, moment)
        return replace(
            loop,
            before=with_faulty(loop.before, poses),
            after=with_faulty(loop.after, poses),
            findings=tuple(replace(f, step=with_faulty(f.step, poses)) for f in loop.findings),
            advice=(*_without_faults(poses), *loop.advice),
        )
    linear = fit(poses, signs=signs, reference=reference)
    moving = set(channels_of(poses)) - still_conditions(poses)
    effects = by_run(catalogue_for(moving) if catalogue is None else catalogue, poses)
    made = _made(linear, _Given(poses, signs, reference, left_out(linear)), effects)
    search, before, steps = made.search, made.before, made.steps
    unexplained = _unexplained(made)
    smooth, undescribed = described(steps[-1], unexplained, signs) if empirical else (None, "")
    after = smooth or steps[-1]
    findings: list[Finding] = []
    for effect, step, chance in zip(made.adopted, steps, made.chances, strict=False):
        others = [e for e in made.adopted if e is not effect]
        without = made.given.tried(others) if others else before
        spoiled = tuple(poses[i].began for i in made.found.spoiled)
        rivals, pair = made.found.rivals, (without, steps[-1])
        findings.append(finding_of(search, effect, pair, after, step, rivals, spoiled, chance))
    if smooth is not None:
        findings.append(description_of(smooth, steps[-1], unexplained.p_value))
        unexplained = unexplained_of(smooth, search.passed_over)
    faulty = faults_of(Ground.at(search.problem, search.linear.state), effects)
    shown = search.full | faulty.keys() | {e.name for e in made.adopted if not isinstance(e, Part)}
    blind = {e.name: why_not_shown(search, e) for e in effects if e.name not in shown}
    if catalogue is None:
        faulty = dict(plugins()[1]) | faulty
    instead = {n: made.given.tried(effects) for f in findings for n, effects in f.instead.items()}
    known = {n: c for n, c in instead.items() if c is not None}
    if smooth is None:
        after = replace(after, rivals=known | _spoiled_instead(made))
    before, after = (replace(c, holds_at=moment) for c in (before, after))
    if after.sensor.effects:
        beyond = extrapolated(after)
        after = replace(after, linear_only=before, cautions=(*after.cautions, *([beyond] if beyond else [])))
    known = {name: replace(c, holds_at=moment) for name, c in known.items()}
    held = None if check is None else held_out(before, after, check, known)
    advice = advice_of(findings, unexplained, undescribed, blind, faulty)
    return Loop(
        before=before.with_blind_to(tuple(blind)),
        after=after.with_blind_to(tuple(blind)),
        findings=tuple(findings),
        unexplained=unexplained,
        held_out=held,
        advice=tuple(_again(made) + advice + better_of(held)),
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
        return fit(
            self.poses,
            signs=self.signs,
            reference=self.reference,
            effects=effects,
            aside=self.aside,
            why=Exclusion.OUTLIER,
        )

    def tried(self, effects: Sequence[Effect]) -> Calibration | None:
        """None where the poses cannot carry it."""
        try:
            return self.fit(effects)
        except (Refused, EffectFault):
            return None


@dataclass(frozen=True)
class _Made:
    """What was made of the poses: ``found`` explains them by effects, of which those ``adopted`` lower the error in
    poses left out; ``search`` is that of the poses used."""

    found: Explanation
    search: Search
    adopted: list[Effect]
    given: _Given
    before: Calibration
    steps: list[Calibration]
    """The fit with ever more of the effects adopted, or the linear fit."""
    quiet: _Given
    """Poses without the creep that what moves the bias makes."""

    chances: tuple[float, ...] = ()
    """Of each effect adopted its coincidence (`triaxcal.search`)."""

    spoiled_by_chance: float = 0.0
    """That of the poses left out as spoiled, beside the effects."""

    @property
    def untested(self) -> dict[str, float]:
        """The effects that were not put to the test, each with its coincidence."""
        chances = zip(self.adopted, self.chances, strict=True)
        return {e.name: chance for e, chance in chances if chance >= FAMILYWISE}

    @property
    def aside(self) -> list[PoseResult]:
        """Poses left out as spoiled."""
        return [p for p in self.steps[-1].poses if p.excluded == Exclusion.OUTLIER]

    @property
    def rivals(self) -> list[str]:
        """Effects that would explain as much as leaving these poses out, where none is adopted."""
        found = () if self.adopted else self.found.instead
        return list(dict.fromkeys(e.name for effects in found for e in effects))


def _made(linear: Calibration, of_linear: _Given, effects: Sequence[Effect]) -> _Made:
    """``of_linear`` are the poses as the ``linear`` fit has them."""
    # What moves the bias also makes poses creep: to the search that is no error of their means.
    quiet_of_linear = replace(of_linear, poses=without_creep(of_linear.poses))
    found = explained(quiet_of_linear.poses, of_linear.aside, of_linear.signs, of_linear.reference, effects)
    if found.adopted:
        given, quiet = (replace(g, aside=found.aside) for g in (of_linear, quiet_of_linear))
        # Poses in which |a| itself creeps are something that is left, not an excuse for it.
        left = replace(given, poses=with_creep_left(given.poses, quiet.fit(found.adopted)))
        before = given.fit(())
        steps = [left.fit(found.adopted[:count]) for count in range(1, len(found.adopted) + 1)]
        # The search has asked this of poses without their creep.
        if compared(steps[-1], before).lower:
            search = found.search
            chances = tuple(coincidence(search, e, search.found) for e in found.adopted)
            by_chance = coincidence_of_spoiled(search, search.found)
            return _Made(found, search, found.adopted, left, before, steps, quiet, chances, by_chance)
        found.linear.passed_over[" with ".join(e.name for e in found.adopted)] = NO_LOWER
    # What is left is asked of the poses that the calibration is of.
    found.linear.settle_on(found.linear.linear)
    return _Made(found, found.linear, [], of_linear, linear, [linear], quiet_of_linear)


def _unexplained(made: _Made) -> Unexplained:
    search, p = made.search, made.search.anything_p(made.search.found)
    left = unexplained_of(made.quiet.fit(made.adopted), search.passed_over, p, search.nearest(), hints_of(search))
    # Beside the residuals of poses with their creep, which are told, it must not look less than they are.
    left = replace(left, rms_g=max(left.rms_g, beyond_noise(made.steps[-1])))
    whole_p = made.found.whole_p
    if made.adopted and not left.significant:
        return _named_or_none(made) or moving_inside(search) or left
    if made.rivals and whole_p is not None and whole_p < LACK_OF_FIT:
        return spoiled_or(replace(made.quiet, aside=()).fit(()), whole_p, made.aside, made.rivals, left)
    return left


def _named_or_none(made: _Made) -> Unexplained | None:
    """Where effects explain all there is, but need not be what it is; None where they were put to the test."""
    search, spoiled = made.search, [made.given.poses[i].began for i in made.found.spoiled]
    in_doubt = made.aside if made.spoiled_by_chance >= FAMILYWISE else []
    if made.untested or spoiled:
        sure = [] if spoiled else [e for e in made.adopted if e.name not in made.untested]
        before = made.quiet.tried(sure) or made.quiet.fit(())
        p = search.anything_p(search.model(sure) or search.linear)
        left = or_named(before, p, made.untested, spoiled, moving_inside(search))
        return spoiled_or(before, p, in_doubt, [NAMELESS], left) if in_doubt else left
    unknown = tuple(sorted(search.left_out.unknown(made.adopted)))
    whole = replace(made.quiet, aside=unknown).tried(made.adopted) if in_doubt else None
    if whole is None:
        return None
    return spoiled_or(whole, whole.residual.lack_of_fit_p, in_doubt, [NAMELESS])


def _spoiled_instead(made: _Made) -> dict[str, Calibration]:
    """The linear model without poses that explain as much as the effects do, were they spoiled."""
    if not made.found.spoiled or not made.adopted:
        return {}
    model = replace(made.given, aside=made.found.spoiled).tried(())
    if model is None:
        return {}
    left_out = the_poses(p.pose.began for p in model.poses if not p.used)
    return {f"that something spoiled {left_out}": model}


def _without_faults(poses: Sequence[Pose]) -> list[str]:
    """To take again the poses in which the outputs did not follow the acceleration, by what was the matter."""
    faults = dict.fromkeys(p.fault for p in poses if p.fault)
    return [f"take again {the_poses(p.began for p in poses if p.fault == f)}: left out ({f})" for f in faults]


def _again(made: _Made) -> list[str]:
    """What to take again: poses left out as spoiled, and what would explain as much without that."""
    if not made.aside:
        return []
    advice = f"take again {the_poses(p.pose.began for p in made.aside)}: left out as spoiled"
    if made.rivals:
        advice += f", but {' or '.join(made.rivals)} would explain as much; {SAME}"
    elif made.untested or made.spoiled_by_chance >= FAMILYWISE:
        advice += f", but something else may act; {SAME}"
    return [advice]
