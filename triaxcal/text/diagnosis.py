"""What a closed loop found: whether the calibration can be used, what acts and how likely, and what is left."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from triaxcal.figures import moment
from triaxcal.next_recording import NextRecording, Source
from triaxcal.poses.pose import Began
from triaxcal.posterior.average import Refusal
from triaxcal.posterior.blind import Blind, Why
from triaxcal.posterior.findings import Findings, Unmodelled
from triaxcal.posterior.loop import Call, Candidate, Finding, Verdict
from triaxcal.posterior.unmodelled import What
from triaxcal.units import ErrorUnit

ALMOST = 0.999
"""Probabilities beyond are told as such: by which model they were reckoned matters more."""
GOES_WITH = {
    What.NOTHING: "each pose by itself",
    What.DIRECTION: "the direction",
    What.ODD: "the sign and the size of an axis's reading",
    What.EVEN: "the size of an axis's reading",
    What.BEFORE: "the pose before",
    What.TIME: "the time",
}
CALLS = {
    Call.USABLE: "usable",
    Call.RECORD_MORE: "usable as it is; more poses would tell more",
    Call.INVESTIGATE: "investigate before use",
}


def call(found: Call) -> str:
    return CALLS[found]


def chance(p: float) -> str:
    """A probability as it stands in a sentence."""
    if p > ALMOST:
        return f"more than {ALMOST}"
    return f"less than {1 - ALMOST:.1g}" if p < 1 - ALMOST else f"{p:.2g}" if p < 0.99 else f"{p:.3f}"


def cause(
    found: Findings,
    findings: Sequence[Finding],
    candidates: Sequence[Candidate],
    began: Mapping[int, Began],
    small: ErrorUnit,
) -> str:
    """What acts, each with its probability; ``began`` says when the poses began, by their place."""
    said = [*_causes(found, findings, candidates, began, small)]
    return "; ".join(said) or f"no effect shows (nothing acts with probability {chance(found.nothing)})"


def _causes(
    found: Findings,
    findings: Sequence[Finding],
    candidates: Sequence[Candidate],
    began: Mapping[int, Began],
    small: ErrorUnit,
) -> Iterator[str]:
    if found.another is not None:
        since = moment(began[found.another.pose])
        yield (
            f"from the pose at {since} on one calibration does not hold: another unit, or channels that were exchanged "
            f"(probability {chance(found.another.probability)})"
        )
    for finding in findings:
        yield f"{_named(finding)} acts"
    for candidate in candidates:
        yield f"{candidate.effect} probably acts ({chance(candidate.probability)})"
    if found.unmodelled.likely:
        yield unmodelled(found.unmodelled, small)
    if found.outliers:
        poses = ", ".join(f"{moment(began[i])} ({chance(p)})" for i, p in found.outliers.items())
        yield f"outliers, which are left out: {'the pose' if len(found.outliers) == 1 else 'poses'} at {poses}"


def _named(finding: Finding) -> str:
    if not finding.alternatives:
        return f"{finding.effect} ({chance(finding.probability)})"
    each = {finding.effect: finding.probability, **finding.alternatives}
    return "one of " + ", ".join(f"{name} ({chance(p)})" for name, p in each.items())


def unmodelled(part: Unmodelled, small: ErrorUnit) -> str:
    """What no effect of the catalogue describes."""
    with_what = f"; it goes with {GOES_WITH[part.what]}" if part.what in GOES_WITH else ""
    return (
        f"something acts that no effect describes (probability {chance(part.probability)}), "
        f"{small.in_full(part.rms)} rms{with_what}"
    )


def reason(finding: Finding, refusal: Refusal | None) -> str:
    """What a finding rests on, and why it is not corrected, where it is not."""
    said = f"it acts with probability {chance(finding.probability)}"
    if finding.alternatives:
        others = ", ".join(f"{name} {chance(p)}" for name, p in finding.alternatives.items())
        together = chance(finding.probability + sum(finding.alternatives.values()))
        said += f", or else {others}: one of them with {together}"
    if finding.verdict is Verdict.CONFOUNDED and refusal is not None:
        said += f"; not corrected, because {REFUSED[refusal]}"
    return said


REFUSED = {
    Refusal.UNMODELLED: "something that no effect describes acts as well",
    Refusal.ANOTHER: "one calibration does not hold in all poses",
    Refusal.ONE_POSE: "what was found hangs on a single pose",
}


def errors(before_rms: float, after_rms: float, following: NextRecording, small: ErrorUnit) -> str:
    """The residual before and after, and what to expect of the next recording."""
    how = {Source.ASSUMED: "assumed", Source.MEASURED: "measured"}[following.source]
    start, within = small.in_full(following.start_to_start), small.in_full(following.expanded_uncertainty)
    return (
        f"residual rms {small.in_full(before_rms)} before, {small.in_full(after_rms)} after; in the next recording "
        f"within {within} (expanded, with {start} from start to start, {how})"
    )


def blind(why: Blind) -> str:
    """Why poses cannot show an effect in full."""
    match why.why:
        case Why.NOT_LOGGED:
            return f"channel {why.channel} is not logged"
        case Why.SOMETIMES_LOGGED:
            return f"channel {why.channel} is not logged in every pose"
        case Why.RATE_UNKNOWN:
            return f"how fast {why.channel} changes is not known in every pose"
        case Why.NOT_KNOWN:
            return f"{why.channel} is not known"
        case Why.STOOD_STILL:
            return f"{why.channel} stood still"
        case Why.EVEN_RATE:
            return f"{why.channel} changes no faster in one pose than in another"
        case Why.EVEN_SCATTER:
            return "the readings scatter alike in all poses"
        case Why.MOVED_ALONG:
            return "too few poses, or what it goes with moved along with their directions"
        case Why.FEW_DIRECTIONS:
            return "the poses point in too few directions"
