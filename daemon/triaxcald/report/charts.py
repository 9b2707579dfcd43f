"""The residuals in order of time, the bars before and after, and the raw streams."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from triaxcald.report.document import HeldOut, Pose, Stage
from triaxcald.report.figures import clean, micro, micro_g
from triaxcald.report.ink import AFTER, AXES, BAND, BEFORE, FLOOR, MUTED, STEP, draw, hang_grid
from triaxcald.report.stream import StreamOverview

_CONSPICUOUS = 3.0
_MOST_MARKED = 10


def time_picture(poses: Sequence[Pose], stages: Sequence[Stage], noise_floor_g: float | None) -> Markup | None:
    """Residual per pose in order of time: all stages on one scale, then the last one on its own."""
    shown = [stage for stage in stages if stage.pose_residual_g is not None]
    if not shown:
        return None
    place, label = _places(poses)
    colours = _stage_colours(stages)
    alt = f"Residual of {len(poses)} poses in order of time, {' and '.join(s.label.lower() for s in shown)}"

    def paint(figure: Figure) -> None:
        panels = figure.subplots(2 if len(shown) > 1 else 1, 1, sharex=True, squeeze=False)[:, 0]
        for axes in panels:
            _noise_band(axes, noise_floor_g)
            axes.set_ylabel("residual, µg")
            hang_grid(axes)
        for stage in shown:
            _pose_residuals(panels[0], place, poses, stage, colours[stage.label])
        if len(shown) > 1:
            last = shown[-1]
            _pose_residuals(panels[1], place, poses, last, colours[last.label])
            panels[1].set_title(f"{last.label}, enlarged", loc="left")
        _mark_conspicuous(panels[-1], place, poses, shown[-1])
        panels[-1].set_xlabel(label)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=5)

    return draw("time", alt, (8.0, 4.0 if len(shown) > 1 else 2.8), paint)


def bars_picture(stages: Sequence[Stage], held_out: HeldOut | None) -> Markup | None:
    """Errors of every stage in µg against the noise floor, or None when none is known."""
    groups = _bar_groups(stages, held_out)
    if not groups:
        return None
    colours = _stage_colours(stages)
    told = [f"{name}: " + ", ".join(f"{s} {micro_g(v)}" for s, v in bars) for name, bars, _ in groups]
    rows = sum(len(bars) + 1 for _, bars, _ in groups)

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        marks_g = [floor_g or 0.0 for _, _, floor_g in groups] + [v for _, bars, _ in groups for _, v in bars]
        axis_end_ug = 1.14e6 * (max(marks_g) or 1e-6)
        top, ticks = 0.0, []
        for name, bars, floor_g in groups:
            ticks.append((top + 0.5 * (len(bars) - 1), name))
            _bar_group(axes, top, bars, floor_g, colours, axis_end_ug, named=not top)
            top += len(bars) + 0.8
        axes.set(xlim=(0, axis_end_ug), ylim=(top - 1.0, -0.8), xlabel="error of the magnitude, µg")
        axes.set_yticks([at for at, _ in ticks], labels=[name for _, name in ticks])
        hang_grid(axes, "x")
        axes.tick_params(axis="y", length=0)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=5)

    return draw("bars", f"Bars. {'; '.join(told)}", (8.0, 0.9 + 0.27 * rows), paint)


def stream_picture(stream: StreamOverview) -> Markup | None:
    """The three raw outputs with the still spans shaded, or None for an empty stream."""
    if stream.time_s.size == 0:
        return None
    alt = f"Raw outputs x, y and z over time with {len(stream.spans)} still spans shaded"
    scale, unit = (60.0, "min") if np.ptp(stream.time_s) > 600 else (1.0, "s")

    def paint(figure: Figure) -> None:
        panels = figure.subplots(3, 1, sharex=True)
        spans = [(start / scale, (end - start) / scale) for start, end in stream.spans]
        for axes, name, colour, column in zip(panels, "xyz", AXES, stream.readings.T, strict=True):
            axes.broken_barh(spans, (0, 1), transform=axes.get_xaxis_transform(), facecolor=BAND)
            axes.plot(stream.time_s / scale, column, color=colour, lw=0.8)
            axes.set_ylabel(f"u{name}, {clean(stream.unit)[:16]}")
            axes.yaxis.set_major_locator(MaxNLocator(4))
            hang_grid(axes)
        panels[-1].set_xlabel(f"time, {unit} (shaded: still spans)")

    return draw("streams", alt, (8.0, 4.4), paint)


def _places(poses: Sequence[Pose]) -> tuple[NDArray[np.float64], str]:
    """Where each pose stands on the axis of time, or its number where a time is missing."""
    middles = [pose.middle_s for pose in poses]
    times_s = np.array([middle for middle in middles if middle is not None])
    if times_s.size < len(poses):
        return np.array([pose.number for pose in poses], dtype=np.float64), "pose"
    if times_s.size and float(np.ptp(times_s)) > 600:
        return times_s / 60.0, "time, min"
    return times_s, "time, s"


def _stage_colours(stages: Sequence[Stage]) -> dict[str, str]:
    colours = {stage.label: STEP for stage in stages}
    if len(stages) > 1:
        colours[stages[0].label] = BEFORE
    colours[stages[-1].label] = AFTER
    return colours


def _noise_band(axes: Axes, noise_floor_g: float | None) -> None:
    axes.axhline(0, color=MUTED, lw=0.7)
    if noise_floor_g is not None:
        for factor in (2, 1):
            reach = factor * noise_floor_g * 1e6
            axes.axhspan(-reach, reach, color=BAND, lw=0, label="±1, ±2 noise floors" if factor == 2 else None)


def _pose_residuals(axes: Axes, place: NDArray[np.float64], poses: Sequence[Pose], stage: Stage, colour: str) -> None:
    assert stage.pose_residual_g is not None
    used, residual_ug = np.array([pose.used for pose in poses]), stage.pose_residual_g * 1e6
    size = 4.0 if len(poses) <= 100 else 2.2
    axes.plot(place[used], residual_ug[used], "o-", color=colour, ms=size, lw=0.6, label=stage.label)
    axes.plot(place[~used], residual_ug[~used], "x", color=colour, ms=size + 1.5)


def _mark_conspicuous(axes: Axes, place: NDArray[np.float64], poses: Sequence[Pose], stage: Stage) -> None:
    """Numbers beside the poses a metrologist looks up first: not used, or far out for their noise."""
    assert stage.pose_residual_g is not None
    conspicuous = [
        (abs(pose.studentized or 0.0), pose, at, residual_g)
        for at, residual_g, pose in zip(place, stage.pose_residual_g, poses, strict=True)
        if np.isfinite(residual_g) and (abs(pose.studentized or 0.0) > _CONSPICUOUS or not pose.used)
    ]
    for _, pose, at, residual_g in sorted(conspicuous, key=lambda entry: -entry[0])[:_MOST_MARKED]:
        note = f"pose {pose.number}" + ("" if pose.used else ", not used")
        axes.annotate(note, (at, residual_g * 1e6), (6, 4), textcoords="offset points", fontsize=7)


Group = tuple[str, list[tuple[str, float]], float | None]


def _bar_groups(stages: Sequence[Stage], held_out: HeldOut | None) -> list[Group]:
    floor_g = next((s.residual.noise_floor_g for s in reversed(stages) if s.residual.noise_floor_g), None)
    held_out_floor_g = held_out.noise_floor_g if held_out else None
    rows = (
        ("residual, rms", floor_g, [s.residual.rms_g for s in stages]),
        ("cross-validated, rms", floor_g, [s.residual.cross_validated_rms_g for s in stages]),
        ("held-out, rms", held_out_floor_g, [s.held_out_rms_g for s in stages]),
    )
    groups: list[Group] = []
    for name, floor, values in rows:
        bars = [(s.label, value) for s, value in zip(stages, values, strict=True) if value is not None]
        if bars:
            groups.append((name, bars, floor))
    return groups


def _bar_group(
    axes: Axes, top: float, bars: list[tuple[str, float]], floor_g: float | None,
    colours: dict[str, str], axis_end_ug: float, *, named: bool,
) -> None:  # fmt: skip
    for i, (label, value_g) in enumerate(bars):
        axes.barh(top + i, value_g * 1e6, 0.82, color=colours[label], label=label if named else None)
        just_below = floor_g is not None and 0.0 <= floor_g * 1e6 - value_g * 1e6 < 0.07 * axis_end_ug
        at_ug = (floor_g if just_below and floor_g else value_g) * 1e6
        axes.annotate(micro(value_g), (at_ug, top + i), (4, 0), textcoords="offset points", va="center", fontsize=8)
    if floor_g is not None:
        axes.vlines(floor_g * 1e6, top - 0.6, top + len(bars) - 0.4, color=FLOOR, lw=1.6, linestyles=(0, (3, 1.5)),
                    label="noise floor" if named else "_nolegend_")  # fmt: skip
