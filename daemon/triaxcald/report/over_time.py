"""The residuals along the time of each recording, before and after, above the
channels that moved meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

import triaxcal as tc
from triaxcald.report.charts import BAND, FLOOR, INK, MUTED, draw, hang_grid, stage_colours
from triaxcald.report.document import Pose, Stage
from triaxcald.report.figures import MICRO_G, clean, unit_label

_CONSPICUOUS = 3.0
_MOST_MARKED = 8
_NOTE_SIZE = (0.24, 0.12)
"""Width and height of a note beside a pose, in those of the panel."""
_MOST_CHANNELS = 4
_MOST_BARS = 120
_PANEL_IN = (4.8, 2.4)


def time_pictures(
    poses: Sequence[Pose],
    stages: Sequence[Stage],
    noise_floor_g: float | None,
    *,
    moments_in: Callable[[str], Mapping[str, float]],
    unit: tc.units.ErrorUnit,
) -> list[tuple[str, tuple[Markup, ...]]]:
    """Those of each recording, by its own clock, with the recording's name;
    ``moments_in`` it are marked."""
    pictures: list[tuple[str, tuple[Markup, ...]]] = []
    for recording in dict.fromkeys(pose.recording for pose in poses):
        rows = np.array([pose.recording == recording for pose in poses])
        drawings = time_panels(
            [pose for pose in poses if pose.recording == recording],
            [_in_rows(stage, rows) for stage in stages],
            noise_floor_g,
            moments=moments_in(recording),
            unit=unit,
            name=f"time{len(pictures) or ''}",
        )
        if drawings:
            pictures.append((recording, drawings))
    return pictures


def _in_rows(stage: Stage, rows: NDArray[np.bool_]) -> Stage:
    residual_g = None if stage.pose_residual_g is None else stage.pose_residual_g[rows]
    known = residual_g is not None and not np.isnan(residual_g).all()
    return replace(stage, pose_residual_g=residual_g if known else None)


def time_panels(
    poses: Sequence[Pose],
    stages: Sequence[Stage],
    noise_floor_g: float | None,
    *,
    moments: Mapping[str, float] | None = None,
    unit: tc.units.ErrorUnit = MICRO_G,
    name: str = "time",
) -> tuple[Markup, ...]:
    """A panel a stage, each on its own scale, and one for each logged channel
    that moved; ``moments`` are marked. All poses are of one recording."""
    shown = [stage for stage in stages if stage.pose_residual_g is not None]
    if not shown:
        return ()
    place, label = _places(poses)
    marked = moments if "time" in label else None
    of = f" of {clean(poses[0].recording)}" if poses[0].recording else ""
    colours = stage_colours(stages)

    def panel(title: str, alt: str, number: int, fill: Callable[[Axes], None]) -> Markup:
        def paint(figure: Figure) -> None:
            axes = figure.subplots()
            fill(axes)
            axes.set_title(title, loc="left", weight="bold", pad=14 if marked else None)
            axes.set_xlabel(label)
            _mark_moments(axes, marked)
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.ticklabel_format(axis="y", useOffset=False)
            hang_grid(axes)

        return draw(f"{name}-{number}", alt, _PANEL_IN, paint)

    def of_stage(stage: Stage) -> Callable[[Axes], None]:
        def fill(axes: Axes) -> None:
            _noise_band(axes, noise_floor_g, unit)
            _residuals(axes, place, poses, stage, colours[stage.label], unit)
            axes.set_ylabel(f"residual, {unit_label(unit)}")
            if stage is shown[-1]:
                _mark_conspicuous(axes, place, poses, stage, unit)

        return fill

    def of_channel(values: NDArray[np.float64]) -> Callable[[Axes], None]:
        def fill(axes: Axes) -> None:
            axes.plot(place, values, "s-", color=MUTED, ms=3, lw=0.8)

        return fill

    panels = [
        (stage.label, f"Residual of {len(poses)} poses{of} in order of time, {stage.label.lower()}", of_stage(stage))
        for stage in shown
    ]
    panels += [
        (f"Channel {clean(channel)[:40]}, mean of each pose", f"Channel {clean(channel)}{of}", of_channel(values))
        for channel, values in _moving_channels(poses).items()
    ]
    return tuple(panel(title, alt, number, fill) for number, (title, alt, fill) in enumerate(panels))


def _places(poses: Sequence[Pose]) -> tuple[NDArray[np.float64], str]:
    """Where each pose stands on the axis of time, or its number where a time is
    missing."""
    middles = [pose.middle_s for pose in poses]
    times_s = np.array([middle for middle in middles if middle is not None])
    if times_s.size < len(poses):
        return np.array([pose.number for pose in poses], dtype=np.float64), "pose"
    return times_s, "time, s"


def _moving_channels(poses: Sequence[Pose]) -> dict[str, NDArray[np.float64]]:
    """The channels that every pose has and that did not stand still, by name."""
    names = set.intersection(*(set(pose.channels) for pose in poses)) if poses else set()
    columns = {name: [pose.channels[name] for pose in poses] for name in sorted(names)}
    whole = {
        name: np.array(column, dtype=np.float64)
        for name, column in columns.items()
        if all(value is not None for value in column)
    }
    moving = {name: v for name, v in whole.items() if float(np.ptp(v)) > 1e-9 * float(np.abs(v).max())}
    return dict(list(moving.items())[:_MOST_CHANNELS])


def _noise_band(axes: Axes, noise_floor_g: float | None, unit: tc.units.ErrorUnit) -> None:
    axes.axhline(0, color=MUTED, lw=0.7)
    if noise_floor_g is not None:
        for factor in (2, 1):
            reach = factor * unit.count(noise_floor_g)
            axes.axhspan(-reach, reach, color=BAND, lw=0, label="±1, ±2 noise floors" if factor == 2 else None)


def _residuals(
    axes: Axes, place: NDArray[np.float64], poses: Sequence[Pose], stage: Stage, colour: str, unit: tc.units.ErrorUnit
) -> None:
    """With one standard error of the pose either way, as far as it is known."""
    assert stage.pose_residual_g is not None
    used, residual = np.array([pose.used for pose in poses]), unit.count(1.0) * stage.pose_residual_g
    size = 4.0 if len(poses) <= 100 else 2.2
    if len(poses) <= _MOST_BARS:
        half = np.array([unit.count(pose.standard_error_g or 0.0) for pose in poses])
        axes.vlines(place, residual - half, residual + half, color=colour, lw=0.9)
    axes.plot(place[used], residual[used], "o-", color=colour, ms=size, lw=0.6)
    axes.plot(place[~used], residual[~used], "x", color=colour, ms=size + 2.0, mew=1.6)
    if (~used).any() and np.isfinite(residual[used]).any():
        _keep_used_in_sight(axes, residual, used)


def _keep_used_in_sight(axes: Axes, residual: NDArray[np.float64], used: NDArray[np.bool_]) -> None:
    """Poses left out may be off by a hundred times what the others are: those
    are drawn at the edge, as arrows."""
    reach = 3.0 * float(np.nanmax(np.abs(residual[used])))
    if not float(np.nanmax(np.abs(residual))) > 2 * reach > 0:
        return
    axes.set_ylim(-reach, reach)
    at = axes.lines[-1].get_xdata()
    for x, y in zip(np.asarray(at), residual[~used], strict=True):
        if abs(y) > reach:
            axes.plot([x], [np.sign(y) * 0.93 * reach], "^" if y > 0 else "v", color=FLOOR, ms=6)


def _mark_moments(axes: Axes, moments: Mapping[str, float] | None) -> None:
    for name, at_s in (moments or {}).items():
        axes.axvline(at_s, color=FLOOR, lw=1.2, ls=(0, (4, 2)))
        axes.annotate(
            name, (at_s, 1.0), (3, 3), xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8
        )


def _mark_conspicuous(
    axes: Axes, place: NDArray[np.float64], poses: Sequence[Pose], stage: Stage, unit: tc.units.ErrorUnit
) -> None:
    """Numbers beside the poses a metrologist looks up first: not used, or far
    out for their noise."""
    assert stage.pose_residual_g is not None
    conspicuous = [
        (abs(pose.studentized or 0.0), pose, at, residual_g)
        for at, residual_g, pose in zip(place, stage.pose_residual_g, poses, strict=True)
        if np.isfinite(residual_g) and (abs(pose.studentized or 0.0) > _CONSPICUOUS or not pose.used)
    ]
    low, high = axes.get_ylim()
    taken: list[tuple[float, float]] = []
    for _, pose, at, residual_g in sorted(conspicuous, key=lambda entry: -entry[0]):
        note = f"pose {pose.number}" + ("" if pose.used else ", not used")
        y = float(np.clip(unit.count(residual_g), low + 0.07 * (high - low), high - 0.12 * (high - low)))
        left = at > place.min() + 0.8 * np.ptp(place)
        across, along = (at - place.min()) / (np.ptp(place) or 1.0), (y - low) / (high - low)
        # A note that would lie on another is left to the table.
        if any(abs(across - x) < _NOTE_SIZE[0] and abs(along - z) < _NOTE_SIZE[1] for x, z in taken):
            continue
        taken.append((across, along))
        axes.annotate(
            note, (at, y), (-7 if left else 7, 3), textcoords="offset points", fontsize=7, color=INK,
            ha="right" if left else "left",
        )  # fmt: skip
        if len(taken) == _MOST_MARKED:
            return
