"""The closed loop: effects beyond the linear model with their probabilities, and the
error before and after their correction."""

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
"""Maximum number of effects in `Loop.traces` that are corrected on average only: more
would hide the likeliest."""
Coefficients = Mapping[str, tuple[float, float | None, str]]
"""Name → value, standard error, unit."""


class Verdict(StrEnum):
    ADOPTED = "adopted"
    """The effect acts, and is corrected."""
    CONFOUNDED = "confounded"
    """One of several effects acts; or the effect acts, and no effect is corrected
    (`Loop.refusal`)."""


class Recommendation(StrEnum):
    """The recommended use of the calibration."""

    USABLE = "usable"
    """All effects are known and corrected, or none acts."""
    RECORD_MORE = "record_more"
    """Some effect is uncertain, and further poses would decide; or the calibration is
    less certain than the start-to-start repeatability of the unit."""
    INVESTIGATE = "investigate"
    """An unmodelled part acts, or the unit or its mounting changed."""


@dataclass(frozen=True)
class Finding:
    """An effect that acts for certain, alone or as the likeliest of competing
    effects.

    ``alternatives`` has the competing effects with their probabilities, ``together``
    is the probability that at least one of all acts. A probability is None if nothing
    shows that it is calibrated (`Loop.stated`). The ``coefficients`` are the corrected
    ones, else those conditional on this effect. ``remedy`` removes its cause."""

    effect: str
    verdict: Verdict
    probability: float | None
    alternatives: Mapping[str, float | None]
    coefficients: Coefficients
    remedy: str
    together: float


@dataclass(frozen=True)
class Candidate:
    """An effect that acts more likely than not, but not for certain.

    The ``coefficients`` are conditional on the effect. Its ``probability`` holds if
    the catalogue contains the truth, which is unknown, and so it is None
    (`Loop.stated`). ``hangs_on_one_pose``: the effect would be certain without some
    single pose."""

    effect: str
    probability: float | None
    coefficients: Coefficients
    hangs_on_one_pose: bool = False


@dataclass(frozen=True)
class Loop:
    """The result of a diagnosis.

    ``before`` is the linear calibration, ``after`` the calibration to use, ``found``
    the findings from the posterior. ``not_identifiable`` has the effects that these
    poses cannot show in full, ``faulty`` the unusable effects of other packages, each
    with its reason."""

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
    """The calibration conditional on an effect, for candidates and for findings that
    are not corrected."""

    @cached_property
    def traces(self) -> tuple[Trace, ...]:
        """Partial residuals of each finding and each candidate against its driving
        variable; without any, of the likeliest effects that are corrected on average.

        An unmodelled part is shown against the variables that explain most of it, with
        the findings in the model and without its correction; a part by direction shows
        the readings first. After a change of the unit or its mounting, or if probably
        no effect acts, the residuals."""
        rows = self.posterior.evidence.rows
        # The named effects, else the likeliest of the average.
        names = [*(f.effect for f in self.findings), *(c.effect for c in self.candidates)]
        names = names or sorted(self.averaged, key=lambda name: -self.averaged[name])[:SHOWN]
        of_names = [of_effect(rows, self.conditional_on.get(name, self.after), name) for name in names]
        # The unmodelled part: significant, or the only explanation that is left.
        something = self.found.nothing < self.posterior.evidence.odds.reported
        unmodelled = self.found.unexplained.significant or (something and not names and not self.found.outliers)
        by_direction = unmodelled and self.found.unexplained.kind in OF_DIRECTION
        shown = unmodelled and self.found.change_point is None
        of_unmodelled = telling_variables(rows, self._with_findings(), by_direction) if shown else ()
        # The residuals, if nothing else is shown or the unit changed.
        found = (*(trace for each in of_names for trace in each), *of_unmodelled)
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
        """Effects that the model average corrects and that are neither findings nor
        candidates, each with its probability."""
        named = {name for f in self.findings for name in (f.effect, *f.alternatives)} | {
            c.effect for c in self.candidates
        }
        return {name: p for name, p in self.after.weights.items() if name not in named}

    @property
    def probabilities(self) -> Mapping[str, float]:
        """Marginal posterior probability of each effect, the likeliest first. It holds
        if the catalogue contains the truth."""
        return self.posterior.effect_probabilities

    @property
    def stated(self) -> Mapping[str, float | None]:
        """The calibrated ``probabilities``, and None for the others. The probability of
        a likely but uncertain effect is not calibrated: if the truth is in no
        catalogue, a likely name is wrong."""
        return stated(self.found, self.probabilities)

    @property
    def smooth(self) -> bool:
        """Whether the calibration corrects a smooth function of the direction in place
        of named effects."""
        return Empirical().name in self.after.terms

    @cached_property
    def advice(self) -> Advice:
        """The next measurement; without actions if it cannot be determined."""
        try:
            return advice(self.posterior)
        except Refused:  # the model has no inverse in further poses
            return Advice((), 0.0, 0.0, {})

    @cached_property
    def next_recording(self) -> NextRecording:
        """The uncertainty in the next recording, from this recording alone, without a
        station's statements about its reference."""
        return next_recording(self.after, budget(self.after))

    @cached_property
    def too_uncertain(self) -> bool:
        """Whether more poses would improve the next recording: the calibration adds
        more variance to its error than the start-to-start change, which no pose
        reduces."""
        known = max(self.next_recording.start_to_start, START_TO_START * self.after.reference)
        return bool(self.next_recording.standard > np.sqrt(2) * known)

    @cached_property
    def settled(self) -> bool:
        """Whether nothing unexplained is open: the effects and outliers that are
        certain, and probably no more, explain the poses, and the effects are
        corrected."""
        return self._known and self.refusal not in (Refusal.UNMODELLED, Refusal.CHANGE_POINT, Refusal.ONE_POSE)

    @cached_property
    def _known(self) -> bool:
        return decided(self.posterior) and not self.candidates

    @cached_property
    def call(self) -> Recommendation:
        """The recommended use of the calibration."""
        if self.refusal in (Refusal.UNMODELLED, Refusal.CHANGE_POINT):
            return Recommendation.INVESTIGATE
        more = self.too_uncertain or self.found.outliers or (not self._known and self.advice.actions)
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
    """Find and correct the effects that still poses show beyond the linear model.

    ``catalogue`` has the effects of the search, by default all known ones for the
    poses' channels. ``check`` has poses of another recording, for the hold-out error.
    ``at`` is the moment of the recording for which the calibration holds elsewhere: a
    number is in seconds from the first sample. The function calls ``progress`` at each
    stage. It raises the errors of `triaxcal.estimate.pose_fit.fit`.
    """
    # The linear fit, and the posterior of effects and outliers around it.
    progress(Stage.FIT)
    linear = fit(poses, signs=signs, reference=reference)
    sound = [p for p in poses if not p.fault]
    moment = ReferenceEpoch.of(sound, at)
    if moment is None:
        raise Refused("no pose without a fault")
    posterior = posterior_of(poses, linear, signs=signs, catalogue=catalogue, odds=odds, progress=progress)
    progress(Stage.ERRORS)
    # The linear calibration without the outliers of the posterior.
    before = replace(_without_outliers(poses, linear, signs, posterior), holds_at=moment)
    # The effects that these poses cannot show, or that fail.
    effects = considered(poses, catalogue)
    faulty = faults_of(posterior.evidence.rows, effects)
    hidden = not_identifiable(posterior.evidence, [e for e in effects if e.name not in faulty])
    # The findings, and the calibration with the correction.
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
    """The linear calibration from all poses except the posterior's outliers."""
    likely = {
        int(i): float(p) for i, p in zip(posterior.evidence.rows.places, posterior.outlier_probabilities, strict=True)
    }
    outliers = [i for i, p in likely.items() if reaches(p, posterior.evidence.odds.reported)]
    if outliers != [i for i, p in enumerate(linear.poses) if p.excluded == Exclusion.OUTLIER]:
        with suppress(Refused):  # the other poses may not determine a fit
            linear = fit(poses, signs=signs, reference=linear.reference, excluded=outliers, why=Exclusion.OUTLIER)
    return replace(
        linear, poses=tuple(replace(p, outlier_probability=likely.get(i)) for i, p in enumerate(linear.poses))
    )


@dataclass(frozen=True)
class _Report:
    """The reported figures of an effect: from ``after``, or conditional on the
    effect."""

    posterior: Posterior
    moment: ReferenceEpoch
    after: Calibration
    found: Findings
    conditional: dict[str, Calibration] = field(default_factory=dict)
    """The calibrations of `conditional_on`, by effect."""

    def finding(self, named: Named, refused: Refusal | None) -> Finding:
        probabilities = named.probabilities
        name, *others = probabilities
        calibrated = stated(self.found, probabilities)
        adopted = not others and refused is None
        coefficients, remedy = self._of(self.after, name) if adopted else self.conditional_on(name)
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
        return Candidate(name, calibrated, self.conditional_on(name)[0], hangs)

    def conditional_on(self, name: str) -> tuple[Coefficients, str]:
        """Coefficients and remedy conditional on the effect."""
        averaged = average(self.posterior.conditional_on(name), self.moment)
        reference = self.posterior.evidence.rows.problem.channel_reference
        self.conditional[name] = replace(
            self.after, sensor=averaged.sensor, covariance=averaged.covariance, channel_reference=reference
        )
        return self._of(self.conditional[name], name)

    def _of(self, c: Calibration, name: str) -> tuple[Coefficients, str]:
        """Coefficients and remedy in a calibration."""
        effect, q = next((e, q) for e, q in c.sensor.effects if e.name == name)
        floor = self.after.residual.noise_floor_g
        if not effect.coefficients[0].unit.startswith("g"):
            floor /= c.reference  # the effect is a share of the magnitude
        return c.coefficients_of(name), effect.advice(float(abs(q).max()), floor)
