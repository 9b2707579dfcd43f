"""What a closed loop found: whether the calibration can be used, what acts and
how likely, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from triaxcal.diagnosis import Candidate, Finding, Loop, Recommendation, Verdict
from triaxcal.estimate.calibration import Residual
from triaxcal.estimate.hold_out import HoldOut
from triaxcal.evidence.findings import Findings, Unexplained
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.prior import Odds
from triaxcal.number_format import plain
from triaxcal.poses.pose import PoseStart
from triaxcal.poses.pose_in_words import moment
from triaxcal.text.advice import GOES_WITH, REFUSED, advice, chance, notes, to_do
from triaxcal.uncertainty.next_recording import NextRecording, Source
from triaxcal.units import ErrorUnit

__all__ = ["advice", "call", "cause", "chance", "errors", "lines", "notes", "reason", "unexplained"]

EVEN = 0.5
"""Probability from which on it is likelier than not that nothing acts."""
LIKELIEST = 3
"""Effects that are named where none is likely."""
CALLS = {
    Recommendation.USABLE: "usable",
    Recommendation.RECORD_MORE: "record more",
    Recommendation.INVESTIGATE: "investigate",
}


def lines(loop: Loop, small: ErrorUnit, following: NextRecording | None = None) -> tuple[str, str, str, str]:
    """The whole in four lines: the call, the cause, the error before and after,
    and what to do. ``following`` is the next recording where a station knows
    more of the reference than the poses tell."""
    began = {i: p.pose.began for i, p in enumerate(loop.after.poses)}
    acts = cause(loop.found, loop.findings, loop.candidates, began, small, loop.probabilities, loop.averaged)
    return (
        call(loop.call),
        acts,
        errors(loop.before.residual, loop.after.residual, loop.held_out, following or loop.next_recording, small),
        to_do(loop, small),
    )


def _each(weights: Mapping[str, float]) -> str:
    each = ", ".join(f"{name} ({chance(p)})" for name, p in weights.items())
    return f"what may act, each by its probability: {each}"


def call(found: Recommendation) -> str:
    return CALLS[found]


def cause(
    found: Findings,
    findings: Sequence[Finding],
    candidates: Sequence[Candidate],
    began: Mapping[int, PoseStart],
    small: ErrorUnit,
    probabilities: Mapping[str, float],
    weights: Mapping[str, float] | None = None,
) -> str:
    """What acts, each with its probability; ``began`` says when the poses
    began, by their place. ``probabilities`` are those of all effects, the
    likeliest first, and ``weights`` those of effects that are corrected as far
    as they are probable, and named nowhere else."""
    said = [*_causes(found, findings, candidates, began, small)]
    also = " also" if findings or candidates else ""
    mean = [f"the correction{also} averages over {_each(weights)}"] if weights else []
    return "; ".join([*(said or [_nothing_named(found, probabilities, weights)]), *mean])


def _nothing_named(found: Findings, probabilities: Mapping[str, float], weights: Mapping[str, float] | None) -> str:
    if found.nothing >= EVEN:
        shows = "is likely" if weights else "shows"
        return f"no effect {shows} (nothing acts with probability {chance(found.nothing)})"
    likely = [f"{name} ({chance(p)})" for name, p in probabilities.items()][:LIKELIEST]
    none = f"something that no effect describes ({chance(found.unexplained.probability)})"
    return f"something acts, and these poses do not tell what; the likeliest are {', '.join(likely)}; or {none}"


def _causes(
    found: Findings,
    findings: Sequence[Finding],
    candidates: Sequence[Candidate],
    began: Mapping[int, PoseStart],
    small: ErrorUnit,
) -> Iterator[str]:
    if found.change_point is not None:
        since = moment(began[found.change_point.pose])
        yield (
            f"from the pose at {since} on one calibration does not hold: another unit, or channels that were exchanged "
            f"(probability {chance(found.change_point.probability)})"
        )
    for finding in findings:
        yield f"{_named(finding)} acts"
    for candidate in candidates:
        one_pose = ", but less so without some one pose" if Odds().hangs_on_one_pose(candidate.probability) else ""
        yield f"{candidate.effect} probably acts ({chance(candidate.probability)}{one_pose})"
    if found.unexplained.significant:
        yield unexplained(found.unexplained, small)
    if found.outliers:
        poses = ", ".join(f"{moment(began[i])} ({chance(p)})" for i, p in found.outliers.items())
        yield f"{'an outlier: the pose' if len(found.outliers) == 1 else 'outliers: the poses'} at {poses}"


def _named(finding: Finding) -> str:
    if not finding.alternatives:
        return f"{finding.effect} ({chance(finding.probability)})"
    each = {finding.effect: finding.probability, **finding.alternatives}
    return "one of " + ", ".join(f"{name} ({chance(p)})" for name, p in each.items())


def unexplained(part: Unexplained, small: ErrorUnit) -> str:
    """What no effect of the catalogue describes."""
    with_what = f"; it goes with {GOES_WITH[part.kind]}" if part.kind in GOES_WITH else ""
    return (
        f"something acts that no effect describes (probability {chance(part.probability)}), "
        f"{small.in_full(part.rms_g)} rms{with_what}"
    )


def reason(finding: Finding, refusal: Refusal | None) -> str:
    """What a finding rests on, and why it is not corrected, where it is not."""
    said = f"it acts with probability {chance(finding.probability)}"
    if finding.alternatives:
        others = ", ".join(f"{name} {chance(p)}" for name, p in finding.alternatives.items())
        together = chance(finding.together)
        said += f", or else {others}: one of them with {together}"
    if finding.verdict is Verdict.CONFOUNDED and refusal is not None:
        said += f"; not corrected, because {REFUSED[refusal]}"
    return said


def errors(before: Residual, after: Residual, held: HoldOut | None, following: NextRecording, small: ErrorUnit) -> str:
    """The errors before and after, what tells most first, and what to expect of
    the next recording."""
    how = {Source.ASSUMED: "assumed", Source.MEASURED: "measured"}[following.source]
    start, within = small.in_full(following.start_to_start), small.in_full(following.expanded_uncertainty)
    said = []
    if held is not None:
        said.append(f"held-out rms {_pair(small.in_full, held.before_rms_g, held.after_rms_g)}")
    if before.cross_validated_rms_g is not None and after.cross_validated_rms_g is not None:
        crossed = _pair(small.in_full, before.cross_validated_rms_g, after.cross_validated_rms_g)
        said.append(f"cross-validated rms {crossed}")
    if before.weighted_rms is not None and after.weighted_rms is not None:
        said.append(f"residuals in standard errors, rms, {_pair(_ratio, before.weighted_rms, after.weighted_rms)}")
    if before.reduced_chi2 is not None and after.reduced_chi2 is not None:
        said.append(f"χ² per degree of freedom {_pair(_ratio, before.reduced_chi2, after.reduced_chi2)}")
    said.append(f"residual rms {_pair(small.in_full, before.rms_g, after.rms_g)}")
    said.append(f"expanded uncertainty in the next recording {within} ({start} from start to start, {how})")
    return "; ".join(said)


def _pair(text: Callable[[float], str], before: float, after: float) -> str:
    """Before and after; once where nothing is corrected."""
    return text(before) if before == after else f"{text(before)} before, {text(after)} after"


def _ratio(value: float) -> str:
    return plain(value, 2)
