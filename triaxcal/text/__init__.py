"""English for the values that the metrology returns: cautions, findings of data
quality, lines of the budget.

The one room that makes sentences; no other reads them back. An effect brings
its own remedy, and an exception its own line.
"""

from typing import TYPE_CHECKING

from triaxcal.lazy import lazily
from triaxcal.text.budget import basis, not_evaluated, remedy
from triaxcal.text.calibration import as_at, holds, html, poses, short, summary, use, verification
from triaxcal.text.cautions import caution
from triaxcal.text.quality import quality, quality_line

if TYPE_CHECKING:
    from triaxcal.text import advice, bias_update, diagnosis, pooled_units, population, traces

_ROOMS = ("advice", "bias_update", "diagnosis", "pooled_units", "population", "traces")
"""Chapters that import the diagnosis, which most commands do without."""

__all__ = [
    "advice",
    "as_at",
    "basis",
    "bias_update",
    "caution",
    "diagnosis",
    "holds",
    "html",
    "not_evaluated",
    "pooled_units",
    "population",
    "poses",
    "quality",
    "quality_line",
    "remedy",
    "short",
    "summary",
    "traces",
    "use",
    "verification",
]  # fmt: skip


if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, {}, _ROOMS)
