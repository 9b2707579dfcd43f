"""How well a line works (`triaxcal.quality/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc

Share = Annotated[float, Field(ge=0, le=1)]


class ChartPoint(tc.schema.Model):
    run: Annotated[str | None, Field(description="id of the run")]
    serial: Annotated[str | None, Field(description="serial number")]
    time: Annotated[str, Field(description="end of the run, UTC")]
    value: Annotated[tc.schema.Figure, Field(description="the figure")]
    rules: Annotated[
        list[Literal["outside", "run"]],
        Field(description="rules that it breaks: outside the control limits, or the eighth in a row on one side"),
    ]


class ControlLimits(tc.schema.Model):
    centre: Annotated[tc.schema.Figure, Field(description="centre line")]
    lower: Annotated[tc.schema.Figure, Field(description="lower control limit")]
    upper: Annotated[tc.schema.Figure, Field(description="upper control limit")]


class Chart(tc.schema.Model):
    points: Annotated[list[ChartPoint], Field(description="values in the order of time")]
    individuals: Annotated[ControlLimits, Field(description="mean ± 2.66 times the mean moving range")]
    moving_range: Annotated[ControlLimits, Field(description="of the differences between neighbours")]


class Characteristic(tc.schema.Model):
    """One value of each unit, from its last run with the figure, failed units among
    them."""

    name: Annotated[str, Field(description="name of the figure, as in `results`")]
    unit: Annotated[str, Field(description="its unit")]
    n: Annotated[int, Field(description="number of units")]
    mean: Annotated[tc.schema.Figure, Field(description="mean")]
    sd: Annotated[tc.schema.Figure | None, Field(description="standard deviation; `null` of one unit")]
    low: Annotated[tc.schema.Figure | None, Field(description="lower limit; `null` without one")]
    high: Annotated[tc.schema.Figure | None, Field(description="upper limit, the latest; `null` without one")]
    limits_changed: Annotated[bool, Field(description="whether units were judged by different limits")]
    ppk: Annotated[
        tc.schema.Figure | None, Field(description="Ppk; `null` without a limit, and of fewer than 30 units")
    ]
    ppk_interval: Annotated[list[tc.schema.Figure] | None, Field(description="its exact 95 % interval")]
    chart: Annotated[Chart, Field(description="chart of individuals and moving ranges")]


class Quality(tc.schema.Model):
    """Yield, reasons and capability of a station's runs."""

    format: Annotated[Literal["triaxcal.quality/1"], Field(description="format of this document")]
    units: Annotated[int, Field(description="units that have passed or failed")]
    first_pass_yield: Annotated[Share | None, Field(description="share of units whose first judged run passed")]
    first_pass_yield_interval: Annotated[list[Share] | None, Field(description="its 95 % interval")]
    yield_: Annotated[Share | None, Field(alias="yield", description="share of units whose last judged run passed")]
    yield_interval: Annotated[list[Share] | None, Field(description="its 95 % interval")]
    attempts: Annotated[int, Field(description="attempts, aborted ones among them")]
    codes: Annotated[dict[str, int], Field(description="number of attempts by code, the most frequent first")]
    characteristics: Annotated[list[Characteristic], Field(description="figures and coefficients")]
