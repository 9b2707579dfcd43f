"""The residual of every pose over the sphere of directions, one pair of
hemispheres a stage."""

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

from triaxcal.units import ErrorUnit
from triaxcald.report.document import Pose
from triaxcald.report.figures import MICRO_G, micro, unit_label
from triaxcald.report.ink import GRID, INK, MUTED, draw
from triaxcald.report.stages import Stage

# Readable on white and on near-black alike: saturated ends, a middle grey for
# "no more than noise".
_COLOURS = LinearSegmentedColormap.from_list(
    "residual", ["#0a4fd0", "#3f86f0", "#8db4e8", "#a3a3a3", "#eab27e", "#f07f1e", "#c04a00"]
)
_MOST_DOUBLINGS = 7
_EQUATOR = 0.02
WIDTH_IN, HEIGHT_IN = 4.8, 3.4
_MOST_NUMBERED = 40
_LABEL_SIZE = (0.25, 0.14)
"""Width and height of a number beside a pose, in radii of the sphere."""


def sphere_pictures(
    poses: Sequence[Pose], stages: Sequence[Stage], noise_floor_g: float | None, unit: ErrorUnit = MICRO_G
) -> tuple[Markup, ...]:
    """Poses on two equal-area hemispheres coloured by residual, a picture a
    stage on one scale; none without directions or residuals."""
    shown = [stage for stage in stages if stage.pose_residual_g is not None]
    if not shown or all(pose.direction is None for pose in poses):
        return ()
    norm = _doubling_classes(shown, noise_floor_g)
    return tuple(_of_stage(poses, stage, norm, unit, f"sphere{i or ''}") for i, stage in enumerate(shown))


def _of_stage(poses: Sequence[Pose], stage: Stage, norm: BoundaryNorm, unit: ErrorUnit, name: str) -> Markup:
    def paint(figure: Figure) -> None:
        pair = figure.subplots(1, 2, squeeze=False)
        for axes, side in zip(pair[0], (1, -1), strict=True):
            _hemisphere(axes, side, poses, stage, norm)
            axes.text(0, -1.52, "+Z half" if side > 0 else "−Z half", ha="center", color=MUTED, fontsize=8)
        pair[0, 0].set_title(stage.label, loc="left", weight="bold", pad=8)
        _colour_bar(figure, pair, norm, 0.2 / HEIGHT_IN, unit)

    alt = f"Residual over the sphere for {len(poses)} poses, {stage.label.lower()}"
    return draw(name, alt, (WIDTH_IN, HEIGHT_IN), paint)


def equal_area(direction: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Lambert's projection of unit vectors (n, 3) onto the unit disc (n, 2)
    about +Z or −Z.

    Both halves are seen from +Z, so +X lies right and +Y up in each.
    """
    height = np.clip(side * direction[:, 2], 0.0, 1.0)
    across = np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
    return direction[:, :2] / np.where(across > 0, across, 1.0) * np.sqrt(1.0 - height)[:, None]


def _doubling_classes(stages: Sequence[Stage], noise_floor_g: float | None) -> BoundaryNorm:
    """Classes of ±1, ±2, ±4 … noise floors, so that errors before and after
    both show on one scale."""
    largest = max(float(np.nanmax(np.abs(r))) for stage in stages if (r := stage.pose_residual_g) is not None)
    unit = noise_floor_g if noise_floor_g is not None and noise_floor_g > 0 else (largest / 8 or 1e-6)
    doublings = int(np.clip(np.ceil(np.log2(max(largest / unit, 1.0))), 2, _MOST_DOUBLINGS))
    edges = unit * 2.0 ** np.arange(doublings + 1)
    return BoundaryNorm([*-edges[::-1], *edges], _COLOURS.N, extend="neither", clip=True)


def _hemisphere(axes: Axes, side: int, poses: Sequence[Pose], stage: Stage, norm: BoundaryNorm) -> None:
    axes.set(xlim=(-1.42, 1.42), ylim=(-1.56, 1.36), aspect="equal")
    axes.axis("off")
    axes.add_patch(Circle((0, 0), 1, fill=False, ec=MUTED, lw=0.9))
    for tilt_deg in (30, 60):
        axes.add_patch(Circle((0, 0), float(np.sqrt(1 - np.cos(np.radians(tilt_deg)))), fill=False, ec=GRID, lw=0.6))
    axes.plot([-1, 1], [0, 0], color=GRID, lw=0.6, zorder=0)
    axes.plot([0, 0], [-1, 1], color=GRID, lw=0.6, zorder=0)
    for label, x, y in (("+X", 1.27, -0.02), ("−X", -1.22, -0.02), ("+Y", 0, 1.24), ("−Y", 0, -1.18)):
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
            s=52 if numbered else 18, edgecolors=edge, linewidths=0.6, clip_on=False, zorder=3,
        )  # fmt: skip
    if numbered:
        for (x, y), numbers in _labels([pose.number for pose, _ in here], places):
            # Clear of the axes' names, which stand above the rim and to the
            # right of it.
            up = -9.0 if y > 0.85 and abs(x) < 0.3 else 7.5 if x > 0.85 and abs(y) < 0.2 else 4.5
            axes.annotate(numbers, (x, y), (4.5, up), textcoords="offset points", fontsize=6.5)


def _labels(numbers: Sequence[int], places: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], str]]:
    """One for all poses whose own would lie on each other, as of a pose that is
    taken twice."""
    groups: list[tuple[NDArray[np.float64], list[int]]] = []
    for number, place in zip(numbers, places, strict=True):
        near = next((g for at, g in groups if np.all(np.abs(place - at) < _LABEL_SIZE)), None)
        if near is None:
            groups.append((place, [number]))
        else:
            near.append(number)
    return [(place, ", ".join(map(str, group))) for place, group in groups]


def _colour_bar(figure: Figure, grid: NDArray[np.object_], norm: BoundaryNorm, share: float, unit: ErrorUnit) -> None:
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=grid, orientation="horizontal", fraction=share, pad=0.02, aspect=37,
        spacing="uniform",
    )  # fmt: skip
    bar.set_ticks(list(norm.boundaries), labels=[micro(edge, unit) for edge in norm.boundaries])
    bar.ax.tick_params(labelsize=6, rotation=45)
    bar.set_label(f"residual of the magnitude, {unit_label(unit)}")
    bar.outline.set_edgecolor(MUTED)
