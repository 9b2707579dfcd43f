"""The report room: one self-contained HTML page from the documents of a
calibration."""

from triaxcald.report.page import render_report
from triaxcald.report.stream import StreamOverview, thin

__all__ = ["StreamOverview", "render_report", "thin"]
