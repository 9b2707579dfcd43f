"""What many units show (`triaxcal.fleet/1`): distributions, control charts, capability,
gauge studies, drift and recalibration intervals, effects, and effects of places."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc

Chance = Annotated[tc.schema.Figure, Field(ge=0, le=1)]
Interval = Annotated[list[tc.schema.Figure | None], Field(min_length=2, max_length=2)]


class Mention(tc.schema.Model):
    """A run that is named."""

    run: Annotated[str | None, Field(description="id of the run")]
    serial: Annotated[str | None, Field(description="serial number of the unit")]
    time: Annotated[str, Field(description="end of the run, UTC")]
    value: Annotated[tc.schema.Figure, Field(description="value [`unit`]")]


class DistributionOfFigure(tc.schema.Model):
    """One value a unit: that of its last run with the figure."""

    mean: Annotated[tc.schema.Figure, Field(description="mean [`unit`]")]
    sd: Annotated[
        tc.schema.Figure | None, Field(description="standard deviation, n − 1 [`unit`]; `null` with one unit")
    ]
    median: Annotated[tc.schema.Figure, Field(description="median [`unit`]")]
    robust_sd: Annotated[
        tc.schema.Figure | None,
        Field(description="1.4826 times the median distance from the median [`unit`]; `null` with one unit"),
    ]
    quantiles: Annotated[
        dict[str, tc.schema.Figure],
        Field(description="by probability: 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99 [`unit`]"),
    ]
    normality_p: Annotated[
        Chance | None,
        Field(description="p-value of the Anderson–Darling test; `null` below 8 units and for equal values"),
    ]
    outliers: Annotated[
        list[Mention],
        Field(
            description="units as far from the median, in robust standard deviations, as 0.05 of n normal "
            "ones; at most 20, the farthest first"
        ),
    ]
    outliers_count: Annotated[int, Field(description="number of outliers")]


class GroupOfUnits(tc.schema.Model):
    name: Annotated[str, Field(description="its name: batch, station, …, or the period")]
    n: Annotated[int, Field(description="number of units")]
    mean: Annotated[tc.schema.Figure, Field(description="mean [`unit`]")]
    sd: Annotated[tc.schema.Figure | None, Field(description="standard deviation [`unit`]; `null` with one unit")]
    median: Annotated[tc.schema.Figure, Field(description="median [`unit`]")]
    apart: Annotated[
        tc.schema.Figure | None,
        Field(description="distance of the median from that of all units, in standard errors of it; `null` if unknown"),
    ]


class Comparison(tc.schema.Model):
    """Groups of units by one factor. P-values are adjusted for all comparisons of the
    part number (Holm)."""

    factor: Annotated[str, Field(description="`batch`, `station`, `fixture`, `slot`, `operator`, `order` or `time`")]
    location_p: Annotated[Chance | None, Field(description="p-value of the same location, by ranks (Kruskal–Wallis)")]
    scatter_p: Annotated[Chance | None, Field(description="p-value of the same scatter (Brown–Forsythe)")]
    between_sd: Annotated[
        tc.schema.Figure | None, Field(description="standard deviation between the groups' true means [`unit`]")
    ]
    share: Annotated[Chance | None, Field(description="its share of the variance of a unit")]
    groups: Annotated[list[GroupOfUnits], Field(description="the groups, by name; at most 40, the largest")]
    groups_count: Annotated[int, Field(description="number of groups")]


class Signals(tc.schema.Model):
    """Signals of one chart."""

    count: Annotated[int, Field(description="number of signals; those that follow each other are one")]
    expected: Annotated[
        tc.schema.Figure,
        Field(description="number of signals by chance: n over the average run length"),
    ]
    run_length: Annotated[
        tc.schema.Figure,
        Field(description="average run length while nothing changes, for normal values of known mean and scatter"),
    ]
    last: Annotated[list[Mention], Field(description="the last ten of them")]


class EwmaChart(Signals):
    weight: Annotated[tc.schema.Figure, Field(description="weight λ of the last value")]
    width: Annotated[tc.schema.Figure, Field(description="limits in standard deviations of the average")]
    low: Annotated[tc.schema.Figure, Field(description="lower limit [`unit`]")]
    high: Annotated[tc.schema.Figure, Field(description="upper limit [`unit`]")]


class CusumChart(Signals):
    count: Annotated[int, Field(description="number of signals; after each both sums begin at zero")]
    reference: Annotated[tc.schema.Figure, Field(description="reference value k, in standard deviations")]
    decision: Annotated[tc.schema.Figure, Field(description="decision interval h, in standard deviations")]
    since: Annotated[list[Mention], Field(description="of each signal in `last`: the first run that its sum counts")]


class IndividualsChart(Signals):
    low: Annotated[tc.schema.Figure, Field(description="lower control limit, `centre` − 2.66 mean moving ranges")]
    high: Annotated[tc.schema.Figure, Field(description="upper control limit")]


class Charts(tc.schema.Model):
    """Control charts, a value a unit, by the end of the runs."""

    centre: Annotated[tc.schema.Figure, Field(description="mean [`unit`]")]
    sd: Annotated[tc.schema.Figure, Field(description="mean moving range over 1.128 [`unit`]")]
    individuals: Annotated[
        IndividualsChart, Field(description="individuals: outside the limits, or the eighth in a row on one side")
    ]
    ewma: Annotated[EwmaChart, Field(description="exponentially weighted moving average")]
    cusum: Annotated[CusumChart, Field(description="tabular CUSUM, set to zero after a signal")]


class CapabilityOfFigure(tc.schema.Model):
    high: Annotated[tc.schema.Figure, Field(description="upper limit of the latest run that has one [`unit`]")]
    outside: Annotated[int, Field(description="number of units above it")]
    outside_interval: Annotated[Interval | None, Field(description="exact 95 % interval of their share")]
    ppk: Annotated[
        tc.schema.Figure | None,
        Field(description="(`high` − mean) / (3 sd); `null` with fewer than 30 units, and for equal values"),
    ]
    ppk_interval: Annotated[Interval | None, Field(description="exact 95 % interval for a normal distribution")]


class GaugeComponent(tc.schema.Model):
    sd: Annotated[tc.schema.Figure, Field(description="standard deviation [`unit`]")]
    sd_interval: Annotated[Interval, Field(description="95 % interval of it")]
    variance_share: Annotated[Chance, Field(description="share of the total variance")]
    study_share: Annotated[Chance, Field(description="share of the total standard deviation")]


class GaugeOfFigure(tc.schema.Model):
    """Of units that were measured more than once."""

    factor: Annotated[
        str | None, Field(description="what stands for the appraiser; `null`: repetition alone, whatever changed")
    ]
    method: Annotated[
        Literal["anova", "reml"],
        Field(description="`anova` for balanced data, else `reml`, restricted maximum likelihood"),
    ]
    parts: Annotated[int, Field(description="number of units")]
    appraisers: Annotated[int, Field(description="number of places of the factor")]
    measurements: Annotated[int, Field(description="number of runs")]
    interaction: Annotated[bool, Field(description="whether the interaction is kept: its p-value is at most 0.25")]
    components: Annotated[
        dict[str, GaugeComponent],
        Field(
            description="`repeatability`, `reproducibility`, `appraiser`, `interaction`, `gauge`, `part`, `total`; "
            "absent where the data have none"
        ),
    ]
    grr: Annotated[Chance, Field(description="standard deviation of the gauge over the total (%GRR / 100)")]
    grr_interval: Annotated[Interval, Field(description="95 % interval of it")]
    categories: Annotated[
        int | None, Field(description="number of distinct categories (ndc); `null` without a scatter of the gauge")
    ]


class DriftOfFigure(tc.schema.Model):
    """Of units that were measured more than once. Scale factors are relative to their
    median."""

    movement: Annotated[
        Literal["random_walk", "slope"],
        Field(description="`random_walk`: variance `rate`² per day; `slope`: each unit has its own, of sd `rate`"),
    ]
    rate: Annotated[tc.schema.Figure, Field(description="per √day (random walk) or per day (slope) [`rate_unit`]")]
    rate_interval: Annotated[Interval, Field(description="95 % interval of it; `null` for no bound")]
    rate_unit: Annotated[str, Field(description="unit of the rate")]
    trend: Annotated[tc.schema.Figure, Field(description="change per day that all units share")]
    trend_standard_error: Annotated[tc.schema.Figure, Field(description="its standard error")]
    start_to_start: Annotated[
        tc.schema.Figure, Field(description="standard deviation from start to start; 0 where it cannot be told")
    ]
    separable: Annotated[
        bool, Field(description="whether times between runs differ enough to tell start-to-start scatter from drift")
    ]
    units: Annotated[int, Field(description="number of units")]
    changes: Annotated[int, Field(description="number of differences between successive runs of a unit")]
    span_days: Annotated[tc.schema.Figure, Field(description="longest time between runs of a unit [d]")]


class FigureOfFleet(tc.schema.Model):
    name: Annotated[str, Field(description="column of [results](results.md), uncertainty, or `EFFECT.COEFFICIENT`")]
    unit: Annotated[str, Field(description="unit of the values")]
    n: Annotated[int, Field(description="number of units with the figure")]
    distribution: Annotated[DistributionOfFigure, Field(description="over units")]
    comparisons: Annotated[list[Comparison], Field(description="between groups, by factor")]
    charts: Annotated[Charts | None, Field(description="control charts; `null` below 8 units, and for equal values")]
    capability: Annotated[CapabilityOfFigure | None, Field(description="against the limit; `null` without one")]
    gauge: Annotated[
        list[GaugeOfFigure], Field(description="gauge studies, by factor; empty where too few units repeat")
    ]
    drift: Annotated[DriftOfFigure | None, Field(description="`null` where too few units repeat")]


class Recalibration(tc.schema.Model):
    """How long a calibration lasts, by the drifts of its nine coefficients."""

    limit_g: Annotated[tc.schema.Figure, Field(description="limit of the error of |a| [g]")]
    probability: Annotated[Chance, Field(description="probability that the error is beyond it at the end")]
    days: Annotated[
        tc.schema.Figure | None,
        Field(
            description="time until then, in a direction drawn at random [d]; `null` where it is beyond all that "
            "is known"
        ),
    ]
    interval: Annotated[
        Interval, Field(description="95 % interval of it, by those of the rates [d]; `null` for no bound")
    ]
    at_start: Annotated[Chance, Field(description="probability right after a calibration")]
    figures: Annotated[list[str], Field(description="coefficients that count")]


class EffectOfFleet(tc.schema.Model):
    effect: Annotated[str, Field(description="its [name](effects.md)")]
    units: Annotated[int, Field(description="number of units with a certificate")]
    expected: Annotated[
        tc.schema.Figure, Field(description="expected number of them in which it acts: sum of its probabilities")
    ]
    likely: Annotated[int, Field(description="number of them in which it acts with 0.5 or more")]
    comparisons: Annotated[
        list[Comparison], Field(description="of its probability between groups; `mean` is the share of units")
    ]


KIND_OF_PLACE = "`batch`, `station`, `fixture`, `slot`, `operator`, `hour`, `everywhere`"


class PlaceOfEffect(tc.schema.Model):
    kind: Annotated[str, Field(description=KIND_OF_PLACE)]
    name: Annotated[str, Field(description="its name; of `hour` the hours, UTC, as `14-18`; empty for `everywhere`")]
    probability: Annotated[Chance, Field(description="that it is this one, if the effect acts")]


class PlacedValue(tc.schema.Model):
    """An effect that belongs to a place or a time instead of a unit."""

    kind: Annotated[str, Field(description=f"of the likeliest place: {KIND_OF_PLACE}")]
    place: Annotated[str, Field(description="its name; of `hour` the hours, UTC, as `14-18`")]
    verdict: Annotated[
        Literal["named", "confounded", "candidate"],
        Field(
            description="`named`: certain, at this place; `confounded`: certain, at one of `places`; `candidate`: "
            "more likely than not"
        ),
    ]
    places: Annotated[list[PlaceOfEffect], Field(description="places that the runs do not tell apart, likeliest first")]
    since: Annotated[str | None, Field(description="since when, UTC; `null`: from the first run on")]
    since_interval: Annotated[list[str] | None, Field(description="dates that hold it with 95 %; `null` if unknown")]
    until: Annotated[str | None, Field(description="until when, UTC; `null`: to the last run")]
    figure: Annotated[str, Field(description="what changes")]
    probability: Annotated[Chance, Field(description="that it acts there")]
    size: Annotated[str, Field(description="by how much, in words")]
    text: Annotated[str, Field(description="the whole, in words")]


class Product(tc.schema.Model):
    """Units of one part number."""

    part_number: Annotated[str | None, Field(description="part number; `null` where none was given")]
    units: Annotated[int, Field(description="number of units, by serial number")]
    runs: Annotated[int, Field(description="number of runs that measured something")]
    repeated: Annotated[int, Field(description="number of units with two runs or more")]
    left_out: Annotated[
        int,
        Field(description="number of their runs that failed or were aborted: not in gauge studies and drifts"),
    ]
    first: Annotated[str, Field(description="end of the first run, UTC")]
    last: Annotated[str, Field(description="end of the last run, UTC")]
    factors: Annotated[dict[str, int], Field(description="number of groups, by factor")]
    certificates: Annotated[int, Field(description="number of certificates that were read")]
    tests: Annotated[int, Field(description="number of comparisons for which p-values are adjusted")]
    figures: Annotated[
        list[FigureOfFleet], Field(description="figures with a limit, coefficients, uncertainties, effects")
    ]
    effects: Annotated[list[EffectOfFleet], Field(description="effects of the certificates, most units first")]
    recalibration: Annotated[
        Recalibration | None, Field(description="`null` without a limit, or where too few units repeat")
    ]
    places: Annotated[list[PlacedValue], Field(description="effects of places, most probable first")]


class FleetDocument(tc.schema.Model):
    """The runs that were asked for. A run that measured nothing is none of them."""

    format: Annotated[Literal["triaxcal.fleet/1"], Field(description="format of this document")]
    source: Annotated[tc.schema.Text, Field(description="folder, file or host of the database")]
    selected: Annotated[dict[str, str], Field(description="options that chose the runs, by name")]
    units: Annotated[int, Field(description="number of units, of all part numbers")]
    runs: Annotated[int, Field(description="number of runs that measured something")]
    skipped: Annotated[list[tc.schema.Text], Field(description="names of files that could not be read")]
    products: Annotated[list[Product], Field(description="by part number, most runs first")]
