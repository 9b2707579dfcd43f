"""Numbers as text, thinned streams and the projection of the sphere."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.text.traces import effect_title
from triaxcald.report import StreamOverview, thin
from triaxcald.report.charts import equal_area
from triaxcald.report.figures import clean, digits, micro_g, number, p_value, plus_minus


@pytest.mark.parametrize(
    ("value", "standard_error", "unit", "text"),
    [
        (-2.410618, 1.6e-5, "V/g", "−2.410\u202f618(16) V/g"),
        (6.25454406e-3, 1.56e-5, "rad", "6.255(16) × 10⁻³ rad"),
        (-6.5046e-4, 1.56e-5, "rad", "−0.650(16) × 10⁻³ rad"),
        (3.1e-8, 1.0e-9, "g/g^2", "31.0(1.0) × 10⁻⁹ g/g²"),
        (123456.0, 25.0, "count/g", "123\u202f456(25) count/g"),
        (0.0, 0.012, "g", "0(12) × 10⁻³ g"),
        (0.5, None, "g", "0.500\u202f000 g ± —"),
        (None, 0.1, "g", "—"),
    ],
)
def test_a_coefficient_is_written_to_the_place_of_its_error(
    value: float | None, standard_error: float | None, unit: str, text: str
) -> None:
    assert plus_minus(value, standard_error, unit) == text


@pytest.mark.parametrize(
    ("value_g", "text"),
    [(9.996e-5, "100 µg"), (-1.2183e-5, "−12.2 µg"), (4e-8, "0.04 µg"), (0.0, "0.00 µg"), (0.0125, "12500 µg")],
)
def test_errors_are_written_in_micro_g_with_three_digits(value_g: float, text: str) -> None:
    assert micro_g(value_g) == text


def test_p_values_and_small_numbers_are_short() -> None:
    assert p_value(3e-40) == "< 10⁻⁶"
    assert p_value(0.43) == "0.43"
    assert digits(3.0e-7, 2) == "3.0 × 10⁻⁷"


@pytest.mark.parametrize("value", [None, "1", True, float("nan"), float("-inf"), 1e300, 10**400, [1.0]])
def test_what_is_no_usable_number_is_missing(value: object) -> None:
    assert number(value) is None


def test_numpy_numbers_are_numbers() -> None:
    assert number(np.float32(0.5)) == 0.5
    assert number(np.int64(3)) == 3.0


def test_effects_have_readable_titles() -> None:
    assert effect_title("third_order_nonlinearity") == "Third-order nonlinearity"
    assert effect_title("channel_bias:supply_v") == "Channel bias: supply_v"


def test_text_loses_what_prints_as_nothing() -> None:
    assert clean("a\n b\u202e\x07") == "a b\ufffd\ufffd"


def test_thinning_keeps_order_ends_and_every_extreme() -> None:
    values = np.random.default_rng(1).normal(size=(100_000, 3))
    values[41_234, 1], values[77_777, 2], values[500, 0] = 50.0, -60.0, np.nan
    times, thinned = thin(np.arange(100_000.0), values, points=2000)
    assert times.size <= 2000
    assert (np.diff(times) > 0).all()
    assert (times[0], times[-1]) == (0.0, 99_999.0)
    np.testing.assert_array_equal(np.nanmax(thinned, axis=0), np.nanmax(values, axis=0))
    np.testing.assert_array_equal(np.nanmin(thinned, axis=0), np.nanmin(values, axis=0))


def test_a_short_stream_is_left_alone() -> None:
    times, values = thin([0.0, 1.0], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(times, [0, 1])
    np.testing.assert_array_equal(values, [[1, 2, 3], [4, 5, 6]])


def test_thinning_to_fewer_points_than_one_stretch_has_extremes_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 8"):
        thin(np.arange(10.0), np.zeros((10, 3)), points=7)


def test_an_overview_with_shapes_that_disagree_is_refused() -> None:
    with pytest.raises(ValueError, match=r"expected \(n,\) and \(n, 3\)"):
        StreamOverview(np.zeros(4), np.zeros((5, 3)), (), "V")


def test_the_projection_keeps_areas() -> None:
    """Archimedes: a cap of height h covers h of its hemisphere, so it must cover h of the disc."""
    height = np.linspace(0.0, 1.0, 11)
    across = np.sqrt(1.0 - height**2)
    for side in (1, -1):
        projected = equal_area(np.column_stack([across, np.zeros(11), side * height]), side)
        np.testing.assert_allclose(projected[:, 0] ** 2, 1.0 - height, atol=1e-12)
