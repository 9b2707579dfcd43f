"""The page itself: documents in, one self-contained HTML text out."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.caveats import assumption
from triaxcald.certificate import Certified
from triaxcald.outcome import Ending
from triaxcald.provision.state import Held
from triaxcald.raw_to_poses import Pipeline
from triaxcald.report import figures
from triaxcald.report.charts import (
    StreamOverview,
    bars_picture,
    bracket,
    moments_in,
    no_variable_tells,
    overview_of,
    sphere_pictures,
    stream_pictures,
    trace_panels,
)
from triaxcald.report.document import faults_of, left_out, mapping, numbers, read_device, read_document, texts, vector
from triaxcald.report.figures import factor, in_plain, number, told
from triaxcald.report.over_time import time_pictures
from triaxcald.report.verdict import before_after, choices_in, final_word, judge, lacks_fit, who_corrects

# The uncertainty budget of a calibration document, read without trust like the rest
# of it.


@dataclass(frozen=True)
class BudgetLine:
    """``magnitude_g`` is a standard uncertainty of |a|; ``share`` of its
    variance, 0…1."""

    source: str
    evaluation: str
    magnitude_g: float | None
    share: float | None
    how: str
    assumes: tuple[str, ...] = ()

    @property
    def percent(self) -> str:
        if self.share is None:
            return ""
        return "< 1 %" if 0 < self.share < 0.01 else f"{self.share:.0%}".replace("%", " %")


@dataclass(frozen=True)
class Uncertainty:
    lines: tuple[BudgetLine, ...]
    standard_g: float | None
    coverage_factor: float | None
    expanded_g: float | None
    level_percent: float | None
    expanded: Mapping[str, float | None]
    dominant: str
    halved_by: str
    if_halved_g: float | None
    not_evaluated: tuple[str, ...]
    scopes: tuple[tuple[str, str, float | None], ...] = ()
    """Name, meaning, and expanded uncertainty of |a| in g."""


SCOPES = {
    "this_fit": ("This fit", "the calibration by itself, at the reference conditions"),
    "this_sessions_poses": ("This session’s poses", "one more pose of this recording, with its noise"),
    "another_day": ("Another day", "the next recording, with how the unit starts"),
}


def read_uncertainty(calibration: Mapping[str, object]) -> Uncertainty | None:
    """None where the document has no budget."""
    known = mapping(calibration.get("uncertainty"))
    entries = known.get("budget")
    if not isinstance(entries, (list, tuple)) or not entries:
        return None
    whole, level = mapping(known.get("magnitude")), number(known.get("level"))
    return Uncertainty(
        lines=tuple(_line(mapping(entry)) for entry in entries),
        standard_g=number(whole.get("standard_g")),
        coverage_factor=number(whole.get("coverage_factor")),
        expanded_g=number(whole.get("expanded_g")),
        level_percent=None if level is None else 100 * level,
        expanded=dict(_expanded(mapping(known.get("expanded")))),
        dominant=_words(known.get("dominant")),
        halved_by=str(known.get("halved_by") or ""),
        if_halved_g=number(known.get("magnitude_if_halved_g")),
        not_evaluated=texts(known.get("not_evaluated")),
        scopes=tuple(_scopes(mapping(calibration.get("expanded_uncertainty_g")))),
    )


def _scopes(known: Mapping[str, object]) -> Iterator[tuple[str, str, float | None]]:
    for key, (name, meaning) in SCOPES.items():
        if key in known:
            yield name, meaning, number(known[key])


def _line(entry: Mapping[str, object]) -> BudgetLine:
    return BudgetLine(
        _words(entry.get("source")),
        str(entry.get("evaluation") or ""),
        number(entry.get("magnitude_g")),
        number(entry.get("share")),
        str(entry.get("how") or ""),
        texts(entry.get("assumes")),
    )


def _expanded(known: Mapping[str, object]) -> Iterator[tuple[str, float | None]]:
    """Of every coefficient, by a name like `bias.x` or `warm_up.x`."""
    for group in td.roles.LINEAR:
        for axis, value in zip("xyz", vector(known.get(group)) or (None, None, None), strict=True):
            yield f"{group}.{axis}", value
    for effect, values in mapping(known.get("effects")).items():
        for name, value in numbers(values).items():
            yield f"{effect}.{name}", value


def _words(name: object) -> str:
    return str(name or "").replace("_", " ")


# Parts of a certificate that the page shows elsewhere, or that are too long to
# read.
_SHOWN_ELSEWHERE = {
    "format", "calibration", "loop", "before", "after", "held_out", "findings", "unexplained", "poses",
    "limits", "data_quality", "advice", "residual", "result", "registers", "verification", "not_written", "device",
    "choices", "outcome", "candidates", "probabilities", "summary", "notes", "traces",
}  # fmt: skip
_LONGEST_LIST = 16


def render_report(
    document: Mapping[str, object],
    *,
    title: str,
    stream: StreamOverview | None = None,
    certificate: Mapping[str, object] | None = None,
) -> str:
    """HTML of a `triaxcal.calibration/1` or `triaxcal.loop/1`: no script, no
    outside resource.

    Limits (`limits`, named like the fields of a residual, in g) come from the
    document or the certificate; a document with `refused` gives the reason in
    place of a result. The same input gives the same bytes.
    """
    outcome, papers = read_document(document), certificate or {}
    unit, device = outcome.small, read_device(papers)
    limits = {name: figures.number(value) for name, value in mapping(papers.get("limits")).items()}
    floor_g = outcome.final.noise_floor_g
    uncertainty = read_uncertainty(mapping(document.get("calibration")) or document)
    dominant = uncertainty.lines[0] if uncertainty else None
    assumed = assumption(dominant.assumes, outcome.reference_unit) if dominant else ""
    return _ENVIRONMENT.get_template("report.html").render(
        title=title,
        outcome=outcome,
        smooth=tc.text.traces.SMOOTH,
        unit=unit,
        verdict=judge(outcome, limits, uncertainty.expanded_g if uncertainty else None, final_word(papers)),
        uncertainty=uncertainty,
        assumed=assumed,
        traces=trace_panels(document.get("traces"), outcome, unit),
        no_variable_tells=no_variable_tells(document.get("traces")),
        bars=bars_picture(outcome.stages, outcome.held_out, unit),
        sphere=sphere_pictures(outcome.poses, outcome.stages, floor_g, unit),
        over_time=time_pictures(
            outcome.poses, outcome.stages, floor_g, moments_in=lambda name: moments_in(outcome, name), unit=unit
        ),
        faults=faults_of(outcome.data_quality),
        left_out=left_out(outcome.poses, unit),
        rows=before_after(outcome, unit),
        device=device,
        choices=choices_in(document, papers, outcome),
        lacks_fit=lacks_fit,
        who_corrects=lambda finding: who_corrects(finding, device),
        told=lambda effect: told(effect, outcome.channel_reference),
        bracket=lambda finding: bracket(finding, outcome),
        streams=stream_pictures(stream) if stream is not None else (),
        provenance=list(_entries(papers)),
    )


def _entries(papers: Mapping[str, object], above: str = "") -> Iterator[tuple[str, str]]:
    """The certificate's own facts as (label, text), nested ones with their
    path."""
    judged = {"verdict", "outside"} if "outcome" in papers else set()  # of the fit alone
    for key, value in papers.items():
        if not above and key in _SHOWN_ELSEWHERE | judged:
            continue
        label = f"{above}{str(key).replace('_', ' ')}"
        if isinstance(value, Mapping):
            yield from _entries(value, f"{label}: ")
        elif not isinstance(value, (list, tuple)):
            yield label, "" if value is None else str(value)
        elif 0 < len(value) <= _LONGEST_LIST and not any(isinstance(v, (Mapping, list, tuple)) for v in value):
            yield label, ", ".join(str(v) for v in value)


def _printable(value: object) -> object:
    if value is None or value == "":
        return tc.rounding.MISSING
    return value if isinstance(value, Markup) else figures.clean(value)


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["factor"] = factor
    for function in (
        in_plain, tc.text.traces.effect_title, figures.chance, figures.digits, figures.fixed, figures.in_full,
        figures.micro,
        figures.expanded, figures.micro_g, figures.p_value, figures.plus_minus, figures.unit_label,
    ):  # fmt: skip
        environment.filters[function.__name__] = function
    return environment


_ENVIRONMENT = _environment()


# The report on one unit of a station, from values that its recording holds: line
# and audit draw it alike.

_DRAWING = threading.Lock()
"""The pictures' style is the process's own: one report is drawn at a time."""


def unit_report(
    certified: Certified, pipeline: Pipeline, ending: Ending, verification: Mapping[str, Any] | None, held: Held
) -> str:
    """``pipeline`` is that of the readings, finished. The same values give the
    same bytes."""
    papers: dict[str, object] = dict(certified.document)
    papers["outcome"] = {"verdict": ending.verdict.value, "reason": ending.reason}
    if verification:
        papers["verification"] = verification
    if certified.image is not None:
        papers["device"] = text.held(held)
    profile = pipeline.bundle.profile
    overview = overview_of(pipeline.windows, pipeline.poses(), profile.output.unit)
    unit = certified.document["unit"]
    with _DRAWING:
        return render_report(
            certified.document["result"],
            title=f"{unit['product']} {unit['serial'] or 'of unknown serial number'}",
            stream=overview,
            certificate=papers,
        )
