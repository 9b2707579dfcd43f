"""diagnose --check: poses of another recording of the same unit, and what speaks against them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble

Run = Callable[..., Any]
RECORDINGS = Path(__file__).parents[3] / "recordings"
RATE_HZ, HOLD_S, MOVE_S = 25.0, 6.0, 1.0
REPEATED = "duplicate_samples: 1"


def write(path: Path, seed: int, *, count: int = 14, repeated: bool = False, k: float = 2.0, m: float = 0.0) -> Path:
    """A recording as text, of scale factors ``k`` and of misalignments larger by ``m`` rad; ``repeated``: with a sample
    that came twice."""
    up = np.array([v for _, v in directions(14)])[np.random.default_rng(seed).permutation(14)][:count]
    sensor = Sensor(np.full(3, k), np.array([2e-3, -1e-3, 1e-3]) + m, np.array([1e-3, 2e-3, -1e-3]))
    unit = SyntheticUnit(sensor, Tumble(up, HOLD_S, MOVE_S), np.full(3, 2e-4), Environment(), seed=seed)
    t_s = np.arange(int(count * (HOLD_S + MOVE_S) * RATE_HZ)) / RATE_HZ
    rows = [f"{t:.3f},{x:.9f},{y:.9f},{z:.9f}\n" for t, (x, y, z) in zip(t_s, unit.sample(t_s)[0], strict=True)]
    if repeated:
        rows.insert(50, rows[50])
    path.write_text("t_s,ux,uy,uz\n" + "".join(rows), "utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check")
    write(folder / "main.csv", 1)
    write(folder / "later.csv", 2)
    write(folder / "check.csv", 3, repeated=True)
    write(folder / "few.csv", 4, count=5, repeated=True)
    write(folder / "strange.csv", 5, k=3.2)
    write(folder / "aged.csv", 6, k=2.02)
    write(folder / "other.csv", 7, m=6e-3)
    return folder


@pytest.mark.slow
def test_a_check_recording_of_another_unit_is_an_error_that_names_both_serials(triaxcal: Run) -> None:
    main, check = RECORDINGS / "can-second-order.mcap", RECORDINGS / "modbus-temperature-bias.mcap"
    triaxcal("diagnose", main, "--check", check).failed(2, f"{check}: unit: 1002; {main} has 1001")


def test_a_check_recording_that_is_read_otherwise_is_an_error(folder: Path, triaxcal: Run) -> None:
    done = triaxcal("diagnose", RECORDINGS / "can-second-order.mcap", "--check", folder / "check.csv")
    done.failed(2, "check.csv: signs of the scale factors: +,+,+", "-,-,-")


@pytest.mark.slow
def test_an_error_of_other_settings_names_the_option_that_says_them_of_both(folder: Path, triaxcal: Run) -> None:
    later = folder / "later.csv"
    stated = folder / "stated.csv"
    stated.write_text(later.read_text("utf-8").replace("t_s,ux,uy,uz", "t_s,ux [V],uy [V],uz [V]"), "utf-8")
    for recordings in ((stated, "--check", later), (stated, later)):
        words = f"{later}: output unit: not stated; {stated} has V; --output-unit says it for all"
        triaxcal("diagnose", *recordings).failed(2, words)
        assert triaxcal("diagnose", *recordings, "--output-unit", "V", "--json").code == 0
    done = triaxcal("diagnose", RECORDINGS / "can-second-order.mcap", "--check", later)
    done.failed(2, "signs of the scale factors", "; --sign says it for all")


def test_what_is_diagnosed_is_no_check_however_its_path_is_written(folder: Path, triaxcal: Run) -> None:
    main, later = folder / "main.csv", folder / "later.csv"
    (folder / "link.csv").unlink(missing_ok=True)
    (folder / "link.csv").symlink_to(later)
    for check in (later, folder / ".." / folder.name / "later.csv", folder / "link.csv"):
        for recordings in ([later], [main, later]):
            done = triaxcal("diagnose", *recordings, "--check", check)
            done.failed(2, f"--check {check}: ", "another recording")
            assert done.err.count("\n") == 1


@pytest.mark.slow
def test_what_spoils_the_check_recording_stands_behind_its_name(folder: Path, triaxcal: Run) -> None:
    main, check = folder / "main.csv", folder / "check.csv"
    document = triaxcal("diagnose", main, "--check", check, "--json").json
    assert document["data_quality"] == [f"{check}: {REPEATED}"]
    assert document["held_out"]["poses"] == 14
    assert f"warning: {check}: {REPEATED}\n" in triaxcal("diagnose", main, "--check", check).err
    assert triaxcal("diagnose", main, "--json").json["data_quality"] == []


@pytest.mark.slow
def test_a_check_recording_that_cannot_be_of_this_unit_is_told_from_one_whose_unit_has_aged(
    folder: Path, triaxcal: Run
) -> None:
    main, strange, aged = (folder / f"{name}.csv" for name in ("main", "strange", "aged"))
    remark = f"{strange} does not look like this unit: |a| is off by 0.6 of the reference"
    (said,) = triaxcal("diagnose", main, "--check", strange, "--json").json["calibration"]["warnings"]
    assert said.startswith(remark)
    done = triaxcal("diagnose", main, "--sign=+,+,+", "--check", strange)
    assert (done.code, done.err) == (0, f"warning: {said}\n")
    assert triaxcal("diagnose", main, "--sign=+,+,+", "--check", aged).err == ""
    (default,) = triaxcal("diagnose", main, "--check", aged).err.splitlines()
    assert default.startswith("warning: no --sign was given, so +,+,+ is taken")


@pytest.mark.slow
def test_a_recording_of_a_unit_of_the_same_type_is_asked_about(folder: Path, triaxcal: Run, tmp_path: Path) -> None:
    """Its errors are within what age could make of this one; its axes stand otherwise."""
    main, other, cal = folder / "main.csv", folder / "other.csv", tmp_path / "main.json"
    asked = f"and {other}: misalignment differs by up to 6"
    (said,) = triaxcal("diagnose", main, "--check", other, "--json").json["calibration"]["warnings"]
    assert said.startswith(f"{main} {asked}")
    assert said.endswith("the same unit?")
    assert f"warning: {said}\n" in triaxcal("diagnose", main, other).err
    assert triaxcal("fit", main, "-o", cal).code == 0
    (said,) = triaxcal("verify", cal, other, "--json").json["warnings"]
    assert said.startswith(f"{cal} {asked}")


@pytest.mark.slow
def test_verify_says_when_a_recording_cannot_be_of_the_unit_of_the_calibration(folder: Path, triaxcal: Run) -> None:
    cal, strange, aged = folder / "main.json", folder / "strange.csv", folder / "aged.csv"
    assert triaxcal("fit", folder / "main.csv", "-o", cal).code == 0
    (said,) = triaxcal("verify", cal, strange, "--json").json["warnings"]
    assert said.startswith(f"{strange} does not look like this unit: |a| is off by 0.6 of the reference")
    done = triaxcal("verify", cal, strange)
    assert (done.code, done.err) == (0, f"warning: {said}\n")
    assert triaxcal("verify", cal, strange, "--limit", "1e-3").code == 1
    assert triaxcal("verify", cal, aged, "--json").json["warnings"] == []


@pytest.mark.parametrize("command", [["fit"], ["fit", "--turning"], ["diagnose"]])
def test_a_refusal_is_told_with_what_spoils_the_recording(folder: Path, triaxcal: Run, command: list[str]) -> None:
    done = triaxcal(*command, folder / "few.csv", "--json")
    done.failed(3, "refused")
    assert f"warning: {REPEATED}\n" in done.err


@pytest.mark.slow
def test_of_several_units_a_refusal_names_the_recording_that_is_spoiled(folder: Path, triaxcal: Run) -> None:
    few = folder / "few.csv"
    done = triaxcal("diagnose", "--units", folder / "main.csv", few)
    done.failed(3, "few.csv")
    assert f"warning: {few}: {REPEATED}\n" in done.err


@pytest.mark.slow
def test_a_report_is_headed_by_the_name_of_the_file_alone(folder: Path, triaxcal: Run) -> None:
    page = folder / "page.html"
    assert triaxcal("fit", folder / "main.csv", "--report", page).code == 0
    assert "<h1>main.csv</h1>" in page.read_text("utf-8")
    assert str(folder) not in page.read_text("utf-8")


@pytest.mark.slow
def test_verify_says_which_effects_of_the_calibration_stayed_behind_with_its_recording(
    folder: Path, triaxcal: Run, tmp_path: Path
) -> None:
    cal = tmp_path / "drifting.json"
    assert triaxcal("fit", folder / "main.csv", "-o", cal).code == 0
    document = json.loads(cal.read_text("utf-8"))
    document["effects"] = {"bias_drift": {axis: {"value": 1e-6, "unit": "g/s"} for axis in "xyz"}}
    document["channel_reference"] = {"t_s": 50.0}
    cal.write_text(json.dumps(document), "utf-8")
    warnings = triaxcal("verify", cal, folder / "main.csv", "--json").json["warnings"]
    (warning,) = warnings
    assert re.fullmatch(
        rf"bias_drift in {cal} goes with the time of its own recording, and counts as \d+ s after its start", warning
    )
