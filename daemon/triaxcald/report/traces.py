"""The trace picture: what the poses show of each finding and each candidate, a
panel for each variable."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from triaxcal.effects.contract import SINCE_START
from triaxcal.evidence.partial_residuals import POSE, Quantity, Trace
from triaxcal.pictures import Inks, paint_trace
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT
from triaxcal.text import traces as words
from triaxcal.units import ErrorUnit
from triaxcald.report.document import CANDIDATE, Finding, Outcome, Pose
from triaxcald.report.figures import MICRO_G, chance, clean, effect_title, number
from triaxcald.report.ink import AFTER, BAND, FLOOR, MUTED, draw, hang_grid
from triaxcald.report.untrusted import mapping, texts

PANEL_IN = (4.2, 2.9)
"""Of a size that letters are legible on a telephone and in three columns."""
INKS = Inks(used=FLOOR, excluded=MUTED, curve=AFTER, band=BAND, zero=MUTED)
MOST = 12
"""Panels of one document: three for each of four effects."""


@dataclass(frozen=True)
class Panel:
    """``title`` says of what it is, ``caption`` what it shows."""

    title: str
    caption: str
    drawing: Markup
    partial: bool
    """Whether it is of partial residuals."""


def trace_panels(value: object, outcome: Outcome, unit: ErrorUnit = MICRO_G) -> tuple[Panel, ...]:
    """Of the ``traces`` of a document; of one that has none the residuals in
    standard errors, as far as these are known."""
    known = list(read_traces(value))[:MOST] or list(_residuals(outcome.poses))
    return tuple(_panel(trace, outcome, unit, f"trace{i}") for i, trace in enumerate(known))


def read_traces(value: object) -> Iterator[Trace]:
    """Those that can be drawn."""
    for entry in value if isinstance(value, (list, tuple)) else []:
        known = mapping(entry)
        x, y, error = (_array(known.get(key)) for key in ("x", "y", "error"))
        curve = mapping(known.get("curve"))
        grid, fitted, half = (_array(curve.get(key)) for key in ("x", "y", "half_width"))
        if known.get("quantity") not in list(Quantity) or not len(x) or not len(x) == len(y) == len(error):
            continue
        whole = len(grid) == len(fitted) == len(half) and bool(np.isfinite([grid, fitted, half]).all())
        nothing = np.empty(0)
        flags = known.get("excluded")
        excluded = np.resize([bool(v) for v in flags] if isinstance(flags, list) and flags else [False], len(x))
        sound = np.isfinite(x) & np.isfinite(y) & np.isfinite(error)
        if sound.any():
            yield Trace(
                effect=clean(known.get("effect") or ""),
                axis=clean(known.get("axis") or "")[:1],
                coefficients=tuple(map(clean, texts(known.get("coefficients")))),
                variable=clean(known.get("variable") or POSE),
                quantity=Quantity(str(known["quantity"])),
                pose=np.flatnonzero(sound),
                x=x[sound],
                y=y[sound],
                error=np.abs(error[sound]),
                excluded=excluded[sound],
                grid=grid if whole else nothing,
                curve=fitted if whole else nothing,
                half_width=half if whole else nothing,
                share=number(known.get("share")),
                p_value=number(known.get("p_value")),
            )


def _array(value: object) -> NDArray[np.float64]:
    values = [number(v) for v in value] if isinstance(value, (list, tuple)) else []
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def _residuals(poses: Sequence[Pose]) -> Iterator[Trace]:
    known = [(p, p.residual_g / p.standard_error_g) for p in poses if p.residual_g is not None and p.standard_error_g]
    if not known:
        return
    timed = all(p.middle_s is not None for p, _ in known) and len({p.recording for p, _ in known}) == 1
    nothing = np.empty(0)
    yield Trace(
        effect="",
        axis="",
        coefficients=(),
        variable=SINCE_START if timed else POSE,
        quantity=Quantity.STANDARD_ERRORS,
        pose=np.array([p.number - 1 for p, _ in known]),
        x=np.array([p.middle_s if timed else p.number for p, _ in known], dtype=np.float64),
        y=np.array([ratio for _, ratio in known]),
        error=np.ones(len(known)),
        excluded=np.array([not p.used for p, _ in known]),
        grid=nothing,
        curve=nothing,
        half_width=nothing,
    )


def _panel(trace: Trace, outcome: Outcome, unit: ErrorUnit, name: str) -> Panel:
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        paint_trace(axes, trace, unit, INKS)
        hang_grid(axes)

    drawing = draw(name, words.description(trace, unit), PANEL_IN, paint)
    partial = trace.quantity is not Quantity.STANDARD_ERRORS
    return Panel(words.title(trace), _caption(trace, outcome), drawing, partial)


def _caption(trace: Trace, outcome: Outcome) -> str:
    """How sure it is that this acts, or what the picture says."""
    if trace.quantity is Quantity.STANDARD_ERRORS:
        return _of_residuals(outcome)
    if trace.share is not None:
        return _of_curve(trace.share, trace.p_value)
    if trace.effect == words.SMOOTH:
        return "The mean over all that may act, as a function of the direction"
    finding = next((f for f in outcome.findings if f.effect == trace.effect), None)
    if finding is None:
        return f"Probability {chance(outcome.averaged.get(trace.effect))}, and corrected by as much"
    return _of_finding(finding)


def _of_curve(share: float, p_value: float | None) -> str:
    said = f"Smooth curves on three axes take away {100 * max(share, 0.0):.0f} % (adjusted)"
    if p_value is None:
        return said
    if p_value > SIGNIFICANT:
        return f"{said}, no more than chance does for one of these variables (p {p_value:.2g})"
    return f"{said}; chance does as much with p {p_value:.1g}"


def _of_finding(finding: Finding) -> str:
    sure = "Probable" if finding.probability is None else f"Probability {chance(finding.probability)}"
    if finding.alternatives:
        return f"{sure}; or instead {', '.join(effect_title(n).lower() for n in finding.alternatives[:3])}"
    return sure + (", not certain" if finding.verdict == CANDIDATE else "")


def _of_residuals(outcome: Outcome) -> str:
    nothing = outcome.nothing_probability
    if outcome.searched and not outcome.findings and not outcome.something_is_left:
        likely = "" if nothing is None else f" (probability {chance(nothing)} that nothing acts)"
        return f"Nothing is left beyond noise{likely}"
    return "What is left, in standard errors of the poses"
