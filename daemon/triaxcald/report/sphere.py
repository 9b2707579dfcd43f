"""The residual of every pose over the sphere of directions, one pair of hemispheres a stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from triaxcald.report.document import Pose, Stage
from triaxcald.report.figures import micro
from triaxcald.report.ink import GRID, INK, MUTED, draw

# Readable on white and on near-black alike: saturated ends, a middle grey for "no more than noise".
_COLOURS = LinearSegmentedColormap.from_list(
    "residual", ["#0a4fd0", "#3f86f0", "#8db4e8", "#a3a3a3", "#eab27e", "#f07f1e", "#c04a00"]
)
_MOST_DOUBLINGS = 7
_EQUATOR = 0.02
_MOST_NUMBERED = 60


def sphere_picture(poses: Sequence[Pose], stages: Sequence[Stage], noise_floor_g: float | None) -> Markup | None:
    """Poses on two equal-area hemispheres coloured by residual, or None without directions or residuals."""
    shown = [stage for stage in stages if stage.pose_residual_g is not None]
    if not shown or all(pose.direction is None for pose in poses):
        return None
    norm = _doubling_classes(shown, noise_floor_g)
    alt = f"Residual over the sphere for {len(poses)} poses, {' and '.join(s.label.lower() for s in shown)}"

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(shown), 2, squeeze=False)
        for row, stage in zip(grid, shown, strict=True):
            for axes, side in zip(row, (1, -1), strict=True):
                _hemisphere(axes, side, poses, stage, norm)
                if stage is shown[0]:
                    axes.set_title("Upper half, +Z in the middle" if side > 0 else "Lower half, −Z in the middle",
                                   pad=16)  # fmt: skip
            row[0].text(-1.85, 0, stage.label, ha="center", va="center", weight="bold", rotation=90)
        _colour_bar(figure, grid, norm)

    return draw("sphere", alt, (8.0, 2.7 * len(shown) + 0.75), paint)


def equal_area(direction: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Lambert's projection of unit vectors (n, 3) onto the unit disc (n, 2) about +Z or −Z.

    Both halves are seen from +Z, so +X lies right and +Y up in each.
    """
    height = np.clip(side * direction[:, 2], 0.0, 1.0)
    across = np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
    return direction[:, :2] / np.where(across > 0, across, 1.0) * np.sqrt(1.0 - height)[:, None]


def _doubling_classes(stages: Sequence[Stage], noise_floor_g: float | None) -> BoundaryNorm:
    """Classes of ±1, ±2, ±4 … noise floors, so that errors before and after both show on one scale."""
    largest = max(float(np.nanmax(np.abs(stage.pose_residual_g))) for stage in stages)  # type: ignore[arg-type]
    unit = noise_floor_g if noise_floor_g is not None and noise_floor_g > 0 else (largest / 8 or 1e-6)
    doublings = int(np.clip(np.ceil(np.log2(max(largest / unit, 1.0))), 2, _MOST_DOUBLINGS))
    edges = unit * 2.0 ** np.arange(doublings + 1)
    return BoundaryNorm([*-edges[::-1], *edges], _COLOURS.N, extend="neither", clip=True)


def _hemisphere(axes: Axes, side: int, poses: Sequence[Pose], stage: Stage, norm: BoundaryNorm) -> None:
    axes.set(xlim=(-1.28, 1.28), ylim=(-1.24, 1.24), aspect="equal")
    axes.axis("off")
    axes.add_patch(Circle((0, 0), 1, fill=False, ec=MUTED, lw=0.9))
    for tilt_deg in (30, 60):
        axes.add_patch(Circle((0, 0), float(np.sqrt(1 - np.cos(np.radians(tilt_deg)))), fill=False, ec=GRID, lw=0.6))
    axes.plot([-1, 1], [0, 0], color=GRID, lw=0.6, zorder=0)
    axes.plot([0, 0], [-1, 1], color=GRID, lw=0.6, zorder=0)
    for label, x, y in (("+X", 1.17, 0), ("−X", -1.17, 0), ("+Y", 0, 1.17), ("−Y", 0, -1.17)):
        axes.text(x, y, label, ha="center", va="center", color=MUTED, fontsize=8)
    assert stage.pose_residual_g is not None
    here = [
        (pose, residual)
        for pose, residual in zip(poses, stage.pose_residual_g, strict=True)
        if pose.direction is not None and side * pose.direction[2] >= -_EQUATOR and np.isfinite(residual)
    ]
    if here:
        _markers(axes, side, here, norm, numbered=len(poses) <= _MOST_NUMBERED)


def _markers(axes: Axes, side: int, here: Sequence[tuple[Pose, float]], norm: BoundaryNorm, *, numbered: bool) -> None:
    places = equal_area(np.array([pose.direction for pose, _ in here]), side)
    used = np.array([pose.used for pose, _ in here])
    residuals = np.array([residual for _, residual in here])
    for mask, marker, edge in ((used, "o", INK), (~used, "X", INK)):
        axes.scatter(
            places[mask, 0], places[mask, 1], c=residuals[mask], cmap=_COLOURS, norm=norm, marker=marker,
            s=70 if numbered else 22, edgecolors=edge, linewidths=0.6, clip_on=False, zorder=3,
        )  # fmt: skip
    if numbered:
        for (pose, _), (x, y) in zip(here, places, strict=True):
            axes.annotate(str(pose.number), (x, y), (5.5, 5.5), textcoords="offset points", fontsize=6.5)


def _colour_bar(figure: Figure, grid: NDArray[np.object_], norm: BoundaryNorm) -> None:
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=grid, orientation="horizontal", fraction=0.04, pad=0.02, aspect=45,
        spacing="uniform",
    )  # fmt: skip
    bar.set_ticks(list(norm.boundaries), labels=[micro(edge) for edge in norm.boundaries])
    bar.set_label("residual of the magnitude, µg (grey: within one noise floor; every colour doubles)")
    bar.outline.set_edgecolor(MUTED)
