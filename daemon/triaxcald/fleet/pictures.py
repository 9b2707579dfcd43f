"""The pictures of the page as inline SVG: how a figure is distributed, over all units
and by group, and its control charts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

import triaxcal as tc
from triaxcald.fleet.values import Fleet
from triaxcald.report.charts import AFTER, BAND, BEFORE, FLOOR, INK, MUTED, STEP, draw, hang_grid
from triaxcald.report.figures import clean, power

WIDTH_IN: Final = 4.2
DIFFERS: Final = 0.05
"""Adjusted p-value from which groups are drawn."""
GROUPS_DRAWN: Final = 12
"""Of a factor, those farthest from all units."""
UNITS_DRAWN: Final = 300
"""Of a control chart, the last ones."""
LONGEST: Final = 20


@dataclass(frozen=True)
class Scale:
    """Values of a picture in powers of a thousand."""

    factor: float
    label: str

    @staticmethod
    def of(values: tc.Floats, unit: str) -> Scale:
        largest = float(np.max(np.abs(values))) if len(values) else 0.0
        exponent = 0 if largest <= 0 or 0.1 <= largest < 1e4 else 3 * math.floor((math.log10(largest) + 1) / 3)
        label = clean(unit) if unit != "1" else ""
        if exponent:
            label = f"{power(exponent)} {label}".strip()
        return Scale(10.0**-exponent, label)


def distribution_picture(fleet: Fleet, figure: Mapping[str, Any], title: str, name: str) -> Markup:
    """A histogram of all units, and boxes of the groups of each factor that differs."""
    of = fleet.figures[figure["name"]]
    last = fleet.last(of.values)
    values, limit = of.values[last], (figure["capability"] or {}).get("high")
    scale = Scale.of(values if limit is None else np.append(values, limit), of.unit)
    parts = [_groups_drawn(fleet, c, last, values) for c in figure["comparisons"] if differs(c)]
    rows = sum(len(groups) + 1 for _, groups in parts)

    def paint(drawing: Drawing) -> None:
        heights = [1.5] + ([0.22 * rows] if rows else [])
        panels = drawing.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        _histogram(panels[0], values * scale.factor)
        for axes in panels:
            if limit is not None:
                axes.axvline(limit * scale.factor, color=BEFORE, lw=1.2, ls=(0, (4, 2)))
        if rows:
            _boxes(panels[-1], parts, scale.factor, float(np.median(values)) * scale.factor)
        panels[-1].set_xlabel(f"{title.lower()}, {scale.label}" if scale.label else title.lower())

    alt = f"Distribution of {title.lower()} over {len(values)} units" + (
        f", by {', '.join(factor for factor, _ in parts)}" if parts else ""
    )
    return draw(f"{name}-distribution", alt, (WIDTH_IN, 2.1 + 0.21 * rows), paint)


def differs(comparison: Mapping[str, Any]) -> bool:
    ps = [p for p in (comparison["location_p"], comparison["scatter_p"]) if p is not None]
    return bool(ps) and min(ps) < DIFFERS


def _groups_drawn(
    fleet: Fleet, comparison: Mapping[str, Any], last: tc.Ints, values: tc.Floats
) -> tuple[str, list[tuple[str, tc.Floats]]]:
    factor = comparison["factor"]
    group, names = fleet.groups(factor)
    large = [g for g in comparison["groups"] if g["n"] >= tc.population.GROUP_LEAST]
    shown = sorted(large, key=lambda g: -abs(g["apart"] or 0.0))[:GROUPS_DRAWN]
    return factor, [
        (g["name"], values[group[last] == names.index(g["name"])]) for g in sorted(shown, key=lambda g: g["name"])
    ]


def _histogram(axes: Axes, values: tc.Floats) -> None:
    low, high = np.quantile(values, [0.005, 0.995])
    spread = (high - low) or abs(high) or 1.0
    inside = values[(values >= low - spread) & (values <= high + spread)]
    bins = int(np.clip(2 * len(inside) ** (1 / 3) * 1.5, 5, 40))
    axes.hist(inside, bins=bins, color=AFTER, rwidth=0.92)
    axes.set_ylabel("units")
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    hang_grid(axes)


def _boxes(axes: Axes, parts: Sequence[tuple[str, list[tuple[str, tc.Floats]]]], factor: float, median: float) -> None:
    """Whiskers from 5 to 95 %, a box from 25 to 75 %, a line at the median."""
    at, ticks, names = 0.0, [], []
    axes.axvline(median, color=MUTED, lw=0.7)
    for title, groups in parts:
        ticks.append(at)
        names.append(f"by {title}")
        at += 1
        for name, mine in groups:
            q = np.quantile(mine * factor, [0.05, 0.25, 0.5, 0.75, 0.95])
            axes.hlines(at, q[0], q[4], color=STEP, lw=1.0)
            axes.barh(at, q[3] - q[1], 0.62, left=q[1], color=AFTER, alpha=0.55)
            axes.vlines(q[2], at - 0.34, at + 0.34, color=INK, lw=1.4)
            ticks.append(at)
            names.append(f"{clean(name)[:LONGEST]} ({len(mine)})")
            at += 1
    axes.set_yticks(ticks, labels=names)
    for label in axes.get_yticklabels():
        if label.get_text().startswith("by "):
            label.set_fontweight("bold")
    axes.set_ylim(at - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    hang_grid(axes, "x")


def chart_picture(fleet: Fleet, figure: Mapping[str, Any], title: str, name: str) -> Markup | None:
    """Individuals with their limits and the EWMA, and the two sums of the CUSUM. None
    where there is no chart."""
    charts = figure["charts"]
    if charts is None:
        return None
    of = fleet.figures[figure["name"]]
    values = of.values[fleet.last(of.values)]
    first = max(0, len(values) - UNITS_DRAWN)
    chart = tc.population.individuals(values)
    assert chart.centre is not None
    assert chart.sd is not None
    ewma = tc.population.ewma(values, chart.centre, chart.sd)
    cusum = tc.population.cusum(values, chart.centre, chart.sd, restart=True)
    number, shown = np.arange(first, len(values)) + 1, values[first:]
    scale = Scale.of(shown, of.unit)
    outside = np.array([why is not None for why in chart.outside])[first:]

    def paint(drawing: Drawing) -> None:
        top, below = drawing.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
        top.plot(number, shown * scale.factor, ".", color=MUTED, ms=3, label="unit")
        top.plot(number[outside], shown[outside] * scale.factor, "o", color=BEFORE, ms=4, label="signal")
        top.plot(number, ewma.statistic[first:] * scale.factor, color=AFTER, lw=1.2, label="EWMA")
        limits = charts["individuals"]
        for value in (limits["low"], limits["high"]):
            top.axhline(value * scale.factor, color=FLOOR, lw=0.9, ls=(0, (4, 2)))
        top.axhspan(ewma.low[-1] * scale.factor, ewma.high[-1] * scale.factor, color=BAND, lw=0)
        top.axhline(ewma.centre * scale.factor, color=FLOOR, lw=0.7)
        top.set_ylabel(scale.label or title.lower())
        top.yaxis.set_major_locator(MaxNLocator(5))
        drawing.legend(*top.get_legend_handles_labels(), loc="outside upper right", ncols=3)
        below.fill_between(number, cusum.high[first:], 0, color=AFTER, lw=0)
        below.fill_between(number, -cusum.low[first:], 0, color=STEP, lw=0)
        for value in (cusum.decision, -cusum.decision):
            below.axhline(value, color=FLOOR, lw=0.9, ls=(0, (4, 2)))
        below.set_ylabel("CUSUM")
        below.set_xlabel("unit, in order of time")
        below.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        for axes in (top, below):
            hang_grid(axes)

    counts = ", ".join(f"{charts[key]['count']} signals of {key}" for key in ("individuals", "ewma", "cusum"))
    drawn = f"the last {len(shown)} of {len(values)}" if first else f"{len(values)}"
    return draw(f"{name}-chart", f"Control charts of {title.lower()}, {drawn} units: {counts}", (WIDTH_IN, 3.3), paint)
