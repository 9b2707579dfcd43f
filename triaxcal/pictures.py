"""Pictures of results. The one room of the metrology that imports matplotlib,
when it is called."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from triaxcal.errors import InvalidData
from triaxcal.units import ErrorUnit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE_IN = (9.0, 4.0)
"""Width and height in inches: two panels side by side, legible across a page."""


def residuals_figure(document: Mapping[str, Any]) -> Figure:
    """Of a `triaxcal.calibration/1`: the residuals of its poses in their order,
    with their standard errors, and where the poses lie on the sphere, in an
    equal-area projection of both halves. Raises InvalidData where it has no
    poses."""
    from matplotlib.figure import Figure  # not pyplot: no window, no state

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
    figure = Figure(figsize=SIZE_IN, layout="constrained")
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
