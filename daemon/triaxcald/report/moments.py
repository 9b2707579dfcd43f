"""The moments that effects of the model name, each by the clock of one
recording, and the poses about them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from triaxcald.report.document import Finding, Outcome
from triaxcald.report.figures import clean, effect_title
from triaxcald.report.meanings import run_of


def moments_in(outcome: Outcome, recording: str) -> Mapping[str, float]:
    """By name, in s by the clock of the recording; an empty name is the only
    one's."""
    return {
        clean(effect_title(finding.effect)): at_s
        for finding in outcome.findings
        if (at_s := finding.shape("at")) is not None and finding.in_model and _recording(finding, outcome) == recording
    }


def bracket(finding: Finding, outcome: Outcome) -> str:
    """In which pose or between which a moment lies, and how far it may be from
    there; empty where there is none."""
    at_s, recording = finding.shape("at"), _recording(finding, outcome)
    timed = [
        (pose, pose.start_s, pose.end_s)
        for pose in outcome.poses
        if pose.start_s is not None and pose.end_s is not None and pose.recording == recording
    ]
    if at_s is None:
        return ""
    where = f" of {recording}" if recording else ""
    error_s = next((c.standard_error for c in finding.coefficients if c.name == "at"), None)

    def reach(sure: bool) -> str:
        if sure or error_s is None:
            return ""
        first, last = max(at_s - 2 * error_s, 0.0), min(at_s + 2 * error_s, max(end_s for _, _, end_s in timed))
        return f"; two standard errors reach from {first:.1f} s to {last:.1f} s"

    for pose, start_s, end_s in timed:
        if start_s <= at_s <= end_s:
            sure = error_s is None or (start_s <= at_s - 2 * error_s and at_s + 2 * error_s <= end_s)
            return f"The moment lies {'' if sure else 'most likely '}in pose {pose.number}{where}{reach(sure)}."
    before = [(end_s, pose.number) for pose, _, end_s in timed if end_s < at_s]
    after = [(start_s, pose.number) for pose, start_s, _ in timed if start_s > at_s]
    if not (before and after):
        return ""
    (end_s, first), (start_s, last) = max(before), min(after)
    # Anywhere between the two is a rectangle; a tenth more, and it may have
    # been inside them.
    sure = error_s is None or error_s <= 1.1 * (start_s - end_s) / math.sqrt(12)
    return (
        f"The moment lies {'' if sure else 'most likely '}between pose {first} and pose {last}{where}, that is between "
        f"{end_s:.1f} s and {start_s:.1f} s{reach(sure) or '; the poses tell it no nearer'}."
    )


def _recording(finding: Finding, outcome: Outcome) -> str:
    """The one that its coefficients name; empty where they name none, or
    several."""
    runs = {run for c in finding.coefficients if (run := run_of(c.name)[1]) is not None}
    run = runs.pop() if len(runs) == 1 else 0
    return outcome.recordings[run - 1] if 0 < run <= len(outcome.recordings) else ""
