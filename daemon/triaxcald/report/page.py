"""The page itself: documents in, one self-contained HTML text out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from triaxcal.text.traces import SMOOTH
from triaxcald.remarks import assumption
from triaxcald.report import figures
from triaxcald.report.before_after import before_after
from triaxcald.report.budget import read_uncertainty
from triaxcald.report.charts import bars_picture, stream_pictures
from triaxcald.report.choices import choices_in, who_corrects
from triaxcald.report.document import read_document
from triaxcald.report.faults import faults_of, left_out
from triaxcald.report.meanings import factor, in_plain, told
from triaxcald.report.moments import bracket, moments_in
from triaxcald.report.over_time import time_pictures
from triaxcald.report.registers import read_device
from triaxcald.report.sphere import sphere_pictures
from triaxcald.report.stream import StreamOverview
from triaxcald.report.traces import trace_panels
from triaxcald.report.untrusted import mapping
from triaxcald.report.verdict import final_word, judge

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
        smooth=SMOOTH,
        unit=unit,
        verdict=judge(outcome, limits, uncertainty.expanded_g if uncertainty else None, final_word(papers)),
        uncertainty=uncertainty,
        assumed=assumed,
        traces=trace_panels(document.get("traces"), outcome, unit),
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
        return figures.MISSING
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
        in_plain, figures.chance, figures.digits, figures.effect_title, figures.fixed, figures.in_full, figures.micro,
        figures.expanded, figures.micro_g, figures.p_value, figures.plus_minus, figures.unit_label,
    ):  # fmt: skip
        environment.filters[function.__name__] = function
    return environment


_ENVIRONMENT = _environment()
