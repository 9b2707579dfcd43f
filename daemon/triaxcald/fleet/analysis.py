"""From fleets to the document `triaxcal.fleet/1`: what the statistics of the metrology
say of each figure, rounded as documents are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

import triaxcal as tc
from triaxcald.fleet.places import Placed
from triaxcald.fleet.reading import Row
from triaxcald.fleet.values import FAILED, Figure, Fleet
from triaxcald.service.quality import COEFFICIENTS, FIGURES

CHARTED_LEAST: Final = 8
"""Units below which a moving range says too little of the scatter."""
REPEATED_LEAST: Final = 5
"""Units that repeat, below which no gauge study is made."""
STUDIED_MOST: Final = 2000
"""Runs of a gauge study and of a drift, those of evenly spread units: more would make
no figure better known than it is used."""
PAIRS_MOST: Final = 25
"""Pairs of successive runs of one unit in them: as many short times as long ones. The
work grows with the third power of a unit's runs."""
NAMED_MOST: Final = 20
LAST: Final = 10
GROUPS_MOST: Final = 40
LIKELY: Final = 0.5
GAUGE_FACTORS: Final = ("operator", "station", "fixture", "slot")
SMALLEST_EFFECT: Final = 0.5
"""Expected number of units of an effect that is listed."""
PROBABILITY: Final = 0.05

population = tc.population


@dataclass(frozen=True)
class Asked:
    """``limit_g`` of the error of |a| after which a unit is calibrated anew, None for
    that of the runs; ``probability`` that it is exceeded then."""

    limit_g: float | None = None
    probability: float = PROBABILITY
    selected: Mapping[str, str] = field(default_factory=dict)


Placing = Callable[[Fleet], Sequence[Placed]]


def fleet_document(
    fleets: Sequence[Fleet], source: str, skipped: Sequence[str], asked: Asked, placing: Placing = lambda _: ()
) -> dict[str, Any]:
    """`triaxcal.fleet/1`. ``placing`` gives the effects of places of a fleet."""
    return {
        "format": "triaxcal.fleet/1",
        "source": source,
        "selected": dict(asked.selected),
        "units": sum(len(fleet.serials) for fleet in fleets),
        "runs": sum(len(fleet.rows) for fleet in fleets),
        "skipped": list(skipped),
        "products": [_product(fleet, asked, placing(fleet)) for fleet in fleets],
    }


def _product(fleet: Fleet, asked: Asked, placed: Sequence[Placed]) -> dict[str, Any]:
    comparing = _Comparing.of(fleet)
    drifts = {name: found for name in fleet.figures if (found := _drift(fleet, name)) is not None}
    known = fleet.unit >= 0
    runs_of_unit = np.bincount(fleet.unit[known], minlength=1)
    failed = known & fleet.with_verdict(*FAILED)
    return {
        "part_number": fleet.part_number,
        "units": len(fleet.serials),
        "runs": len(fleet.rows),
        "repeated": int(np.sum(runs_of_unit > 1)),
        "left_out": int(np.sum(runs_of_unit[fleet.unit[failed]] > 1)),
        "first": fleet.rows[0]["ended"],
        "last": fleet.rows[-1]["ended"],
        "factors": {name: len(set(labels) - {None}) for name, labels in fleet.factors.items()},
        "certificates": sum(paper is not None for paper in fleet.certified),
        "tests": comparing.tests,
        "figures": [_figure(fleet, name, comparing, drifts.get(name)) for name in fleet.figures if comparing.n(name)],
        "effects": _effects(fleet, comparing),
        "recalibration": _recalibration(fleet, drifts, asked),
        "places": [value.document for value in sorted(placed, key=lambda value: -value.probability)],
    }


def _figure(fleet: Fleet, name: str, comparing: _Comparing, drift: Any | None) -> dict[str, Any]:
    figure, last = fleet.figures[name], comparing.last[name]
    values, rows = figure.values[last], [fleet.rows[i] for i in last.tolist()]
    return {
        "name": name,
        "unit": figure.unit,
        "n": len(last),
        "distribution": _distribution(values, rows),
        "comparisons": comparing.documents(name),
        "charts": _charts(values, rows, name in FIGURES),
        "capability": _capability(values, fleet.limit(name)),
        "gauge": _gauges(fleet, figure),
        "drift": None if drift is None else _drift_document(drift, _unit_of_drift(figure)),
    }


def _mention(row: Row, value: float) -> dict[str, Any]:
    serial = row["serial"] if row["work_serial"] is None else row["work_serial"]
    return {"run": row["run"], "serial": serial, "time": row["ended"], "value": tc.rounding.number(value)}


def _distribution(values: tc.Floats, rows: Sequence[Row]) -> dict[str, Any]:
    of = population.distribution(values)
    far = sorted(of.outliers, key=lambda i: -abs(values[i] - of.median))[:NAMED_MOST]
    return {
        "mean": tc.rounding.number(of.mean),
        "sd": tc.rounding.number(of.sd),
        "median": tc.rounding.number(of.median),
        "robust_sd": tc.rounding.number(of.robust_sd),
        "quantiles": {
            str(p): tc.rounding.number(value) for p, value in zip(population.QUANTILES, of.quantiles, strict=True)
        },
        "normality_p": tc.rounding.probability(of.normality_p),
        "outliers": [_mention(rows[i], values[i]) for i in far],
        "outliers_count": len(of.outliers),
    }


# Groups.


@dataclass(frozen=True)
class _Comparing:
    """Every figure and every effect by every factor, with p-values adjusted for all."""

    fleet: Fleet
    last: dict[str, tc.Ints]
    values: dict[str, tc.Floats]
    found: dict[tuple[str, str], population.Heterogeneity]
    adjusted: dict[tuple[str, str], tuple[float, float]]
    """Of location and scatter."""

    @staticmethod
    def of(fleet: Fleet) -> _Comparing:
        values = {name: figure.values for name, figure in fleet.figures.items()}
        values |= {_of_effect(name): chances for name, chances in fleet.effects.items()}
        last = {name: fleet.last(of) for name, of in values.items()}
        found: dict[tuple[str, str], population.Heterogeneity] = {}
        for factor in fleet.factors:
            group, _ = fleet.groups(factor)
            for name, of in values.items():
                rows = last[name][group[last[name]] >= 0]
                if len(rows) and (one := population.heterogeneity(of[rows], group[rows])) is not None:
                    found[name, factor] = one
        p = population.holm([p for one in found.values() for p in (one.location_p, one.scatter_p)])
        return _Comparing(fleet, last, values, found, dict(zip(found, zip(p[::2], p[1::2], strict=True), strict=True)))

    @property
    def tests(self) -> int:
        return 2 * len(self.found)

    def n(self, name: str) -> int:
        return len(self.last[name])

    def documents(self, name: str) -> list[dict[str, Any]]:
        return [self._document(name, factor) for factor in self.fleet.factors if self.n(name) > 1]

    def _document(self, name: str, factor: str) -> dict[str, Any]:
        one = self.found.get((name, factor))
        location, scatter = self.adjusted.get((name, factor), (None, None))
        groups = list(self._groups(name, factor))
        largest = sorted(sorted(groups, key=lambda g: -g["n"])[:GROUPS_MOST], key=lambda g: g["name"])
        return {
            "factor": factor,
            "location_p": tc.rounding.probability(location),
            "scatter_p": tc.rounding.probability(scatter),
            "between_sd": None if one is None else tc.rounding.number(one.between_sd, 4),
            "share": None if one is None else tc.rounding.chance(one.share),
            "groups": largest,
            "groups_count": len(groups),
        }

    def _groups(self, name: str, factor: str) -> Iterable[dict[str, Any]]:
        group, names = self.fleet.groups(factor)
        rows = self.last[name][group[self.last[name]] >= 0]
        values, label = self.values[name][rows], group[rows]
        if not len(rows):
            return
        order = np.argsort(label, kind="stable")
        bounds = np.searchsorted(label[order], np.arange(len(names) + 1))
        whole = float(np.median(values))
        spread = float(1.4826 * np.median(np.abs(values - whole)))
        for i, of_group in enumerate(names):
            mine = values[order[bounds[i] : bounds[i + 1]]]
            if not len(mine):
                continue
            # The median of normal values has π/2 times the variance of the mean.
            error = spread * math.sqrt(math.pi / 2 / len(mine))
            yield {
                "name": of_group,
                "n": len(mine),
                "mean": tc.rounding.number(population.mean_of(mine)),
                "sd": tc.rounding.number(float((mine - mine[0]).std(ddof=1))) if len(mine) > 1 else None,
                "median": tc.rounding.number(float(np.median(mine))),
                "apart": tc.rounding.number((float(np.median(mine)) - whole) / error, 3) if error > 0 else None,
            }


def _of_effect(name: str) -> str:
    return f"effect {name}"


def _effects(fleet: Fleet, comparing: _Comparing) -> list[dict[str, Any]]:
    found = []
    for name in fleet.effects:
        key = _of_effect(name)
        chances = comparing.values[key][comparing.last[key]]
        if not len(chances) or chances.sum() < SMALLEST_EFFECT:
            continue
        found.append(
            {
                "effect": name,
                "units": len(chances),
                "expected": tc.rounding.number(float(chances.sum()), 4),
                "likely": int(np.sum(chances >= LIKELY)),
                "comparisons": comparing.documents(key),
            }
        )
    return sorted(found, key=lambda one: -one["expected"])


# Charts and limits.


def _charts(values: tc.Floats, rows: Sequence[Row], positive: bool) -> dict[str, Any] | None:
    of = population.individuals(values)
    if len(values) < CHARTED_LEAST or not of.sd or of.centre is None or of.low is None or of.high is None:
        return None
    ewma = population.ewma(values, of.centre, of.sd)
    cusum = population.cusum(values, of.centre, of.sd, restart=True)
    outside = _begun([i for i, why in enumerate(of.outside) if why is not None])
    n = len(values)

    def signals(indices: Sequence[int], run_length: float) -> dict[str, Any]:
        return {
            "count": len(indices),
            "expected": tc.rounding.number(n / run_length, 3),
            "run_length": tc.rounding.number(run_length, 4),
            "last": [_mention(rows[i], values[i]) for i in indices[-LAST:]],
        }

    low = max(of.low, 0.0) if positive else of.low
    return {
        "centre": tc.rounding.number(of.centre),
        "sd": tc.rounding.number(of.sd),
        "individuals": signals(outside, population.individuals_run_length())
        | {"low": tc.rounding.number(low), "high": tc.rounding.number(of.high)},
        "ewma": signals(_begun(ewma.signals), ewma.run_length)
        | {
            "weight": ewma.weight, "width": ewma.width,
            "low": tc.rounding.number(float(ewma.low[-1])), "high": tc.rounding.number(float(ewma.high[-1])),
        },
        "cusum": signals(cusum.signals, cusum.run_length)
        | {
            "reference": cusum.reference, "decision": cusum.decision,
            "since": [_mention(rows[i], values[i]) for i in cusum.since[-LAST:]],
        },
    }  # fmt: skip


def _begun(signals: Sequence[int]) -> list[int]:
    """The first of signals that follow each other: one excursion is one signal."""
    known = set(signals)
    return [i for i in signals if i - 1 not in known]


def _capability(values: tc.Floats, high: float | None) -> dict[str, Any] | None:
    if high is None:
        return None
    of = population.capability_of(values, None, high)
    return {
        "high": high,
        "outside": of.outside,
        "outside_interval": _interval(of.outside_interval, 4),
        "ppk": tc.rounding.number(of.ppk, 4),
        "ppk_interval": _interval(of.interval, 4),
    }


def _interval(ends: Sequence[float | None] | None, digits: int) -> list[float | None] | None:
    return None if ends is None else [tc.rounding.number(end, digits) for end in ends]


# Units that repeat.


def _repeated(fleet: Fleet, values: tc.Floats) -> tc.Ints:
    """Runs that did not fail, of units with two values or more: all, or of evenly
    spread units as many as `STUDIED_MOST`, with `PAIRS_MOST` of each."""
    rows = np.flatnonzero(np.isfinite(values) & (fleet.unit >= 0) & ~fleet.with_verdict(*FAILED))
    counts = np.bincount(fleet.unit[rows], minlength=len(fleet.serials))
    for unit in np.flatnonzero(counts > 2 * PAIRS_MOST):
        mine = fleet.unit[rows] == unit
        rows = np.sort(np.concatenate([rows[~mine], _thinned(rows[mine])]))
    counts = np.bincount(fleet.unit[rows], minlength=len(fleet.serials))
    units = np.flatnonzero(counts > 1)
    if len(units) < REPEATED_LEAST:
        return rows[:0]
    if counts[units].sum() > STUDIED_MOST:
        share = STUDIED_MOST / counts[units].sum()
        units = units[np.linspace(0, len(units) - 1, max(REPEATED_LEAST, int(share * len(units)))).astype(np.int64)]
    return rows[np.isin(fleet.unit[rows], units)]


def _thinned(rows: tc.Ints) -> tc.Ints:
    """Of one unit's runs, by time: evenly spread pairs of successive ones."""
    first = np.linspace(0, len(rows) - 2, PAIRS_MOST).astype(np.int64)
    return np.asarray(rows[np.unique(np.concatenate([first, first + 1]))])


def _gauges(fleet: Fleet, figure: Figure) -> list[dict[str, Any]]:
    rows = _repeated(fleet, figure.values)
    # Errors and uncertainties are of a run, and no property of a unit.
    if figure.unit == "g" and figure.name not in COEFFICIENTS:
        return []
    if not len(rows) or np.ptp(figure.values[rows]) == 0.0:
        return []
    studies: list[tuple[str | None, tc.Ints, tc.Ints]] = [(None, rows, np.zeros(len(rows), dtype=np.int64))]
    for factor in GAUGE_FACTORS:
        if factor in fleet.factors:
            group = fleet.groups(factor)[0][rows]
            inside, known = rows[group >= 0], group[group >= 0]
            if _crossed(fleet.unit[inside], known):
                studies.append((factor, inside, known))
    found = []
    for by, inside, group in studies:
        try:
            study = population.gauge_study(figure.values[inside], fleet.unit[inside], group)
        except tc.InvalidData:  # too many places, or nothing that repeats within them
            continue
        found.append(_gauge_document(by, study))
    return found


def _crossed(unit: tc.Ints, group: tc.Ints) -> bool:
    """Whether enough units were measured at two places."""
    if not len(unit):
        return False
    pairs = np.unique(np.column_stack([unit, group]), axis=0)
    return int(np.sum(np.bincount(pairs[:, 0]) > 1)) >= REPEATED_LEAST


def _gauge_document(factor: str | None, study: population.GaugeStudy) -> dict[str, Any]:
    return {
        "factor": factor,
        "method": study.method.value,
        "parts": study.parts,
        "appraisers": study.appraisers,
        "measurements": study.measurements,
        "interaction": study.interaction,
        "components": {
            name: {
                "sd": tc.rounding.number(of.sd, 4),
                "sd_interval": _interval([math.sqrt(end) for end in of.interval], 4),
                "variance_share": tc.rounding.chance(of.share) if of.share < 1 else 1.0,
                "study_share": tc.rounding.chance(of.study_share) if of.study_share < 1 else 1.0,
            }
            for name, of in study.components.items()
        },
        "grr": tc.rounding.chance(study.grr) if study.grr < 1 else 1.0,
        "grr_interval": _interval(study.grr_interval, 4),
        "categories": study.categories,
    }


def _drift(fleet: Fleet, name: str) -> population.Drift | None:
    """Of a coefficient; scale factors as shares of their median."""
    if name not in COEFFICIENTS:
        return None
    figure = fleet.figures[name]
    rows = _repeated(fleet, figure.values)
    if not len(rows):
        return None
    scale = abs(float(np.median(figure.values[rows]))) if name.startswith("scale_factor") else 1.0
    return population.drift_of(
        fleet.unit[rows], fleet.days[rows], figure.values[rows] / (scale or 1.0), figure.errors[rows] / (scale or 1.0)
    )


def _unit_of_drift(figure: Figure) -> str:
    return "1" if figure.name.startswith("scale_factor") else figure.unit


def _drift_document(of: population.Drift, unit: str) -> dict[str, Any]:
    per = "√d" if of.movement is population.Movement.RANDOM_WALK else "d"
    return {
        "movement": of.movement.value,
        "rate": tc.rounding.number(of.rate, 4),
        "rate_interval": _interval(of.rate_interval, 4),
        "rate_unit": f"{unit}/{per}",
        "trend": tc.rounding.number(of.trend, 4),
        "trend_standard_error": tc.rounding.number(of.trend_standard_error, 4),
        "start_to_start": tc.rounding.number(of.start_to_start, 4),
        "separable": of.separable,
        "units": of.units,
        "changes": of.changes,
        "span_days": tc.rounding.number(of.span, 4),
    }


_PARTS: Final = {
    **{f"bias_{axis}": (population.Part.BIAS, (i,)) for i, axis in enumerate("xyz")},
    **{f"scale_factor_{axis}": (population.Part.SCALE_FACTOR, (i,)) for i, axis in enumerate("xyz")},
    # R₁₂ = αz, R₁₃ = αy, R₂₃ = αx.
    **{
        f"misalignment_{axis}": (population.Part.MISALIGNMENT, axes)
        for axis, axes in (("x", (1, 2)), ("y", (0, 2)), ("z", (0, 1)))
    },
}


def _recalibration(fleet: Fleet, drifts: Mapping[str, population.Drift], asked: Asked) -> dict[str, Any] | None:
    limit = asked.limit_g or fleet.limit("verification_rms_g") or fleet.limit("rms_g")
    known = {name: drifts[name] for name in _PARTS if name in drifts}
    if limit is None or not known:
        return None
    figures = [population.Moving(*_PARTS[name], drift, _new(fleet, name)) for name, drift in known.items()]
    found = population.recalibration_interval(figures, limit, asked.probability)
    return {
        "limit_g": limit,
        "probability": asked.probability,
        "days": tc.rounding.number(found.time, 4),
        "interval": _interval(found.interval, 4),
        "at_start": tc.rounding.probability(found.at_start),
        "figures": list(known),
    }


def _new(fleet: Fleet, name: str) -> float:
    """Standard uncertainty of a coefficient when it is new: the median stated one."""
    figure = fleet.figures[name]
    stated = figure.errors[np.isfinite(figure.errors)]
    if not len(stated):
        return 0.0
    scale = abs(float(np.nanmedian(figure.values))) if name.startswith("scale_factor") else 1.0
    return float(np.median(stated)) / (scale or 1.0)
