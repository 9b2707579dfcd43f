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
