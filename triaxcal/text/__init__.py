"""English for the values that the metrology returns: cautions, findings of data
quality, lines of the budget.

The one room that makes sentences; no other reads them back. An effect brings
its own remedy, and an exception its own line.
"""

from triaxcal.text.budget import basis, not_evaluated, remedy
from triaxcal.text.cautions import caution
from triaxcal.text.holds import as_at, holds, use
from triaxcal.text.quality import quality, quality_line
from triaxcal.text.summary import html, poses, short, summary, verification

__all__ = [
    "as_at", "basis", "caution", "holds", "html", "not_evaluated", "poses", "quality", "quality_line", "remedy",
    "short", "summary", "use", "verification",
]  # fmt: skip
