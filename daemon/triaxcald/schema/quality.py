"""The quality of a line (`triaxcal.quality/1`), and the control chart of one figure
(`triaxcal.chart/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc

Share = Annotated[tc.schema.Figure, Field(ge=0, le=1)]
Interval = Annotated[list[tc.schema.Figure], Field(min_length=2, max_length=2)]


class Characteristic(tc.schema.Model):
    """One value a unit: that of its last attempt with the figure, whatever its
    verdict."""

    name: Annotated[str, Field(description="figure or coefficient: a column of [results](results.md)")]
    unit: Annotated[str, Field(description="unit of the value")]
    n: Annotated[int, Field(description="number of units with the figure")]
    mean: Annotated[tc.schema.Figure, Field(description="mean [`unit`]")]
    sd: Annotated[
        tc.schema.Figure | None,
        Field(description="standard deviation over all of them, n − 1 [`unit`]; `null` with one unit"),
    ]
    low: Annotated[tc.schema.Figure | None, Field(description="lower limit; `null` without one")]
    high: Annotated[tc.schema.Figure | None, Field(description="upper limit of the latest attempt; `null` without one")]
    limits_changed: Annotated[
        bool, Field(description="whether some of these attempts had another limit, or none; verdicts go by their own")
    ]
    outside: Annotated[int | None, Field(description="number of units above `high`; `null` without a limit")]
    ppk: Annotated[
        tc.schema.Figure | None,
        Field(
            description="(`high` − `mean`) / (3 `sd`); `null` with fewer than 30 units, equal values, or no limit. "
            "For values that have no normal distribution it is no share outside"
        ),
    ]
    ppk_interval: Annotated[
        Interval | None, Field(description="exact 95 % interval of `ppk` for a normal distribution, by noncentral t")
    ]


class Quality(tc.schema.Model):
    """The attempts that were asked for. A `provision` or `restore` is none."""

    format: Annotated[Literal["triaxcal.quality/1"], Field(description="format of this document")]
    units: Annotated[int, Field(description="units with an attempt, by expected serial number, else the reported one")]
    first_pass_yield: Annotated[
        Share | None,
        Field(
            description="share of units whose first judged attempt passed; judged is `pass` or `fail`. Units whose "
            "first one came before these attempts do not count"
        ),
    ]
    first_pass_yield_interval: Annotated[
        Interval | None, Field(description="exact 95 % interval of it (Clopper and Pearson)")
    ]
    first_pass_units: Annotated[
        int, Field(description="units that count in it: `yield_units` without those judged before")
    ]
    yield_: Annotated[
        Share | None,
        Field(
            alias="yield",
            description="share of units whose last attempt passed, `not_judged` ones apart; an aborted one did not",
        ),
    ]
    yield_interval: Annotated[Interval | None, Field(description="exact 95 % interval of it (Clopper and Pearson)")]
    yield_units: Annotated[int, Field(description="units that count in it: `units` without those only `not_judged`")]
    attempts: Annotated[int, Field(description="number of attempts, those without a serial number among them")]
    codes: Annotated[
        dict[str, int], Field(description="number of attempts by [code](outcome.md#verdict-and-code), most first")
    ]
    characteristics: Annotated[list[Characteristic], Field(description="figures with a limit, then coefficients")]


class Point(tc.schema.Model):
    run: Annotated[str | None, Field(description="id of the attempt's run")]
    serial: Annotated[str | None, Field(description="serial number of the unit")]
    time: Annotated[str, Field(description="end of the attempt, UTC")]
    value: Annotated[tc.schema.Figure, Field(description="value [`unit`]")]
    moving_range: Annotated[
        tc.schema.Figure | None, Field(description="distance from the value before; `null` of the first")
    ]
    outside: Annotated[
        Literal["limits", "run"] | None,
        Field(
            description="`limits` for a value outside the control limits, `run` for the eighth and later values in a "
            "row on one side of the centre; else `null`"
        ),
    ]
    moving_range_outside: Annotated[bool, Field(description="whether `moving_range` is above `mr_high`")]
    limit: Annotated[tc.schema.Figure | None, Field(description="upper limit that the attempt had; `null` without one")]


class Chart(tc.schema.Model):
    """Individuals and moving ranges of two, by the end of the attempts. Values are
    chosen as in [quality](#quality): one a unit."""

    format: Annotated[Literal["triaxcal.chart/1"], Field(description="format of this document")]
    name: Annotated[str, Field(description="figure or coefficient: a column of [results](results.md)")]
    unit: Annotated[str, Field(description="unit of the values")]
    n: Annotated[int, Field(description="number of values from which centre and limits are computed")]
    points: Annotated[list[Point], Field(description="the last values, the latest last")]
    centre: Annotated[tc.schema.Figure | None, Field(description="mean; `null` without a value")]
    low: Annotated[
        tc.schema.Figure | None,
        Field(
            description="lower control limit, `centre` − 2.66 `mr_mean`; `null` with one value, and below zero for "
            "what is never negative"
        ),
    ]
    high: Annotated[tc.schema.Figure | None, Field(description="upper control limit, `centre` + 2.66 `mr_mean`")]
    mr_mean: Annotated[tc.schema.Figure | None, Field(description="mean moving range; `null` with one value")]
    mr_high: Annotated[tc.schema.Figure | None, Field(description="its upper control limit, 3.267 `mr_mean`")]
    limit: Annotated[
        tc.schema.Figure | None, Field(description="upper limit of the latest attempt; `null` without one")
    ]
