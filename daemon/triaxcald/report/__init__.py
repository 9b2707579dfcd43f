"""The report room: one self-contained HTML page from the documents of a
calibration."""

from triaxcald.report.charts import StreamOverview, thin
from triaxcald.report.page import render_report

__all__ = ["StreamOverview", "render_report", "thin"]
