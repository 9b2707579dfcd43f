"""The search: steps that earn their place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import stats

from triaxcal.effects import TIME, effect_named
from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.loop import diagnose
from triaxcal.poses.pose import Pose
from triaxcal.search import Search
from triaxcal.sensor import Sensor

Recorded = Callable[..., list[Pose]]
Searched = Callable[..., Search]
SECOND, WARMTH = effect_named("second_order_nonlinearity"), effect_named("temperature_bias")


def test_what_is_there_is_found_and_no_more(search: Search) -> None:
    assert [e.name for e in search.run()] == ["second_order_nonlinearity"]
    assert search.found.chi2 < stats.chi2.isf(1e-3, 14)


def test_a_catalogue_without_the_truth_names_nothing_that_explains_little(
    poses: list[Pose], searched: Searched
) -> None:
    others = [effect_named(n) for n in ("temperature_bias", "temperature_scale_factor", "bias_drift")]
    search = searched(poses, others)
    assert search.run() == []
    assert search.passed_over
    assert all(search.passed_over.values())


def test_nothing_is_searched_where_no_effect_is_known(poses: list[Pose], searched: Searched) -> None:
    search = searched(poses, [])
    assert search.run() == []
    assert search.tests == 1.0


def test_two_effects_that_hide_each_other_are_found_together(paper_unit: Sensor, recorded: Recorded) -> None:
    """A drift and a temperature that rises and falls back: neither explains nine tenths of what is there."""
    t = np.arange(26)
    rng = np.random.default_rng(2)
    temp = 25 + 3 * np.cos(2 * np.pi * t / 11) + 0.3 * rng.standard_normal(26)
    sensor = replace(
        paper_unit, effects=((WARMTH, np.array([2e-4, 1e-4, -2e-4])), (BiasDrift(), np.array([4e-6, -5e-6, 4e-6])))
    )
    loop = diagnose(recorded(sensor, 2, channels={"temp_c": temp}), signs=(-1, -1, -1))
    names = [{f.effect, *f.alternatives} for f in loop.findings]
    assert len(names) == 2
    for truth in ("temperature_bias", "bias_drift"):
        assert any(truth in n for n in names)
    assert not loop.unexplained.significant


def test_time_is_among_the_conditions_of_the_search(search: Search) -> None:
    assert TIME in search.problem.channel_reference
    assert search.still >= {"scatter_x", "scatter_y", "scatter_z"}
