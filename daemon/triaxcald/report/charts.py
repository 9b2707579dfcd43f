"""The bars of every step against the noise floor, and the raw streams."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from triaxcal.units import ErrorUnit
from triaxcald.report.figures import MICRO_G, clean, micro, micro_g, unit_label
from triaxcald.report.ink import AXES, BAND, FLOOR, draw, hang_grid
from triaxcald.report.over_time import stage_colours
from triaxcald.report.stages import HoldOut, Stage
from triaxcald.report.stream import StreamOverview

Group = tuple[str, list[tuple[str, float]], float | None]
_LONGEST_LABEL = 34


def bars_picture(stages: Sequence[Stage], held_out: HoldOut | None, unit: ErrorUnit = MICRO_G) -> Markup | None:
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
    colours: dict[str, str], axis_end: float, unit: ErrorUnit, *, named: bool,
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
