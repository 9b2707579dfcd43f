"""Pictures of recordings and of what was found in them, small enough to keep with the documentation."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import blended_transform_factory
from PIL import Image

from triaxcal.arrays import Floats
from triaxcal.model.samples import Samples
from triaxcal.poses.pose import Pose

Line = tuple[str, str, Floats, Floats]
"""Name, style, moments in s, values."""
COLOURS = ("#1f5fa8", "#c1272d", "#2c8a3d")
COLUMNS = 1400


def draw(path: Path, title: str, shown: Samples, each: Sequence[tuple[str, Sequence[Pose]]]) -> None:
    """Outputs of one recording, with its still spans shaded and numbered; below them a strip of spans for every
    further recording in ``each`` (name, poses), of which the first is the one shown.
    """
    height = 2.6 + (0.16 * len(each) if len(each) > 1 else 0)
    figure, rows = plt.subplots(
        2, 1, figsize=(11, height), sharex=True, height_ratios=(2.6, max(0.16 * len(each), 0.1)), layout="constrained"
    )
    upper, lower = rows
    t_s = (shown.time_ns - shown.time_ns[0]) * 1e-9
    for axis, (name, colour) in enumerate(zip("xyz", COLOURS, strict=True)):
        _envelope(upper, t_s, shown.readings[:, axis], colour, name)
    for number, pose in enumerate(each[0][1], 1):
        creeping = bool(np.any(pose.creep))
        upper.axvspan(pose.start_s, pose.end_s, color="#e8b04a" if creeping else "#888888", alpha=0.35, lw=0)
        place = blended_transform_factory(upper.transData, upper.transAxes)
        upper.text(pose.t_s, 1.01, str(number), transform=place, ha="center", va="bottom", fontsize=6)
    levels = np.array([pose.mean for pose in each[0][1]])
    if len(levels) > 1:
        # What goes far beyond the poses, as shaking does, would press them flat.
        middle, half = (levels.max() + levels.min()) / 2, (levels.max() - levels.min()) / 2
        upper.set_ylim(middle - 1.8 * half, middle + 1.8 * half)
    upper.set_title(title, fontsize=9, pad=12, loc="left")
    upper.legend(loc="upper right", fontsize=6, ncols=3, frameon=False)
    upper.tick_params(labelsize=7)
    for row, (name, poses) in enumerate(each):
        for pose in poses:
            colour = "#e8b04a" if np.any(pose.creep) else "#888888"
            lower.barh(-row, pose.end_s - pose.start_s, left=pose.start_s, height=0.8, color=colour)
        lower.text(1.003, -row, f"{name}: {len(poses)}", transform=lower.get_yaxis_transform(), fontsize=6, va="center")
    lower.set_yticks([])
    lower.set_xlabel("s", fontsize=7)
    lower.tick_params(labelsize=7)
    lower.set_xlim(t_s[0], t_s[-1])
    save(path, figure)


def draw_by_run(path: Path, label: str, panels: Sequence[Sequence[Line]]) -> None:
    """A panel for every run, on one axis of values."""
    figure, axes = plt.subplots(1, len(panels), figsize=(11, 2.8), sharey=True, layout="constrained")
    for k, (ax, lines) in enumerate(zip(axes, panels, strict=True), 1):
        for name, style, t_s, value in lines:
            ax.plot(t_s, value, style, label=name, ms=4, lw=1)
        ax.axhline(0, color="#888888", lw=0.5)
        ax.set_title(f"run {k}", fontsize=8, loc="left")
        ax.set_xlabel("s", fontsize=7)
        ax.tick_params(labelsize=7)
    axes[0].set_ylabel(label, fontsize=7)
    axes[-1].legend(fontsize=6, frameon=False, ncols=2)
    save(path, figure)


def draw_pairs(path: Path, labels: tuple[str, str], before: Floats, after: Floats, of: Sequence[str]) -> None:
    """Errors after over errors before, logarithmic, with the line on which nothing changes; ``of`` are the groups."""
    figure, ax = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
    for name in dict.fromkeys(of):
        index = [i for i, other in enumerate(of) if other == name]
        ax.loglog(before[index], after[index], "o", ms=4, label=name)
    ends = np.array([min(before.min(), after.min()) / 1.2, max(before.max(), after.max()) * 1.2])
    ax.loglog(ends, ends, color="#888888", lw=0.7)
    ax.set_xlabel(labels[0], fontsize=7)
    ax.set_ylabel(labels[1], fontsize=7)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    ax.tick_params(labelsize=7)
    ax.legend(fontsize=6, frameon=False)
    save(path, figure)


def save(path: Path, figure: Figure) -> None:
    """As a small PNG."""
    held = io.BytesIO()
    figure.savefig(held, format="png", dpi=110)
    plt.close(figure)
    Image.open(held).convert("RGB").quantize(64).save(path, optimize=True)


def _envelope(axes: Axes, t_s: Floats, values: Floats, colour: str, name: str) -> None:
    """The least and the largest value in each column of the picture, so that nothing brief is lost."""
    block = max(len(values) // COLUMNS, 1)
    whole = len(values) // block * block
    parts = values[:whole].reshape(-1, block)
    axes.fill_between(
        t_s[:whole:block], parts.min(axis=1), parts.max(axis=1), color=colour, label=name, lw=0.7, edgecolor=colour
    )
