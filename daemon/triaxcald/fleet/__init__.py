"""Statistics over many units: rows of a folder or a database, what they show, the page
and the table."""

from triaxcald.fleet.analysis import Asked, fleet_document
from triaxcald.fleet.page import render_fleet
from triaxcald.fleet.reading import Selection, read_runs
from triaxcald.fleet.table import COLUMNS, table_rows
from triaxcald.fleet.values import Fleet, fleets_of

__all__ = [
    "COLUMNS",
    "Asked",
    "Fleet",
    "Selection",
    "fleet_document",
    "fleets_of",
    "read_runs",
    "render_fleet",
    "table_rows",
]
