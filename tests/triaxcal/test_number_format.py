"""Numbers in sentences."""

from __future__ import annotations

import pytest

from triaxcal.number_format import micro_g, number_of, plain, probability


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (1.1183e-3, "1118 µg"),
        (15e-6, "15.0 µg"),
        (5.031e-6, "5.03 µg"),
        (2e-13, "2e-07 µg"),
        (0.0, "0 µg"),
        (-3.2, "-3200000 µg"),
        (None, "unknown"),
    ],
)
def test_an_error_has_the_digits_that_tables_have_or_three(value: float | None, said: str) -> None:
    assert micro_g(value) == said


def test_a_sign_is_told_where_it_is_asked_for() -> None:
    assert micro_g(1.1183e-3, "+") == "+1118 µg"
    assert micro_g(5.031e-6, "+") == "+5.03 µg"


@pytest.mark.parametrize(
    ("value", "digits", "said"),
    [(1234.5, 3, "1234"), (290.4, 2, "290"), (0.3333, 2, "0.33"), (59.98, 4, "59.98"), (1e-7, 3, "1e-07")],
)
def test_a_number_keeps_all_its_digits_before_the_point(value: float, digits: int, said: str) -> None:
    assert plain(value, digits) == said


@pytest.mark.parametrize(
    ("p", "said"),
    [(0.0, "< 1e-12"), (1e-300, "< 1e-12"), (3.21e-8, "3.2e-08"), (0.913, "0.91"), (1.0, "1"), (None, "—")],
)
def test_a_probability_is_never_said_to_be_nothing(p: float | None, said: str) -> None:
    assert probability(p) == said


@pytest.mark.parametrize(("count", "said"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames")])
def test_one_is_told_in_the_singular(count: int, said: str) -> None:
    assert number_of(count, "frame") == said
