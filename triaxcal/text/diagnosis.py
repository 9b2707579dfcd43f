"""What a closed loop found: whether the calibration can be used, what acts and
how likely, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from triaxcal.diagnosis import Candidate, Finding, Loop, Recommendation, Verdict
from triaxcal.effects.empirical import Empirical
from triaxcal.estimate.calibration import Residual
from triaxcal.estimate.hold_out import Contradiction, HoldOut
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.posterior import Findings, Unexplained
from triaxcal.number_format import number_of, plain
from triaxcal.poses.pose import PoseStart, moment
from triaxcal.text.advice import GOES_WITH, REFUSED, advice, chance, notes, to_do
from triaxcal.uncertainty import Stated, budget
from triaxcal.uncertainty.combined import NextRecording, Scopes, Source
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


def lines(
    loop: Loop, small: ErrorUnit, following: NextRecording | None = None, stated: Stated | None = None
) -> tuple[str, str, str, str]:
    """The whole in four lines: the call, the cause, the error before and after,
    and what to do. ``following`` is the next recording where a station has
    ``stated`` more of the reference than the poses tell. What a check recording
    contradicts comes first."""
    began = {i: p.pose.began for i, p in enumerate(loop.after.poses)}
    following = following or loop.next_recording
    scopes = Scopes.of(loop.after, budget(loop.after, stated), following)
    against = contradiction(loop, scopes, small)
    before, after = loop.before.residual, loop.after.residual
    return (
        f"{against}; {call(loop.call)}" if against else call(loop.call),
        cause(loop.found, loop.findings, loop.candidates, began, small, loop.stated, loop.averaged),
        errors(before, after, loop.held_out, scopes, following, small) + excluded(loop, small),
        to_do(loop, small),
    )


def _corrects(weights: Mapping[str, float]) -> str:
    if Empirical().name in weights:
        return "is a smooth function of the direction, without a physical meaning"
    return f"averages over {_each(weights)}"


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
    probabilities: Mapping[str, float | None],
    weights: Mapping[str, float] | None = None,
) -> str:
    """What acts, each with its probability; ``began`` says when the poses
    began, by their place. ``probabilities`` are those of all effects, the
    likeliest first, and ``weights`` those of effects that are corrected as far
    as they are probable, and named nowhere else."""
    said = [*_causes(found, findings, candidates, began, small)]
    also = " also" if findings or candidates else ""
    mean = [f"the correction{also} {_corrects(weights)}"] if weights else []
    return "; ".join([*(said or [_nothing_named(found, probabilities, weights)]), *mean])


def _nothing_named(
    found: Findings, probabilities: Mapping[str, float | None], weights: Mapping[str, float] | None
) -> str:
    if found.nothing >= EVEN:
        shows = "is likely" if weights else "shows"
        return f"no effect {shows} (nothing acts with probability {chance(found.nothing)})"
    names = [likely(name, p) for name, p in probabilities.items()][:LIKELIEST]
    none = f"something that no known effect describes ({chance(found.unexplained.probability)})"
    return f"something acts, and these poses do not tell what; the likeliest are {', '.join(names)}; or {none}"


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
        one_pose = ", and a single pose decides it" if candidate.hangs_on_one_pose else ""
        yield f"{candidate.effect} probably acts, if the cause is one of the effects that were looked for{one_pose}"
    if found.unexplained.significant:
        yield unexplained(found.unexplained, small)
    if found.outliers:
        poses = ", ".join(f"{moment(began[i])} ({chance(p)})" for i, p in found.outliers.items())
        yield f"{'an outlier: the pose' if len(found.outliers) == 1 else 'outliers: the poses'} at {poses}"


def _named(finding: Finding) -> str:
    if not finding.alternatives:
        return likely(finding.effect, finding.probability)
    first = (
        f"{finding.effect} (likeliest)" if finding.probability is None else likely(finding.effect, finding.probability)
    )
    return "one of " + ", ".join([first, *(likely(name, p) for name, p in finding.alternatives.items())])


def likely(name: str, p: float | None) -> str:
    """A name with its probability, where that is calibrated."""
    return name if p is None else f"{name} ({chance(p)})"


def unexplained(part: Unexplained, small: ErrorUnit) -> str:
    """What no effect of the catalogue describes."""
    with_what = f"; it goes with {GOES_WITH[part.kind]}" if part.kind in GOES_WITH else ""
    return (
        f"something acts that no known effect describes (probability {chance(part.probability)}), "
        f"{small.in_full(part.rms_g)} rms{with_what}"
    )


def reason(finding: Finding, refusal: Refusal | None) -> str:
    """What a finding rests on, and why it is not corrected, where it is not."""
    p = finding.probability
    said = "it probably acts" if p is None else f"it acts with probability {chance(p)}"
    if finding.alternatives:
        others = ", ".join(likely(name, p) for name, p in finding.alternatives.items())
        together = chance(finding.together)
        said += f", or else {others}: one of them with {together}"
    if finding.verdict is Verdict.CONFOUNDED and refusal is not None:
        said += f"; not adopted, because {REFUSED[refusal]}"
    return said


def errors(
    before: Residual,
    after: Residual,
    held: HoldOut | None,
    scopes: Scopes,
    following: NextRecording,
    small: ErrorUnit,
) -> str:
    """The errors before and after in the same poses, what tells most first, and
    how uncertain |a| is in which readings."""
    how = {Source.ASSUMED: "assumed", Source.MEASURED: "measured between these recordings"}[following.source]
    start = small.in_full(following.start_to_start)
    expanded = ", ".join(f"{name} {small.in_full(value)}" for name, value in scopes.named.items())
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
    said.append(f"expanded uncertainty: {expanded} ({start} from start to start, {how})")
    return "; ".join(said)


def _pair(text: Callable[[float], str], before: float, after: float) -> str:
    """Before and after; once where nothing is corrected."""
    return text(before) if before == after else f"{text(before)} before, {text(after)} after"


def _ratio(value: float) -> str:
    return plain(value, 2)


def excluded(loop: Loop, small: ErrorUnit) -> str:
    """The poses that neither residual has, and by how much they are off; empty
    where there is none."""
    pairs = [
        (b.residual_g, a.residual_g)
        for b, a in zip(loop.before.poses, loop.after.poses, strict=True)
        if not a.used and np.isfinite([b.residual_g, a.residual_g]).all()
    ]
    if not pairs:
        return ""
    before, after = (small.in_full(float(np.abs(v).max())) for v in np.transpose(pairs))
    return f"; {number_of(len(pairs), 'pose')} excluded from both, off by up to {before} before, {after} after"


def contradiction(loop: Loop, scopes: Scopes, small: ErrorUnit) -> str:
    """What the check recording contradicts; empty where nothing."""
    held = loop.held_out
    found = held and held.contradicts(scopes.another_day)
    if not held or not found:
        return ""
    error = small.in_full(held.after_rms_g)
    if found is Contradiction.UNCERTAINTY:
        said = f"{error} rms there, expanded uncertainty on another day {small.in_full(scopes.another_day)}"
    else:
        said = f"{small.in_full(held.before_rms_g)} rms there with the linear model, {error} after"
    return f"the check recording contradicts the calibration: {said}"
