"""Draws the picture of the README: residuals before and after, on the sphere and against what drives them.

    python docs/pictures/before_after.py

It diagnoses a recording of this repository as a user would, and draws from the document alone.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from triaxcald.cli.commands import main

HERE = Path(__file__).parent
RECORDING = HERE.parents[1] / "recordings" / "modbus-temperature-bias.mcap"
PICTURE = HERE / "before-after.png"
MICRO = 1e6
WIDTH_IN, HEIGHT_IN, DPI = 10.0, 5.9, 160  # 1600 px, shown at 800


def diagnosis(recording: Path) -> Mapping[str, Any]:
    """The document `triaxcal.loop/1` of the recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "loop.json"
        assert main(["diagnose", str(recording), "-o", str(path)]) == 0
        return json.loads(path.read_text("utf-8"))


def hemispheres(axes: Axes, up: np.ndarray, residual: np.ndarray, most: float) -> Any:
    """Directions (n,3) and residuals (n,) in Lambert's equal-area projection, both halves."""
    turn = np.linspace(0, 2 * np.pi, 200)
    points = None
    for x, half, name in ((-1.1, up[:, 2] >= 0, "z axis up"), (1.1, up[:, 2] < 0, "z axis down")):
        axes.fill(x + np.cos(turn), np.sin(turn), facecolor="0.96", edgecolor="0.7", linewidth=0.8)
        axes.text(x, -1.1, name, ha="center", va="top", fontsize=11, color="0.35")
        across = np.hypot(up[half, 0], up[half, 1])
        radius = np.sqrt(np.maximum(1 - np.abs(up[half, 2]), 0.0))
        scale = np.divide(radius, across, out=np.zeros_like(radius), where=across > 0)
        points = axes.scatter(
            x + up[half, 0] * scale, up[half, 1] * scale, c=residual[half], cmap="RdBu_r", vmin=-most, vmax=most,
            s=110, edgecolors="0.25", linewidths=0.7,
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_axis_off()
    return points


def against_cause(axes: Axes, trace: Mapping[str, Any], *, corrected: bool) -> None:
    """The partial residuals of one axis in the poses, with the fitted curve or without what it explains."""
    grid, curve = np.array(trace["curve"]["x"]), MICRO * np.array(trace["curve"]["y"])
    x, y, error = np.array(trace["x"]), MICRO * np.array(trace["y"]), MICRO * np.array(trace["error"])
    if corrected:
        y = y - np.interp(x, grid, curve)
    else:
        axes.plot(grid, curve, color="#c1272d", linewidth=2.2, label="fitted effect")
        axes.legend(frameon=False, fontsize=12, loc="best")
    axes.axhline(0.0, color="0.7", linewidth=1.0, zorder=0)
    axes.errorbar(x, y, error, fmt="o", color="#1f5fa8", markersize=6, elinewidth=1.2)
    axes.set_ylabel(f"residual of {trace['axis']}, µg", fontsize=12)
    axes.spines[["top", "right"]].set_visible(False)


def picture(loop: Mapping[str, Any]) -> Figure:
    """Before above after; the sphere on the left, the cause on the right, on the same scales."""
    mpl.rcParams.update({"font.size": 12})
    poses = [p for p in loop["calibration"]["poses"] if p["used"]]
    up = np.array([p["direction"] for p in poses])
    residuals = [MICRO * np.array([p[key] for p in poses]) for key in ("before_residual_g", "residual_g")]
    most = float(np.abs(residuals[0]).max())
    trace = max(loop["traces"], key=lambda t: float(np.ptp(t["curve"]["y"])))
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
    rows = figure.subplots(2, 2, width_ratios=(1.15, 1))
    titles = ("Before: linear model", f"After: with {loop['findings'][0]['effect']}")
    points = None
    for (sphere, cause), residual, title, key in zip(rows, residuals, titles, ("before", "after"), strict=True):
        points = hemispheres(sphere, up, residual, most)
        rms = MICRO * loop[key]["cross_validated_rms_g"]
        sphere.set_title(f"{title}, {rms:.3g} µg rms", fontsize=13, fontweight="bold")
        against_cause(cause, trace, corrected=key == "after")
    upper, lower = rows[0][1], rows[1][1]
    lower.sharex(upper)
    lower.set_ylim(upper.get_ylim())
    upper.set_title("Against the temperature", fontsize=13, fontweight="bold")
    lower.set_xlabel("temperature, °C", fontsize=12)
    bar = figure.colorbar(
        points, ax=[row[0] for row in rows], orientation="horizontal", shrink=0.8, aspect=40, pad=0.01
    )
    bar.set_label("residual of the magnitude in a pose, µg", fontsize=12)
    return figure


if __name__ == "__main__":
    picture(diagnosis(RECORDING)).savefig(PICTURE, dpi=DPI, metadata={"Software": None})
