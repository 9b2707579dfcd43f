"""Close the loop: what acts beyond the linear model, with which probability,
and what the error becomes with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from triaxcal.effects.catalogue import plugins
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import Empirical
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration, Exclusion, ReferenceEpoch
from triaxcal.estimate.hold_out import HoldOut, held_out
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.mixture import OF_DIRECTION
from triaxcal.evidence.model_average import Refusal, average, corrected
from triaxcal.evidence.next_measurement import Advice, advice, decided
from triaxcal.evidence.partial_residuals import Trace, of_effect, residuals, telling_variables
from triaxcal.evidence.posterior import Findings, Named, NotIdentifiable, Posterior, findings, not_identifiable, stated
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.search import considered, posterior_of
from triaxcal.evidence.terms import faults_of
from triaxcal.model.samples import Moment
from triaxcal.poses.pose import Pose
from triaxcal.progress import Progress, Stage, unreported
from triaxcal.rounding import reaches
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import START_TO_START, NextRecording, next_recording

SHOWN = 2
"""Effects that are only corrected on average, at most, in `Loop.traces`: more
would hide the likeliest."""
Coefficients = Mapping[str, tuple[float, float | None, str]]
"""Name → value, standard error, unit."""


class Verdict(StrEnum):
    ADOPTED = "adopted"
    """Known, and corrected."""
    CONFOUNDED = "confounded"
    """One of several acts; or it is known, and no effect is corrected
    (`Loop.refusal`)."""


class Recommendation(StrEnum):
    """What to do with the calibration."""

    USABLE = "usable"
    """What acts is known and corrected, or nothing does."""
    RECORD_MORE = "record_more"
    """What acts is not known for certain, and poses could tell; or the
    calibration is less certain than the unit comes back after a start."""
    INVESTIGATE = "investigate"
    """Something acts that no effect describes, or this is not one unit in one
    mounting."""


@dataclass(frozen=True)
class Finding:
    """An effect that acts for certain, alone or as the likeliest of
    ``alternatives``, each with its probability; ``together`` is that of at
    least one of them. A probability is None where nothing tells that it is
    calibrated (`Loop.stated`). The ``coefficients`` are those that are corrected, or
    else those if it is this effect that acts; ``remedy`` is how to be rid of
    it."""

    effect: str
    verdict: Verdict
    probability: float | None
    alternatives: Mapping[str, float | None]
    coefficients: Coefficients
    remedy: str
    together: float


@dataclass(frozen=True)
class Candidate:
    """An effect that acts more likely than not, and not for certain: with the
    ``coefficients`` if it acts. Its ``probability`` is that if the truth is in
    the catalogue, which nobody knows, and so None (`Loop.stated`);
    ``hangs_on_one_pose``: it would be certain but for some one pose."""

    effect: str
    probability: float | None
    coefficients: Coefficients
    hangs_on_one_pose: bool = False


@dataclass(frozen=True)
class Loop:
    """The closed loop. ``before`` is the linear calibration, ``after`` the one
    that is handed on; ``found`` all that is read off the posterior.
    ``not_identifiable`` are effects that these poses cannot show in full,
    ``faulty`` those of other packages that cannot be used, each with the
    reason."""

    before: Calibration
    after: Calibration
    found: Findings
    findings: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    refusal: Refusal | None
    held_out: HoldOut | None
    not_identifiable: Mapping[str, NotIdentifiable]
    faulty: Mapping[str, str]
    posterior: Posterior = field(repr=False, compare=False)
    conditional_on: Mapping[str, Calibration] = field(repr=False, compare=False)
    """What the calibration would be if an effect acts, of findings that are not
    corrected and of candidates."""

    @cached_property
    def traces(self) -> tuple[Trace, ...]:
        """What the poses show of each finding and each candidate, against what
        drives it; where there are none, of the likeliest effects that are
        corrected all the same. Of what has no name, against the variables that
        tell most of it, with the findings in the model and without what corrects
        it; the readings first where it goes with the direction. Where the unit or
        its mounting changed, or no effect probably acts, the residuals."""
        rows = self.posterior.evidence.rows
        names = [*(f.effect for f in self.findings), *(c.effect for c in self.candidates)]
        names = names or sorted(self.averaged, key=lambda name: -self.averaged[name])[:SHOWN]
        of_names = [of_effect(rows, self.conditional_on.get(name, self.after), name) for name in names]
        something = self.found.nothing < self.posterior.evidence.odds.reported
        unnamed = self.found.unexplained.significant or (something and not names and not self.found.outliers)
        by_direction = unnamed and self.found.unexplained.kind in OF_DIRECTION
        shown = unnamed and self.found.change_point is None
        of_rest = telling_variables(rows, self._with_findings(), by_direction) if shown else ()
        found = (*(trace for each in of_names for trace in each), *of_rest)
        return (*found, residuals(self.after)) if self.found.change_point or not found else found

    def _with_findings(self) -> Calibration:
        """The calibration with the findings as its only effects."""
        if not self.findings:
            return self.before
        c = self.conditional_on.get(self.findings[0].effect, self.after)
        names = {f.effect for f in self.findings}
        return replace(c, sensor=replace(c.sensor, effects=tuple(e for e in c.sensor.effects if e[0].name in names)))

    @property
    def averaged(self) -> Mapping[str, float]:
        """Effects that are corrected by as much as they are probable, and are
        neither findings nor candidates: each with its probability."""
        named = {name for f in self.findings for name in (f.effect, *f.alternatives)} | {
            c.effect for c in self.candidates
        }
        return {name: p for name, p in self.after.weights.items() if name not in named}

    @property
    def probabilities(self) -> Mapping[str, float]:
        """That each effect acts, whatever else does, the likeliest first; as the
        posterior has it, in whose catalogue the truth is."""
        return self.posterior.effect_probabilities

    @property
    def stated(self) -> Mapping[str, float | None]:
        """Those of the ``probabilities`` that are calibrated, else None. One that
        is likely and not known is not: where the truth is in no catalogue, a
        likely name is wrong."""
        return stated(self.found, self.probabilities)

    @property
    def smooth(self) -> bool:
        """Whether a smooth function of the direction is corrected in the place
        of names."""
        return Empirical().name in self.after.terms

    @cached_property
    def advice(self) -> Advice:
        """What to record next; nothing where that cannot be determined."""
        try:
            return advice(self.posterior)
        except Refused:  # the model has no inverse in poses to come
            return Advice((), 0.0, 0.0, {})

    @cached_property
    def next_recording(self) -> NextRecording:
        """As the recording tells by itself, without what a station knows of its
        reference."""
        return next_recording(self.after, budget(self.after))

    @cached_property
    def too_uncertain(self) -> bool:
        """Whether more poses would make the next recording better, whatever
        acts: the variance of its error that the calibration itself adds is more
        than that from start to start, which no pose lessens."""
        known = max(self.next_recording.start_to_start, START_TO_START * self.after.reference)
        return bool(self.next_recording.standard > np.sqrt(2) * known)

    @cached_property
    def call(self) -> Recommendation:
        if self.refusal in (Refusal.UNMODELLED, Refusal.CHANGE_POINT):
            return Recommendation.INVESTIGATE
        known = decided(self.posterior) and not self.candidates
        more = self.too_uncertain or self.found.outliers or (not known and self.advice.actions)
        return Recommendation.RECORD_MORE if more else Recommendation.USABLE


def diagnose(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    check: Sequence[Pose] | None = None,
    catalogue: Sequence[Effect] | None = None,
    at: Moment | float = Moment.END,
    odds: Odds | None = None,
    progress: Progress = unreported,
) -> Loop:
    """Find and correct the effects that still poses show beyond the linear
    model.

    ``catalogue`` are the effects to look for: all that are known for these
    poses' channels where it is None. ``check`` are poses of another recording,
    for the held-out error. ``at`` is the moment of the recording for which the
    calibration holds elsewhere: a number in seconds from the first sample.
    ``progress`` is called as the work goes on. Raises as
    `triaxcal.estimate.pose_fit.fit` does.
    """
    progress(Stage.FIT)
    linear = fit(poses, signs=signs, reference=reference)
    sound = [p for p in poses if not p.fault]
    moment = ReferenceEpoch.of(sound, at)
    if moment is None:
        raise Refused("no pose without a fault")
    posterior = posterior_of(poses, linear, signs=signs, catalogue=catalogue, odds=odds, progress=progress)
    progress(Stage.ERRORS)
    before = replace(_without_outliers(poses, linear, signs, posterior), holds_at=moment)
    effects = considered(poses, catalogue)
    faulty = faults_of(posterior.evidence.rows, effects)
    hidden = not_identifiable(posterior.evidence, [e for e in effects if e.name not in faulty])
    found = findings(posterior)
    after, refused = corrected(before, posterior, moment)
    before, after = (c.with_blind_to(tuple(hidden)) for c in (before, after))
    report = _Report(posterior, moment, after, found)
    sound_check = None if check is None else [p for p in check if not p.fault]
    return Loop(
        before=before,
        after=after,
        found=found,
        findings=tuple(report.finding(named, refused) for named in found.named),
        candidates=tuple(report.candidate(name, p) for name, p in found.candidates.items()),
        refusal=refused,
        held_out=None if sound_check is None else held_out(before, after, sound_check),
        not_identifiable=hidden,
        faulty=(dict(plugins()[1]) if catalogue is None else {}) | faulty,
        posterior=posterior,
        conditional_on=dict(report.conditional),
    )


def _without_outliers(
    poses: Sequence[Pose], linear: Calibration, signs: Sequence[float], posterior: Posterior
) -> Calibration:
    """The linear calibration without the poses that are outliers whatever else
    acts, and with all others."""
    likely = {
        int(i): float(p) for i, p in zip(posterior.evidence.rows.places, posterior.outlier_probabilities, strict=True)
    }
    outliers = [i for i, p in likely.items() if reaches(p, posterior.evidence.odds.reported)]
    if outliers != [i for i, p in enumerate(linear.poses) if p.excluded == Exclusion.OUTLIER]:
        with suppress(Refused):  # the others may not carry a fit
            linear = fit(poses, signs=signs, reference=linear.reference, excluded=outliers, why=Exclusion.OUTLIER)
    return replace(
        linear, poses=tuple(replace(p, outlier_probability=likely.get(i)) for i, p in enumerate(linear.poses))
    )


@dataclass(frozen=True)
class _Report:
    """What is reported of an effect of this name: as it is in ``after``, or as
    it would be if it acted."""

    posterior: Posterior
    moment: ReferenceEpoch
    after: Calibration
    found: Findings
    conditional: dict[str, Calibration] = field(default_factory=dict)
    """By name, as `if_it_acts` found them."""

    def finding(self, named: Named, refused: Refusal | None) -> Finding:
        probabilities = named.probabilities
        name, *others = probabilities
        calibrated = stated(self.found, probabilities)
        adopted = not others and refused is None
        coefficients, remedy = self._of(self.after, name) if adopted else self.if_it_acts(name)
        return Finding(
            effect=name,
            verdict=Verdict.ADOPTED if adopted else Verdict.CONFOUNDED,
            probability=calibrated[name],
            alternatives={other: calibrated[other] for other in others},
            coefficients=coefficients,
            remedy=remedy,
            together=named.together,
        )

    def candidate(self, name: str, probability: float) -> Candidate:
        calibrated = stated(self.found, {name: probability})[name]
        hangs = self.posterior.evidence.odds.hangs_on_one_pose(probability)
        return Candidate(name, calibrated, self.if_it_acts(name)[0], hangs)

    def if_it_acts(self, name: str) -> tuple[Coefficients, str]:
        made = average(self.posterior.conditional_on(name), self.moment)
        reference = self.posterior.evidence.rows.problem.channel_reference
        self.conditional[name] = replace(
            self.after, sensor=made.sensor, covariance=made.covariance, channel_reference=reference
        )
        return self._of(self.conditional[name], name)

    def _of(self, c: Calibration, name: str) -> tuple[Coefficients, str]:
        effect, q = next((e, q) for e, q in c.sensor.effects if e.name == name)
        floor = self.after.residual.noise_floor_g
        if not effect.coefficients[0].unit.startswith("g"):
            floor /= c.reference  # the effect is a share of the magnitude
        return c.coefficients_of(name), effect.advice(float(abs(q).max()), floor)
