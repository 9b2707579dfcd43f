"""Yield and distributions of known rows, intervals by published tables, by other computations and by known truth
over many seeds, and control charts of a published example."""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from scipy import stats

from triaxcal.population import PPK_LEAST, individuals, one_sided_interval, share_interval
from triaxcald.schema.columns import NAMES
from triaxcald.schema.quality import Chart, Quality
from triaxcald.service.quality import COLUMNS, UNITS, chart_of, quality_of

CODES = {"pass": "within_limits", "fail": "fit_outside", "aborted": "absent", "not_judged": "no_limit"}


def row(at: int, serial: str | None, verdict: str = "pass", **cells: Any) -> dict[str, Any]:
    """The attempt at a unit at a time in minutes."""
    time = datetime(2030, 1, 1, tzinfo=UTC) + timedelta(minutes=at)
    return {
        **dict.fromkeys(COLUMNS), "run": f"run {at}", "serial": serial, "verdict": verdict, "code": CODES[verdict],
        "ended": time.isoformat(timespec="milliseconds"), "at_us": at * 60_000_000, "tried": 1, **cells,
    }  # fmt: skip


def verdicts(**by_serial: str) -> list[dict[str, Any]]:
    """Each unit's attempts in words, one after the other."""
    told = [(serial, word) for serial, words in by_serial.items() for word in words.split()]
    return [row(at, serial, word) for at, (serial, word) in enumerate(told)]


def counts(rows: Iterable[dict[str, Any]], before: dict[tuple[str, str | None], int] | None = None) -> list[Any]:
    document = Quality.model_validate(quality_of(rows, before)).document()
    return [
        document[key] for key in ("units", "first_pass_units", "first_pass_yield", "yield_units", "yield", "attempts")
    ]


def by_name(rows: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {c["name"]: c for c in Quality.model_validate(quality_of(rows)).document()["characteristics"]}


def normal(n: int, seed: int = 1, mean: float = 6e-5, sd: float = 1e-5) -> list[float]:
    return np.random.default_rng(seed).normal(mean, sd, n).tolist()


def measured(values: Iterable[float], limit: float | None = 1e-4) -> list[dict[str, Any]]:
    return [row(at, f"{at}x", rms_g=value, rms_limit_g=limit) for at, value in enumerate(values)]


# Yield.


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("pass", (1, 1)),
        ("fail", (0, 0)),
        ("fail pass", (0, 1)),
        ("aborted pass", (1, 1)),  # an aborted attempt does not judge the unit
        ("aborted fail pass", (0, 1)),
        ("pass fail", (1, 0)),
        ("pass aborted", (1, 0)),  # but a unit whose last attempt did not end has not passed
        ("aborted aborted", (0, 0)),
        ("pass not_judged", (1, 1)),  # without a limit an attempt says nothing
        ("not_judged fail", (0, 0)),
    ],
)
def test_the_first_judged_and_the_last_attempt_decide(words: str, expected: tuple[int, int]) -> None:
    attempts = len(words.split())
    assert counts(verdicts(unit=words)) == [1, 1, expected[0], 1, expected[1], attempts]


def test_units_that_were_never_judged_for_want_of_a_limit_do_not_count() -> None:
    assert counts(verdicts(a="not_judged", b="pass")) == [2, 1, 1.0, 1, 1.0, 2]
    assert counts(verdicts(a="not_judged")) == [1, 0, None, 0, None, 1]
    assert counts([]) == [0, 0, None, 0, None, 0]
    assert quality_of([])["yield_interval"] is None


def test_shares_are_of_units_and_not_of_attempts() -> None:
    rows = verdicts(a="pass", b="fail fail fail pass", c="fail", d="pass")
    assert counts(rows) == [4, 4, 0.5, 4, 0.75, 7]
    assert quality_of(rows)["codes"] == {"fit_outside": 4, "within_limits": 3}
    assert list(quality_of(rows)["codes"]) == ["fit_outside", "within_limits"]


def test_a_unit_is_known_by_its_expected_number_else_by_the_one_it_reports() -> None:
    rows = [
        row(0, "0042", "fail"), row(1, None, "aborted", work_serial="42"), row(2, "77", work_serial="042"),
        row(3, None, "aborted"),
    ]  # fmt: skip
    assert counts(rows) == [1, 1, 0, 1, 1, 4]


def test_a_provisioning_and_a_copy_of_an_outcome_are_no_attempts() -> None:
    assert counts([row(0, "1", "fail"), row(0, "1", "fail"), row(1, "1", tried=0, rms_g=1e-5)]) == [1, 1, 0, 1, 0, 1]


def test_a_retest_is_no_first_pass_although_the_first_attempt_was_not_asked_for() -> None:
    rows = [row(10, "01"), row(11, "2"), row(12, "3", "aborted"), row(13, "4", "aborted")]
    first_judged_us = {(serial, None): at * 60_000_000 for serial, at in (("1", 5), ("2", 11), ("3", 5))}
    assert counts(rows, first_judged_us) == [4, 2, 0.5, 4, 0.5, 4]


def test_products_that_are_numbered_each_for_itself_are_other_units() -> None:
    rows = [row(10, "7", "fail", part_number="A"), row(11, "7", part_number="B"), row(12, "07", part_number="B")]
    before = {("7", "A"): 10 * 60_000_000, ("7", "B"): 11 * 60_000_000}
    assert counts(rows, before) == [2, 2, 0.5, 2, 0.5, 3]
    assert counts(rows[1:], before) == [1, 1, 1.0, 1, 1.0, 2]


@pytest.mark.parametrize(("count", "of"), [(0, 10), (1, 10), (10, 10), (43, 50), (19990, 20000)])
def test_the_interval_of_a_share_is_that_of_scipy(count: int, of: int) -> None:
    exact = stats.binomtest(count, of).proportion_ci(0.95, "exact")
    assert share_interval(count, of) == pytest.approx((exact.low, exact.high), rel=1e-9)


# Distributions.


def test_a_characteristic_has_one_value_a_unit_the_last_one_failed_units_included() -> None:
    rows = [
        row(0, "1", "fail", rms_g=3e-4, rms_limit_g=1e-4, bias_x=0.1), row(1, "2", rms_g=5e-5, rms_limit_g=1e-4),
        row(2, "1", rms_g=7e-5, rms_limit_g=1e-4, bias_x=0.2), row(3, "3", "fail", rms_g=2e-4, rms_limit_g=1e-4),
        row(4, "1", "aborted"),
    ]  # fmt: skip
    found = by_name(rows)
    assert list(found) == ["rms_g", "bias_x"]
    values = [5e-5, 7e-5, 2e-4]
    rms = found["rms_g"]
    assert (rms["n"], rms["unit"], rms["low"], rms["high"], rms["outside"]) == (3, "g", None, 1e-4, 1)
    assert rms["mean"] == pytest.approx(np.mean(values))
    assert rms["sd"] == pytest.approx(np.std(values, ddof=1))
    bias = found["bias_x"]
    assert (bias["n"], bias["mean"], bias["sd"], bias["high"], bias["ppk"], bias["outside"]) == (
        1,
        0.2,
        None,
        None,
        None,
        None,
    )


def test_ppk_goes_by_the_latest_limit_and_says_that_limits_changed() -> None:
    values = normal(60)
    same = by_name(measured(values))["rms_g"]
    assert same["ppk"] == pytest.approx((1e-4 - np.mean(values)) / (3 * np.std(values, ddof=1)), rel=1e-3)
    assert same["limits_changed"] is False
    rows = measured(values)
    for earlier in rows[:30]:
        earlier["rms_limit_g"] = 5e-5
    changed = by_name(rows)["rms_g"]
    assert (changed["ppk"], changed["high"], changed["limits_changed"]) == (same["ppk"], 1e-4, True)


def test_ppk_is_not_stated_for_few_units_equal_values_or_without_a_limit() -> None:
    assert by_name(measured(normal(PPK_LEAST - 1)))["rms_g"]["ppk"] is None
    assert by_name(measured(normal(PPK_LEAST)))["rms_g"]["ppk"] is not None
    for rows in (measured([5e-5] * 40), measured(normal(40), None)):
        found = by_name(rows)["rms_g"]
        assert (found["ppk"], found["ppk_interval"]) == (None, None)


@pytest.mark.parametrize("value", [3e-5, 3.3e-5, 5e-5, 0.1, 1.0015])
@pytest.mark.parametrize("n", [30, 40, 77])
def test_equal_values_have_no_scatter_whatever_their_decimals(value: float, n: int) -> None:
    found = by_name(measured([value] * n))["rms_g"]
    assert (found["mean"], found["sd"], found["ppk"]) == (value, 0.0, None)
    chart = individuals([value] * n)
    assert (chart.centre, chart.low, chart.high) == (value, value, value)
    assert set(chart.outside) == {None}


TOLERANCE_FACTORS = [
    (10, 0.95, 2.911), (10, 0.99, 3.981), (30, 0.95, 2.220), (30, 0.99, 3.064), (50, 0.95, 2.065), (50, 0.99, 2.862),
    (100, 0.95, 1.927), (100, 0.99, 2.684),
]  # fmt: skip
"""Values, share of the distribution and factor k of one-sided tolerance limits with 95 % confidence (Lieberman,
Industrial Quality Control 14 (1958) no. 10, 7; also in ISO 16269-6)."""


@pytest.mark.parametrize(("n", "share", "k"), TOLERANCE_FACTORS)
def test_the_lower_end_is_that_of_published_tolerance_factors(n: int, share: float, k: float) -> None:
    """A limit k sd above the mean of n values has the share below it with 95 % confidence: a Ppk of k/3 is then
    known to be no lower than that of the share."""
    true = stats.norm.ppf(share) / 3
    below, above = (one_sided_interval((k + d) / 3, n, level=0.90)[0] for d in (-0.001, 0.001))
    assert below < true < above


@pytest.mark.parametrize("n", [10, 30, 100, 20_000])
@pytest.mark.parametrize("ppk", [-0.5, 0.0, 0.4, 1.33, 2.5])
def test_the_interval_is_that_of_scipys_noncentral_t(n: int, ppk: float) -> None:
    low, high = one_sided_interval(ppk, n)
    scale = 3 * math.sqrt(n)
    assert stats.nct.cdf(scale * ppk, n - 1, scale * low) == pytest.approx(0.975, abs=1e-9)
    assert stats.nct.cdf(scale * ppk, n - 1, scale * high) == pytest.approx(0.025, abs=1e-9)


def test_the_interval_is_near_bissells_where_that_is_good() -> None:
    """Bissell, Applied Statistics 39 (1990) 331: its error falls as 1/n."""
    n, ppk = 2000, 1.33
    half = stats.norm.ppf(0.975) * math.sqrt(1 / (9 * n) + ppk**2 / (2 * (n - 1)))
    assert one_sided_interval(ppk, n) == pytest.approx((ppk - half, ppk + half), abs=0.002)


@pytest.mark.parametrize(("n", "true"), [(30, 0.67), (30, 1.33), (100, 1.67)])
def test_the_interval_has_the_truth_in_95_of_100_cases(n: int, true: float) -> None:
    trials = 1000
    values = np.random.default_rng(n).standard_normal((trials, n))
    estimates = (3 * true - values.mean(axis=1)) / (3 * values.std(axis=1, ddof=1))
    ends = [one_sided_interval(p, n) for p in estimates]
    for misses in (sum(true < low for low, _ in ends), sum(true > high for _, high in ends)):
        assert stats.binomtest(misses, trials, 0.025).pvalue > 1e-3


# Control charts.

FLOW = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]
"""NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: mean 50.81, mean moving range 1.8778, limits 45.8159 and
55.8041 with 3/1.128 in place of 2.66."""


def test_a_chart_is_that_of_a_published_example() -> None:
    found = individuals(FLOW)
    assert found.centre == pytest.approx(50.81)
    assert found.mr_mean == pytest.approx(1.8778, abs=5e-5)
    factor = 2.66 * 1.128 / 3
    assert found.low == pytest.approx(50.81 - factor * (50.81 - 45.8159), abs=1e-4)
    assert found.high == pytest.approx(50.81 + factor * (55.8041 - 50.81), abs=1e-4)
    assert found.moving_ranges.tolist() == pytest.approx([2.0, 2.3, 1.4, 3.5, 3.4, 1.4, 0.2, 1.2, 1.5])
    assert found.outside == (None,) * 10


def test_a_moving_range_has_the_limit_of_a_published_example() -> None:
    """Montgomery and Runger, Applied Statistics and Probability for Engineers, exercise 15-17: the mean moving range
    56/19 has the limit 9.628."""
    values = np.cumsum([0.0, 1, 2, -1, 0, 4, -1, 2, -1, 5, -5, 6, -1, 8, -3, 1, -2, 4, -6, 3])
    found = individuals(values.tolist())
    assert found.mr_mean == pytest.approx(56 / 19)
    assert found.mr_high == pytest.approx(9.628, abs=2e-3)


def test_a_value_beyond_a_limit_and_the_eighth_on_one_side_are_marked() -> None:
    alternating = [1.0, -1.0] * 10
    assert individuals([*alternating, 40.0, -40.0]).outside == (None,) * 20 + ("limits", "limits")
    one_side = [-1.0, *[1.0, 0.2] * 4, 1.0, -1.0, -1.6, -1.0, -1.8]  # about a mean near zero
    assert individuals(one_side).outside == (None,) * 8 + ("run", "run") + (None,) * 4


def test_a_value_on_the_centre_ends_a_run() -> None:
    values = [1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, -8.0]
    assert np.mean(values) == 0.0
    assert "run" not in individuals(values).outside


def test_false_alarms_of_a_chart_are_as_rare_as_3_sigma_says() -> None:
    values = np.random.default_rng(3).standard_normal(20_000)
    beyond = sum(mark == "limits" for mark in individuals(values.tolist()).outside)
    assert stats.binomtest(beyond, len(values), 0.0027).pvalue > 1e-3


def test_a_step_is_found_although_it_is_in_the_mean() -> None:
    values = np.random.default_rng(4).standard_normal(200)
    values[150:] += 4.0
    marks = individuals(values.tolist()).outside
    assert sum(mark is not None for mark in marks[150:]) > 40


def test_a_chart_has_one_point_a_unit_by_its_end_with_its_own_limit() -> None:
    rows = [
        row(0, "1", "fail", rms_g=3e-4, rms_limit_g=2e-4), row(1, "2", rms_g=5e-5, rms_limit_g=2e-4),
        row(2, "1", rms_g=7e-5, rms_limit_g=1e-4), row(3, "3", rms_g=6e-5, rms_limit_g=None),
    ]  # fmt: skip
    found = Chart.model_validate(chart_of(rows, "rms_g", 100)).document()
    assert [p["run"] for p in found["points"]] == ["run 1", "run 2", "run 3"]
    assert [p["limit"] for p in found["points"]] == [2e-4, 1e-4, None]
    assert [p["moving_range"] for p in found["points"]] == [None, pytest.approx(2e-5), pytest.approx(1e-5)]
    assert (found["n"], found["limit"], found["unit"]) == (3, None, "g")
    last = chart_of(rows, "rms_g", 1)
    assert (last["points"], last["centre"], last["n"]) == (found["points"][-1:], found["centre"], 3)


def test_a_figure_that_is_never_negative_has_no_limit_below_zero() -> None:
    values = [1e-5, 9e-5, 1e-5, 9e-5]
    assert chart_of(measured(values), "rms_g", 10)["low"] is None
    biases = [row(at, str(at), bias_x=value) for at, value in enumerate(values)]
    assert chart_of(biases, "bias_x", 10)["low"] < 0


@pytest.mark.parametrize("values", [[], [5e-5]])
def test_a_chart_of_nothing_or_one_value_has_no_limits(values: list[float]) -> None:
    found = Chart.model_validate(chart_of(measured(values), "rms_g", 10)).document()
    assert (found["n"], len(found["points"])) == (len(values), len(values))
    assert [found[key] for key in ("low", "high", "mr_mean", "mr_high")] == [None] * 4
    with pytest.raises(KeyError):
        chart_of([], "duration_s", 10)


def test_the_columns_are_those_of_results() -> None:
    assert {*COLUMNS, *UNITS} <= set(NAMES)
