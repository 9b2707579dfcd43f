"""Pictures of results. The one room of the metrology that imports matplotlib,
when it is called."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.effects.contract import RUN
from triaxcal.errors import InvalidData
from triaxcal.evidence.partial_residuals import PREDICTED, Quantity, Trace
from triaxcal.text import traces as words
from triaxcal.units import ErrorUnit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_IN = (9.0, 4.0)
"""Width and height in inches: two panels side by side, legible across a page."""
PANEL_IN, COLUMNS = (4.2, 2.9), 3
"""Of a trace, and how many stand side by side."""
IN_SIGHT = 3.0
"""Times the largest value of the poses that are used and of the curve: what is
excluded and farther off stands at the edge, as an arrow."""
EXPECTED = 2.0
"""Standard errors within which 95 % of residuals lie where noise is all."""


@dataclass(frozen=True)
class Inks:
    """Colours of a trace."""

    used: str = "C0"
    excluded: str = "C3"
    curve: str = "C1"
    band: str = "#ff7f0e40"
    zero: str = "0.7"


def _figure(size_in: tuple[float, float]) -> Figure:
    """One that a notebook shows."""
    return _shown_in_notebooks()(figsize=size_in, layout="constrained")


@cache
def _shown_in_notebooks() -> type[Figure]:
    from matplotlib.figure import Figure  # not pyplot: no window, no state

    class NotebookFigure(Figure):
        def _repr_png_(self) -> bytes:
            sheet = io.BytesIO()
            self.savefig(sheet, format="png")
            return sheet.getvalue()

    return NotebookFigure


def traces_figure(traces: Sequence[Trace], small: ErrorUnit) -> Figure:
    """A panel for each, under its title. Raises InvalidData where there are
    none."""
    if not traces:
        raise InvalidData("there is no trace to plot")
    columns = min(COLUMNS, len(traces))
    rows = -(-len(traces) // columns)
    figure = _figure((PANEL_IN[0] * columns, PANEL_IN[1] * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, trace in zip(panels, traces, strict=False):
        paint_trace(axes, trace, small)
        axes.set_title(words.title(trace), loc="left")
    for axes in panels[len(traces) :]:
        axes.set_axis_off()
    return figure


def paint_trace(axes: Axes, trace: Trace, small: ErrorUnit, inks: Inks | None = None) -> None:
    """The partial residuals with one standard error either way, the fitted curve
    and its 95 % band; crosses are poses that the fit does not use."""
    inks = inks or Inks()
    in_errors = trace.quantity is Quantity.STANDARD_ERRORS
    unit = 1.0 if in_errors else small.count(1.0)
    x, grid = (_shown(trace.variable, values, small) for values in (trace.x, trace.grid))
    axes.axhline(0.0, color=inks.zero, linewidth=0.8)
    if in_errors:
        axes.axhspan(-EXPECTED, EXPECTED, color=inks.band, linewidth=0)
    if len(grid):
        low, high = unit * (trace.curve - trace.half_width), unit * (trace.curve + trace.half_width)
        axes.fill_between(grid, low, high, color=inks.band, linewidth=0)
        axes.plot(grid, unit * trace.curve, color=inks.curve, linewidth=1.6)
    for those, colour, marker in ((~trace.excluded, inks.used, "o"), (trace.excluded, inks.excluded, "x")):
        axes.errorbar(
            x[those], unit * trace.y[those], unit * trace.error[those], fmt=marker, markersize=4, color=colour,
            ecolor=colour, elinewidth=0.9,
        )  # fmt: skip
    _keep_used_in_sight(axes, x, unit * trace.y, unit * np.abs(trace.curve), trace.excluded, inks.excluded)
    axes.set_xlabel(words.x_label(trace, small))
    axes.set_ylabel(words.y_label(trace, small))


def _shown(variable: str, values: Floats, small: ErrorUnit) -> Floats:
    """The variable in the unit of its label."""
    if variable == PREDICTED:
        return np.asarray(small.count(1.0) * values)
    return values + 1 if variable == RUN else values


def _keep_used_in_sight(axes: Axes, x: Floats, y: Floats, curve: Floats, excluded: Bools, colour: str) -> None:
    if excluded.all() or not excluded.any():
        return
    reach = IN_SIGHT * max(float(np.abs(y[~excluded]).max()), float(curve.max(initial=0.0)))
    far = excluded & (np.abs(y) > reach)
    if not far.any() or not reach > 0:
        return
    axes.set_ylim(-reach, reach)
    for at, value in zip(x[far], y[far], strict=True):
        axes.plot([at], [np.sign(value) * 0.93 * reach], "^" if value > 0 else "v", color=colour, markersize=6)


def residuals_figure(document: Mapping[str, Any]) -> Figure:
    """Of a `triaxcal.calibration/1`: the residuals of its poses in their order,
    with their standard errors, and where the poses lie on the sphere, in an
    equal-area projection of both halves. Raises InvalidData where it has no
    poses."""
    poses = document.get("poses") or []
    if not poses:
        raise InvalidData("there is no pose to plot: this calibration is not of still poses")
    try:
        reference_unit = str((document.get("units") or {}).get("reference") or "g")
        small = ErrorUnit.of(reference_unit, float(document.get("reference", 1.0)))
        used = np.array([bool(p["used"]) for p in poses])
        residual = np.array([small.count(float(p["residual_g"])) for p in poses])
        error = np.array([small.count(float(p["standard_error_g"])) for p in poses])
        up = np.array([p["direction"] for p in poses], dtype=float).reshape(len(poses), 3)
    except (AttributeError, KeyError, TypeError, ValueError) as e:
        raise InvalidData(f"poses that cannot be plotted: {e!r}") from None
    figure = _figure(SIZE_IN)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2])
    number = np.arange(1, len(poses) + 1)
    left.axhline(0.0, color="0.7", linewidth=0.8)
    for those, colour, label in ((used, "C0", "used"), (~used, "C3", "excluded")):
        if those.any():
            left.errorbar(
                number[those], residual[those], error[those], fmt="o", markersize=4, color=colour, label=label
            )
    left.set_xlabel("pose")
    left.set_ylabel(f"residual of |a|, {small}")
    left.legend(frameon=False)
    _sphere(right, up, residual, used, str(small))
    return figure


def _sphere(axes: Any, up: Any, residual: Any, used: Any, unit: str) -> None:
    """Lambert's projection of each half, the lower one beside the upper."""
    turn = np.linspace(0, 2 * np.pi, 100)
    most = float(np.abs(residual[used]).max(initial=0.0)) or 1.0
    shown = None
    for centre, half, name in ((-1.1, up[:, 2] >= 0, "+z up"), (1.1, up[:, 2] < 0, "−z up")):
        axes.plot(centre + np.cos(turn), np.sin(turn), color="0.7", linewidth=0.8)
        axes.text(centre, -1.25, name, ha="center")
        r = np.sqrt(np.maximum(1 - np.abs(up[half, 2]), 0.0))
        across = np.hypot(up[half, 0], up[half, 1])
        scale = np.divide(r, across, out=np.zeros_like(r), where=across > 0)
        shown = axes.scatter(
            centre + up[half, 0] * scale,
            up[half, 1] * scale,
            c=np.where(used[half], residual[half], np.nan),
            cmap="coolwarm",
            vmin=-most,
            vmax=most,
            edgecolors=np.where(used[half], "0.3", "C3"),
            plotnonfinite=True,
        )
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.figure.colorbar(shown, ax=axes, orientation="horizontal", label=f"residual, {unit}")
