"""poses, fit, diagnose, verify, plan: one JSON document with every key of the contract, and the exit codes."""

from __future__ import annotations

import gzip
import io
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcald.cli.showing import judge

Run = Callable[..., Any]

RESIDUAL = {
    "rms_g", "max_abs_g", "cross_validated_rms_g", "noise_floor_g", "lack_of_fit_p", "weighted_rms", "reduced_chi2",
}  # fmt: skip
CALIBRATION = {
    "format", "terms", "units", "scale_factor", "misalignment", "bias", "matrix", "centre", "effects",
    "standard_error", "residual", "poses", "condition", "blind_to", "warnings", "holds_at", "next_recording",
}  # fmt: skip
LOOP = {
    "format", "call", "summary", "before", "after", "findings", "candidates", "probabilities", "nothing_probability",
    "another_unit", "not_corrected", "choices", "unexplained", "data_quality", "advice", "calibration", "traces",
    "notes",
}  # fmt: skip
UNEXPLAINED = {
    "significant", "probability", "kind", "rms_g", "lead", "p_value", "or_spoiled", "or_named", "only_inside",
}  # fmt: skip
SHAPES = {"time_constant", "at", "knee"}
SIGNS = "--sign=-,-,-"


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _all_finite(document: Any) -> None:
    found = list(_numbers(document))
    assert found
    assert all(math.isfinite(v) for v in found)


def _likeliest(document: Any) -> Any:
    """The one name of 0.5 or more, which is second order: a finding where no other would do, else a candidate."""
    (found,) = [*document["findings"], *document["candidates"]]
    assert found["effect"] == next(iter(document["probabilities"])) == "second_order_nonlinearity"
    probability = found["probability"]
    assert probability == document["probabilities"][found["effect"]]
    assert probability >= 0.5 if found.get("verdict") == "adopted" else probability is None
    return found


def _is_calibration(document: Any, effects: set[str]) -> None:
    assert document["format"] == "triaxcal.calibration/1"
    assert set(document) >= CALIBRATION
    assert document["terms"] == ["linear", *document["effects"]]
    assert set(document["effects"]) == effects
    for name in ("scale_factor", "misalignment", "bias", "centre"):
        assert np.shape(document[name]) == (3,)
    assert np.shape(document["matrix"]) == (3, 3)
    assert {k: np.shape(v) for k, v in document["standard_error"].items()} == {
        "scale_factor": (3,), "misalignment": (3,), "bias": (3,)
    }  # fmt: skip
    for coefficients in document["effects"].values():
        assert 0 < coefficients["weight"] <= 1
        for name in set(coefficients) - {"weight"}:
            held = coefficients[name]
            assert set(held) == {"value", "standard_error", "unit"}
            assert (name in SHAPES and held["standard_error"] is None) or held["standard_error"] > 0
    assert set(document["residual"]) == RESIDUAL
    for pose in document["poses"]:
        assert set(pose) >= {"start_s", "end_s", "mean", "residual_g", "studentized", "leverage", "used"}
        assert pose["end_s"] > pose["start_s"]
        assert np.shape(pose["mean"]) == (3,)
        assert 0 < pose["leverage"] <= 1
        assert (pose["used"], pose["excluded"]) == (True, None)
    for name in ("blind_to", "warnings"):
        assert all(isinstance(text, str) for text in document[name])
    _all_finite(document)


def test_poses_of_a_recording(finished_run: Any, triaxcal: Run) -> None:
    done = triaxcal("poses", finished_run.can, "--json")
    assert (done.code, done.err) == (0, "")
    assert done.json["format"] == "triaxcal.poses/1"
    assert len(done.json["poses"]) >= 26
    for pose in done.json["poses"]:
        assert set(pose) == {"start_s", "end_s", "samples", "mean", "standard_error", "channels", "used", "fault"}
        assert (pose["used"], pose["fault"]) == (True, None)
        assert np.shape(pose["mean"]) == np.shape(pose["standard_error"]) == (3,)
        assert pose["samples"] > 0
        assert "temp_c" in pose["channels"]
    _all_finite(done.json)


def test_fit_of_a_recording_takes_signs_and_unit_from_its_profile(finished_run: Any, asked: Run) -> None:
    done = asked("fit", finished_run.can, "--json")
    assert (done.code, done.err) == (0, "")
    _is_calibration(done.json, effects=set())
    assert all(k < 0 for k in done.json["scale_factor"])
    assert done.json["units"] == {
        "output": "V", "reference": "g", "scale_factor": "V/g", "misalignment": "rad", "bias": "g"
    }  # fmt: skip


def test_fit_of_the_exported_text_is_fit_of_the_recording(
    finished_run: Any, exported: Path, triaxcal: Run, asked: Run
) -> None:
    of_recording = asked("fit", finished_run.can, "--json").json
    of_text = triaxcal("fit", exported, "--json", SIGNS, "--output-unit", "V").json
    of_text.pop("data_quality")
    of_recording.pop("data_quality")
    assert of_recording.pop("unit") == {"name": "can", "serial": "4711"}
    assert of_text == of_recording


@pytest.mark.slow
def test_text_may_be_compressed_or_come_through_standard_input(
    exported: Path, tmp_path: Path, triaxcal: Run, asked: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = asked("fit", exported, "--json", SIGNS)
    packed = tmp_path / "a.csv.gz"
    packed.write_bytes(gzip.compress(exported.read_bytes(), 1))
    assert triaxcal("fit", packed, "--json", SIGNS).json == plain.json
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(exported.read_bytes())))
    assert triaxcal("fit", "-", "--json", SIGNS).json == plain.json


def test_signs_turn_the_calibration_round(exported: Path, asked: Run) -> None:
    plus = asked("fit", exported, "--json").json
    minus = asked("fit", exported, "--json", SIGNS).json
    np.testing.assert_allclose(plus["scale_factor"], -np.array(minus["scale_factor"]), rtol=1e-9)
    np.testing.assert_allclose(plus["bias"], -np.array(minus["bias"]), rtol=1e-9)
    np.testing.assert_allclose(plus["centre"], minus["centre"], rtol=1e-9)


def test_another_reference_scales_the_answer(exported: Path, triaxcal: Run, asked: Run) -> None:
    one = asked("fit", exported, "--json").json
    fifty = triaxcal("fit", exported, "--json", "--reference", "50").json
    np.testing.assert_allclose(fifty["scale_factor"], np.array(one["scale_factor"]) / 50, rtol=1e-9)
    np.testing.assert_allclose(fifty["misalignment"], one["misalignment"], rtol=1e-6)
    # Errors are rounded in documents: the one to a billionth (half of it off), fifty times the other's 1e-11 as well.
    assert fifty["residual"]["rms_g"] == pytest.approx(50 * one["residual"]["rms_g"], abs=0.5e-9 + 50 * 0.5e-11 + 1e-12)


@pytest.mark.slow
def test_what_diagnose_finds_does_not_hang_on_the_size_of_the_reference(exported: Path, asked: Run) -> None:
    """A power of ten: the force below which a sign is not certain (remanence, hysteresis) goes by powers of ten."""
    one, hundred = (asked("diagnose", exported, "--json", SIGNS, *r).json for r in ([], ["--reference", "100"]))
    before, after = _likeliest(one), _likeliest(hundred)
    assert hundred["probabilities"] == one["probabilities"]
    for axis, held in before["coefficients"].items():
        assert after["coefficients"][axis]["value"] == pytest.approx(held["value"] / 100, rel=1e-6)
    # Errors are rounded in documents, here to a billionth.
    assert hundred["after"]["rms_g"] == pytest.approx(100 * one["after"]["rms_g"], abs=1e-9)


@pytest.mark.slow
def test_results_go_to_files_and_are_the_printed_document(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    cal, report = tmp_path / "cal.json", tmp_path / "r.html"
    done = triaxcal("fit", finished_run.can, "--json", "-o", cal, "--report", report)
    assert done.code == 0
    assert cal.read_text() == done.out
    page = report.read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert f"<h1>{finished_run.can.name}</h1>" in page
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cal.json", "r.html"]


@pytest.mark.slow
def test_diagnose_finds_what_is_hidden_and_judges_it_on_another_recording(
    finished_run: Any, exported: Path, tmp_path: Path, triaxcal: Run
) -> None:
    options = ("--json", SIGNS, "--output-unit", "V", "-o", tmp_path / "cal.json")
    done = triaxcal("diagnose", finished_run.can, "--check", exported, *options)
    document = done.json
    assert (done.code, done.err) == (0, "")
    assert document["format"] == "triaxcal.loop/1"
    assert set(document) == LOOP | {"held_out", "unit"}
    assert set(document["before"]) == set(document["after"]) == RESIDUAL
    assert set(document["held_out"]) == {"before_rms_g", "after_rms_g", "noise_floor_g", "poses", "contradicts"}
    assert document["held_out"]["contradicts"] is None
    assert document["held_out"]["poses"] >= 26
    assert document["held_out"]["after_rms_g"] < 0.5 * document["held_out"]["before_rms_g"]
    found = _likeliest(document)["coefficients"]
    for axis, truth in {"x": 5e-4, "y": -4e-4, "z": 3e-4}.items():
        assert abs(found[axis]["value"] - truth) < 5 * found[axis]["standard_error"]
    # On exact directions even functions of the force differ little: by that the poses tell them, or not.
    likely = {name for name, p in document["probabilities"].items() if p is None or p >= 0.01}
    assert likely <= {"second_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling", "compression"}
    assert set(document["unexplained"]) == UNEXPLAINED
    assert document["unexplained"]["significant"] is False
    assert document["after"]["rms_g"] < 0.5 * document["before"]["rms_g"]
    calibration = document["calibration"]
    assert calibration["terms"][1] == "second_order_nonlinearity"
    _is_calibration(calibration, effects=likely & set(calibration["terms"]))
    assert calibration["linear_only"]["terms"] == ["linear"]
    assert calibration["linear_only"]["residual"] == document["before"]
    assert json.loads((tmp_path / "cal.json").read_text()) == document


def test_without_a_check_there_is_no_held_out_error(exported: Path, asked: Run) -> None:
    document = asked("diagnose", exported, "--json", SIGNS).json
    assert set(document) == LOOP


@pytest.mark.slow
def test_verify_judges_a_recording_by_a_calibration(finished_run: Any, calibrations: Path, triaxcal: Run) -> None:
    linear, closed = calibrations / "linear.json", calibrations / "closed.json"
    fitted = json.loads(linear.read_text())
    done = triaxcal("verify", linear, finished_run.can, "--json")
    assert (done.code, done.err) == (0, "")
    keys = {"format", "rms_g", "max_abs_g", "noise_floor_g", "expected_rms_g", "poses", "data_quality", "warnings"}
    assert set(done.json) == keys
    assert done.json["noise_floor_g"] < done.json["expected_rms_g"]
    _all_finite(done.json)
    assert done.json["rms_g"] == pytest.approx(fitted["residual"]["rms_g"], rel=0.05)
    assert len(done.json["poses"]) == len(fitted["poses"])
    certificate = finished_run.unit("can")["certificate"]
    by_closed = triaxcal("verify", closed, finished_run.can, "--json").json
    assert by_closed["rms_g"] < 0.5 * done.json["rms_g"]
    assert triaxcal("verify", certificate, finished_run.can, "--json").json == by_closed


@pytest.mark.slow
@pytest.mark.parametrize("command", [["fit"], ["diagnose"], ["verify", "linear.json"]])
def test_a_limit_decides_between_0_and_1(
    finished_run: Any, calibrations: Path, triaxcal: Run, asked: Run, command: list[str]
) -> None:
    words = [calibrations / w if w.endswith(".json") else w for w in command]
    assert asked(*words, finished_run.can, "--limit", "0.01").code == 0
    outside = triaxcal(*words, finished_run.can, "--limit", "1e-9", "--json")
    assert outside.code == 1
    assert outside.err.startswith("outside the limit: rms ")
    assert outside.json["format"].startswith("triaxcal.")


def test_the_same_for_people_is_a_table_and_no_json(
    finished_run: Any, calibrations: Path, triaxcal: Run, asked: Run
) -> None:
    within = (finished_run.can, "--limit", "0.01")
    assert "bias.x" in asked("fit", *within).out
    assert "still poses in " in triaxcal("poses", finished_run.can).out
    assert "second_order_nonlinearity" in asked("diagnose", *within).out
    assert "noise floor" in asked("verify", calibrations / "linear.json", *within).out
    assert "cannot show: " in triaxcal("plan").out
    assert "none is wanted" in triaxcal("plan", finished_run.can).out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "poses"),
    [([], 26), (["--poses", "14"], 14), (["--poses", "26"], 26), (["--poses", "9"], 9), (["--poses", "40"], 40),
     (["--for", "second_order_nonlinearity"], 14), (["--for", "third_order_nonlinearity"], 26)],
)  # fmt: skip
def test_plan_in_its_forms(triaxcal: Run, arguments: list[str], poses: int) -> None:
    done = triaxcal("plan", *arguments, "--json")
    assert (done.code, done.err) == (0, "")
    assert done.json["format"] == "triaxcal.plan/1"
    assert done.json["directions"] == len({p["label"] for p in done.json["poses"]}) == poses
    assert [i for i, p in enumerate(done.json["poses"]) if p.get("repeat")] == [poses]
    assert done.json["poses"][-1]["up"] == done.json["poses"][0]["up"]
    np.testing.assert_allclose([np.linalg.norm(p["up"]) for p in done.json["poses"]], 1.0, rtol=1e-9)
    assert done.json["dilution"] > 0
    assert not set(arguments[1:]) & set(done.json["blind_to"])


def test_a_plan_that_cannot_show_what_it_is_for_is_refused(triaxcal: Run) -> None:
    done = triaxcal("plan", "--poses", "9", "--for", "third_order_nonlinearity", "--json")
    assert done.code == 3
    assert "cannot show third_order_nonlinearity" in done.err


def test_plan_names_no_pose_where_none_is_missing(finished_run: Any, triaxcal: Run) -> None:
    document = triaxcal("plan", finished_run.can, "--json").json
    assert document["have"] >= 26
    assert document["poses"] == []


def test_plan_names_the_poses_that_a_recording_still_lacks(exported: Path, tmp_path: Path, triaxcal: Run) -> None:
    """Without the poses near ±X up: with scale factors below zero an output below zero means up."""
    poses = triaxcal("poses", exported, "--json").json["poses"]
    up = [(-np.array(p["mean"])) / np.linalg.norm(p["mean"]) for p in poses]
    cut = [p for p, v in zip(poses, up, strict=True) if v[0] > 0.4]
    lines = exported.read_text().splitlines()
    kept = [
        line
        for line in lines[1:]
        if not any(p["start_s"] - 0.7 <= float(line.split(",")[0]) <= p["end_s"] + 0.7 for p in cut)
    ]
    path = tmp_path / "half.csv"
    path.write_text("\n".join([lines[0], *kept]) + "\n")
    document = triaxcal("plan", path, SIGNS, "--json").json
    assert document["have"] == len(poses) - len(cut)
    wanted = {p["label"]: p["up"] for p in document["poses"]}
    assert wanted
    assert all(v[0] > 0 for v in wanted.values()), wanted


def _remade(text: bytes, **settings: Any) -> bytes:
    """A station file with further settings at its head."""
    head, _, rest = text.decode().partition("\n")
    return "\n".join([head, *(f"{k} = {v}" for k, v in settings.items()), rest]).encode()


@pytest.mark.slow
def test_fit_and_diagnose_of_a_recording_take_its_signs_and_its_reference(
    finished_run: Any, rewrite: Callable[..., Path], triaxcal: Run
) -> None:
    path = rewrite(
        finished_run.can,
        attachment=lambda name, data: _remade(data, reference=1.002) if name == "station.toml" else data,
        metadata=lambda name, record: {**record, "signs": "1,-1,1"} if name == "unit" else record,
    )
    told = [finished_run.can, "--sign=+,-,+", "--reference", "1.002", "--json"]
    fitted = triaxcal("fit", path, "--json").json
    assert [math.copysign(1, k) for k in fitted["scale_factor"]] == [1, -1, 1]
    assert (fitted["reference"], fitted["units"]["reference"]) == (1.002, "g")
    assert fitted == triaxcal("fit", *told).json
    closed = triaxcal("diagnose", path, "--json").json
    assert [math.copysign(1, k) for k in closed["calibration"]["scale_factor"]] == [1, -1, 1]
    assert closed == triaxcal("diagnose", *told).json


def test_the_users_word_goes_before_the_recordings(finished_run: Any, triaxcal: Run) -> None:
    fitted = triaxcal("fit", finished_run.can, "--sign=+,+,-", "--reference", "1.05", "--json").json
    assert [math.copysign(1, k) for k in fitted["scale_factor"]] == [1, 1, -1]
    assert fitted["reference"] == 1.05


@pytest.mark.slow
def test_verify_accepts_what_the_calibration_was_made_with_and_nothing_else(
    finished_run: Any, tmp_path: Path, triaxcal: Run
) -> None:
    cal = tmp_path / "cal.json"
    triaxcal("fit", finished_run.can, "--reference", "1.01", "-o", cal)
    plain = triaxcal("verify", cal, finished_run.can, "--json")
    assert plain.code == 0
    same = ["--sign=-,-,-", "--reference", "1.01"]
    assert triaxcal("verify", cal, finished_run.can, *same, "--json").json == plain.json
    for option, words in (
        ("--sign=-,-,+", f"--sign: the scale factors in {cal} have other signs"),
        ("--reference=1.02", f"--reference 1.02: {cal} was made for 1.01"),
    ):
        triaxcal("verify", cal, finished_run.can, option, "--json").failed(2, words)


@pytest.mark.slow
def test_the_unit_of_another_reference_is_that_of_every_coefficient(
    exported: Path, tmp_path: Path, triaxcal: Run
) -> None:
    """A magnetometer, say; no coefficient is then in g."""
    field = ["--reference", "50", "--reference-unit", "µT", "--output-unit", "V"]
    cal = tmp_path / "cal.json"
    document = triaxcal("diagnose", exported, SIGNS, *field, "--json", "-o", cal).json
    units = {"output": "V", "reference": "µT", "scale_factor": "V/µT", "misalignment": "rad", "bias": "µT"}
    assert document["calibration"]["units"] == units
    assert re.search(r"residual rms [\d.]+e-6 µT before, [\d.]+e-6 µT after; expanded", document["summary"][2])
    held = document["calibration"]["effects"]["second_order_nonlinearity"]
    coefficients = [*_likeliest(document)["coefficients"].values(), *(held[axis] for axis in "xyz")]
    assert {c["unit"] for c in coefficients} == {"µT/µT²"}
    fitted = triaxcal("fit", exported, SIGNS, *field, "--json").json
    assert (fitted["units"], fitted["reference"]) == (units, 50)
    shown = triaxcal("diagnose", exported, SIGNS, *field, "--verbose").out
    assert "µT/µT²" in shown
    assert "V/µT" in shown
    assert "1e-6 µT" in shown
    assert "µg" not in shown
    unnamed = triaxcal("fit", exported, SIGNS, "--reference", "50", "--json").json
    assert unnamed["units"]["bias"] == "reference unit"
    said = triaxcal("fit", exported, SIGNS, "--reference", "50").out
    assert f"residual rms {unnamed['residual']['rms_g'] / 50 * 1e6:.3g} ppm of the reference" in said
    assert "1e-6" not in said


def test_what_is_no_number_is_within_no_limit(capsys: pytest.CaptureFixture[str]) -> None:
    assert [judge(1e-4, rms, 1.0) for rms in (0.9e-4, 1e-4, 1.1e-4, math.inf, math.nan)] == [0, 0, 1, 1, 1]
    assert judge(None, math.nan, 1.0) == 0
    assert len(capsys.readouterr().err.splitlines()) == 3


@pytest.mark.slow
def test_a_terminal_that_knows_ascii_alone_is_shown_everything(exported: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [Path(sys.executable).with_name("triaxcal"), "fit", exported, "--reference=50", "--reference-unit=µT"]
    done = subprocess.run(command, env=environment, capture_output=True, timeout=180)
    assert done.returncode == 0, done.stderr
    assert b"output/\\xb5T" in done.stdout
    assert b"noise floor " in done.stdout
    assert b"Traceback" not in done.stderr


@pytest.mark.slow
def test_a_place_gives_the_reference_and_its_uncertainty(exported: Path, triaxcal: Run, asked: Run) -> None:
    plain = asked("fit", exported, SIGNS, "--json").json
    placed = triaxcal("fit", exported, SIGNS, "--latitude", "50.45", "--height", "179", "--json").json
    g = placed["reference"]
    assert g == pytest.approx(1.00038, abs=2e-5)
    np.testing.assert_allclose(np.array(placed["scale_factor"]) * g, plain["scale_factor"], rtol=1e-7)
    lines = {x["source"]: x for x in placed["uncertainty"]["budget"]}
    assert lines["reference"]["magnitude_g"] == pytest.approx(43e-6, rel=0.01)
    assert plain["uncertainty"]["not_evaluated"][0].startswith("reference: taken as exact")
    stated = triaxcal("diagnose", exported, SIGNS, "--reference-uncertainty", "1e-4", "--json").json
    lines = {x["source"]: x for x in stated["calibration"]["uncertainty"]["budget"]}
    assert lines["reference"]["magnitude_g"] == pytest.approx(1e-4, rel=0.01)
    shown = triaxcal("diagnose", exported, SIGNS, "--latitude", "50.45", "--height", "179", "--verbose")
    assert "dominant: reference; to halve it: know the reference to 21.6 µg" in shown.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--latitude", "50"], "--latitude, --height: give both, or neither"),
        (["--latitude", "50", "--height", "1", "--reference", "1"], "--reference: --latitude and --height say it"),
        (["--latitude", "50", "--height", "1", "--reference-unit", "m/s2"], "--reference-unit m/s2: --latitude"),
        (["--latitude", "x", "--height", "1"], "--latitude: expected degrees between -90 and 90, not 'x'"),
        (["--latitude", "1", "--height", "1e6"], "--height: expected metres between -500 and 9000, not '1e6'"),
        (["--reference-uncertainty", "-1"], "--reference-uncertainty: expected a number of at least 0, not '-1'"),
        (["--thermometer-uncertainty", "nan"], "--thermometer-uncertainty: expected a number of at least 0"),
    ],
)
def test_a_reference_that_cannot_be_is_refused_in_one_line(
    exported: Path, triaxcal: Run, options: list[str], words: str
) -> None:
    triaxcal("fit", exported, *options).failed(2, words)
