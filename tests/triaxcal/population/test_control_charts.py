"""Charts of the NIST/SEMATECH e-Handbook of Statistical Methods (https://www.itl.nist.gov/div898/handbook/pmc/section3/,
pages pmc322, pmc323, pmc3231 and pmc324), and average run lengths of published tables."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.errors import InvalidData
from triaxcal.population import (
    cusum,
    cusum_run_length,
    ewma,
    ewma_run_length,
    individuals,
    individuals_run_length,
    one_sided_run_length,
)

FLOW_RATE = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]
"""6.3.2.2."""
EWMA_DATA = [
    52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5, 49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6,
    52.1,
]  # fmt: skip
EWMA_PRINTED = [
    50.60, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33, 50.11, 49.36, 49.52, 50.05, 49.38, 49.92,
    50.73, 51.23, 51.94, 51.99,
]  # fmt: skip
"""6.3.2.4, target 50, s 2.0539, λ 0.3."""
CUSUM_DATA = [
    324.925, 324.675, 324.725, 324.350, 325.350, 325.225, 324.125, 324.525, 325.225, 324.600, 324.625, 325.150, 328.325,
    327.250, 327.825, 328.500, 326.675, 327.775, 326.875, 328.350,
]  # fmt: skip
ABOVE = [0, 0, 0, 0, 0.03, 0, 0, 0, 0, 0, 0, 0, 3.01, 4.94, 7.45, 10.63, 11.99, 14.44, 16.00, 19.04]
BELOW = [0, 0.01, 0, 0.33, 0, 0, 0.56, 0.72, 0.17, 0.25, 0.31, 0, 0, 0, 0, 0, 0, 0, 0, 0]
"""6.3.2.3, target 325, k 0.3175, h 4.1959 in the unit of the data."""


def test_the_individuals_chart_of_the_handbook() -> None:
    chart = individuals(FLOW_RATE)
    assert chart.centre == pytest.approx(50.81)
    assert chart.mr_mean == pytest.approx(1.8778, abs=5e-5)
    # The handbook divides by 1.128, ASTM's factor 2.66 is that rounded.
    assert (chart.low, chart.high) == pytest.approx((45.8159, 55.8041), abs=2e-3)
    assert not any(chart.outside)


def test_the_ewma_chart_of_the_handbook() -> None:
    chart = ewma(EWMA_DATA, 50.0, 2.0539, weight=0.3, width=3.0)
    assert chart.statistic == pytest.approx(EWMA_PRINTED, abs=5.1e-3)
    assert chart.high == pytest.approx([52.5884] * 20, abs=1e-4)
    assert chart.low == pytest.approx([47.4115] * 20, abs=2e-4)
    assert chart.signals == ()


def test_exact_limits_of_an_ewma_begin_with_those_of_one_value() -> None:
    chart = ewma(EWMA_DATA, 50.0, 2.0, weight=0.3, width=3.0, exact_limits=True)
    assert chart.high[0] == pytest.approx(50 + 3 * 0.3 * 2.0)
    assert chart.high[-1] == pytest.approx(50 + 3 * 2.0 * np.sqrt(0.3 / 1.7), rel=1e-5)


def test_the_cusum_of_the_handbook() -> None:
    chart = cusum(CUSUM_DATA, 325.0, 1.0, reference=0.3175, decision=4.1959)
    assert chart.high == pytest.approx(ABOVE, abs=0.02)
    assert chart.low == pytest.approx(BELOW, abs=0.02)
    assert chart.signals == tuple(range(13, 20))
    assert set(chart.since) == {12}


def test_each_shift_is_one_signal_where_the_sum_restarts() -> None:
    rng = np.random.default_rng(3)
    values = np.concatenate([rng.normal(0, 1, 60), rng.normal(3, 1, 4), rng.normal(0, 1, 60)])
    assert len(cusum(values, 0.0, 1.0, restart=True).signals) < len(cusum(values, 0.0, 1.0).signals)
    assert abs(cusum(values, 0.0, 1.0, restart=True).since[0] - 60) <= 3


# Run lengths.


def test_run_lengths_of_shewhart_charts() -> None:
    """Champ and Woodall, Technometrics 29 (1987) 393: charts C1 and C14, no shift."""
    assert individuals_run_length(0.0, 3.0, None) == pytest.approx(370.40, abs=5e-3)
    assert individuals_run_length() == pytest.approx(152.73, abs=5e-3)
    assert individuals_run_length(1.0, 3.0, None) == pytest.approx(43.89, abs=0.01)  # Montgomery: 43.9 to 44


@pytest.mark.parametrize(
    ("shift", "half", "small"),
    [
        (0.0, 500, 500),
        (0.25, 255, 76.7), (0.5, 88.8, 29.3), (0.75, 35.9, 17.6), (1.0, 17.5, 12.6), (1.5, 6.53, 8.07),
        (2.0, 3.63, 5.99),
        (2.5, 2.50, 4.80), (3.0, 1.93, 4.03), (3.5, 1.58, 3.49), (4.0, 1.34, 3.11), (5.0, 1.07, 2.55),
    ],
)  # fmt: skip
def test_run_lengths_of_lucas_and_saccucci(shift: float, half: float, small: float) -> None:
    """Technometrics 32 (1990) 1, table 3: λ 0.5 with L 3.071, λ 0.03 with L 2.437; printed to three digits."""
    assert ewma_run_length(0.5, 3.071, shift) == pytest.approx(half, rel=6e-3)
    assert ewma_run_length(0.03, 2.437, shift) == pytest.approx(small, rel=6e-3)


def test_run_lengths_of_crowder() -> None:
    """Technometrics 29 (1987) 401, table 1, L 2."""
    printed = {0.0: (26.45, 127.53), 0.5: (11.89, 18.97), 1.0: (4.91, 8.38), 2.0: (1.94, 4.04), 4.0: (1.05, 2.15)}
    for shift, (half, small) in printed.items():
        assert ewma_run_length(0.5, 2.0, shift) == pytest.approx(half, abs=6e-3)
        assert ewma_run_length(0.05, 2.0, shift) == pytest.approx(small, abs=6e-3)


def test_a_run_length_to_ten_digits() -> None:
    """SAS/QC manual, 1999: λ 0.25, L 3, shift 1."""
    assert ewma_run_length(0.25, 3.0, 1.0) == pytest.approx(11.154267016, abs=1e-8)
    assert ewma_run_length(1.0, 3.0) == pytest.approx(370.398, abs=1e-3)


@pytest.mark.parametrize(
    ("shift", "plain", "fast"),
    [
        (0.0, 168, 149),
        (0.25, 74.2, 62.7), (0.5, 26.6, 20.1), (0.75, 13.3, 8.97), (1.0, 8.38, 5.29), (1.5, 4.75, 2.86),
        (2.0, 3.34, 2.01), (2.5, 2.62, 1.59), (3.0, 2.19, 1.32), (4.0, 1.71, 1.07), (5.0, 1.31, 1.01),
    ],
)  # fmt: skip
def test_run_lengths_of_lucas_and_crosier(shift: float, plain: float, fast: float) -> None:
    """Technometrics 24 (1982) 199, table 1: k 0.5, h 4, without and with a head start of 2."""
    assert cusum_run_length(0.5, 4.0, shift) == pytest.approx(plain, rel=6e-3)
    assert cusum_run_length(0.5, 4.0, shift, 2.0) == pytest.approx(fast, rel=6e-3)


def test_run_lengths_of_the_handbook() -> None:
    """6.3.2.3.1: one-sided, k 0.5, h 4 and 5, without a shift and with one of a standard deviation."""
    assert one_sided_run_length(0.5, 4.0) == pytest.approx(336, abs=0.9)
    assert one_sided_run_length(0.5, 5.0) == pytest.approx(930, abs=1.0)
    assert one_sided_run_length(0.5, 4.0, 1.0) == pytest.approx(8.38, abs=5e-3)
    assert one_sided_run_length(0.5, 5.0, 1.0) == pytest.approx(10.4, abs=0.05)
    assert cusum_run_length(0.5, 5.0) == pytest.approx(465, abs=0.6)  # Montgomery, table 9.3


def test_run_lengths_of_vance() -> None:
    """Journal of Quality Technology 18 (1986) 188, table 1: one-sided, k 0, h 10."""
    printed = {-0.25: 2071.51, -0.125: 400.28, 0.0: 124.66, 0.25: 36.71, 0.5: 20.37, 1.0: 10.75}
    for shift, length in printed.items():
        assert one_sided_run_length(0.0, 10.0, shift) == pytest.approx(length, rel=1e-4, abs=6e-3)


def test_run_lengths_of_simulated_charts() -> None:
    rng = np.random.default_rng(11)
    lengths = [
        (cusum(values, 0.0, 1.0, reference=0.5, decision=2.0).signals or (199,))[0] + 1
        for values in rng.normal(0.5, 1, (2000, 200))
    ]
    error = np.std(lengths) / np.sqrt(len(lengths))
    assert np.mean(lengths) == pytest.approx(cusum_run_length(0.5, 2.0, 0.5), abs=4 * error)


def test_wrong_parameters_are_refused() -> None:
    for bad in ({"sd": 0.0}, {"sd": 1.0, "weight": 0.0}, {"sd": 1.0, "weight": 1.5}):
        with pytest.raises(InvalidData):
            ewma([1.0], 0.0, **bad)
    with pytest.raises(InvalidData):
        cusum([1.0], 0.0, 1.0, reference=0.0)
