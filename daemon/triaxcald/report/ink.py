"""From a matplotlib figure to inline SVG that takes its colours from the page,
light or dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import Literal

import matplotlib
import matplotlib.style
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Stand-ins that occur nowhere else in a drawing; the page's style sheet gives
# them their colours.
INK, MUTED, GRID, PAPER = "#010101", "#010102", "#010103", "#010104"
BEFORE, STEP, AFTER, FLOOR = "#010105", "#010106", "#010107", "#010108"
AXES = ("#010109", "#01010a", "#01010b")
BAND = "#01010c"
_VARIABLES = {
    INK: "ink", MUTED: "muted", GRID: "grid", PAPER: "paper", BEFORE: "before", STEP: "step",
    AFTER: "after", FLOOR: "floor", AXES[0]: "x", AXES[1]: "y", AXES[2]: "z", BAND: "band",
}  # fmt: skip

_STYLE = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
}
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def draw(name: str, alt: str, size_in: tuple[float, float], paint: Callable[[Figure], None]) -> Markup:
    """Inline SVG of what `paint` draws, `alt` read aloud in its place.

    The same drawing gives the same bytes; `name` keeps the ids of several
    drawings on a page apart.
    """
    with matplotlib.style.context(["default", {**_STYLE, "svg.hashsalt": name}]):
        figure = Figure(figsize=size_in, layout="constrained")
        paint(figure)
        sheet = io.StringIO()
        figure.savefig(sheet, format="svg", metadata=_NO_METADATA)
    return _inline(sheet.getvalue(), name, alt)


def hang_grid(axes: Axes, axis: Literal["x", "y"] = "y") -> None:
    axes.grid(True, axis=axis)
    axes.tick_params(length=2.5, width=0.6)


def _inline(svg: str, name: str, alt: str) -> Markup:
    body = svg[svg.index("<svg") :]
    head, body = body.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    body = re.sub(r"<style[^>]*>.*?</style>", "", body, count=1, flags=re.DOTALL)
    body = body.replace("xlink:href=", "href=")
    body = re.sub(r'( id="| href="#|url\(#)', rf"\g<1>{name}-", body)
    body = re.sub("|".join(_VARIABLES), lambda found: f"var(--{_VARIABLES[found[0]]})", body)
    return Markup('<svg role="img" aria-label="{}" {}><title>{}</title>{}').format(
        escape(alt), Markup(box[0] if box else ""), escape(alt), Markup(body.strip())
    )
