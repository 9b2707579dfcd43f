"""The page of a fleet: one self-contained HTML text, without a script."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

import triaxcal as tc
from triaxcald.fleet.pictures import Scale, chart_picture, differs, distribution_picture
from triaxcald.fleet.values import Fleet
from triaxcald.report import figures
from triaxcald.report.figures import clean, digits

TITLES: Final = {
    "rms_g": "Residual of the fit, rms",
    "cross_validated_rms_g": "Cross-validated error, rms",
    "verification_rms_g": "Error in the check poses, rms",
    "uncertainty_this_fit_g": "Expanded uncertainty of |a|, this fit",
    "uncertainty_another_day_g": "Expanded uncertainty of |a|, another day",
    **{f"scale_factor_{axis}": f"Scale factor {axis}" for axis in "xyz"},
    **{f"misalignment_{axis}": f"Misalignment {axis}" for axis in "xyz"},
    **{f"bias_{axis}": f"Bias {axis}" for axis in "xyz"},
}
SIGNALS_MANY: Final = 3.0
"""Times the number expected by chance from which signals are pointed out."""
POINTED_MOST: Final = 12
GAUGE_FAILS: Final = 0.3
"""%GRR above which AIAG calls a gauge not acceptable."""
MONTH_DAYS: Final = 30.0
_DRAWING = threading.Lock()
"""The pictures' style is the process's own: one page is drawn at a time."""


@dataclass(frozen=True)
class Drawn:
    """A figure with its title and pictures."""

    figure: Mapping[str, Any]
    title: str
    distribution: Markup | None
    chart: Markup | None


def render_fleet(
    document: Mapping[str, Any], fleets: Sequence[Fleet], tell: Callable[[int, int], None] = lambda done, of: None
) -> str:
    """HTML of a `triaxcal.fleet/1`; ``fleets`` are those that it was made from, in its
    order. ``tell`` is called with the number of figures drawn so far, and of all."""
    total, done = sum(len(product["figures"]) for product in document["products"]), 0
    drawn: list[list[Drawn]] = []
    with _DRAWING:
        for i, (product, fleet) in enumerate(zip(document["products"], fleets, strict=True)):
            of_product = []
            for j, figure in enumerate(product["figures"]):
                name, title = f"p{i}f{j}", title_of(figure["name"])
                of_product.append(
                    Drawn(
                        figure, title, distribution_picture(fleet, figure, title, name) if scatters(figure) else None,
                        chart_picture(fleet, figure, title, name),
                    )
                )  # fmt: skip
                done += 1
                tell(done, total)
            drawn.append(of_product)
    return (
        _environment()
        .get_template("fleet.html")
        .render(
            document=document,
            products=list(zip(document["products"], drawn, strict=True)),
            notices=[list(notices(product)) for product in document["products"]],
        )
    )


def scatters(figure: Mapping[str, Any]) -> bool:
    return bool(figure["distribution"]["sd"])


def title_of(name: str) -> str:
    if name in TITLES:
        return TITLES[name]
    effect, _, coefficient = name.partition(".")
    return f"{tc.text.traces.effect_title(effect)}, {coefficient}" if coefficient else tc.text.traces.effect_title(name)


# What a reader should look at first.


def notices(product: Mapping[str, Any]) -> Iterator[str]:
    """The most striking findings, a sentence each."""
    places = [f"{value['text']}." for value in product["places"]]
    found = [*_outside(product), *places, *_differences(product), *_signals(product), *_gauges(product)]
    yield from found[:POINTED_MOST]
    if len(found) > POINTED_MOST:
        yield f"{len(found) - POINTED_MOST} more in the tables below."


def _outside(product: Mapping[str, Any]) -> Iterator[str]:
    for figure in product["figures"]:
        limit = figure["capability"]
        if limit is not None and limit["outside"]:
            verb = "is" if limit["outside"] == 1 else "are"
            yield (
                f"{tc.number_format.number_of(limit['outside'], 'unit')} of {figure['n']} {verb} outside the limit: "
                f"{title_of(figure['name']).lower()}."
            )


def _differences(product: Mapping[str, Any]) -> Iterator[str]:
    """The least probable first."""
    found = []
    sources = [(title_of(figure["name"]), figure["comparisons"]) for figure in product["figures"]]
    sources += [
        (f"probability of {tc.text.traces.effect_title(effect['effect']).lower()}", effect["comparisons"])
        for effect in product["effects"]
    ]
    for title, comparisons in sources:
        for of in comparisons:
            if differs(of):
                p = min(p for p in (of["location_p"], of["scatter_p"]) if p is not None)
                found.append((p, f"{title} differs by {of['factor']}{_farthest(of)} (p {figures.p_value(p)})."))
    yield from (text[:1].upper() + text[1:] for _, text in sorted(found))


def _farthest(comparison: Mapping[str, Any]) -> str:
    """The group whose median is farthest from that of all, among those compared."""
    compared = [group for group in comparison["groups"] if group["n"] >= tc.population.GROUP_LEAST]
    far = max(compared, key=lambda g: abs(g["apart"] or 0.0), default=None)
    if far is None or not far["apart"] or comparison["location_p"] is None or comparison["location_p"] >= 0.05:
        return ""
    return f", most at {clean(far['name'])}"


def _signals(product: Mapping[str, Any]) -> Iterator[str]:
    for figure in product["figures"]:
        charts = figure["charts"]
        if charts is None:
            continue
        many = [
            (name, charts[key])
            for key, name in (("individuals", "individuals chart"), ("ewma", "EWMA"), ("cusum", "CUSUM"))
            if _many(charts[key])
        ]
        if many:
            told = ", ".join(
                f"{of['count']} signals of the {name} (by chance {digits(of['expected'], 2)})" for name, of in many
            )
            last = last_move(charts)
            moved = f"; the mean last moved about {last['time'][:10]}" if last else ""
            yield f"{title_of(figure['name'])}: {told}{moved}."


def _many(chart: Mapping[str, Any]) -> bool:
    return bool(chart["count"] > SIGNALS_MANY * max(chart["expected"], 1.0))


def last_move(charts: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The first run of the last signal of the CUSUM, where more come than by chance."""
    since = charts["cusum"]["since"]
    return since[-1] if since and _many(charts["cusum"]) else None


def _gauges(product: Mapping[str, Any]) -> Iterator[str]:
    """The factor that matters most."""
    for figure in product["figures"]:
        worst = worst_study(figure)
        if worst is not None and worst["grr"] > GAUGE_FAILS and figure["name"] in TITLES:
            by = f" by {worst['factor']}" if worst["factor"] else ""
            yield f"{title_of(figure['name'])}: %GRR {percent(worst['grr'])}{by} (above 30 %: not acceptable, AIAG)."


# Effects of places.


def place_words(place: Mapping[str, Any]) -> str:
    """ "fixture F2"; "hours 14-18 UTC"."""
    kind = tc.population.PlaceKind(place["kind"])
    return tc.text.population.place(tc.population.Place(kind, place["name"]))


def where(value: Mapping[str, Any]) -> str:
    """All places that it may be of."""
    text = " or ".join(map(place_words, value["places"]))
    return text[:1].upper() + text[1:]


def acting(value: Mapping[str, Any]) -> str:
    """The time in which it acts."""
    interval = value["since_interval"]
    began = f" (95 %: {interval[0]} to {interval[1]})" if interval and interval[0] != interval[1] else ""
    match value["since"], value["until"]:
        case None, None:
            return "always"
        case None, until:
            return f"until {until}"
        case since, None:
            return f"since {since}{began}"
        case since, until:
            return f"from {since}{began} until {until}"


# How the page writes figures.


def concise(value: float | None, error: float | None, unit: str = "") -> str:
    return tc.rounding.concise(value, error, "" if unit == "1" else figures.unit_text(unit))


def roughly(value: float | None, unit: str = "") -> str:
    """Two digits: a standard deviation."""
    return tc.rounding.concise_error(value, "" if unit == "1" else figures.unit_text(unit)) if value else digits(value)


def mean_of(figure: Mapping[str, Any]) -> str:
    """With the standard error of the mean."""
    of = figure["distribution"]
    error = None if of["sd"] is None else of["sd"] / figure["n"] ** 0.5
    return concise(of["mean"], error, figure["unit"])


def percent(share: float | None) -> str:
    return tc.rounding.MISSING if share is None else f"{digits(100 * share, 3 if share >= 0.1 else 2)} %"


def percents(ends: Sequence[float | None] | None) -> str:
    """An interval of a share, in per cent."""
    return between(None if ends is None else [None if end is None else 100 * end for end in ends], 2)


def between(ends: Sequence[float | None] | None, significant: int = 3) -> str:
    """An interval."""
    if ends is None:
        return tc.rounding.MISSING
    low, high = ends
    return f"{digits(low, significant)} to {'∞' if high is None else digits(high, significant)}"


def gauge_table(product: Mapping[str, Any]) -> dict[str, Any]:
    """A row a figure, all its standard deviations in one unit."""
    studied = [figure for figure in product["figures"] if figure["gauge"]]
    known = sorted({study["factor"] for figure in studied for study in figure["gauge"]} - {None})
    return {"factors": known, "rows": [_gauge_row(figure, known) for figure in studied]}


def worst_study(figure: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The study by the factor that matters most; that of repetition where there is no
    factor."""
    studies = [study for study in figure["gauge"] if study["factor"]] or figure["gauge"]
    return max(studies, key=lambda study: study["grr"], default=None)


def _gauge_row(figure: Mapping[str, Any], factors: Sequence[str]) -> dict[str, Any]:
    by = {study["factor"]: study for study in figure["gauge"]}
    worst = worst_study(figure) or {}
    alone = by.get(None, worst)["components"]
    scale = Scale.of(np.array([alone["part"]["sd"], alone["repeatability"]["sd"]]), figure["unit"])

    def sd(found: Mapping[str, Any] | None) -> str:
        return digits(None if found is None else found["sd"] * scale.factor, 2)

    return {
        "title": _with_unit(figure, scale),
        "units": sd(alone["part"]),
        "repetition": sd(alone["repeatability"]),
        "places": {name: sd(by[name]["components"].get("reproducibility") if name in by else None) for name in factors},
        "study": worst,
    }


def drift_table(product: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a figure."""
    return [_drift_row(figure) for figure in product["figures"] if figure["drift"] is not None]


def _drift_row(figure: Mapping[str, Any]) -> dict[str, Any]:
    """What it changes by in `MONTH_DAYS`, as a standard deviation."""
    of = figure["drift"]
    time = MONTH_DAYS**0.5 if of["movement"] == "random_walk" else MONTH_DAYS
    low, high = of["rate_interval"]
    largest = np.array([(of["rate"] if high is None else high) * time, of["start_to_start"]])
    scale = Scale.of(largest, of["rate_unit"].rpartition("/")[0])
    trend, error = (of[key] * MONTH_DAYS * scale.factor for key in ("trend", "trend_standard_error"))
    return {
        "title": _with_unit(figure, scale),
        "drift": of,
        "change": digits(of["rate"] * time * scale.factor, 2),
        "interval": [None if end is None else end * time * scale.factor for end in (low, high)],
        "trend": f"{digits(trend, 2)} ± {digits(error, 2)}",
        "start": digits(of["start_to_start"] * scale.factor, 2),
    }


def _with_unit(figure: Mapping[str, Any], scale: Scale) -> str:
    title = title_of(figure["name"])
    return f"{title}, {figures.unit_text(scale.label)}" if scale.label else title


def lasting(days: float | None) -> str:
    """A time in the unit that people would use."""
    if days is None:
        return "longer than the data can tell"
    for least, size, name in ((730, 365.25, "years"), (60, 30.44, "months"), (2, 1, "days"), (1 / 12, 1 / 24, "hours")):
        if days >= least:
            return f"{digits(days / size, 2)} {name}"
    return f"{digits(days * 1440, 2)} minutes" if days > 0 else "no time"


def differing(figure: Mapping[str, Any]) -> str:
    """The factors by which it differs."""
    return ", ".join(c["factor"] for c in figure["comparisons"] if differs(c)) or "none"


def _printable(value: object) -> object:
    if value is None or value == "":
        return tc.rounding.MISSING
    return value if isinstance(value, Markup) else clean(value)


@cache
def _environment() -> Environment:
    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader([here / "templates", here.parent / "report" / "templates"]),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "acting": acting, "between": between, "chance": figures.chance, "concise": concise, "differing": differing,
        "digits": digits,
        "drift_table": drift_table, "effect_title": tc.text.traces.effect_title, "gauge_table": gauge_table,
        "last_move": last_move, "lasting": lasting, "mean_of": mean_of,
        "p_value": figures.p_value, "percent": percent, "percents": percents,
        "place_words": place_words, "where": where,
        "roughly": roughly, "title_of": title_of,
    }  # fmt: skip
    environment.tests["differing"] = differs
    return environment
