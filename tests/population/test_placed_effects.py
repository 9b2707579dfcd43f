"""Effects of places: worlds with a known truth at known places, and worlds without any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import triaxcal as tc
from tests.population.worlds import KINDS, YEAR_S, World, judged, with_broken_end, world
from triaxcal.population import Form, PlacedEffects, PlaceKind, UnitRun, Verdict, placed_effects
from triaxcal.population.statements import _listed

SMALL = 150
"""Units of the fast worlds."""


def plain(made: World) -> World:
    """Without poses, effects and further figures: the nine coefficients alone."""
    return replace(made, runs=[replace(run, poses=None, effects={}, figures={}) for run in made.runs])


def small(seed: int, effects: int, *kinds: str) -> World:
    return plain(world(seed, effects, SMALL, kinds=kinds or None, sizes=(4.0, 8.0)))


def test_a_coefficient_that_one_place_shifts_is_named_with_place_time_and_size() -> None:
    made = small(3, 1, "one coefficient")
    found = placed_effects(made.runs)
    judgement = judged(made, 0, found)
    assert judgement.listed
    assert judgement.pattern
    statement = judgement.statements[0]
    (change, *_) = statement.sizes.values()
    assert abs(abs(change.in_spreads) - made.truths[0].size) < 0.35 * made.truths[0].size


def test_gravity_that_is_wrong_at_one_station_is_one_factor_of_three_scale_factors() -> None:
    made = small(5, 1, "gravity")
    found = placed_effects(made.runs)
    assert judged(made, 0, found).listed
    (statement,) = found.statements
    assert (statement.pattern.form, statement.pattern.name) == (Form.SHIFT, "common_factor")
    (factor,) = statement.sizes.values()
    assert abs(abs(factor.value) / 6e-3 / made.truths[0].size - 1) < 0.25
    assert 0 < factor.uncertainty < 0.2 * abs(factor.value)


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_nothing_is_named_where_nothing_acts(seed: int) -> None:
    found = placed_effects(small(seed, 0).runs)
    assert found.statements == ()
    assert found.nothing > 0.5


def runs_at(places: list[tuple[str, str]], shift: np.ndarray) -> list[UnitRun]:
    """A run of a unit at each station and fixture, a day apart; ``shift`` (N,) of the bias of x in spreads."""
    rng = np.random.default_rng(1)
    own = rng.normal(size=(len(places), 9))
    own[:, 6] += shift
    scale = np.array([1e-3] * 9)
    base = np.array([1.0] * 3 + [0.0] * 6)
    return [
        UnitRun(f"U{i}", 86400.0 * i, base + scale * row, scale / 100, station=station, fixture=fixture)
        for i, (row, (station, fixture)) in enumerate(zip(own, places, strict=True))
    ]


def test_places_with_the_same_runs_are_confounded_and_both_are_listed() -> None:
    places = [("S1", "F1") if i % 3 else ("S2", "F2") for i in range(90)]
    found = placed_effects(runs_at(places, np.array([4.0 * (s == "S2") for s, _ in places])))
    (statement,) = found.statements
    assert statement.verdict is Verdict.CONFOUNDED
    assert {(p.kind, p.name) for p in statement.places} >= {(PlaceKind.STATION, "S2"), (PlaceKind.FIXTURE, "F2")}
    assert sum(statement.places.values()) == pytest.approx(1.0, abs=0.02)


def test_a_fixture_that_moves_is_told_from_its_station_and_a_change_has_its_date() -> None:
    rng = np.random.default_rng(2)
    places = [(str(rng.choice(["S1", "S2"])), str(rng.choice(["F1", "F2"]))) for _ in range(160)]
    acts = np.array([fixture == "F2" and i >= 80 for i, (_, fixture) in enumerate(places)])
    found = placed_effects(runs_at(places, 5.0 * acts))
    (statement,) = found.statements
    assert statement.verdict is Verdict.NAMED
    assert (statement.place.kind, statement.place.name) == (PlaceKind.FIXTURE, "F2")
    assert statement.pattern.name == "bias.x"
    assert statement.since_s is not None
    assert statement.since_interval_s is not None
    assert abs(statement.since_s / 86400 - 80) < 4
    assert statement.since_interval_s[0] <= 80 * 86400 <= statement.since_interval_s[1] + 2 * 86400
    assert statement.until_s is None
    assert statement.runs == acts.sum()


def test_a_broken_unit_and_a_unit_that_is_measured_often_are_no_effect_of_a_place() -> None:
    places = [("S1", "F1") if i % 2 else ("S2", "F2") for i in range(100)]
    runs = runs_at(places, np.array([60.0 if i == 50 else 0.0 for i in range(100)]))
    golden = [replace(runs[7], time_s=86400.0 * i, station="S2", fixture="F2") for i in range(0, 100, 5)]
    rng = np.random.default_rng(5)
    golden = [replace(g, coefficients=g.coefficients + rng.normal(size=9) * 1e-5) for g in golden]
    assert placed_effects([*runs, *golden]).statements == ()


@pytest.mark.parametrize("seed", range(70, 78))
def test_a_broken_unit_among_the_last_runs_is_no_drift_of_a_place(seed: int) -> None:
    assert placed_effects(with_broken_end(small(seed, 0), seed).runs).statements == ()


def test_equal_coefficients_have_no_spread_and_no_effect() -> None:
    runs = runs_at([("S1", "F1") if i % 2 else ("S2", "F2") for i in range(70)], np.zeros(70))
    found = placed_effects([replace(run, coefficients=runs[0].coefficients) for run in runs])
    assert (found.statements, found.candidates, found.runs) == ((), (), 70)


def test_a_drift_counts_the_runs_after_its_begin() -> None:
    rng = np.random.default_rng(6)
    places = [("S1", str(rng.choice(["F1", "F2"]))) for _ in range(200)]
    inside = np.array([fixture == "F2" for _, fixture in places])
    ramp = np.clip((np.arange(200) - 100) / 100, 0.0, None)
    (statement,) = placed_effects(runs_at(places, 12.0 * ramp * inside)).statements
    assert statement.pattern.form is Form.DRIFT
    assert statement.since_s is not None
    assert abs(statement.since_s / 86400 - 100) < 30
    assert statement.runs == np.sum(inside & (86400.0 * np.arange(200) > statement.since_s))


def test_a_place_is_listed_alone_only_where_it_is_certain() -> None:
    rest = dict.fromkeys("bcde", 0.004)
    assert list(_listed({"a": 0.992} | rest, 0.99)) == ["a"]
    assert list(_listed({"a": 0.984} | rest, 0.99)) == ["a", "b"]


def test_repeated_units_tell_a_small_shift_that_different_units_hide() -> None:
    """A shift of a fifth of the spread: units that were measured at both stations show it."""
    places = [("S1", "F1")] * 60
    runs = runs_at(places, np.zeros(60))
    rng = np.random.default_rng(3)

    def again(run: UnitRun, shift: float) -> UnitRun:
        moved = run.coefficients + np.eye(9)[6] * shift + rng.normal(size=9) * 1e-5
        return replace(run, coefficients=moved, station="S2", fixture="F1", time_s=run.time_s + 3600)

    shifted = placed_effects([*runs, *(again(run, 2e-4) for run in runs[:40])])
    (statement,) = shifted.statements
    # Of two stations nothing shows which one is right.
    assert {place.name for place in statement.places} == {"S1", "S2"}
    (change,) = statement.sizes.values()
    assert abs(abs(change.value) - 2e-4) < 3 * change.uncertainty < 1e-4
    assert placed_effects([*runs, *(again(run, 0.0) for run in runs[:40])]).statements == ()
    others = runs_at([("S1", "F1") if i < 60 else ("S2", "F1") for i in range(100)], np.repeat([0.0, 0.2], [60, 40]))
    assert placed_effects(others).statements == ()


def test_runs_of_too_few_units_are_refused_and_rare_part_numbers_left_out() -> None:
    runs = runs_at([("S1", "F1")] * 59, np.zeros(59))
    with pytest.raises(tc.InvalidData, match="need 60"):
        placed_effects(runs)
    more = runs_at([("S1", "F1")] * 70, np.zeros(70))
    rare = [replace(run, part_number="rare") for run in runs[:8]]
    found = placed_effects([*more, *rare])
    assert (found.runs, found.omitted) == (70, 8)


def test_the_order_of_the_runs_makes_no_difference() -> None:
    made = small(3, 1, "one coefficient")
    assert repr(placed_effects(made.runs)) == repr(placed_effects(made.runs[::-1]))


def found_in(made: World) -> PlacedEffects:
    return placed_effects(made.runs)


@pytest.mark.slow
@pytest.mark.parametrize("what", KINDS)
def test_each_kind_of_effect_is_named_or_listed_in_a_year_of_units(what: str) -> None:
    """At the size of the benchmark, by the figures that show it."""
    made = world(41, 1, kinds=(what,), sizes=(4.0, 8.0))
    found = found_in(made)
    judgement = judged(made, 0, found)
    assert judgement.listed, (made.truths, found)
    assert judgement.pattern, (made.truths, found)
    if judgement.since_off_s is not None:
        assert abs(judgement.since_off_s) < 0.05 * YEAR_S


@pytest.mark.slow
def test_worlds_without_an_effect_are_silent() -> None:
    assert [found_in(world(seed)).statements for seed in range(60, 66)] == [()] * 6
