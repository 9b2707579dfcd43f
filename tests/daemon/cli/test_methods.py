"""fit --turning, --attitudes, --datasheet, and references other than gravity: documents, exit codes, errors."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.documents import Calibration
from triaxcal.model.directions import cube_directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import Tumble
from triaxcald.documents import to_text
from triaxcald.recording.reader import Recording

Run = Callable[..., Any]

SIGNS = "--sign=-,+,+"
UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))
MAGNETOMETER = Sensor(np.array([15.0, 14.0, 16.0]), np.array([0.02, -0.03, 0.01]), np.array([200.0, -350.0, 90.0]))
GYROSCOPE = Sensor(np.array([131.0, 130.0, -132.0]), np.array([0.01, -0.02, 0.01]), np.array([300.0, -200.0, 310.0]))
REFERENCES = {
    "magnetometer": (MAGNETOMETER, 48.0, 0.3, ["--reference", "48", "--reference-unit", "µT"]),
    "gyroscope": (GYROSCOPE, 100.0, 0.05, ["--reference", "100", "--reference-unit", "deg/s", "--sign=+,+,-"]),
}
PLAN = cube_directions()[:14]
UPS = np.array([v for _, v in PLAN])
PROJECT = Path(__file__).parents[3]
RECORDING = PROJECT / "recordings/can-second-order.mcap"


def write(path: Path, t_s: np.ndarray, u: np.ndarray) -> Path:
    np.savetxt(path, np.c_[t_s, u], delimiter=",", header="t_s,ux,uy,uz", comments="", fmt="%.9g")
    return path


def still(path: Path, sensor: Sensor, ups: np.ndarray, noise: float, seed: int, reference: float = 1.0) -> Path:
    """Poses of 3 s, 1 s apart, at 100 Hz."""
    t_s = np.arange(400 * len(ups)) / 100
    a = Tumble(ups, 3.0, 1.0, lever_m=0.0).specific_force(t_s) * reference
    rng = np.random.default_rng(seed)
    return write(path, t_s, sensor.output(a, {}) + rng.standard_normal(a.shape) * noise * sensor.scale_factor)


def turning(path: Path, sensor: Sensor, noise: float, reference: float = 1.0, count: int = 20_000) -> Path:
    t = np.arange(count) * 0.02
    z = 0.999 * np.sin(np.pi / 2 * (2 * np.abs(0.618 * t / np.pi % 2 - 1) - 1))
    r = np.sqrt(1 - z**2)
    a = np.stack([r * np.cos(np.pi * t), r * np.sin(np.pi * t), z], axis=1) * reference
    noisy = np.random.default_rng(9).standard_normal(a.shape) * noise * sensor.scale_factor
    return write(path, t / 2, sensor.output(a, {}) + noisy)


@pytest.fixture(scope="module")
def files(once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        still(folder / "14.csv", UNIT, UPS, 1e-3, 1)
        still(folder / "check.csv", UNIT, UPS[::-1], 1e-3, 2)
        still(folder / "4.csv", UNIT, UPS[2:6], 1e-3, 3)
        turning(folder / "turning.csv", UNIT, 0.01)
        (folder / "labels.csv").write_text("label\n" + "".join(f"{label}\n" for label, _ in PLAN))

    return once("ways", make)


def attitudes(folder: Path, text: str) -> Path:
    path = folder / "att.csv"
    path.write_text(text, "utf-8")
    return path


def pulls(document: dict[str, Any], sensor: Sensor) -> np.ndarray:
    names = ("scale_factor", "misalignment", "bias")
    found = np.concatenate([document[n] for n in names])
    errors = np.concatenate([document["standard_error"][n] for n in names])
    return (found - np.concatenate([sensor.scale_factor, sensor.misalignment, sensor.bias])) / errors


def is_calibration(document: dict[str, Any]) -> None:
    assert document["format"] == "triaxcal.calibration/1"
    assert set(document) >= {
        "terms", "units", "scale_factor", "misalignment", "bias", "matrix", "centre", "effects", "standard_error",
        "residual", "poses", "condition", "blind_to", "warnings", "data_quality",
    }  # fmt: skip
    read = tc.schema.Calibration.read(document)
    assert read is not None
    assert to_text(read.document()) == to_text(document)


# A unit that turns


@pytest.mark.slow
def test_a_turning_unit_gives_a_calibration_that_verify_takes(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    cal, report = tmp_path / "cal.json", tmp_path / "r.html"
    done = triaxcal("fit", files / "turning.csv", "--turning", SIGNS, "--json", "-o", cal, "--report", report)
    assert (done.code, done.err) == (0, "")
    is_calibration(done.json)
    assert done.json == json.loads(cal.read_text())
    assert (done.json["poses"], done.json["effects"], done.json["samples"]) == ([], {}, 20_000)
    assert done.json["noise_g"] == pytest.approx([0.01] * 3, rel=0.05)
    assert done.json["residual"]["cross_validated_rms_g"] is None
    assert done.json["residual"]["lack_of_fit_p"] > 0.001
    assert np.max(np.abs(pulls(done.json, UNIT))) < 4.5
    assert "<html" in report.read_text("utf-8")
    verified = triaxcal("verify", cal, files / "check.csv", "--json", "--limit", "1e-3")
    assert verified.code == 0
    assert verified.json["rms_g"] < 5e-4


def test_a_turning_unit_at_the_console(files: Path, triaxcal: Run) -> None:
    done = triaxcal("fit", files / "turning.csv", "--turning", SIGNS)
    assert done.code == 0
    assert "20000 samples, whose noise is 0.0" in done.out
    assert "scale_factor.x" in done.out


@pytest.mark.slow
def test_a_turning_unit_says_at_which_temperature_its_biases_hold(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    warm, cal, older = tmp_path / "warm.csv", tmp_path / "cal.json", tmp_path / "older.json"
    header, *rows = (files / "turning.csv").read_text().splitlines()
    degrees = np.round(np.linspace(20, 26, len(rows)) ** 2 / 26, 3)
    warm.write_text("\n".join([f"{header},temp_c", *(f"{r},{d}" for r, d in zip(rows, degrees, strict=True))]) + "\n")
    document = triaxcal("fit", warm, "--turning", SIGNS, "--json", "-o", cal).json
    is_calibration(document)
    assert document["temperature_c"] == pytest.approx(
        {"mean": float(np.mean(degrees)), "lowest": float(degrees[0]), "highest": 26.0}
    )
    shown = triaxcal("fit", warm, "--turning", SIGNS).out
    assert f"temp_c = {np.mean(degrees):.4g} °C, the mean of the samples (15.38 to 26 °C)" in shown
    without = triaxcal("fit", files / "turning.csv", "--turning", SIGNS, "--json").json
    assert without.pop("temperature_c") is None
    assert {k: v for k, v in document.items() if k != "temperature_c"} == without
    older.write_text(json.dumps(without))
    assert Calibration.load(older).to_dict()["bias"] == document["bias"]
    assert triaxcal("verify", older, files / "check.csv", "--limit", "1e-3").code == 0
    assert triaxcal("fit", files / "4.csv", "--passport", older).code == 0


def test_a_turning_unit_through_standard_input(files: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    there = triaxcal("fit", files / "turning.csv", "--turning", SIGNS, "--json").json
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO((files / "turning.csv").read_bytes())))
    assert triaxcal("fit", "-", "--turning", SIGNS, "--json").json == there


@pytest.mark.slow
def test_a_recording_is_read_sample_by_sample_too(triaxcal: Run) -> None:
    done = triaxcal("fit", RECORDING, "--turning", "--json")
    assert done.code == 0
    is_calibration(done.json)
    poses = triaxcal("fit", RECORDING, "--json").json
    assert done.json["unit"] == poses["unit"]
    # It moves fast between its poses, with levers: |a| is off by 4 %, which is told, and covered by the stated errors.
    away = np.array(done.json["scale_factor"]) - poses["scale_factor"]
    assert np.max(np.abs(away) / done.json["standard_error"]["scale_factor"]) < 4
    assert any("acceleration besides gravity" in w for w in done.json["warnings"])
    assert any("without --turning" in w for w in done.json["warnings"])


def test_a_calibration_of_a_turning_unit_can_be_written_to_the_device(
    files: Path, triaxcal: Run, workshop: Any, tmp_path: Path
) -> None:
    cal = tmp_path / "cal.json"
    assert triaxcal("fit", files / "turning.csv", "--turning", "--sign=-,-,-", "-o", cal).code == 0
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"serial": "4711", "bus": served.bus})
        done = triaxcal("provision", cal, station, "--dry-run", "--json")
    assert done.code == 0
    assert done.json["format"] == "triaxcal.provisioning/1"


def test_turning_about_one_axis_is_refused_with_what_is_missing(triaxcal: Run, tmp_path: Path) -> None:
    t = np.arange(5000) * 0.02
    a = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    rng = np.random.default_rng(0)
    path = write(tmp_path / "flat.csv", t, UNIT.output(a, {}) + 1e-3 * rng.standard_normal(a.shape))
    out = tmp_path / "cal.json"
    triaxcal("fit", path, "--turning", SIGNS, "-o", out).failed(3, "every side is up", "add the poses", "Z")
    triaxcal("fit", path, "--turning").failed(3, "no --sign was given")
    assert not out.exists()


def test_a_limit_outside_is_exit_one(files: Path, triaxcal: Run) -> None:
    assert triaxcal("fit", files / "turning.csv", "--turning", SIGNS, "--limit", "1e-6").code == 1


# Poses of known attitude


@pytest.mark.slow
def test_labels_are_attitudes(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    cal, report = tmp_path / "cal.json", tmp_path / "r.html"
    done = triaxcal(
        "fit", files / "14.csv", "--attitudes", files / "labels.csv", "--json", "-o", cal, "--report", report
    )
    assert (done.code, done.err) == (0, "")
    is_calibration(done.json)
    assert np.max(np.abs(pulls(done.json, UNIT))) < 4.5
    held = done.json["attitudes"]
    away = np.abs(np.array(held["rotation"]) - np.eye(3))
    assert np.max(away) < 5 * max(held["rotation_standard_error_rad"])
    assert [row["name"] for row in held["rows"]] == [f"line {i + 2} ({label})" for i, (label, _) in enumerate(PLAN)]
    assert triaxcal("verify", cal, files / "check.csv", "--limit", "1e-3").code == 0


def test_vectors_with_times_may_come_in_any_order_and_leave_poses_out(
    files: Path, triaxcal: Run, tmp_path: Path
) -> None:
    rows = [f"{4 * i},{4 * i + 3},{3 * x},{3 * y},{3 * z}\n" for i, (x, y, z) in enumerate(UPS) if i != 5]
    path = attitudes(tmp_path, "# table 7\nstart_s,end_s,x,y,z\n" + "".join(reversed(rows)))
    done = triaxcal("fit", files / "14.csv", "--attitudes", path, SIGNS, "--json")
    assert done.code == 0
    assert len(done.json["poses"]) == 13
    assert all(p["used"] for p in done.json["poses"])
    assert np.max(np.abs(pulls(done.json, UNIT))) < 4.5


def test_a_wrong_row_is_named_at_the_console(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    labels = [label for label, _ in PLAN]
    labels[4] = "+X-Y"
    path = attitudes(tmp_path, "label\n" + "\n".join(labels) + "\n")
    done = triaxcal("fit", files / "14.csv", "--attitudes", path, "--attitude-error", "1e-4")
    assert done.code == 0
    assert "excluded as wrong: line 6 (+X-Y)" in done.err
    assert "rotation from the table's frame" in done.out
    assert "as declared" in done.out


def test_a_declared_error_that_the_poses_contradict_comes_with_what_they_say(
    files: Path, triaxcal: Run, tmp_path: Path
) -> None:
    """Attitudes off by 0.02 rad, where 1e-4 is declared."""
    off = UPS + np.cross(np.random.default_rng(1).standard_normal(UPS.shape) * 0.02, UPS)
    path = attitudes(tmp_path, "x,y,z\n" + "".join(f"{x},{y},{z}\n" for x, y, z in off))
    declared = ["fit", files / "14.csv", "--attitudes", path, SIGNS, "--attitude-error"]
    done = triaxcal(*declared, "1e-4", "--json")
    assert done.code == 0
    is_calibration(done.json)
    instead = done.json["attitudes"]["if_estimated"]
    assert instead["error_rad"] == pytest.approx(0.02, abs=4 * instead["error_standard_error_rad"])
    assert (done.json["attitudes"]["error_rad"], done.json["attitudes"]["estimated"]) == (1e-4, False)
    said = next(w for w in done.json["warnings"] if "contradict the declared error" in w)
    option = said.partition("--attitude-error ")[2].split()[0]
    taken = triaxcal(*declared, option, "--json").json
    assert taken["attitudes"]["if_estimated"] is None
    for name in ("scale_factor", "misalignment", "bias"):
        assert np.max(np.abs(np.array(taken[name]) - instead[name]) / instead["standard_error"][name]) < 0.1
    assert np.max(np.abs(pulls(instead, UNIT))) < 4.5


ATTITUDE_FAULTS = [
    ("x,y\n1,0\n", "line 1: the column z is missing"),
    ("start_s,x,y,z\n0,1,0,0\n", "line 1: the column end_s is missing"),
    ("up\n+X\n", "line 1: no column 'up' is known"),
    ("start_s,end_s\n0,1\n", "line 1: the columns x,y,z are missing"),
    ("x,x,y,z\n1,1,1,1\n", "line 1: the column x is there twice"),
    ("x,y,z\n1,0,0\n0,up,0\n", "line 3: y: 'up', expected a finite number"),
    ("x,y,z\n# one\n\n1,0,nan\n", "line 4: z: 'nan', expected a finite number"),
    ("x,y,z\n1,0,1e999\n", "line 2: z: '1e999', expected a finite number"),
    ("x,y,z\n0,0,0\n", "line 2: x,y,z: a vector of no length"),
    ("x,y,z\n1,0\n", "line 2: 2 fields, expected 3 (x,y,z)"),
    ("label\n+X\nup\n", "line 3: label: 'up', expected one of a plan as +X"),
    ("x,y,z,start_s,end_s\n1,0,0,5,4\n", "line 2: end_s: 4 is not after start_s 5"),
    ("x,y,z,start_s,end_s\n1,0,0,500,504\n", "line 2: no still pose of"),
    ("x,y,z,start_s,end_s\n1,0,0,0,2\n0,1,0,1,3\n", "line 3: the still pose at"),
    ("x,y,z\n", "line 1: no attitudes after the header"),
    ("", "empty, expected the header"),
    ("x,y,z\n" + "1,0,0\n" * 13, "13 attitudes, but 14 still poses in"),
]


@pytest.mark.parametrize(("text", "words"), ATTITUDE_FAULTS)
def test_a_faulty_attitude_file_is_one_line(files: Path, triaxcal: Run, tmp_path: Path, text: str, words: str) -> None:
    path = attitudes(tmp_path, text)
    triaxcal("fit", files / "14.csv", "--attitudes", path, "-o", tmp_path / "cal.json").failed(2, f"{path}: ", words)
    assert not (tmp_path / "cal.json").exists()


def test_too_few_rows_say_at_which_times_the_poses_are(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    path = attitudes(tmp_path, "x,y,z\n1,0,0\n")
    triaxcal("fit", files / "4.csv", "--attitudes", path).failed(2, "1 attitudes, but 4 still poses", "(at 0.", "–")


def test_attitudes_in_one_plane_are_refused_with_what_is_missing(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    path = attitudes(tmp_path, "label\n+X\n-X\n+Y\n-Y\n")
    triaxcal("fit", files / "4.csv", "--attitudes", path).failed(3, "cannot carry twelve parameters", "add the poses")


def test_an_attitude_file_that_is_not_there(files: Path, triaxcal: Run, tmp_path: Path) -> None:
    triaxcal("fit", files / "14.csv", "--attitudes", tmp_path / "none.csv").failed(2, "none.csv: cannot be read")


# Refinement of datasheet values


@pytest.fixture
def datasheet(files: Path, asked: Run, tmp_path: Path) -> Path:
    done = asked("fit", files / "turning.csv", "--turning", SIGNS, "--output-unit", "V", "--json")
    assert done.code == 0
    path = tmp_path / "datasheet.json"
    path.write_text(done.out, "utf-8")
    return path


@pytest.mark.slow
def test_four_poses_refine_a_datasheet(files: Path, triaxcal: Run, tmp_path: Path, datasheet: Path) -> None:
    cal, report = tmp_path / "cal.json", tmp_path / "r.html"
    done = triaxcal("fit", files / "4.csv", "--datasheet", datasheet, "--json", "-o", cal, "--report", report)
    assert done.code == 0
    is_calibration(done.json)
    before = json.loads(datasheet.read_text())
    assert done.json["units"] == before["units"]
    for name in ("scale_factor", "misalignment", "bias"):
        assert np.all(np.array(done.json["standard_error"][name]) <= before["standard_error"][name])
        assert done.json["passport"]["value"][name] == before[name]
    assert max(max(v) for n, v in done.json["passport"]["share_of_poses"].items() if n != "effects") > 0.4
    assert np.max(np.abs(pulls(done.json, UNIT))) < 4.5
    assert done.json["passport"]["conflict_p"] > 1e-3
    assert set(done.json["passport"]["source"]["scale_factor"]) <= {"poses", "passport", "both"}
    again = triaxcal("fit", files / "check.csv", "--datasheet", cal)
    assert again.code == 0
    assert "poses' share" in again.out


def test_errors_given_stand_for_the_datasheets_own(files: Path, triaxcal: Run, tmp_path: Path, datasheet: Path) -> None:
    document = json.loads(datasheet.read_text())
    del document["standard_error"]
    bare = tmp_path / "bare.json"
    bare.write_text(json.dumps(document))
    triaxcal("fit", files / "4.csv", "--datasheet", bare).failed(
        2, "bare.json: standard_error: missing", "--datasheet-error"
    )
    done = triaxcal("fit", files / "4.csv", "--datasheet", bare, "--datasheet-error", "1e-3,1e-4,1e-3", "--json")
    assert done.code == 0
    assert done.json["passport"]["standard_error"]["bias"] == [1e-3] * 3


def test_a_unit_that_has_changed_contradicts_its_datasheet(
    files: Path, triaxcal: Run, tmp_path: Path, datasheet: Path
) -> None:
    document = json.loads(datasheet.read_text())
    document["bias"][1] += 0.01
    datasheet.write_text(json.dumps(document))
    done = triaxcal("fit", files / "check.csv", "--datasheet", datasheet)
    assert done.code == 0
    assert "datasheet and poses contradict each other" in done.err
    assert "most in bias.y, which moved by" in done.err
    held = triaxcal("fit", files / "check.csv", "--datasheet", datasheet, "--json").json
    is_calibration(held)
    assert (held["passport"]["changed"], held["passport"]["changed_alone"]) == (["bias.y"], True)


def test_values_that_the_poses_do_not_tell_apart_are_all_named(
    files: Path, triaxcal: Run, tmp_path: Path, datasheet: Path
) -> None:
    document = json.loads(datasheet.read_text())
    document["bias"][0] += 0.01
    datasheet.write_text(json.dumps(document))
    one = still(tmp_path / "one.csv", UNIT, UPS[:1], 1e-3, 8)
    error = ["--datasheet-error", "1e-3,1e-3,1e-3"]
    held = triaxcal("fit", one, "--datasheet", datasheet, *error, "--json").json["passport"]
    assert sorted(held["changed"]) == ["bias.x", "scale_factor.x"]
    assert "which these poses do not tell apart" in triaxcal("fit", one, "--datasheet", datasheet, *error).err


def test_a_certificate_is_a_datasheet_and_its_effects_come_with_it(triaxcal: Run, tmp_path: Path) -> None:
    certificate = tmp_path / "certificate.json"
    with Recording.open(RECORDING) as recording:
        certificate.write_bytes(recording.attachments["certificate.json"])
    done = triaxcal("fit", RECORDING, "--datasheet", certificate, "--json")
    assert done.code == 0
    is_calibration(done.json)
    assert "second_order_nonlinearity" in done.json["terms"]
    assert set(done.json["passport"]["source"]["effects"]) == {"second_order_nonlinearity"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"standard_error": {"scale_factor": [0, 0, 0], "misalignment": [0, 0, 0], "bias": [0, 0, 0]}}, "all are 0"),
        ({"standard_error": {"scale_factor": [1, 2]}}, "standard_error.scale_factor: expected three numbers"),
        ({"standard_error": {"scale_factor": [1, 2, -1]}}, "standard_error.scale_factor: expected three numbers"),
        ({"standard_error": {"scale_factor": [1, 2, 10**400]}}, "standard_error.scale_factor: expected three numbers"),
        ({"correlation": [[1.0]]}, "correlation: expected a correlation matrix of 9 rows"),
        ({"format": "other"}, "format: expected a triaxcal.calibration/1"),
    ],
)
def test_a_faulty_datasheet_is_one_line(
    files: Path, triaxcal: Run, datasheet: Path, change: dict[str, Any], words: str
) -> None:
    datasheet.write_text(json.dumps(json.loads(datasheet.read_text()) | change))
    triaxcal("fit", files / "4.csv", "--datasheet", datasheet).failed(2, "datasheet.json: ", words)


def test_another_units_datasheet_is_an_error(triaxcal: Run, tmp_path: Path) -> None:
    certificate = tmp_path / "certificate.json"
    with Recording.open(RECORDING) as recording:
        document = json.loads(recording.attachments["certificate.json"])
    document["unit"]["serial"] = "9999"
    certificate.write_text(json.dumps(document))
    for command in (["fit", RECORDING, "--datasheet"], ["frame", RECORDING, "--calibration"]):
        triaxcal(*command, certificate).failed(2, "unit.serial is 9999")


def test_numbers_that_no_unit_has_are_refused_in_one_line(
    files: Path, triaxcal: Run, datasheet: Path, tmp_path: Path
) -> None:
    datasheet.write_text(json.dumps(json.loads(datasheet.read_text()) | {"scale_factor": [-1e300, 1e-300, 1.0]}))
    triaxcal("fit", files / "4.csv", "--datasheet", datasheet).failed(3, "far from these poses")


def test_signs_and_reference_must_be_the_datasheets(files: Path, triaxcal: Run, datasheet: Path) -> None:
    triaxcal("fit", files / "4.csv", "--datasheet", datasheet, "--sign=+,+,+").failed(2, "--sign: ", "other signs")
    triaxcal("fit", files / "4.csv", "--datasheet", datasheet, "--reference", "9.81").failed(2, "--reference 9.81")


# Options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--turning", "--datasheet", "c.json"], "not allowed with argument --turning"),
        (["--attitudes", "a.csv", "--turning"], "not allowed with argument --attitudes"),
        (["--attitude-error", "1e-3"], "there are no --attitudes"),
        (["--datasheet-error", "1,1,1"], "there is no --datasheet"),
        (["--attitudes", "a.csv", "--attitude-error", "-1"], "expected radians between 0 and 0.3"),
        (["--datasheet", "c.json", "--datasheet-error", "1,1"], "expected three numbers of at least 0"),
        (["--datasheet", "c.json", "--datasheet-error", "1,1,nan"], "expected three numbers of at least 0"),
        (
            ["--turning", "--reference-uncertainty", "1e-5"],
            "--reference-uncertainty: with --turning there is no budget",
        ),
        (["--attitudes", "a.csv", "--thermometer-uncertainty", "1"], "with --attitudes there is no budget"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(
    files: Path, triaxcal: Run, options: list[str], words: str
) -> None:
    triaxcal("fit", files / "14.csv", *options).failed(2, words)


# Other references than gravity


@pytest.mark.slow
@pytest.mark.parametrize("name", REFERENCES)
def test_another_reference_goes_the_whole_way(name: str, triaxcal: Run, tmp_path: Path) -> None:
    sensor, magnitude, noise, options = REFERENCES[name]
    unit = options[3]
    ups = np.array([v for _, v in cube_directions()])
    main = still(tmp_path / "a.csv", sensor, ups, noise, 4, magnitude)
    check = still(tmp_path / "b.csv", sensor, ups[::-1], noise, 5, magnitude)
    cal, report = tmp_path / "cal.json", tmp_path / "r.html"
    assert len(triaxcal("poses", main, *options, "--json").json["poses"]) == 26
    fitted = triaxcal("fit", main, *options, "--output-unit", "LSB", "--json", "-o", cal, "--report", report)
    assert fitted.code == 0
    assert np.max(np.abs(pulls(fitted.json, sensor))) < 4.5
    below = f"({unit})" if "/" in unit else unit
    assert fitted.json["units"]["scale_factor"] == f"LSB/{below}"
    assert (fitted.json["units"]["bias"], fitted.json["reference"]) == (unit, magnitude)
    assert fitted.json["residual"]["rms_g"] < noise
    page = report.read_text("utf-8")
    assert "µg" not in page
    assert f"10⁻⁶ {unit}" in page
    shown = triaxcal("verify", cal, check, "--reference-unit", unit)
    assert f"1e-6 {unit}" in shown.out
    assert "µg" not in shown.out
    verified = triaxcal("verify", cal, check, "--json").json
    assert verified["rms_g"] < 2 * verified["noise_floor_g"]
    assert triaxcal("plan", main, *options, "--json").json["have"] == 26


@pytest.mark.slow
def test_a_loop_about_a_magnetometer_finds_nothing_that_is_not_there(triaxcal: Run, tmp_path: Path) -> None:
    sensor, magnitude, noise, options = REFERENCES["magnetometer"]
    ups = np.array([v for _, v in cube_directions()])
    main = still(tmp_path / "a.csv", sensor, ups, noise, 4, magnitude)
    check = still(tmp_path / "b.csv", sensor, ups[::-1], noise, 5, magnitude)
    looped = triaxcal("diagnose", main, *options, "--check", check, "--json").json
    assert looped["findings"] == []
    assert looped["held_out"]["after_rms_g"] < 2 * looped["held_out"]["noise_floor_g"]


@pytest.mark.slow
@pytest.mark.parametrize("name", REFERENCES)
def test_another_reference_turns_is_stated_and_refined(name: str, triaxcal: Run, tmp_path: Path) -> None:
    sensor, magnitude, noise, options = REFERENCES[name]
    path = turning(tmp_path / "turning.csv", sensor, noise, magnitude)
    cal = tmp_path / "cal.json"
    signs = [o for o in options if o.startswith("--sign")] or ["--sign=+,+,+"]
    turned = triaxcal("fit", path, "--turning", *options[:4], *signs, "--json", "-o", cal)
    assert turned.code == 0
    assert np.max(np.abs(pulls(turned.json, sensor))) < 4.5
    assert turned.json["noise_g"] == pytest.approx([noise] * 3, rel=0.05)
    few = still(tmp_path / "few.csv", sensor, UPS[2:6], noise, 6, magnitude)
    refined = triaxcal("fit", few, "--datasheet", cal, "--json")
    assert refined.code == 0
    assert refined.json["units"]["reference"] == options[3]
    assert np.max(np.abs(pulls(refined.json, sensor))) < 4.5
    many = still(tmp_path / "many.csv", sensor, UPS, noise, 7, magnitude)
    labels = attitudes(tmp_path, "label\n" + "".join(f"{label}\n" for label, _ in PLAN))
    known = triaxcal("fit", many, "--attitudes", labels, *options, "--json")
    assert known.code == 0
    assert np.max(np.abs(pulls(known.json, sensor))) < 4.5
