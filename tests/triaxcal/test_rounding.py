"""Figures as they are printed know what they were rounded from, and are written as any other number."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable

import numpy as np
import pytest

from triaxcal.rounding import (
    Printed,
    chance,
    concise,
    concise_error,
    correlation,
    degrees,
    direction,
    error,
    number,
    numbers,
    probability,
    reaches,
    uncertainty,
)


@pytest.mark.parametrize(
    ("made", "printed", "step"),
    [
        (number(-2.4210298391234), -2.421029839, 1e-9),
        (number(9.99999999999e-6), 1e-5, 1e-14),
        (uncertainty(2.7292449e-5), 2.72924e-05, 1e-10),
        (probability(0.012344), 0.01234, 1e-5),
        (error(6.3678449e-06), 6.36784e-06, 1e-11),
        (error(4.63678449, 50.0), 4.636784490, 1e-9),
        (chance(0.95664), 0.9566, 1e-4),
        (chance(1.0), 0.9999, 1e-4),
        (degrees(12.3499), 12.3, 0.1),
        (direction(np.array([0.99934402449]))[0], 0.999344024, 1e-9),
        (correlation(np.array([[1.0, 0.1234564], [0.1234564, 1.0]]))[0][1], 0.123456, 1e-6),
    ],
)
def test_a_figure_is_rounded_to_its_step(made: float, printed: float, step: float) -> None:
    assert isinstance(made, Printed)
    assert made == printed
    assert made.step == pytest.approx(step)


@pytest.mark.parametrize(
    ("value", "standard_error", "unit", "text"),
    [
        (-2.41059354, 2.4e-5, "V/g", "−2.410 594(24) V/g"),
        (6.25454406e-3, 1.56e-5, "rad", "6.255(16) × 10⁻³ rad"),
        (9.80665, 0.0123, "m/s²", "9.807(12) m/s²"),
        (1234567.891, 0.25, "", "1 234 567.89(25)"),
        (123456.0, 25.0, "count/g", "123 456(25) count/g"),
        (123456.0, 2512.0, "count/g", "123 500(2500) count/g"),
        (12.0, 2.51, "s", "12.0(2.5) s"),
        (0.12345, 0.0996, "g", "0.12(10) g"),
        (2.0, 0.999, "s", "2.0(1.0) s"),
        (3e-7, 1.2e-5, "g", "0(12) × 10⁻⁶ g"),
        (-4.99e-6, 1.2e-3, "g", "0.0(1.2) × 10⁻³ g"),
        (4.2e9, 3.1e7, "", "4.200(31) × 10⁹"),
        (0.0, 0.0, "g", "0 g"),
        (0.5, None, "g", "0.500 000 g"),
        (0.5, float("nan"), "g", "0.500 000 g"),
        (None, 0.1, "g", "—"),
        (float("inf"), 0.1, "g", "—"),
    ],
)
def test_a_figure_for_people_has_the_digits_that_its_error_leaves(
    value: float | None, standard_error: float | None, unit: str, text: str
) -> None:
    """The concise notation of the GUM, 7.2.2."""
    assert concise(value, standard_error, unit).replace("\u202f", " ") == text


def test_value_and_error_can_be_read_back() -> None:
    rng = np.random.default_rng(1)
    values, errors = rng.normal(size=300) * 10 ** rng.uniform(-8, 8, 300), 10 ** rng.uniform(-9, 7, 300)
    for value, error_of in zip(values, errors, strict=True):
        text = concise(value, error_of).replace("\u202f", "").replace("−", "-")
        body, _, power = text.partition(" × 10")
        exponent = int(power.translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-"))) if power else 0
        number_of, _, digits = body.removesuffix(")").partition("(")
        decimals = len(number_of.partition(".")[2])
        scale = 10.0**exponent if "." in digits or not decimals else 10.0 ** (exponent - decimals)
        assert float(digits) * scale == pytest.approx(error_of, rel=0.051)
        assert abs(float(number_of) * 10.0**exponent - value) <= 0.0501 * error_of + 1e-12 * abs(value)


@pytest.mark.parametrize(
    ("value", "text"), [(4.8e-5, "48 × 10⁻⁶ V"), (0.0, "0.0 V"), (123.4, "120 V"), (0.996, "1.0 V"), (None, "—")]
)
def test_an_uncertainty_for_people_has_two_digits(value: float | None, text: str) -> None:
    assert concise_error(value, "V") == text


@pytest.mark.parametrize("back", [lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy])
def test_what_was_rounded_is_kept(back: Callable[[Printed], Printed]) -> None:
    figure = back(uncertainty(2.7292449e-5))  # type: ignore[arg-type]
    assert (figure, figure.exact) == (2.72924e-05, 2.7292449e-5)
    assert figure.known_to == pytest.approx(2.72924e-06)


def test_a_document_has_the_figure_alone() -> None:
    document = {"a": uncertainty(2.7292449e-5), "b": numbers([[1.23456789012, -0.0]])}
    assert json.dumps(document) == '{"a": 2.72924e-05, "b": [[1.23456789, 0.0]]}'
    assert json.dumps(document, indent=1) == json.dumps(json.loads(json.dumps(document)), indent=1)


@pytest.mark.parametrize("value", [None, np.nan, np.inf])
def test_what_is_no_number_stands_nowhere(value: float | None) -> None:
    assert [of(value) for of in (number, error, uncertainty, probability)] == [None] * 4


@pytest.mark.parametrize(
    ("p", "reached"), [(0.99, True), (0.98999999999, True), (0.98995001, True), (0.98994999, False), (1.0, True)]
)
def test_a_probability_is_as_large_as_it_is_printed(p: float, reached: bool) -> None:
    assert reaches(p, 0.99) is reached
    assert reached is (chance(p) >= 0.99)
