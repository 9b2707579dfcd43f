"""Which recording would tell two names apart: it is made, and it does."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from triaxcal.effects import effect_named
from triaxcal.loop import diagnose
from triaxcal.poses.pose import Pose
from triaxcal.search import Model, Search, telling_apart
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

Recorded = Callable[..., list[Pose]]
Searched = Callable[..., Search]
MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
SQUARE, ASYMMETRY = effect_named("second_order_nonlinearity"), effect_named("scale_factor_asymmetry")
CROSS = effect_named("cross_coupling")
ADVICE = re.compile(r"add poses with up at (.*?): there it differs from (\w+) by .*, which would")


def advised(line: str) -> tuple[np.ndarray, str]:
    """Directions (k,3), and the name to be told."""
    found = ADVICE.match(line)
    assert found is not None, line
    up = np.array([[float(v) for v in one.split(", ")] for one in re.findall(r"\(([^)]*)\)", found[1])])
    return up / np.linalg.norm(up, axis=1, keepdims=True), found[2]


def test_the_poses_that_are_asked_for_tell_two_nonlinearities_apart(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """In nineteen of twenty recordings."""
    told = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        sensor = replace(paper_unit, effects=((SQUARE, 1e-3 * np.eye(3)[rng.integers(3)]),))
        ups = fourteen[rng.permutation(14)] + 0.05 * rng.standard_normal((14, 3))
        poses = noisy_poses(sensor, ups / np.linalg.norm(ups, axis=1, keepdims=True), SIGMA_G, rng)
        (finding,) = diagnose(poses, signs=MINUS).findings
        for line in (a for a in finding.apart if a.startswith("add poses")):
            more, name = advised(line)
            taken = noisy_poses(sensor, more, SIGMA_G, rng)
            later = [replace(p, start_s=p.start_s + 1e3, end_s=p.end_s + 1e3) for p in taken]
            loop = diagnose([*poses, *later], signs=MINUS)
            listed = {n for f in loop.findings for n in (f.effect, *f.alternatives)}
            told.append(not {finding.effect, name} <= listed)
    assert len(told) >= 3
    assert sum(told) >= len(told) - 1


def test_poses_are_asked_for_where_the_other_model_has_more_parameters_than_there_are_poses(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    sensor = replace(paper_unit, effects=((SQUARE, np.array([1e-3, 0.0, 0.0])),))
    search = searched(recorded(sensor, 0, where=fourteen), [SQUARE])
    found = search.model([SQUARE])
    assert found is not None
    search.found = found
    other = Model((CROSS,), search.linear.state.extended([CROSS]), found.chi2, found.price)
    (line,) = telling_apart(search, SQUARE, {CROSS.name: other})
    assert line.startswith("add poses with up at (")


def test_how_many_it_takes_goes_by_what_the_other_model_can_still_make_of_them(
    paper_unit: Sensor, fourteen: np.ndarray, recorded: Recorded, searched: Searched
) -> None:
    asked = []
    for size in (3e-3, 6e-4, 2e-5):
        sensor = replace(paper_unit, effects=((SQUARE, np.array([size, 0.0, 0.0])),))
        search = searched(recorded(sensor, 0, where=fourteen), [SQUARE, ASYMMETRY])
        found, other = search.model([SQUARE]), search.model([ASYMMETRY])
        assert found is not None
        assert other is not None
        search.found = found
        (line,) = telling_apart(search, SQUARE, {ASYMMETRY.name: other})
        asked.append(np.inf if line.endswith("hardly tell") else len(advised(line)[0]))
    assert asked[0] == 3
    assert 3 < asked[1] <= 12
    assert asked[2] == np.inf
