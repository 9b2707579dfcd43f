"""rezero: the document, the exit codes, what is refused, and that nothing is written then."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.interchange.calibration_reading import calibration_of
from triaxcal.model.directions import bias_directions, cube_directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcald.documents import to_text

Run = Callable[..., Any]
UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-3, -6e-3]), np.array([5e-3, -3e-3, 4e-3]))
SHIFT = np.array([2e-3, -1.5e-3, 1e-3])
TODAY = replace(UNIT, bias=UNIT.bias + SHIFT)
CUBE = np.array([v for _, v in cube_directions()])
FOUR = np.array([v for _, v in bias_directions(4)])
NOISE = 5e-5


def means(workshop: Any, unit: Sensor, ups: np.ndarray, name: str = "today.csv", unit_of: str = "") -> Path:
    """A table with a row for each pose."""
    header = ",".join(f"{c}{unit_of}" for c in ("ux", "uy", "uz")) + ",se_ux,se_uy,se_uz"
    rows = [
        ",".join(f"{v:.12g}" for v in (*p.mean, *p.standard_error))
        for p in noisy_poses(unit, ups, NOISE, np.random.default_rng(5))
    ]
    return Path(workshop.write(name, "\n".join([header, *rows]) + "\n"))


@pytest.fixture
def earlier(workshop: Any) -> Path:
    path = Path(workshop.folder) / "cal.json"
    poses = noisy_poses(UNIT, CUBE, NOISE, np.random.default_rng(1))
    tc.calibrate(poses, signs=(-1, 1, 1), output_unit="V").save(path)
    return path


def test_the_document_has_the_new_biases_and_says_what_it_is_of(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    rec, out = means(workshop, TODAY, FOUR), Path(workshop.folder) / "cal2.json"
    done = triaxcal("rezero", earlier, rec, "--pose-means", "--json", "-o", out)
    assert done.code == 0, done
    document = done.json
    assert json.loads(out.read_text()) == document
    assert document["format"] == "triaxcal.calibration/1"
    first = json.loads(earlier.read_text())
    assert [document[k] for k in ("scale_factor", "misalignment")] == [first["scale_factor"], first["misalignment"]]
    assert np.allclose(document["bias"], TODAY.bias, atol=5 * NOISE)
    assert document["origin"] == {
        "calibration": {"name": "cal.json", "sha256": hashlib.sha256(earlier.read_bytes()).hexdigest()},
        "recording": {"name": "today.csv"},
        "poses": 4,
    }
    assert document["rezero"]["before"]["rms_g"] > 5 * document["residual"]["rms_g"]
    assert {line["source"] for line in document["uncertainty"]["budget"]} >= {"noise", "kept", "since"}
    read = tc.schema.Calibration.read(document)
    assert read is not None
    assert to_text(read.document()) == to_text(document)
    # As another program of ours reads it.
    found = calibration_of(document, where="document")
    assert np.isfinite(found.covariance).all()
    again = triaxcal("verify", out, means(workshop, TODAY, CUBE, "check.csv"), "--pose-means", "--json")
    assert again.code == 0
    assert again.json["rms_g"] < 3 * again.json["expected_rms_g"]


def test_it_is_the_same_in_python(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    rec = means(workshop, TODAY, FOUR)
    rows = np.loadtxt(rec, delimiter=",", skiprows=1)
    poses = tc.Poses.of_means(rows[:, :3], standard_errors=rows[:, 3:])
    made = tc.rezero(tc.Calibration.load(earlier), poses).to_dict()
    document = triaxcal("rezero", earlier, rec, "--pose-means", "--json").json
    assert {k: document[k] for k in made if k not in ("origin",)} == {k: made[k] for k in made if k not in ("origin",)}


def test_the_console_shows_the_biases_and_the_error_before_and_after(
    workshop: Any, triaxcal: Run, earlier: Path
) -> None:
    done = triaxcal("rezero", earlier, means(workshop, TODAY, FOUR), "--pose-means")
    assert done.code == 0
    for word in ("bias.x", "kept", "since", "4 poses"):
        assert word in done.out


@pytest.mark.slow
def test_a_page_is_made_of_it(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    page = Path(workshop.folder) / "page.html"
    rec = means(workshop, TODAY, FOUR)
    assert triaxcal("rezero", earlier, rec, "--pose-means", "--report", page, "--json").code == 0
    assert "Before" in page.read_text()
    assert "After" in page.read_text()


@pytest.mark.parametrize(("poses", "code"), [(["--poses", "2"], 3), (["--poses", "3"], 0), ([], 0)])
def test_fewer_than_three_poses_are_refused(
    workshop: Any, triaxcal: Run, earlier: Path, poses: Sequence[str], code: int
) -> None:
    out = Path(workshop.folder) / "cal2.json"
    done = triaxcal("rezero", earlier, means(workshop, TODAY, CUBE), "--pose-means", "-o", out, *poses)
    assert done.code == code
    assert out.exists() == (code == 0)
    if code:
        done.failed(3, "refused: 2 distinct still poses", "add the poses ")


def test_fewer_distinct_poses_than_asked_for_are_told(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    done = triaxcal("rezero", earlier, means(workshop, TODAY, FOUR), "--pose-means", "--json", "--poses", "9")
    assert done.code == 0
    assert done.json["origin"]["poses"] == 4
    assert "today.csv has 4 distinct poses" in done.err


def test_missing_directions_are_named(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    flat = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    done = triaxcal("rezero", earlier, means(workshop, TODAY, flat), "--pose-means")
    done.failed(3, "do not determine three biases", "add the poses ")
    assert "Z" in done.err.rpartition("add the poses ")[2]


def test_scale_factors_that_no_longer_fit_are_refused(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    changed = replace(TODAY, scale_factor=TODAY.scale_factor * 1.01)
    triaxcal("rezero", earlier, means(workshop, changed, FOUR), "--pose-means").failed(3, "no longer fit")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--sign=+,+,+"], "of another sign"),
        (["--reference", "9.80665"], "was made for the reference 1"),
        (["--reference-unit", "m/s^2"], "the reference is in g"),
        (["--output-unit", "mV"], "is of outputs in V"),
    ],
)
def test_other_signs_references_and_units_are_refused(
    workshop: Any, triaxcal: Run, earlier: Path, options: Sequence[str], words: str
) -> None:
    out = Path(workshop.folder) / "cal2.json"
    done = triaxcal("rezero", earlier, means(workshop, TODAY, FOUR), "--pose-means", "-o", out, *options)
    done.failed(3, "refused: cal.json: ", words)
    assert not out.exists()


def test_an_output_that_never_changes_is_refused(workshop: Any, triaxcal: Run, earlier: Path) -> None:
    rec = means(workshop, TODAY, FOUR)
    lines = rec.read_text().splitlines()
    stuck = [lines[0], *(",".join(["1.25", *line.split(",")[1:]]) for line in lines[1:])]
    rec.write_text("\n".join(stuck) + "\n")
    triaxcal("rezero", earlier, rec, "--pose-means").failed(3, "the output of axis x never changes")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": "triaxcal.poses/1"}', "\xff"])
def test_what_is_no_calibration_is_bad_input(workshop: Any, triaxcal: Run, content: str) -> None:
    cal = workshop.write("bad.json", content)
    triaxcal("rezero", cal, means(workshop, TODAY, FOUR), "--pose-means").failed(2, "bad.json")


@pytest.mark.parametrize("arguments", [["--poses", "0"], ["--poses", "x"], ["--poses", "-1"]])
def test_bad_usage_is_bad_input(triaxcal: Run, workshop: Any, earlier: Path, arguments: Sequence[str]) -> None:
    triaxcal("rezero", earlier, "rec.csv", *arguments).failed(2, "--poses")


def test_a_recording_that_is_not_there_is_bad_input(triaxcal: Run, workshop: Any, earlier: Path) -> None:
    triaxcal("rezero", earlier, "nothing.csv").failed(2, "nothing.csv")
    triaxcal("rezero", "nothing.json", "nothing.csv").failed(2, "nothing.json")


def test_the_calibration_is_not_overwritten(triaxcal: Run, workshop: Any, earlier: Path) -> None:
    rec = means(workshop, TODAY, FOUR)
    triaxcal("rezero", earlier, rec, "--pose-means", "-o", earlier).failed(2, "it would overwrite what is read")


@pytest.mark.parametrize(("limit", "code"), [("1e-2", 0), ("1e-9", 1)])
def test_a_limit_judges_the_residual(triaxcal: Run, workshop: Any, earlier: Path, limit: str, code: int) -> None:
    rec = means(workshop, TODAY, FOUR)
    assert triaxcal("rezero", earlier, rec, "--pose-means", "--limit", limit).code == code


@pytest.mark.slow
def test_a_recording_of_another_unit_is_refused(triaxcal: Run, finished_run: Any, calibrations: Path) -> None:
    """By the serial numbers of document and recording."""
    ours = triaxcal("rezero", calibrations / "linear.json", finished_run.can, "--poses", "4", "--json")
    assert ours.code == 0, ours
    assert ours.json["unit"]["serial"] == "4711"
    done = triaxcal("rezero", calibrations / "linear.json", finished_run.modbus, "--poses", "4")
    done.failed(3, "is of the unit with serial 4711")
