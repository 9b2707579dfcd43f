"""The report on one unit of a station, from values that its recording holds:
line and audit draw it alike."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from triaxcald import text
from triaxcald.certificate import Certified
from triaxcald.outcome import Ending
from triaxcald.pipeline import Pipeline
from triaxcald.provision.state import Held
from triaxcald.report.page import render_report
from triaxcald.report.stream import overview_of

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
