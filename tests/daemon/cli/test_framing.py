"""frame: recordings of units on a fixture to one frame, its document, and what is refused."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.half_turns import HANDS, stood
from triaxcal.effects import effect_named
from triaxcal.frames.faces import LABELS, axis_of
from triaxcal.frames.unit_frames import SyntheticFixture
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcald.cli.commands import main

Run = Callable[..., Any]
HZ, HOLD = 50, 80
"""Samples a second, and samples to a pose."""
NO_FACE = [v for label, v in directions(26) if len(label) > 2]
PLAN = [(label, 0.4 * i + turn) for i, label in enumerate(LABELS) for turn in (0.0, np.pi)]
SEQUENCE = ",".join(label for label, _ in PLAN)
SENSOR = Sensor(np.array([-2.41e5, -2.40e5, -2.37e5]), np.array([6e-3, 4e-3, -1e-3]), np.array([6e-3, -3e-3, 5e-3]))
SIGNS = "--sign=-,-,-"
MOUNT = Rotation.from_rotvec([0.05, 0.02, -0.04])
UNIT = {
    "name", "recording", "calibration", "rotation", "rotation_vector_rad", "standard_error_rad", "covariance_rad2",
    "coverage_factor", "expanded_rad", "matrix_body", "centre", "poses", "table", "seating_error_rad", "warnings",
}  # fmt: skip


@pytest.fixture(scope="module")
def fixture() -> SyntheticFixture:
    return SyntheticFixture.drawn(np.random.default_rng(1))


def write(
    path: Path,
    fixture: SyntheticFixture,
    *,
    mount: Rotation = MOUNT,
    sensor: Sensor = SENSOR,
    plan: Sequence[tuple[str, float]] = PLAN,
    extra: Sequence[Any] = NO_FACE,
    seed: int = 0,
) -> Path:
    rng = np.random.default_rng(seed)
    up = np.concatenate([fixture.ups(plan), *([np.array(extra)] if len(extra) else [])]) @ mount.as_matrix()
    a = np.repeat(up, HOLD, axis=0)
    readings = sensor.output(a + 2e-5 * rng.standard_normal(a.shape), {})
    lines = [f"{i / HZ:.2f},{x:.4f},{y:.4f},{z:.4f}" for i, (x, y, z) in enumerate(readings)]
    path.write_text("\n".join(["t_s,ux,uy,uz", *lines]) + "\n")
    return path


@pytest.fixture(scope="module")
def first(fixture: SyntheticFixture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("frame") / "first.csv", fixture)


@pytest.fixture(scope="module")
def second(fixture: SyntheticFixture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mounted turned by a quarter turn, the faces in the opposite order."""
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]) * MOUNT
    return write(tmp_path_factory.mktemp("frame") / "second.csv", fixture, mount=quarter, plan=PLAN[::-1], seed=1)


@pytest.fixture(scope="module")
def calibration(first: Path) -> str:
    """Of the first unit, as text."""
    path = first.with_name("cal.json")
    with contextlib.redirect_stdout(io.StringIO()):
        assert main(["fit", str(first), SIGNS, "-o", str(path)]) == 0
    return path.read_text()


def truth(fixture: SyntheticFixture, mount: Rotation = MOUNT) -> Rotation:
    """Rotation into the least-squares frame of the faces."""
    axes = np.array([axis_of(label) for label in LABELS])
    datum, _ = Rotation.align_vectors(axes, np.array([fixture.inward[label] for label in LABELS]))
    return datum * mount


def off(unit: Any, right: Rotation) -> float:
    """Largest miss of a unit's rotation, in its expanded uncertainties."""
    miss = (right * Rotation.from_matrix(unit["rotation"]).inv()).as_rotvec()
    return float(np.max(np.abs(miss) / unit["expanded_rad"]))


def test_a_unit_comes_into_the_frame_of_the_faces(first: Path, fixture: SyntheticFixture, triaxcal: Run) -> None:
    done = triaxcal("frame", first, SIGNS, "--json", "--output-unit", "counts")
    assert (done.code, done.err) == (0, "")
    document = done.json
    assert (document["format"], document["datum"], document["between"]) == ("triaxcal.frame/1", "least_squares", [])
    (unit,) = document["units"]
    assert set(unit) >= UNIT
    assert (unit["name"], unit["output_unit"], unit["calibration"]) == ("first", "counts", "own")
    assert off(unit, truth(fixture)) < 2
    assert max(unit["standard_error_rad"]) < 5e-6
    assert [p["label"] for p in unit["poses"]] == SEQUENCE.split(",") + [None] * len(NO_FACE)
    assert unit["table"]["tilt_rad"] == pytest.approx(1e-3, abs=2e-5)
    assert unit["nearest_axes"] == ["+X", "+Y", "+Z"]
    assert unit["mounting_assumed"] is True
    assert "no labels were given" in unit["warnings"][0]
    assert document["fixture"]["independent_errors"] == 9
    assert document["agreement"]["p_value"] is None
    assert document["agreement"]["agree"] is None


def test_the_matrix_turns_readings_into_the_bodys_frame(first: Path, fixture: SyntheticFixture, triaxcal: Run) -> None:
    (unit,) = triaxcal("frame", first, SIGNS, "--json").json["units"]
    up = truth(fixture).apply(np.eye(3))
    a = (SENSOR.output(np.eye(3), {}) - unit["centre"]) @ np.array(unit["matrix_body"]).T
    assert a == pytest.approx(up, abs=3e-5)


def test_the_faces_outward_normals_are_those_of_the_fixture(
    first: Path, fixture: SyntheticFixture, triaxcal: Run
) -> None:
    document = triaxcal("frame", first, SIGNS, "--json").json
    datum = truth(fixture) * MOUNT.inv()
    for face in document["fixture"]["faces"]:
        assert face["face"] != face["up"]
        outward = -datum.apply(fixture.inward[face["up"]])
        assert face["normal"] == pytest.approx(outward, abs=2e-5)
        assert np.array(face["error_rad"]) + axis_of(face["face"]) == pytest.approx(outward, abs=2e-5)


def test_several_units_come_into_one_frame(
    first: Path, second: Path, fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run
) -> None:
    output = tmp_path / "frame.json"
    backwards = ",".join(SEQUENCE.split(",")[::-1])
    done = triaxcal(
        "frame",
        first,
        second,
        SIGNS,
        "--faces",
        SEQUENCE,
        f"--faces={backwards}",
        "--datum=-Z,-X",
        "-o",
        output,
        "--json",
    )
    assert (done.code, done.err) == (0, "")
    assert json.loads(output.read_text()) == done.json
    one, two = done.json["units"]
    assert not one["mounting_assumed"]
    assert two["nearest_axes"] == ["+Y", "-X", "+Z"]
    assert done.json["datum"] == "-Z,-X"
    errors = {face["face"]: face["error_rad"] for face in done.json["fixture"]["faces"]}
    assert errors["-Z"] == [0.0, 0.0, 0.0]
    assert errors["-X"][1] == 0.0
    (between,) = done.json["between"]
    assert (between["from"], between["to"]) == ("first", "second")
    right = (Rotation.from_rotvec([0, 0, np.pi / 2]) * MOUNT).inv() * MOUNT
    assert between["rotation_vector_rad"] == pytest.approx(right.as_rotvec(), abs=3e-5)
    assert done.json["agreement"]["degrees_of_freedom"] == 9
    assert done.json["agreement"]["p_value"] > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_units_on_two_fixtures_are_no_success(first: Path, seed: int, tmp_path: Path, triaxcal: Run) -> None:
    other = SyntheticFixture.drawn(np.random.default_rng(seed))
    elsewhere, output = write(tmp_path / "elsewhere.csv", other, seed=seed), tmp_path / "frame.json"
    done = triaxcal("frame", first, elsewhere, SIGNS, "--faces", SEQUENCE, "-o", output, "--json")
    assert done.code == 1
    assert "not one fixture: the units disagree on its faces, p" in done.err
    assert done.json["agreement"]["agree"] is False
    assert done.json["agreement"]["inflation"] > 10
    assert any("the units disagree on the fixture's faces" in w for w in done.json["warnings"])
    assert json.loads(output.read_text()) == done.json


@pytest.mark.slow
def test_units_on_one_fixture_are_a_success(
    first: Path, fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run
) -> None:
    codes = []
    for seed in range(10, 20):
        unit = write(tmp_path / f"{seed}.csv", fixture, seed=seed)
        done = triaxcal("frame", first, unit, SIGNS, "--faces", SEQUENCE, "--json")
        assert done.json["agreement"]["agree"] is (done.code == 0)
        codes.append(done.code)
    assert codes.count(1) <= 1  # one in a hundred is expected


@pytest.mark.slow
def test_a_calibration_from_a_file_gives_the_same_frame_and_its_uncertainty(
    first: Path, calibration: str, tmp_path: Path, triaxcal: Run
) -> None:
    own = triaxcal("frame", first, SIGNS, "--json").json["units"][0]
    cal, loop = tmp_path / "cal.json", tmp_path / "loop.json"
    cal.write_text(calibration)
    assert triaxcal("diagnose", first, SIGNS, "-o", loop).code == 0
    for path in (cal, loop):
        (unit,) = triaxcal("frame", first, "--calibration", path, "--json").json["units"]
        assert unit["calibration"] == str(path)
        assert unit["rotation_vector_rad"] == pytest.approx(own["rotation_vector_rad"], abs=1e-7)
        assert unit["standard_error_rad"] == pytest.approx(own["standard_error_rad"], rel=0.3)


@pytest.mark.slow
def test_a_recording_of_the_faces_alone_goes_with_a_calibration(
    calibration: str, fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run
) -> None:
    cal, faces = tmp_path / "cal.json", write(tmp_path / "faces.csv", fixture, extra=[], seed=3)
    cal.write_text(calibration)
    (unit,) = triaxcal("frame", faces, "--calibration", cal, "--json").json["units"]
    assert off(unit, truth(fixture)) < 2
    bare = json.loads(cal.read_text())
    del bare["standard_error"], bare["poses"]
    cal.write_text(json.dumps(bare))
    (exact,) = triaxcal("frame", faces, "--calibration", cal, "--json").json["units"]
    assert "counts as exact" in exact["warnings"][0]
    assert max(exact["standard_error_rad"]) < max(unit["standard_error_rad"])


@pytest.mark.slow
def test_a_plan_labels_the_poses_in_order(second: Path, tmp_path: Path, triaxcal: Run) -> None:
    labels = [*SEQUENCE.split(",")[::-1], *(label for label, _ in directions(26) if len(label) > 2)]
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"format": "triaxcal.plan/1", "poses": [{"label": x, "up": [0, 0, 1]} for x in labels]}))
    (unit,) = triaxcal("frame", second, SIGNS, "--plan", plan, "--json").json["units"]
    assert unit["nearest_axes"] == ["+Y", "-X", "+Z"]
    plan.write_text(json.dumps({"format": "triaxcal.plan/1", "poses": [{"label": x} for x in labels[:9]]}))
    triaxcal("frame", second, SIGNS, "--plan", plan).failed(2, f"{second}: 9 labels for 32 poses")


def test_headings_give_the_tables_tilt_its_direction(first: Path, fixture: SyntheticFixture, triaxcal: Run) -> None:
    given = ",".join(f"{label}@{np.degrees(h):.6f}" for label, h in PLAN)
    (unit,) = triaxcal("frame", first, SIGNS, "--faces", given, "--json").json["units"]
    assert unit["table"]["up"] == pytest.approx(-fixture.table[:2], abs=2e-5)
    assert unit["poses"][1]["heading_deg"] == pytest.approx(180)


@pytest.mark.slow
def test_a_person_reads_tables_and_warnings(first: Path, second: Path, triaxcal: Run) -> None:
    done = triaxcal(
        "frame", first, second, SIGNS, "--faces", SEQUENCE, f"--faces={','.join(SEQUENCE.split(',')[::-1])}"
    )
    assert done.code == 0
    for words in ("rotation vector", "tilt of the table", "squareness XY", "do the units agree"):
        assert words in done.out
    alone = triaxcal("frame", first, SIGNS)
    assert "warning: no labels were given" in alone.err


def test_a_limit_on_the_standard_error(first: Path, triaxcal: Run) -> None:
    assert triaxcal("frame", first, SIGNS, "--limit", "1e-5").code == 0
    done = triaxcal("frame", first, SIGNS, "--limit", "1e-7")
    assert done.code == 1
    assert "outside the limit: standard error" in done.err


def test_a_face_missing_and_a_pair_missing_are_said(fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run) -> None:
    lacking = write(tmp_path / "lacking.csv", fixture, plan=[*PLAN[:8], *PLAN[9:10]])
    (unit,) = (document := triaxcal("frame", lacking, SIGNS, "--json").json)["units"]
    assert [f["label"] for f in unit["table"]["faces"] if not f["resolved"]] == ["+Z"]
    assert any("with +Z up the fixture stood one way only" in w for w in unit["warnings"])
    assert any("nothing stood with -Z up" in w for w in document["warnings"])
    assert max(unit["standard_error_rad"]) > 2e-4


def test_poses_in_one_orientation_need_the_tables_tilt(
    fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run
) -> None:
    single = write(tmp_path / "single.csv", fixture, plan=PLAN[::2])
    triaxcal("frame", single, SIGNS).failed(
        3, f"{single}: no face of 6 stood in two orientations", "add the poses +X, -X"
    )
    document = triaxcal("frame", single, SIGNS, "--table-tilt", "1e-3", "--json").json
    assert document["units"][0]["table"]["source"] == "given"
    assert off(document["units"][0], truth(fixture)) < 2


def test_a_recording_of_no_faces_is_refused(fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run) -> None:
    spiral = write(tmp_path / "spiral.csv", fixture, plan=PLAN[:2], extra=[v for _, v in directions(17)])
    stars = "+X,+X," + ",".join("*" * 17)
    triaxcal("frame", spiral, SIGNS, "--faces", stars).failed(3, "poses on +X faces do not give a rotation")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--faces", "+X,+Q"], "expected labels as in +X,+X,-X@180,*, not '+Q'"),
        (["--faces", "-X,+X"], "write it with an equals sign: --faces=-X,-X"),
        (["--faces", "+X,+X"], "2 labels for 32 poses, of which 12 stand on 6 faces"),
        (["--faces", SEQUENCE.replace("+Y,+Y", "+Y,-Z")], "the labels contradict the readings: pose 6"),
        (["--faces", SEQUENCE.replace("X", "x").replace("+x", "+X"), "--sign=+,-,-"], "mirror image"),
        (["--faces", "+X", "--faces", "+X", "--faces", "+X"], "--faces: given 3 times for 1 recordings"),
        (["--faces", "+X+X"], "label +X+X: no such side"),
        (["--datum=-Z,+Z"], "two faces at right angles as in -Z,-X, not '-Z,+Z'"),
        (["--datum=up"], "not 'up'"),
        (["--table-tilt", "-1"], "expected an angle of 0 to 1 rad"),
        (["--seating-error", "nan"], "expected an angle of 0 to 1 rad"),
        (["--calibration", "own", "--calibration", "own"], "--calibration: given 2 times for 1 recordings"),
        (["--calibration", "nowhere.json"], "nowhere.json: No such file or directory"),
        (["--plan", "nowhere.json"], "nowhere.json: No such file or directory"),
        (["--plan", "nowhere.json", "--faces", "+X"], "not allowed with argument"),
        (["-o", "nowhere/frame.json"], "there is no folder nowhere"),
    ],
)
def test_what_cannot_be_meant_is_one_line(first: Path, triaxcal: Run, options: list[str], words: str) -> None:
    sign = [] if any(o.startswith("--sign") for o in options) else [SIGNS]
    triaxcal("frame", first, *sign, *options, "--json").failed(2, words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"standard_error": {}}, "standard_error.scale_factor: expected three numbers"),
        ({"standard_error": {"scale_factor": [1, 1], "misalignment": [1], "bias": [1]}}, "expected three numbers of"),
        ({"standard_error": 3}, "standard_error.scale_factor: expected three numbers"),
        ({"correlation": [[1.0]]}, "correlation: expected a correlation matrix of 9 rows"),
        ({"scale_factor": [-1e300, -1e-300, -1.0]}, "no finite direction of up"),
        ({"scale_factor": [2.4e5, -2.4e5, -2.4e5]}, "the scale factors in"),
        ({"format": "triaxcal.verify/1"}, "format: expected a triaxcal.calibration/1"),
    ],
)
def test_a_calibration_that_is_none_is_named(
    first: Path, calibration: str, tmp_path: Path, triaxcal: Run, change: dict[str, Any], words: str
) -> None:
    cal = tmp_path / "cal.json"
    cal.write_text(json.dumps({**json.loads(calibration), **change}))
    triaxcal("frame", first, SIGNS, "--calibration", cal, "--json").failed(2, str(cal), words)


@pytest.mark.slow
def test_every_key_of_the_document_is_explained(first: Path, second: Path, triaxcal: Run) -> None:
    backwards = ",".join(SEQUENCE.split(",")[::-1])
    document = triaxcal("frame", first, second, SIGNS, "--faces", SEQUENCE, f"--faces={backwards}", "--json").json
    text = (Path(__file__).parents[3] / "docs/reference/documents.md").read_text("utf-8")
    section = text.partition("## Frame\n")[2].partition("\n## ")[0]
    named = set(re.findall(r"[A-Za-z_0-9]+", " ".join(re.findall(r"`([^`]*)`", section))))
    assert keys(document) - {"format"} <= named


def keys(value: Any) -> set[str]:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return {*(value if isinstance(value, dict) else ())}.union(*(keys(v) for v in inner))


@pytest.mark.slow
def test_an_effect_in_the_calibration_is_taken_off_first(
    fixture: SyntheticFixture, tmp_path: Path, triaxcal: Run
) -> None:
    """A cubic term is large off the faces; a linear fit would bend to it."""
    effect = (effect_named("third_order_nonlinearity"), np.array([4e-3, -3e-3, 5e-3]))
    bent = Sensor(SENSOR.scale_factor, SENSOR.misalignment, SENSOR.bias, (effect,))
    recording, loop = write(tmp_path / "bent.csv", fixture, sensor=bent), tmp_path / "loop.json"
    assert triaxcal("diagnose", recording, SIGNS, "-o", loop).code == 0
    (unit,) = triaxcal("frame", recording, "--calibration", loop, "--json").json["units"]
    assert unit["terms"] == ["linear", "third_order_nonlinearity"]
    assert off(unit, truth(fixture)) < 2
    assert max(unit["standard_error_rad"]) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hand", "knocks"), [("slides it slowly", None), ("is quick", None), ("slides it slowly", (0.1, 0.2))]
)
@pytest.mark.parametrize("given", [True, False])
def test_two_orientations_are_told_on_a_level_table(
    hand: str, knocks: tuple[float, float] | None, given: bool, tmp_path: Path, triaxcal: Run
) -> None:
    """Where labels count the poses, even beside knocks that last as long as a turn may."""
    stream = stood(SENSOR, HANDS[hand], 0.0, 5, knocks=knocks)
    path = tmp_path / "level.csv"
    lines = [f"{t:.2f},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(stream.t_s, stream.u, strict=True)]
    path.write_text("\n".join(["t_s,ux,uy,uz", *lines]) + "\n")
    labels = ["--faces", ",".join(stream.labels)] if given else []
    (unit,) = triaxcal("frame", path, SIGNS, *labels, "--json").json["units"]
    assert off(unit, stream.rotation) < 2
    assert max(unit["standard_error_rad"]) < 2e-5
    if given:
        assert [p["label"] for p in unit["poses"]] == [x if x in LABELS else None for x in stream.labels]
    assert {f["label"] for f in unit["table"]["faces"] if f["resolved"]} == set(LABELS)


@pytest.mark.slow
def test_labels_that_count_nothing_are_refused_on_a_level_table(tmp_path: Path, triaxcal: Run) -> None:
    stream = stood(SENSOR, HANDS["is quick"], 0.0, 6)
    path = tmp_path / "level.csv"
    lines = [f"{t:.2f},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(stream.t_s, stream.u, strict=True)]
    path.write_text("\n".join(["t_s,ux,uy,uz", *lines]) + "\n")
    given = ",".join([*stream.labels, "+X"])
    triaxcal("frame", path, SIGNS, "--faces", given).failed(2, "33 labels for 32 poses, of which 12 stand on 6 faces")
