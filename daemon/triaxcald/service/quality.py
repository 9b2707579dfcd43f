"""How well a line works: yield, reasons, and the capability of each figure, from the
rows of its runs. Pure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.optimize import brentq
from scipy.stats import beta, nct, norm

from triaxcald.schema.codes import Verdict
from triaxcald.schema.columns import NAMES
from triaxcald.work import plain_serial

LEVEL: Final = 0.95
PPK_LEAST: Final = 30
"""Units below which an estimate of Ppk says too little: its 95 % interval is wider than
± 25 %."""
MR_LIMITS: Final = 2.660
MR_HIGH: Final = 3.267
"""3 / d2 and D4 for moving ranges of two (ASTM E2587; Montgomery, Statistical Quality
Control, appendix VI)."""
FIGURES: Final = {"rms_g": "g", "cross_validated_rms_g": "g", "verification_rms_g": "g"}
"""With an upper limit of the station, where it has one."""
COEFFICIENTS: Final = {
    f"{name}_{axis}": unit
    for name, unit in (("scale_factor", "output/g"), ("misalignment", "rad"), ("bias", "g"))
    for axis in "xyz"
}
JUDGED: Final = (Verdict.PASS.value, Verdict.FAIL.value)
Row = Mapping[str, Any]


def quality_of(rows: Sequence[Row]) -> dict[str, Any]:
    """The `triaxcal.quality/1` of runs in the order of time, with the columns of
    `triaxcal results`.

    A unit counts once it has passed or failed: by its first such run in the first-pass
    yield, by its last one in the yield. Aborted runs and those without a limit count as
    attempts alone. A characteristic has one value of each unit, from its last run with
    the figure, failed units among them.
    """
    units: dict[str, list[Row]] = {}
    for row in rows:
        if (serial := _unit_of(row)) is not None:
            units.setdefault(serial, []).append(row)
    judged = [[r["verdict"] for r in runs if r["verdict"] in JUDGED] for runs in units.values()]
    judged = [verdicts for verdicts in judged if verdicts]
    first = sum(verdicts[0] == Verdict.PASS for verdicts in judged)
    last = sum(verdicts[-1] == Verdict.PASS for verdicts in judged)
    attempts = [row for row in rows if row["attempt"] is not None]
    found = (_characteristic(name, unit, units.values()) for name, unit in {**FIGURES, **COEFFICIENTS}.items())
    return {
        "format": "triaxcal.quality/1",
        "units": len(judged),
        "first_pass_yield": first / len(judged) if judged else None,
        "first_pass_yield_interval": share_interval(first, len(judged)),
        "yield": last / len(judged) if judged else None,
        "yield_interval": share_interval(last, len(judged)),
        "attempts": len(attempts),
        "codes": dict(Counter(row["code"] for row in attempts if row["code"] is not None).most_common()),
        "characteristics": [c for c in found if c is not None],
    }


def _unit_of(row: Row) -> str | None:
    serial = row["serial"] if row["serial"] is not None else row["work_serial"]
    return None if serial is None else plain_serial(serial)


def _characteristic(name: str, unit: str, units: Any) -> dict[str, Any] | None:
    """None where no unit has the figure."""
    last = [found[-1] for runs in units if (found := [row for row in runs if row[name] is not None])]
    last.sort(key=lambda row: (row["ended"], row["outcome"]))
    if not last:
        return None
    values = np.array([float(row[name]) for row in last])
    limits = [row[f"{name.removesuffix('_g')}_limit_g"] for row in last] if name in FIGURES else []
    high = limits[-1] if limits else None
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else None
    ppk = ppk_interval = None
    if high is not None and sd and len(values) >= PPK_LEAST:
        ppk = (high - float(np.mean(values))) / (3 * sd)
        ppk_interval = list(one_sided_interval(ppk, len(values)))
    chart = individuals(values)
    points = [
        {"run": row["run"], "serial": row["serial"], "time": row["ended"], "value": row[name], "rules": list(rules)}
        for row, rules in zip(last, chart.rules, strict=True)
    ]
    return {
        "name": name,
        "unit": unit,
        "n": len(values),
        "mean": float(np.mean(values)),
        "sd": sd,
        "low": None,
        "high": high,
        "limits_changed": len(set(limits)) > 1,
        "ppk": ppk,
        "ppk_interval": ppk_interval,
        "chart": {
            "points": points,
            "individuals": {"centre": chart.centre, "lower": chart.lower, "upper": chart.upper},
            "moving_range": {"centre": chart.range_centre, "lower": 0.0, "upper": chart.range_upper},
        },
    }


def share_interval(count: int, n: int) -> list[float] | None:
    """The share of ``count`` in ``n`` lies between these in 95 % (Clopper and Pearson
    1934); None without any."""
    if not n:
        return None
    tail = (1 - LEVEL) / 2
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, n - count + 1))
    high = 1.0 if count == n else float(beta.ppf(1 - tail, count + 1, n - count))
    return [low, high]


def one_sided_interval(ppk: float, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Exact interval of a Ppk with one limit, from ``n`` normal values.

    3 √n Ppk̂ is distributed as t with n − 1 degrees of freedom and the noncentrality
    3 √n Ppk (Chou, Owen and Borrego 1990, Journal of Quality Technology 22, 223).
    """
    scale = 3 * math.sqrt(n)
    t, tail = scale * ppk, (1 - level) / 2
    # The interval by its variance (Bissell 1990) is near enough to begin from.
    width = norm.ppf(1 - tail) * math.sqrt(1 / (9 * n) + ppk**2 / (2 * (n - 1)))

    def bound(share: float) -> float:
        def off(true: float) -> float:
            return float(nct.cdf(t, n - 1, scale * true)) - share

        reach = 2 * width
        while off(ppk - reach) < 0 or off(ppk + reach) > 0:
            reach *= 2
        return float(brentq(off, ppk - reach, ppk + reach, xtol=1e-9))

    return bound(1 - tail), bound(tail)


RUN_OF: Final = 8
"""So many values on one side of the centre are no chance (Western Electric, rule 4)."""


@dataclass(frozen=True)
class Individuals:
    """A chart of individuals and their moving ranges of two. ``rules`` are those that
    each value breaks: `outside` the limits, `run` of eight on one side."""

    centre: float
    lower: float
    upper: float
    range_centre: float
    range_upper: float
    rules: tuple[tuple[str, ...], ...]


def individuals(values: Sequence[float] | np.ndarray[Any, Any]) -> Individuals:
    """The chart of values in the order of time; a single one has no width."""
    x = np.asarray(values, dtype=float)
    ranges = np.abs(np.diff(x))
    centre = float(np.mean(x))
    width = float(np.mean(ranges)) if len(ranges) else 0.0
    lower, upper = centre - MR_LIMITS * width, centre + MR_LIMITS * width
    side = np.sign(x - centre)
    rules = []
    for i, value in enumerate(x):
        broken = ["outside"] if not lower <= value <= upper else []
        if i + 1 >= RUN_OF and side[i] and np.all(side[i + 1 - RUN_OF : i + 1] == side[i]):
            broken.append("run")
        rules.append(tuple(broken))
    return Individuals(centre, lower, upper, width, MR_HIGH * width, tuple(rules))


assert set(FIGURES) | set(COEFFICIENTS) <= set(NAMES)
