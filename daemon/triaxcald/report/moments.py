"""The moments that effects of the model name, each by the clock of one recording, and the poses about them."""

from __future__ import annotations

from collections.abc import Mapping

from triaxcald.report.document import Finding, Outcome
from triaxcald.report.figures import clean, effect_title
from triaxcald.report.meanings import run_of


def moments_in(outcome: Outcome, recording: str) -> Mapping[str, float]:
    """By name, in s by the clock of the recording; an empty name is the only one's."""
    return {
        clean(effect_title(finding.effect)): at_s
        for finding in outcome.findings
        if (at_s := finding.shape("at")) is not None and finding.in_model and _recording(finding, outcome) == recording
    }


def bracket(finding: Finding, outcome: Outcome) -> str:
    """In which pose or between which a moment lies, and how far it may be from there; empty where there is none."""
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
    for pose, start_s, end_s in timed:
        if start_s <= at_s <= end_s:
            return _said(f"in pose {pose.number}{where}", "", at_s, error_s, end_s - start_s)
    before = [(end_s, pose.number) for pose, _, end_s in timed if end_s < at_s]
    after = [(start_s, pose.number) for pose, start_s, _ in timed if start_s > at_s]
    if not (before and after):
        return ""
    (end_s, first), (start_s, last) = max(before), min(after)
    gap = f"between pose {first} and pose {last}{where}, that is between {end_s:.1f} s and {start_s:.1f} s"
    return _said(gap, "; the poses tell it no nearer", at_s, error_s, start_s - end_s)


def _said(place: str, but: str, at_s: float, error_s: float | None, wide_s: float) -> str:
    if error_s is None or 2 * error_s <= wide_s:
        return f"The moment lies {place}{but}."
    first, last = max(at_s - 2 * error_s, 0.0), at_s + 2 * error_s
    return f"The moment lies most likely {place}; two standard errors reach from {first:.1f} s to {last:.1f} s."


def _recording(finding: Finding, outcome: Outcome) -> str:
    """The one that its coefficients name; empty where they name none, or several."""
    runs = {run for c in finding.coefficients if (run := run_of(c.name)[1]) is not None}
    run = runs.pop() if len(runs) == 1 else 0
    return outcome.recordings[run - 1] if 0 < run <= len(outcome.recordings) else ""
