"""Effects of places in words: each form and kind of figures has a line of its own."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from triaxcal.population import Change, Form, Pattern, Place, PlacedEffects, PlaceKind, Statement, Verdict
from triaxcal.population.figures import FigureKind
from triaxcal.population.hypotheses import COMMON_FACTOR, SEVERAL, THERMOMETER
from triaxcal.text.population import line, lines, pattern, place, sizes


def day(seconds: float) -> str:
    return f"day {seconds / 86400:.0f}"


def statement(verdict: Verdict = Verdict.NAMED, since_s: float | None = None) -> Statement:
    found = Pattern(Form.SHIFT, FigureKind.COEFFICIENTS, "coefficients", "bias.x")
    places = {Place(PlaceKind.FIXTURE, "F2"): 0.7, Place(PlaceKind.STATION, "S1"): 0.3}
    return Statement(
        verdict, 0.83, places, {found: 1.0}, since_s, None, None, {"bias.x": Change(1.23456e-3, 2.1e-5, "g", 3.1)}, 42
    )


def test_a_line_has_places_time_pattern_size_and_number_of_runs() -> None:
    text = line(statement(since_s=8.64e6), day)
    for words in ("fixture F2 or station S1", "since day 100", "bias.x", "0.00123 ± 2.1e-05 g", "42 runs"):
        assert words in text
    assert "0.83" in line(statement(Verdict.CANDIDATE), day)
    assert "0.83" not in text


def of(pattern: Pattern, unit: str) -> str:
    change = Change(0.0384, 0.0055, unit, 3.1)
    return sizes(replace(statement(), patterns={pattern: 1.0}, sizes={pattern.name: change}))


def test_sizes_are_factors_shares_and_per_cent() -> None:
    kind = FigureKind.COEFFICIENTS
    assert of(Pattern(Form.SHIFT, kind, "coefficients", "scale_factor.x"), "") == "scale_factor.x 3.84 ± 0.55 %"
    assert of(Pattern(Form.DRIFT, kind, "coefficients", COMMON_FACTOR), "") == "common factor 3.84 ± 0.55 %"
    assert of(Pattern(Form.SHIFT, kind, "coefficients", "bias.y"), "g") == "bias.y 0.0384 ± 0.0055 g"
    assert of(Pattern(Form.SCATTER, kind, "coefficients", "bias.y"), "1") == "scatter 0.0384 ± 0.0055 times as large"
    assert (
        of(Pattern(Form.FREQUENCY, FigureKind.EFFECT, "hysteresis", "hysteresis"), "1") == "in 3.84 ± 0.55 % of units"
    )
    assert of(Pattern(Form.SHIFT, FigureKind.EFFECT, "hysteresis", "x"), "") == "x 0.0384 ± 0.0055"


def test_hours_are_utc_and_a_change_has_its_interval() -> None:
    assert place(Place(PlaceKind.HOUR, "14-18")) == "hours 14-18 UTC"
    changed = replace(statement(since_s=8.64e6), since_interval_s=(8.5e6, 8.8e6))
    assert "since day 100 (95 %: day 98 to day 102):" in line(changed, day)


def test_statements_come_before_candidates() -> None:
    found = PlacedEffects((statement(),), (statement(Verdict.CANDIDATE),), 0.9, 500, 0)
    assert ["0.83" in text for text in lines(found, day)] == [False, True]


def test_patterns_differ_in_words() -> None:
    names = ("bias.x", SEVERAL, COMMON_FACTOR, THERMOMETER)
    coefficients = [Pattern(f, FigureKind.COEFFICIENTS, "coefficients", n) for f in Form for n in names]
    others = [
        Pattern(f, kind, "hysteresis", SEVERAL)
        for f, kind in itertools.product((Form.SHIFT, Form.DRIFT, Form.SCATTER), FigureKind)
        if kind is not FigureKind.COEFFICIENTS
    ]
    said = [pattern(p) for p in (*coefficients, *others)]
    assert len(set(said)) == len(said)
    assert all(len(text) < 120 for text in said)


@pytest.mark.parametrize("kind", PlaceKind)
def test_every_place_has_words(kind: PlaceKind) -> None:
    assert place(Place(kind, "A")).strip() == place(Place(kind, "A")) != ""
