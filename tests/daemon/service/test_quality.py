"""Yield and capability, judged by published tables, by other computations, and by known truth over many seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, norm

from triaxcald.schema.columns import COLUMNS
from triaxcald.schema.quality import Quality
from triaxcald.service.quality import PPK_LEAST, individuals, one_sided_interval, quality_of, share_interval


def row(number: int, serial: str | None, verdict: str = "pass", **more: Any) -> dict[str, Any]:
    code = {"pass": "within_limits", "fail": "fit_outside", "aborted": "lost", "not_judged": "no_limit"}[verdict]
    return {
        **{column.name: None for column in COLUMNS}, "run": f"run-{number}", "outcome": f"{number:06d}.outcome.json",
        "serial": serial, "verdict": verdict, "code": code, "attempt": 1, "ended": f"2026-01-01T00:{number:04d}",
        **more,
    }  # fmt: skip


def test_a_unit_counts_by_its_first_and_by_its_last_judged_run() -> None:
    rows = [
        row(1, "1", "fail"), row(2, "2"), row(3, "0001", "pass"), row(4, "3", "aborted"), row(5, "3", "fail"),
        row(6, "4", "aborted"), row(7, None, "aborted", work_serial="2"), row(8, "5", "not_judged"),
        row(9, "2", "pass", attempt=None), row(10, None, "aborted"),
    ]  # fmt: skip
    found = quality_of(rows)
    assert Quality.model_validate(found).document() == found
    assert (found["units"], found["attempts"]) == (3, 9)
    assert found["first_pass_yield"] == pytest.approx(1 / 3)
    assert found["yield"] == pytest.approx(2 / 3)
    assert found["codes"] == {"lost": 4, "fit_outside": 2, "within_limits": 2, "no_limit": 1}
    assert next(iter(found["codes"])) == "lost"


def test_nothing_has_no_yield() -> None:
    found = quality_of([])
    assert Quality.model_validate(found).document() == found
    assert (found["units"], found["yield"], found["yield_interval"], found["characteristics"]) == (0, None, None, [])


def test_a_figure_is_of_the_last_run_of_each_unit() -> None:
    rows = [row(n, str(n), rms_g=1e-5 * n, rms_limit_g=1e-4) for n in (1, 2)]
    rows += [row(3, "1", "fail", rms_g=9e-5, rms_limit_g=8e-5, bias_x=0.1), row(4, "2", "aborted")]
    found = {c["name"]: c for c in quality_of(rows)["characteristics"]}
    assert set(found) == {"rms_g", "bias_x"}
    rms = found["rms_g"]
    assert [p["value"] for p in rms["chart"]["points"]] == [2e-5, 9e-5]
    assert (rms["n"], rms["high"], rms["limits_changed"], rms["ppk"]) == (2, 8e-5, True, None)
    assert (found["bias_x"]["high"], found["bias_x"]["sd"]) == (None, None)


@pytest.mark.parametrize(("n", "stated"), [(PPK_LEAST - 1, False), (PPK_LEAST, True)])
def test_few_units_have_no_capability(n: int, stated: bool) -> None:
    values = np.random.default_rng(1).normal(5e-5, 1e-5, n)
    rows = [row(i, str(i), rms_g=float(v), rms_limit_g=1e-4) for i, v in enumerate(values)]
    found = quality_of(rows)
    assert Quality.model_validate(found).document() == found
    (rms,) = found["characteristics"]
    assert (rms["ppk"] is not None, rms["ppk_interval"] is not None) == (stated, stated)
    if stated:
        assert rms["ppk"] == pytest.approx((1e-4 - values.mean()) / (3 * values.std(ddof=1)))
        low, high = rms["ppk_interval"]
        assert low < rms["ppk"] < high


@pytest.mark.slow
@pytest.mark.parametrize("n", [30, 100])
@pytest.mark.parametrize("true", [0.5, 1.0, 1.67])
def test_the_interval_of_a_capability_holds_the_truth(n: int, true: float) -> None:
    """In 95 % of 1500 samples: 1425 ± 17 (two standard deviations)."""
    rng = np.random.default_rng(int(100 * true) + n)
    held = 0
    for _ in range(1500):
        x = rng.normal(0.0, 1.0, n)
        low, high = one_sided_interval((3 * true - x.mean()) / (3 * x.std(ddof=1)), n)
        held += low <= true <= high
    assert held == pytest.approx(1425, abs=3 * 8.5)


@pytest.mark.parametrize(
    ("n", "p", "confidence", "k"),
    [
        (43, 0.90, 0.99, 1.8752),  # NIST/SEMATECH e-Handbook of Statistical Methods, 7.2.6.3
        (10, 0.95, 0.95, 2.911),  # Montgomery, table of one-sided tolerance factors
        (30, 0.95, 0.95, 2.220),
        (100, 0.95, 0.95, 1.927),
    ],
)
def test_the_lower_bound_is_that_of_tolerance_factors(n: int, p: float, confidence: float, k: float) -> None:
    """The factor k is the estimate of 3 Ppk from which at least the share ``p`` is inside with that confidence."""
    low, _ = one_sided_interval(k / 3, n, level=2 * confidence - 1)
    assert 3 * low == pytest.approx(norm.ppf(p), abs=1e-3)


@pytest.mark.parametrize(("count", "n"), [(0, 10), (3, 10), (10, 10), (97, 100)])
def test_the_interval_of_a_share_is_exact(count: int, n: int) -> None:
    """At its ends the count is just as improbable (Clopper and Pearson)."""
    low, high = share_interval(count, n)  # type: ignore[misc]
    if count:
        assert binom.sf(count - 1, n, low) == pytest.approx(0.025)
    else:
        assert low == 0
    if count < n:
        assert binom.cdf(count, n, high) == pytest.approx(0.025)
    else:
        assert high == 1


def test_a_chart_of_individuals_is_that_of_the_textbook() -> None:
    """Montgomery, Introduction to Statistical Quality Control, table 6.6: viscosity of 15 batches of primer."""
    x = [33.75, 33.05, 34.00, 33.81, 33.46, 34.02, 33.68, 33.27, 33.49, 33.20, 33.62, 33.00, 33.54, 33.12, 33.84]
    chart = individuals(x)
    assert chart.centre == pytest.approx(33.52, abs=0.01)
    assert chart.range_centre == pytest.approx(0.48, abs=0.005)
    assert (chart.lower, chart.upper) == (pytest.approx(32.24, abs=0.02), pytest.approx(34.80, abs=0.02))
    assert chart.range_upper == pytest.approx(1.57, abs=0.01)
    assert not any(chart.rules)


def test_values_outside_and_runs_on_one_side_are_marked() -> None:
    x = [-1.0, 1.0] * 40 + [30.0] + [2.0] * 8
    rules = individuals(x).rules
    assert "outside" in rules[80]
    assert rules[-1] == ("run",)
    assert not any(rules[:80])
    assert individuals([1.0]).rules == ((),)
