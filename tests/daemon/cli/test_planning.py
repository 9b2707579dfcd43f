"""plan: what a recording still lacks, what it is wanted for, and plans that nobody could carry out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import cube_directions, dilution, directions

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


@pytest.fixture(scope="module")
def folder(once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        _csv(folder / "half.csv", [v for _, v in directions(26) if v[0] < 0.4])
        _csv(folder / "fourteen.csv", [v for _, v in directions(14)])

    return once("planning", make)


@pytest.fixture
def half(folder: Path) -> Path:
    """Poses enough for a fit, and none with X up."""
    return folder / "half.csv"


@pytest.fixture
def fourteen(folder: Path) -> Path:
    return folder / "fourteen.csv"


def _x_of(document: Any) -> list[float]:
    assert document["poses"]
    return [p["up"][0] for p in document["poses"]]


@pytest.mark.slow
def test_the_recording_may_follow_the_effects_that_it_is_wanted_for(half: Path, triaxcal: Run, asked: Run) -> None:
    plain = asked("plan", half, "--json").json
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
    assert plain["sees"]["third_order_nonlinearity"]["visible"] == 1
    document = triaxcal("plan", "--for", "third_order_nonlinearity", fourteen, "--json").json
    edges = [label for label, v in directions(26) if np.sum(np.abs(v) > 0.1) == 2]
    assert {p["label"] for p in document["poses"]} <= set(edges)
    assert document["promised"]["third_order_nonlinearity"] == {"x": None, "y": None, "z": None}
    after = [p["promised"]["third_order_nonlinearity"]["x"] for p in document["poses"]]
    assert 0 < after[-1] < 1e-4
    shown = triaxcal("plan", "--for", "second_order_nonlinearity", fourteen, "--json").json
    assert shown["poses"] == []
    assert all(v is not None for v in shown["promised"]["second_order_nonlinearity"].values())


def test_what_each_added_pose_would_do_is_said(half: Path, triaxcal: Run, asked: Run) -> None:
    document = asked("plan", half, "--json").json
    worst = [of["worst_standard_error"] for of in (document, *document["poses"])]
    assert worst == sorted(worst, reverse=True)
    assert worst[-1] <= 1.25 < worst[-2]
    fitted = triaxcal("fit", half, "--json").json
    noise = np.median([p["standard_error_g"] for p in fitted["poses"]])
    # The noise of a typical pose, raised where the residuals are larger than it explains.
    assert 0.99 < document["poses"][-1]["standard_error_g"] / worst[-1] / noise < 1.5
    assert document["poses"][-1]["standard_error_g"] == pytest.approx(worst[-1] * document["noise_g"], rel=1e-4)


def test_the_same_poses_have_the_same_dilution_in_a_plan_and_in_a_fit(tmp_path: Path, triaxcal: Run) -> None:
    edges = [v for _, v in cube_directions() if np.sum(np.abs(v) > 0.1) == 2]
    path = _csv(tmp_path / "edges.csv", edges)
    planned, fitted = triaxcal("plan", path, "--json").json, triaxcal("fit", path, "--json").json
    assert planned["dilution"] == pytest.approx(fitted["dilution"], rel=1e-5)
    # Scaled by what the axes went through, which is 0.71 g either way; at the whole of g the errors are larger.
    assert planned["dilution"] == pytest.approx(dilution(np.array(edges)), rel=0.01)
    assert planned["worst_standard_error"] > 1.4 * planned["dilution"]
    whole = _csv(tmp_path / "whole.csv", [v for _, v in directions(14)])
    plain, fitted = triaxcal("plan", "--poses", "14", "--json").json, triaxcal("fit", whole, "--json").json
    assert plain["dilution"] == pytest.approx(fitted["dilution"], rel=0.03)  # its first pose is there twice


@pytest.mark.slow
def test_what_cannot_show_is_said_in_words(tmp_path: Path, fourteen: Path, triaxcal: Run) -> None:
    """Directions that are a degree off tell the third order by next to nothing."""
    rng = np.random.default_rng(2)
    off = [v + 0.02 * rng.standard_normal(3) for _, v in directions(14)]
    path = _csv(tmp_path / "off.csv", [v / np.linalg.norm(v) for v in off])
    for recording in (path, fourteen):
        arguments = ("plan", recording, "--for", "third_order_nonlinearity", "temperature_bias")
        document = triaxcal(*arguments, "--json").json
        nothing = dict.fromkeys("xyz")
        assert document["promised"] == {"third_order_nonlinearity": nothing, "temperature_bias": nothing}
        said = document["cannot_show"]
        assert "the poses there cannot tell x, y, z from the other parameters" in said["third_order_nonlinearity"]
        assert "with the poses to add they can" in said["third_order_nonlinearity"]
        assert "the recording has no channel temp_c" in said["temperature_bias"]
        assert all(line in triaxcal(*arguments).out.replace("\n", " ") for line in said.values())
        assert 0 < document["poses"][-1]["promised"]["third_order_nonlinearity"]["x"] < 1e-4
    seen = triaxcal("plan", fourteen, "--for", "second_order_nonlinearity", "--json").json
    assert seen["cannot_show"] == {}


@pytest.mark.slow
def test_the_poses_wanted_of_a_recording_that_is_refused_mend_it(tmp_path: Path, triaxcal: Run) -> None:
    faces = [v for label, v in directions(14) if len(label) == 2]
    where = dict(directions(26))
    for name, ups in {"none": faces[:1], "four": faces[:4], "faces": faces * 2}.items():
        path = _csv(tmp_path / f"{name}.csv", ups)
        assert triaxcal("fit", path, "--json").code == 3
        document = triaxcal("plan", path, "--json").json
        assert document["dilution"] is document["blind_to"] is document["sees"] is None
        mended = _csv(tmp_path / f"{name}-mended.csv", [*ups, *(where[p["label"]] for p in document["poses"])])
        after = triaxcal("plan", mended, "--json").json
        assert after["dilution"] < 2.3
        assert triaxcal("fit", mended, "--json").code == 0


def test_a_channel_that_is_not_logged_is_asked_for(fourteen: Path, triaxcal: Run) -> None:
    document = triaxcal("plan", fourteen, "--for", "temperature_bias", "--json").json
    assert document["moves"] == {"temp_c": "is not in the recording: log it, and move it"}
    assert document["poses"] == []


# Plans for effects


def _plan(triaxcal: Run, *arguments: str) -> Any:
    done = triaxcal("plan", *arguments, "--json")
    assert (done.code, done.err) == (0, "")
    return done.json


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poses", "effects"),
    [
        (20, ["third_order_nonlinearity"]),
        (14, ["third_order_nonlinearity"]),
        (17, ["second_order_nonlinearity", "third_order_nonlinearity"]),
        (16, ["temperature_scale_factor"]),
        (15, ["bias_drift"]),
    ],
)
def test_a_plan_for_effects_has_as_many_directions_as_asked_for_and_shows_them(
    triaxcal: Run, poses: int, effects: list[str]
) -> None:
    document = _plan(triaxcal, "--poses", str(poses), "--for", *effects)
    assert document["directions"] == poses
    assert len(document["poses"]) == poses + 1
    assert len({p["label"] for p in document["poses"]}) == len({tuple(p["up"]) for p in document["poses"]}) == poses
    assert document["for"] == effects
    assert not set(effects) & set(document["blind_to"])
    assert 0.7 < document["efficiency"] <= 1
    for effect in effects:
        assert document["sees"][effect]["visible"] == document["sees"][effect]["of"]
        assert all(0 < v < 4 for v in document["promised"][effect].values())


@pytest.mark.slow
def test_a_plan_for_temperature_says_how_it_has_to_move(triaxcal: Run) -> None:
    document = _plan(triaxcal, "--poses", "16", "--for", "temperature_bias")
    levels = [p["levels"]["temp_c"] for p in document["poses"]]
    assert set(levels) == {-1.0, 1.0}
    assert levels[0] == levels[-1]
    assert (
        "lowest for poses 1 to 5, highest for poses 6 to 13, lowest for poses 14 to 17" in document["moves"]["temp_c"]
    )
    assert "t_s" in _plan(triaxcal, "--poses", "15", "--for", "bias_drift")["moves"]


@pytest.mark.slow
def test_effects_that_share_a_part_are_warned_of(triaxcal: Run) -> None:
    done = triaxcal("plan", "--poses", "16", "--for", "temperature_bias", "temperature_bias_quadratic", "--json")
    assert done.code == 0
    assert "the effects asked for share 3 combinations of coefficients" in done.err
    assert done.json["together"] == {"visible": 6, "of": 9}
    assert done.json["promised"]["temperature_bias"]["x"] is None


@pytest.mark.slow
def test_the_same_effect_twice_is_asked_for_once(triaxcal: Run) -> None:
    twice = _plan(triaxcal, "--poses", "14", "--for", "second_order_nonlinearity", "second_order_nonlinearity")
    assert twice["for"] == ["second_order_nonlinearity"]


def test_too_few_poses_for_the_effects_are_refused_with_the_number_that_does(triaxcal: Run) -> None:
    words = ("a plan of 11 poses cannot show third_order_nonlinearity; at least 12",)
    triaxcal("plan", "--poses", "11", "--for", "third_order_nonlinearity").failed(3, *words)
    assert _plan(triaxcal, "--poses", "12", "--for", "third_order_nonlinearity")["directions"] == 12


@pytest.mark.slow
def test_people_read_the_same(triaxcal: Run, fourteen: Path) -> None:
    out = triaxcal("plan", "--poses", "14").out
    assert "14 directions, the first repeated at the end" in out
    assert "third_order_nonlinearity: 1 of 3 coefficients show" in out
    out = triaxcal("plan", "--poses", "16", "--for", "temperature_bias").out
    assert "of what any plan of as many poses could tell of temperature_bias" in out
    assert "temp_c: over as wide a range as can be had: lowest for poses 1 to" in out
    assert "worst parameter then" in triaxcal("plan", fourteen, "--for", "third_order_nonlinearity").out


# What cannot be


@pytest.mark.parametrize("name", ["missing.csv", "missing.mcap", "missing.csv.gz"])
def test_a_recording_that_is_not_there_is_no_unknown_effect(tmp_path: Path, triaxcal: Run, name: str) -> None:
    path = tmp_path / name
    triaxcal("plan", "--for", "second_order_nonlinearity", path).failed(2, f"{path}: ", "No such file or directory")


def test_an_effect_that_nobody_knows_is_named(half: Path, triaxcal: Run) -> None:
    triaxcal("plan", "--for", "flat_earth", half).failed(2, "--for flat_earth: no effect of that name; known: ")
    triaxcal("plan", half, "--for", "flat_earth").failed(2, "--for flat_earth: no effect of that name; known: ")
    triaxcal("plan", "--for", half, "flat_earth").failed(2, f"--for {half}: no effect of that name")


def test_the_signs_decide_which_way_is_up(half: Path, triaxcal: Run, asked: Run) -> None:
    assert min(_x_of(asked("plan", half, "--json").json)) > 0
    assert min(_x_of(triaxcal("plan", half, "--json", "--sign=+,+,+").json)) > 0
    assert max(_x_of(triaxcal("plan", half, "--json", "--sign=-,+,+").json)) < 0


def test_the_size_of_the_reference_does_not_change_the_plan(half: Path, triaxcal: Run, asked: Run) -> None:
    plain = asked("plan", half, "--json")
    assert triaxcal("plan", half, "--json", "--reference", "50").json == plain.json


@pytest.mark.slow
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


def test_a_plan_for_effects_has_two_hundred_poses_at_most(triaxcal: Run) -> None:
    arguments = ("--poses", "201", "--for", "bias_drift")
    triaxcal("plan", *arguments).failed(2, "--poses 201: at most 200 with --for")
