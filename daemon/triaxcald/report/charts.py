"""The charts of the page as inline SVG that takes its colours from the page, light or
dark: the bars of every step against the noise floor, the raw streams, the spheres."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal

import matplotlib
import matplotlib.style
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Circle
from matplotlib.textpath import text_to_path
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

import triaxcal as tc
from triaxcald.report.document import CANDIDATE, Finding, HoldOut, Outcome, Pose, Stage, mapping, texts
from triaxcald.report.figures import MICRO_G, chance, clean, micro, micro_g, number, run_of, unit_label

# From a matplotlib figure to inline SVG.

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


_UNDRAWN: ContextVar[bool] = ContextVar("undrawn", default=False)


@contextmanager
def undrawn() -> Iterator[None]:
    """Within it, `draw` returns the description of a picture and no lines, which
    take most of the time of a page."""
    before = _UNDRAWN.set(True)
    try:
        yield
    finally:
        _UNDRAWN.reset(before)


def draw(name: str, alt: str, size_in: tuple[float, float], paint: Callable[[Figure], None]) -> Markup:
    """Inline SVG of what `paint` draws, `alt` read aloud in its place.

    The same drawing gives the same bytes; `name` keeps the ids of several
    drawings on a page apart.
    """
    if _UNDRAWN.get():
        return _inline("<svg></svg>", name, alt)
    with matplotlib.style.context(["default", {**_STYLE, "svg.hashsalt": name}]):
        figure = Figure(figsize=size_in, layout="constrained")
        paint(figure)
        svg = _svg(figure)
    return _inline(svg, name, alt)


_POINTS = 72
"""Units of an SVG drawing an inch."""


def _svg(figure: Figure) -> str:
    """The bytes of `Figure.savefig`, which draws everything once more only to place
    the axes, and measures each text for both anew."""
    sheet, dots, (width, height) = io.StringIO(), figure.dpi, figure.get_size_inches()

    def renderer(out: io.StringIO) -> Any:
        make: Any = _Renderer
        return make(width * _POINTS, height * _POINTS, out, image_dpi=dots, metadata=_NO_METADATA)

    _Canvas(figure).measures = renderer(io.StringIO())
    figure.set_dpi(_POINTS)
    # Place the axes, then draw them where they are.
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine("none")
    both: Any = MixedModeRenderer
    page = both(figure, width, height, dots, renderer(sheet))
    figure.draw(page)
    page.finalize()
    return sheet.getvalue()


class _Canvas(FigureCanvasSVG):
    """With the renderer by which the layout measures."""

    measures: RendererSVG

    def get_renderer(self) -> RendererSVG:
        return self.measures


class _Renderer(RendererSVG):
    """Measures a text once for all pictures."""

    def get_text_width_height_descent(
        self, s: str, prop: FontProperties, ismath: bool | Literal["TeX"]
    ) -> tuple[float, float, float]:
        return _measured(s, prop, ismath) if ismath else _extent(s, prop)


@lru_cache(maxsize=4096)
def _extent(words: str, font: FontProperties) -> tuple[float, float, float]:
    """Width, height and descent; matplotlib asks with a copy of the font."""
    return _measured(words, font, False)


_measured: Callable[..., tuple[float, float, float]] = text_to_path.get_text_width_height_descent


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


# The raw readings as the page shows them: few enough points to draw, no extreme
# lost.


@dataclass(frozen=True)
class StreamOverview:
    """Raw readings thinned for a picture.

    time_s (n,), readings (n, 3) in `unit`, spans the still spans as (start_s,
    end_s) on the same clock. Raises ValueError when the shapes disagree.
    """

    time_s: NDArray[np.float64]
    readings: NDArray[np.float64]
    spans: tuple[tuple[float, float], ...]
    unit: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", np.asarray(self.time_s, dtype=np.float64))
        object.__setattr__(self, "readings", np.asarray(self.readings, dtype=np.float64))
        object.__setattr__(self, "spans", tuple((float(start), float(end)) for start, end in self.spans))
        if self.time_s.ndim != 1 or self.readings.shape != (self.time_s.size, 3):
            raise ValueError(
                f"stream overview: time_s {self.time_s.shape} and readings {self.readings.shape}, "
                "expected (n,) and (n, 3)"
            )


def thin(time_s: ArrayLike, readings: ArrayLike, points: int = 2000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most `points` rows of (n,) and (n, 3), in order, among them every
    stretch's extremes of each axis.

    Raises ValueError below 8 points: the ends and one stretch's six extremes.
    """
    times, values = np.asarray(time_s, dtype=np.float64), np.asarray(readings, dtype=np.float64)
    if points < 8:
        raise ValueError(f"points = {points}, expected at least 8")
    if times.size <= points:
        return times, values
    edges = np.linspace(0, times.size, (points - 2) // 6 + 1).astype(np.intp)
    kept = [np.array([0, times.size - 1])]
    for start, end in pairwise(edges):
        block = values[start:end]
        kept.append(start + np.where(np.isnan(block), np.inf, block).argmin(axis=0))
        kept.append(start + np.where(np.isnan(block), -np.inf, block).argmax(axis=0))
    rows = np.unique(np.concatenate(kept))
    return times[rows], values[rows]


def overview_of(windows: tc.poses.Windows | None, poses: Sequence[tc.Pose], unit: str) -> StreamOverview | None:
    """The stream from its windows' means; None where there is not one whole
    window."""
    if windows is None:
        return None
    time_s, readings = thin((windows.start_ns - int(windows.start_ns[0])) * 1e-9, windows.mean)
    return StreamOverview(time_s, readings, tuple((p.start_s, p.end_s) for p in poses), unit)


Group = tuple[str, list[tuple[str, float]], float | None]
_LONGEST_LABEL = 34


def bars_picture(
    stages: Sequence[Stage], held_out: HoldOut | None, unit: tc.units.ErrorUnit = MICRO_G
) -> Markup | None:
    """Errors of every stage against the noise floor, or None when none is
    known."""
    groups = _bar_groups(stages, held_out)
    if not groups:
        return None
    colours = stage_colours(stages)
    told = [f"{name}: " + ", ".join(f"{s} {micro_g(v, unit)}" for s, v in bars) for name, bars, _ in groups]
    rows = sum(len(bars) + 1 for _, bars, _ in groups)

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        marks_g = [floor_g or 0.0 for _, _, floor_g in groups] + [v for _, bars, _ in groups for _, v in bars]
        axis_end = 1.28 * (unit.count(max(marks_g)) or 1.0)
        top, ticks, names = 0.0, [], []
        for name, bars, floor_g in groups:
            axes.annotate(name, (0, top - 0.72), (2, 0), textcoords="offset points", va="center", weight="bold")
            ticks += [top + i for i in range(len(bars))]
            names += [label[:_LONGEST_LABEL] for label, _ in bars]
            _bar_group(axes, top, bars, floor_g, colours, axis_end, unit, named=not top)
            top += len(bars) + 1.0
        axes.set(xlim=(0, axis_end), ylim=(top - 1.4, -1.1), xlabel=f"error of the magnitude, {unit_label(unit)}")
        axes.set_yticks(ticks, labels=names)
        hang_grid(axes, "x")
        axes.tick_params(axis="y", length=0)
        handles = axes.get_legend_handles_labels()
        if handles[0]:
            figure.legend(*handles, loc="outside upper right")

    return draw("bars", f"Bars. {'; '.join(told)}", (4.8, 0.9 + 0.27 * rows), paint)


def stream_pictures(stream: StreamOverview) -> tuple[Markup, ...]:
    """The three raw outputs with the still spans shaded; none for an empty
    stream."""
    if stream.time_s.size == 0:
        return ()
    return tuple(_of_output(stream, axis) for axis in range(3))


def _of_output(stream: StreamOverview, axis: int) -> Markup:
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        spans = [(start, end - start) for start, end in stream.spans]
        axes.broken_barh(spans, (0, 1), transform=axes.get_xaxis_transform(), facecolor=BAND)
        axes.plot(stream.time_s, stream.readings[:, axis], color=AXES[axis], lw=0.8)
        unit = clean(stream.unit)[:16]
        axes.set_ylabel(f"u{'xyz'[axis]}, {unit}" if unit else f"u{'xyz'[axis]}")
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.set_xlabel("time, s")
        hang_grid(axes)

    alt = f"Raw output {'xyz'[axis]} over time with {len(stream.spans)} still spans shaded"
    return draw(f"stream{axis}", alt, (4.2, 2.2), paint)


def stage_colours(stages: Sequence[Stage]) -> dict[str, str]:
    colours = {stage.label: STEP for stage in stages}
    if len(stages) > 1:
        colours[stages[0].label] = BEFORE
    if stages:
        colours[stages[-1].label] = AFTER
    return colours


def _bar_groups(stages: Sequence[Stage], held_out: HoldOut | None) -> list[Group]:
    floor_g = next((s.residual.noise_floor_g for s in reversed(stages) if s.residual.noise_floor_g), None)
    held_out_floor_g = held_out.noise_floor_g if held_out else None
    rows = (
        ("In the poses of the fit, rms", floor_g, [s.residual.rms_g for s in stages]),
        ("Cross-validated, rms", floor_g, [s.residual.cross_validated_rms_g for s in stages]),
        ("Held-out recording, rms", held_out_floor_g, [s.held_out_rms_g for s in stages]),
    )
    groups: list[Group] = []
    for name, floor, values in rows:
        bars = [(s.label, value) for s, value in zip(stages, values, strict=True) if value is not None]
        if bars:
            groups.append((name, bars, floor))
    return groups


def _bar_group(
    axes: Axes, top: float, bars: list[tuple[str, float]], floor_g: float | None,
    colours: dict[str, str], axis_end: float, unit: tc.units.ErrorUnit, *, named: bool,
) -> None:  # fmt: skip
    for i, (label, value_g) in enumerate(bars):
        axes.barh(top + i, unit.count(value_g), 0.78, color=colours[label])
        just_below = floor_g is not None and 0.0 <= unit.count(floor_g - value_g) < 0.25 * axis_end
        at = unit.count(floor_g if just_below and floor_g else value_g)
        note = micro(value_g, unit) + (f"  ({_times(value_g / floor_g)} × floor)" if floor_g else "")
        axes.annotate(note, (at, top + i), (4, 0), textcoords="offset points", va="center", fontsize=8)
    if floor_g is not None:
        axes.vlines(unit.count(floor_g), top - 0.41, top + len(bars) - 0.57, color=FLOOR, lw=1.6,
                    linestyles=(0, (3, 1.5)), label="noise floor" if named else "_nolegend_")  # fmt: skip


def _times(ratio: float) -> str:
    return f"{ratio:.1f}" if ratio < 10 else f"{min(ratio, 1e9):.0f}"


# The moments that effects of the model name, each by the clock of one recording,
# and the poses about them.


def moments_in(outcome: Outcome, recording: str) -> Mapping[str, float]:
    """By name, in s by the clock of the recording; an empty name is the only
    one's."""
    return {
        clean(tc.text.traces.effect_title(finding.effect)): at_s
        for finding in outcome.findings
        if (at_s := finding.shape("at")) is not None and finding.in_model and _recording(finding, outcome) == recording
    }


def bracket(finding: Finding, outcome: Outcome) -> str:
    """In which pose or between which a moment lies, and how far it may be from
    there; empty where there is none."""
    at_s, recording = finding.shape("at"), _recording(finding, outcome)
    timed = [
        (pose, pose.start_s, pose.end_s)
        for pose in outcome.poses
        if pose.start_s is not None and pose.end_s is not None and pose.recording == recording
    ]
    if at_s is None:
        return ""
    where = f" of {recording}" if recording else ""
    error_s = next((c.standard_error for c in finding.coefficients if c.name == "at"), None)

    def reach(sure: bool) -> str:
        if sure or error_s is None:
            return ""
        first, last = max(at_s - 2 * error_s, 0.0), min(at_s + 2 * error_s, max(end_s for _, _, end_s in timed))
        return f"; two standard errors reach from {first:.1f} s to {last:.1f} s"

    for pose, start_s, end_s in timed:
        if start_s <= at_s <= end_s:
            sure = error_s is None or (start_s <= at_s - 2 * error_s and at_s + 2 * error_s <= end_s)
            return f"The moment lies {'' if sure else 'most likely '}in pose {pose.number}{where}{reach(sure)}."
    before = [(end_s, pose.number) for pose, _, end_s in timed if end_s < at_s]
    after = [(start_s, pose.number) for pose, start_s, _ in timed if start_s > at_s]
    if not (before and after):
        return ""
    (end_s, first), (start_s, last) = max(before), min(after)
    # Anywhere between the two is a rectangle; a tenth more, and it may have
    # been inside them.
    sure = error_s is None or error_s <= 1.1 * (start_s - end_s) / math.sqrt(12)
    return (
        f"The moment lies {'' if sure else 'most likely '}between pose {first} and pose {last}{where}, that is between "
        f"{end_s:.1f} s and {start_s:.1f} s{reach(sure) or '; the poses tell it no nearer'}."
    )


def _recording(finding: Finding, outcome: Outcome) -> str:
    """The one that its coefficients name; empty where they name none, or
    several."""
    runs = {run for c in finding.coefficients if (run := run_of(c.name)[1]) is not None}
    run = runs.pop() if len(runs) == 1 else 0
    return outcome.recordings[run - 1] if 0 < run <= len(outcome.recordings) else ""


# The residual of every pose over the sphere of directions, one pair of hemispheres
# a stage.

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
"""Width and height of a index beside a pose, in radii of the sphere."""


def sphere_pictures(
    poses: Sequence[Pose], stages: Sequence[Stage], noise_floor_g: float | None, unit: tc.units.ErrorUnit = MICRO_G
) -> tuple[Markup, ...]:
    """Poses on two equal-area hemispheres coloured by residual, a picture a
    stage on one scale; none without directions or residuals."""
    shown = [stage for stage in stages if stage.pose_residual_g is not None]
    if not shown or all(pose.direction is None for pose in poses):
        return ()
    norm = _doubling_classes(shown, noise_floor_g)
    return tuple(_of_stage(poses, stage, norm, unit, f"sphere{i or ''}") for i, stage in enumerate(shown))


def _of_stage(poses: Sequence[Pose], stage: Stage, norm: BoundaryNorm, unit: tc.units.ErrorUnit, name: str) -> Markup:
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
    for index, place in zip(numbers, places, strict=True):
        near = next((g for at, g in groups if np.all(np.abs(place - at) < _LABEL_SIZE)), None)
        if near is None:
            groups.append((place, [index]))
        else:
            near.append(index)
    return [(place, ", ".join(map(str, group))) for place, group in groups]


def _colour_bar(
    figure: Figure, grid: NDArray[np.object_], norm: BoundaryNorm, share: float, unit: tc.units.ErrorUnit
) -> None:
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=grid, orientation="horizontal", fraction=share, pad=0.02, aspect=37,
        spacing="uniform",
    )  # fmt: skip
    bar.set_ticks(list(norm.boundaries), labels=[micro(edge, unit) for edge in norm.boundaries])
    bar.ax.tick_params(labelsize=6, rotation=45)
    bar.set_label(f"residual of the magnitude, {unit_label(unit)}")
    bar.outline.set_edgecolor(MUTED)


# The trace picture: what the poses show of each finding and each candidate, a panel
# for each variable.

PANEL_IN = (4.2, 2.9)
"""Of a size that letters are legible on a telephone and in three columns."""
INKS = tc.pictures.Inks(used=FLOOR, excluded=MUTED, curve=AFTER, band=BAND, zero=MUTED)
MOST = 12
"""Panels of one document: three for each of four effects."""
LEAST_DRAWN = 0.05
"""Probability of an effect that is drawn although nothing names it: the
correction contains that share of it, and less is thinner than the line."""


@dataclass(frozen=True)
class Panel:
    """``title`` says of what it is, ``caption`` what it shows."""

    title: str
    caption: str
    drawing: Markup
    partial: bool
    """Whether it is of partial residuals."""


def trace_panels(value: object, outcome: Outcome, unit: tc.units.ErrorUnit = MICRO_G) -> tuple[Panel, ...]:
    """Of the ``traces`` of a document; of one that has none the residuals in
    standard errors, as far as these are known."""
    drawable = list(read_traces(value))
    telling = [trace for trace in drawable if _tells(trace, outcome)] or drawable
    known = telling[:MOST] or list(_residuals(outcome.poses))
    return tuple(_panel(trace, outcome, unit, f"trace{i}") for i, trace in enumerate(known))


def no_variable_tells(value: object) -> bool:
    """Whether the curves against single variables show no more than chance does."""
    curves = [trace for trace in read_traces(value) if trace.share is not None]
    return bool(curves) and all(t.p_value is not None and t.p_value > tc.poses.SIGNIFICANT for t in curves)


def _tells(trace: tc.evidence.Trace, outcome: Outcome) -> bool:
    """Whether a panel shows anything: an effect that is named, or probable enough
    to be seen in the correction, or a curve that chance seldom makes."""
    if trace.share is not None:
        return trace.p_value is None or trace.p_value <= tc.poses.SIGNIFICANT
    named = not trace.effect or trace.effect in {f.effect for f in outcome.findings}
    probability = outcome.averaged.get(trace.effect)
    return named or probability is None or probability >= LEAST_DRAWN


def read_traces(value: object) -> Iterator[tc.evidence.Trace]:
    """Those that can be drawn."""
    for entry in value if isinstance(value, (list, tuple)) else []:
        known = mapping(entry)
        x, y, error = (_array(known.get(key)) for key in ("x", "y", "error"))
        curve = mapping(known.get("curve"))
        grid, fitted, half = (_array(curve.get(key)) for key in ("x", "y", "half_width"))
        if known.get("quantity") not in list(tc.evidence.Quantity) or not len(x) or not len(x) == len(y) == len(error):
            continue
        whole = len(grid) == len(fitted) == len(half) and bool(np.isfinite([grid, fitted, half]).all())
        nothing = np.empty(0)
        flags = known.get("excluded")
        excluded = np.resize([bool(v) for v in flags] if isinstance(flags, list) and flags else [False], len(x))
        sound = np.isfinite(x) & np.isfinite(y) & np.isfinite(error)
        if sound.any():
            yield tc.evidence.Trace(
                effect=clean(known.get("effect") or ""),
                axis=clean(known.get("axis") or "")[:1],
                coefficients=tuple(map(clean, texts(known.get("coefficients")))),
                variable=clean(known.get("variable") or tc.evidence.POSE),
                quantity=tc.evidence.Quantity(str(known["quantity"])),
                pose=np.flatnonzero(sound),
                x=x[sound],
                y=y[sound],
                error=np.abs(error[sound]),
                excluded=excluded[sound],
                grid=grid if whole else nothing,
                curve=fitted if whole else nothing,
                half_width=half if whole else nothing,
                share=number(known.get("share")),
                p_value=number(known.get("p_value")),
            )


def _array(value: object) -> NDArray[np.float64]:
    values = [number(v) for v in value] if isinstance(value, (list, tuple)) else []
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def _residuals(poses: Sequence[Pose]) -> Iterator[tc.evidence.Trace]:
    known = [(p, p.residual_g / p.standard_error_g) for p in poses if p.residual_g is not None and p.standard_error_g]
    if not known:
        return
    timed = all(p.middle_s is not None for p, _ in known) and len({p.recording for p, _ in known}) == 1
    nothing = np.empty(0)
    yield tc.evidence.Trace(
        effect="",
        axis="",
        coefficients=(),
        variable=tc.effects.SINCE_START if timed else tc.evidence.POSE,
        quantity=tc.evidence.Quantity.STANDARD_ERRORS,
        pose=np.array([p.number - 1 for p, _ in known]),
        x=np.array([p.middle_s if timed else p.number for p, _ in known], dtype=np.float64),
        y=np.array([ratio for _, ratio in known]),
        error=np.ones(len(known)),
        excluded=np.array([not p.used for p, _ in known]),
        grid=nothing,
        curve=nothing,
        half_width=nothing,
    )


def _panel(trace: tc.evidence.Trace, outcome: Outcome, unit: tc.units.ErrorUnit, name: str) -> Panel:
    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        tc.pictures.paint_trace(axes, trace, unit, INKS)
        hang_grid(axes)

    drawing = draw(name, tc.text.traces.description(trace, unit), PANEL_IN, paint)
    partial = trace.quantity is not tc.evidence.Quantity.STANDARD_ERRORS
    return Panel(tc.text.traces.title(trace), _caption(trace, outcome), drawing, partial)


def _caption(trace: tc.evidence.Trace, outcome: Outcome) -> str:
    """How sure it is that this acts, or what the picture says."""
    if trace.quantity is tc.evidence.Quantity.STANDARD_ERRORS:
        return _of_residuals(outcome)
    if trace.share is not None:
        return _of_curve(trace.share, trace.p_value)
    if trace.effect == tc.text.traces.SMOOTH:
        return "What the correction adds in each pose, and what the poses show. It has no physical meaning."
    finding = next((f for f in outcome.findings if f.effect == trace.effect), None)
    if finding is None:
        return f"Probability {chance(outcome.averaged.get(trace.effect))}; the correction contains that share of it"
    return _of_finding(finding)


def _of_curve(share: float, p_value: float | None) -> str:
    said = f"Smooth curves on three axes take away {100 * max(share, 0.0):.0f} % (adjusted)"
    if p_value is None:
        return said
    if p_value > tc.poses.SIGNIFICANT:
        return f"{said}, no more than chance does for one of these variables (p {p_value:.2g})"
    return f"{said}; chance does as much with p {p_value:.1g}"


def _of_finding(finding: Finding) -> str:
    sure = "Probable" if finding.probability is None else f"Probability {chance(finding.probability)}"
    if finding.alternatives:
        return (
            f"{sure}; or instead {', '.join(tc.text.traces.effect_title(n).lower() for n in finding.alternatives[:3])}"
        )
    return sure + (", not certain" if finding.verdict == CANDIDATE else "")


def _of_residuals(outcome: Outcome) -> str:
    nothing = outcome.nothing_probability
    if outcome.searched and not outcome.findings and not outcome.something_is_left:
        likely = "" if nothing is None else f" (probability {chance(nothing)} that nothing acts)"
        return f"Nothing is left beyond noise{likely}"
    return "What is left, in standard errors of the poses"
