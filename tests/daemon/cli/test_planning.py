"""plan: what a recording still lacks, what it is wanted for, and plans that nobody could carry out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.plan import directions

Run = Callable[..., Any]
HZ, HOLD = 50, 80
"""Samples a second, and samples to a pose."""


def _csv(path: Path, ups: list[Any]) -> Path:
    """A triad of three positive scale factors, still with each of ``ups`` up in turn."""
    rng = np.random.default_rng(7)
    up = np.repeat(np.array(ups), HOLD, axis=0)
    readings = up * [2.0, 2.1, 1.9] + 0.01 + 2e-5 * rng.standard_normal(up.shape)
    lines = [f"{i / HZ:.2f},{x:.7f},{y:.7f},{z:.7f}" for i, (x, y, z) in enumerate(readings)]
    path.write_text("\n".join(["t_s,ux,uy,uz", *lines]) + "\n")
    return path


@pytest.fixture
def half(tmp_path: Path) -> Path:
    """Poses enough for a fit, and none with X up."""
    return _csv(tmp_path / "half.csv", [v for _, v in directions(26) if v[0] < 0.4])


@pytest.fixture
def fourteen(tmp_path: Path) -> Path:
    return _csv(tmp_path / "fourteen.csv", [v for _, v in directions(14)])


def _x_of(document: Any) -> list[float]:
    assert document["poses"]
    return [p["up"][0] for p in document["poses"]]


def test_the_recording_may_follow_the_effects_that_it_is_wanted_for(half: Path, triaxcal: Run) -> None:
    plain = triaxcal("plan", half, "--json").json
    for effects in (["second_order_nonlinearity"], ["temperature_bias", "second_order_nonlinearity"]):
        after = triaxcal("plan", "--json", "--for", *effects, half)
        before = triaxcal("plan", half, "--json", "--for", *effects)
        assert (after.code, after.err) == (0, "")
        assert after.json == before.json
        assert (after.json["have"], after.json["blind_to"]) == (plain["have"], plain["blind_to"])
        assert [p["label"] for p in after.json["poses"]][: len(plain["poses"])] == [p["label"] for p in plain["poses"]]


def test_poses_that_cannot_show_an_effect_are_told_which_others_do(fourteen: Path, triaxcal: Run) -> None:
    plain = triaxcal("plan", fourteen, "--json").json
    assert plain["poses"] == []
    assert "third_order_nonlinearity" in plain["blind_to"]
    wanted = triaxcal("plan", "--for", "third_order_nonlinearity", fourteen, "--json").json["poses"]
    assert {p["label"] for p in wanted} == {label for label, _ in directions(26)[14:]}
    shown = triaxcal("plan", "--for", "second_order_nonlinearity", fourteen, "--json").json
    assert shown["poses"] == []


@pytest.mark.parametrize("name", ["missing.csv", "missing.mcap", "missing.csv.gz"])
def test_a_recording_that_is_not_there_is_no_unknown_effect(tmp_path: Path, triaxcal: Run, name: str) -> None:
    path = tmp_path / name
    triaxcal("plan", "--for", "second_order_nonlinearity", path).failed(2, f"{path}: ", "No such file or directory")


def test_an_effect_that_nobody_knows_is_named(half: Path, triaxcal: Run) -> None:
    triaxcal("plan", "--for", "flat_earth", half).failed(2, "--for flat_earth: no effect of that name; known: ")
    triaxcal("plan", half, "--for", "flat_earth").failed(2, "--for flat_earth: no effect of that name; known: ")
    triaxcal("plan", "--for", half, "flat_earth").failed(2, f"--for {half}: no effect of that name")


def test_the_signs_decide_which_way_is_up(half: Path, triaxcal: Run) -> None:
    assert min(_x_of(triaxcal("plan", half, "--json").json)) > 0
    assert min(_x_of(triaxcal("plan", half, "--json", "--sign=+,+,+").json)) > 0
    assert max(_x_of(triaxcal("plan", half, "--json", "--sign=-,+,+").json)) < 0


def test_the_size_of_the_reference_does_not_change_the_plan(half: Path, triaxcal: Run) -> None:
    plain = triaxcal("plan", half, "--json")
    assert triaxcal("plan", half, "--json", "--reference", "50").json == plain.json


def test_the_signs_and_the_reference_are_those_of_the_recording(
    finished_run: Any, rewrite: Callable[..., Path], triaxcal: Run
) -> None:
    """A station of other signs than its profile's."""
    turned = rewrite(
        finished_run.can,
        metadata=lambda name, record: {**record, "signs": "1,1,1"} if name == "unit" else record,
    )
    assert triaxcal("plan", turned, "--json").json["poses"] == []
    fitted = triaxcal("fit", turned, "--json").json
    assert all(k > 0 for k in fitted["scale_factor"])


@pytest.mark.parametrize("poses", ["1001", "9999999", "99999999999999999999999"])
def test_more_poses_than_anybody_would_take_are_refused(triaxcal: Run, poses: str) -> None:
    triaxcal("plan", "--poses", poses, "--json").failed(2, f"--poses {poses}: at most 1000")
