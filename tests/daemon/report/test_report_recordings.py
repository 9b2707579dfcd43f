"""The page of several recordings: each by its own clock, and what is of which."""

from __future__ import annotations

import copy
import re
from html import unescape
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from triaxcald.report import render_report

_spec = spec_from_file_location("sample_documents", Path(__file__).with_name("sample_documents.py"))
assert _spec is not None
assert _spec.loader is not None
samples = module_from_spec(_spec)
_spec.loader.exec_module(samples)
_SAMPLE = samples.loop_document(14)
FIRST, SECOND = "/data/monday/first.csv", "/data/tuesday/second.csv"
AT_S = 38.0


def two_recordings() -> dict[str, Any]:
    """Seven poses of either recording, at the same times of their clocks, and a step between poses 1 and 2 of the
    second."""
    document = copy.deepcopy(_SAMPLE)
    known = {"x_run2": {"value": 2e-3, "standard_error": 1e-5, "unit": "g"}, "at": {"value": AT_S, "unit": "s"}}
    finding = document["findings"][0] | {"effect": "bias_step", "coefficients": known}
    document["findings"] = [finding]
    calibration = document["calibration"]
    calibration |= {"terms": ["linear", "bias_step"], "effects": {"bias_step": known}}
    poses = calibration["poses"]
    for i, pose in enumerate(poses):
        pose["recording"] = FIRST if i < 7 else SECOND
        pose |= {name: poses[i % 7][name] for name in ("start_s", "end_s")}
    document["recordings"] = [FIRST, SECOND]
    document["by_recording"] = [
        {"recording": name, "poses": 7, "before_rms_g": 9e-4, "after_rms_g": after_g, "noise_floor_g": 1.5e-5}
        for name, after_g in ((FIRST, 1.2e-5), (SECOND, 1.7e-5))
    ]
    return document


@pytest.fixture
def loop() -> dict[str, Any]:
    return two_recordings()


@pytest.fixture
def bare(loop: dict[str, Any]) -> dict[str, Any]:
    document: dict[str, Any] = samples.without_pictures(loop)
    return document


def page(document: dict[str, Any]) -> tuple[str, str]:
    """The page, and what a reader sees of it, with a bar between cells of tables."""
    html = render_report(document, title="unit")
    body = re.sub(r"<style.*?</style>|<svg.*?</svg>", " ", html, flags=re.DOTALL)
    body = re.sub(r"</t[hd]>\s*<t[hd][^>]*>", " | ", body)
    return html, " ".join(unescape(re.sub(r"<[^>]+>", " ", body)).split())


@pytest.fixture(scope="module")
def shown() -> tuple[str, str]:
    """The page on which the second pose of the second recording is left out."""
    document = two_recordings()
    document["calibration"]["poses"][8] |= {"used": False, "residual_g": 3.062e-3}
    return page(document)


@pytest.mark.slow
def test_a_moment_lies_between_poses_of_the_recording_whose_clock_it_is_on(bare: dict[str, Any]) -> None:
    said = "The moment lies between pose 8 and pose 9 of second.csv, that is between 36.0 s and 46.0 s"
    assert said in page(bare)[1]
    bare["findings"][0]["coefficients"]["at"]["value"] = 50.0
    assert "The moment lies in pose 9 of second.csv." in page(bare)[1]
    del bare["findings"][0]["coefficients"]["x_run2"]
    assert "The moment lies" not in page(bare)[1]


@pytest.mark.slow
def test_each_recording_has_its_picture_over_time_and_the_moment_is_marked_in_its_own(
    shown: tuple[str, str],
) -> None:
    html, text = shown
    pictures = {
        label: svg
        for label, svg in re.findall(r'<svg role="img" aria-label="([^"]*)"(.*?)</svg>', html, flags=re.DOTALL)
        if "in order of time, after" in label
    }
    assert [label.partition(" in order")[0] for label in pictures] == [
        "Residual of 7 poses of first.csv",
        "Residual of 7 poses of second.csv",
    ]
    assert [">Bias step</text>" in svg for svg in pictures.values()] == [False, True]
    assert "second.csv, by its own clock. Residual of each pose at its middle" in text
    ids = re.findall(r' id="([^"]+)"', html)
    assert len(ids) == len(set(ids))


@pytest.mark.slow
def test_every_pose_and_every_residual_names_its_recording(shown: tuple[str, str]) -> None:
    _, text = shown
    assert "Of recordings 1: first.csv, 2: second.csv Pose | Of | Start, s" in text
    assert re.search(r"\b7 \| 1 \| 246\.0 \| .* 8 \| 2 \| 6\.0 \| 36\.0 \|", text)
    assert "Pose 9, at 46.0 s of second.csv: off by 3062 µg" in text
    assert "1. first.csv | 7 | 900 µg | 12.0 µg | 15.0 µg 2. second.csv | 7 | 900 µg | 17.0 µg" in text


def test_a_fault_of_a_recording_names_its_file_without_the_folders(bare: dict[str, Any]) -> None:
    bare["data_quality"] = [f"{bare['recordings'][1]}: creeping_pose: 2 of 7, the first at 25.2 s"]
    assert "Outputs creep while the pose is held | second.csv: 2 of 7, the first at 25.2 s" in page(bare)[1]


@pytest.mark.slow
def test_recordings_of_the_same_name_keep_their_folders(bare: dict[str, Any]) -> None:
    for pose in bare["calibration"]["poses"]:
        pose["recording"] = str(Path(pose["recording"]).with_name("run.csv"))
    bare["recordings"] = ["/data/monday/run.csv", "/data/tuesday/run.csv"]
    assert "pose 9 of /data/tuesday/run.csv" in page(bare)[1]


def test_a_coefficient_of_one_recording_says_so(shown: tuple[str, str]) -> None:
    _, text = shown
    assert "x_run2 | x | −1 before t₁, 0 after, t₁ in recording 2; all earlier ones are before it |" in text


def test_a_single_recording_has_no_word_of_several(loop: dict[str, Any]) -> None:
    _, text = page(samples.without_pictures(_SAMPLE))
    assert "Recording |" not in text
    assert "Of recordings" not in text
    assert "by its own clock" not in text


@pytest.mark.slow
@pytest.mark.parametrize("damage", [None, 3, "first.csv", [], [None, {}], [FIRST]])
def test_damaged_names_of_recordings_still_give_a_page(loop: dict[str, Any], damage: object) -> None:
    if damage != [FIRST]:  # one of them with pictures
        loop = samples.without_pictures(loop)
    loop["recordings"] = loop["by_recording"] = damage
    loop["calibration"]["poses"][3]["recording"] = damage
    loop["findings"][0]["coefficients"]["x_run" + "9" * 5000] = {"value": 1.0}
    assert "Bias step" in page(loop)[1]


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["T", "<uT>", "µg-like"])
def test_names_with_the_unit_of_errors_in_them_stay_as_they_are(loop: dict[str, Any], unit: str) -> None:
    """Where the reference is not in g."""
    loop["calibration"]["units"] = {"reference": unit, "output": "V"}
    loop["calibration"]["reference"] = 5e-5
    for pose in loop["calibration"]["poses"]:
        pose["channels"] = {"dust µg": pose["channels"]["temp_c"]}
    loop["data_quality"] = ["odd: 1e-6 µg is in channel dust µg"]
    html, text = page(loop)
    assert 'aria-label="Channel dust µg of first.csv"' in html
    assert "odd: 1e-6 µg is in channel dust µg" in text
    assert html.count("µg") - html.count("dust µg") - html.count("1e-6 µg") == html.count("µg-like")
    assert f"residual, 10⁻¹² {unit}" in unescape(html)


@pytest.mark.slow
def test_errors_of_a_small_reference_have_digits(bare: dict[str, Any]) -> None:
    bare["calibration"]["units"] = {"reference": "T", "output": "V"}
    bare["calibration"]["reference"] = 5e-5
    for residual in (bare["before"], bare["after"]):
        residual |= {"rms_g": 6.54e-10, "cross_validated_rms_g": 6.54e-10, "noise_floor_g": 7.25e-10}
    bare["held_out"] = None
    assert "654 × 10⁻¹² T rms, 654 × 10⁻¹² T before; noise floor 725 × 10⁻¹² T." in page(bare)[1]
