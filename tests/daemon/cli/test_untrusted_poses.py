"""Poses at a rail, or frozen: poses, verify, plan and fit mark them with their reason, and count them for nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import directions

Run = Callable[..., Any]
HZ, HOLD = 50, 200
"""Samples a second, and samples to a pose."""
K, B, NOISE = np.array([2.0, 2.1, 1.9]), 0.01, 2e-4
RAIL = 1.95
"""Of x, a step below what it reads with its axis up, and above all that it reads otherwise."""
UPS = dict(directions(26))


def _write(path: Path, a: np.ndarray, *, rail: bool, seed: int) -> Path:
    """A triad under ``a`` (n,3) g. Temperature goes up and down all the time, and the bias of z with it."""
    t_s = np.arange(len(a)) / HZ
    temp_c = 20 + 3 * np.sin(2 * np.pi * t_s / 120)
    readings = a * K + B + NOISE * np.random.default_rng(seed).standard_normal(a.shape)
    readings[:, 2] += 2e-3 * (temp_c - 20)
    if rail:
        readings[:, 0] = np.minimum(readings[:, 0], RAIL)
    rows = np.column_stack([t_s, readings, temp_c])
    lines = [f"{t:.2f},{x:.7f},{y:.7f},{z:.7f},{warm:.6f}" for t, x, y, z, warm in rows]
    path.write_text("\n".join(["t_s,ux,uy,uz,temp_c", *lines]) + "\n")
    return path


def _csv(path: Path, ups: list[Any], *, rail: bool = False, seed: int = 7) -> Path:
    """Still with each of ``ups`` up in turn."""
    return _write(path, np.repeat(np.array(ups), HOLD, axis=0), rail=rail, seed=seed)


def _stuck(path: Path) -> Path:
    """Two long poses, in each of which y repeats one value for half a second."""
    lines = _csv(path, [UPS["+X"]] * 8 + [UPS["-Z"]] * 8).read_text().splitlines()
    for i in (*range(701, 726), *range(2301, 2326)):
        t, x, _, *rest = lines[i].split(",")
        lines[i] = ",".join([t, x, lines[i - 1].split(",")[2], *rest])
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def folder(once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        _csv(folder / "clean.csv", list(UPS.values()))
        _csv(folder / "again.csv", list(UPS.values()), seed=8)
        _csv(folder / "rail.csv", list(UPS.values()), rail=True)
        _stuck(folder / "stuck.csv")

    return once("rails", make)


@pytest.fixture
def cal(folder: Path, asked: Run, tmp_path: Path) -> Path:
    """Of the clean recording; `verify` takes what `diagnose` prints."""
    done = asked("diagnose", folder / "clean.csv", "--json")
    assert done.code == 0
    path = tmp_path / "cal.json"
    path.write_text(done.out, "utf-8")
    return path


def _at_fault(document: Any) -> list[Any]:
    assert all(p["used"] is (p["fault"] is None) for p in document["poses"])
    return [p for p in document["poses"] if not p["used"]]


@pytest.mark.slow
def test_verify_leaves_a_pose_at_a_rail_out_of_every_figure(folder: Path, cal: Path, triaxcal: Run) -> None:
    document = triaxcal("verify", cal, folder / "rail.csv", "--json").json
    (pose,) = _at_fault(document)
    assert pose["fault"] == "saturation"
    assert abs(pose["error_g"]) > 0.01
    assert document["max_abs_g"] < 1e-3
    assert document["rms_g"] < 2 * document["noise_floor_g"]
    clean = triaxcal("verify", cal, folder / "clean.csv", "--json").json
    assert document["noise_floor_g"] == pytest.approx(clean["noise_floor_g"], rel=0.1)
    assert any(line.startswith("saturation: x at 1.95 in ") for line in document["data_quality"])
    assert triaxcal("verify", cal, folder / "rail.csv", "--limit", "1e-3").code == 0


@pytest.mark.slow
def test_verify_marks_such_a_pose_and_says_what_spoils_it(folder: Path, cal: Path, triaxcal: Run) -> None:
    done = triaxcal("verify", cal, folder / "rail.csv")
    assert "left out" in done.out
    assert sum("saturation" in line for line in done.out.splitlines()) == 1
    assert "26 poses, 1 of them left out: rms " in done.out
    assert "warning: saturation: x at 1.95 in " in done.err
    clean = triaxcal("verify", cal, folder / "clean.csv")
    assert "left out" not in clean.out
    assert "26 poses: rms " in clean.out


@pytest.mark.slow
def test_verify_refuses_a_recording_without_a_pose_that_can_be_trusted(folder: Path, cal: Path, triaxcal: Run) -> None:
    path = folder / "stuck.csv"
    done = triaxcal("verify", cal, path, "--limit", "1", "--json")
    done.failed(3, f"refused: {path}: no still pose can be trusted: 2 left out (stuck_output)")
    assert "warning: stuck_output: y freezes 2 times, " in done.err


@pytest.mark.slow
def test_creep_that_the_calibration_explains_is_not_in_the_noise_floor(
    folder: Path, cal: Path, triaxcal: Run, tmp_path: Path
) -> None:
    clean, again, linear = folder / "clean.csv", folder / "again.csv", tmp_path / "linear.json"
    assert triaxcal("fit", clean, "-o", linear).code == 0
    explained, all_of_it = (triaxcal("verify", c, again, "--json").json for c in (cal, linear))
    held = triaxcal("diagnose", clean, "--check", again, "--json").json["held_out"]
    assert explained["noise_floor_g"] == held["noise_floor_g"] < 0.2 * all_of_it["noise_floor_g"]
    assert explained["rms_g"] == pytest.approx(held["after_rms_g"], rel=1e-4)
    assert any(line.startswith("creeping_pose: ") for line in explained["data_quality"])


@pytest.mark.slow
def test_poses_marks_them_in_the_table_and_in_the_document(folder: Path, triaxcal: Run) -> None:
    (pose,) = _at_fault(triaxcal("poses", folder / "rail.csv", "--json").json)
    assert pose["fault"] == "saturation"
    assert pose["mean"][0] == pytest.approx(RAIL)
    shown = triaxcal("poses", folder / "rail.csv")
    assert "26 still poses, 1 of them left out in " in shown.out
    assert sum("saturation" in line for line in shown.out.splitlines()) == 1
    assert "left out" not in triaxcal("poses", folder / "clean.csv").out


@pytest.mark.slow
def test_plan_does_not_count_what_cannot_be_trusted_among_what_is_there(tmp_path: Path, triaxcal: Run) -> None:
    ups = [v for label, v in UPS.items() if v[0] < 0.1 or label == "+X"]
    whole, spoiled = (_csv(tmp_path / f"few-{r}.csv", ups, rail=r) for r in (False, True))
    had, document = (triaxcal("plan", path, "--json").json for path in (whole, spoiled))
    assert (had["have"], had["left_out"]) == (len(ups), 0)
    assert (document["have"], document["left_out"]) == (len(ups) - 1, 1)
    assert document["dilution"] > had["dilution"]
    assert any(line.startswith("saturation: ") for line in document["data_quality"])
    shown = triaxcal("plan", spoiled)
    assert f"{spoiled}: {len(ups)} poses, 1 of them left out" in shown.out
    assert f"the {len(ups) - 1} there are cannot show" in shown.out
    assert "warning: saturation: x at 1.95 in " in shown.err
    assert "left out" not in triaxcal("plan", whole).out


def test_poses_too_few_for_a_fit_are_planned_for_as_if_those_at_a_rail_were_not_there(
    tmp_path: Path, triaxcal: Run
) -> None:
    rest = [UPS[label] for label in ("+Y", "-Y", "+Z", "-Z", "-X")]
    spoiled = _csv(tmp_path / "faces.csv", [*rest, UPS["+X"]] * 2, rail=True)
    less = _csv(tmp_path / "less.csv", rest * 2)
    document, wanted = (triaxcal("plan", path, "--json").json for path in (spoiled, less))
    assert document["dilution"] is None
    assert (document["have"], document["left_out"]) == (wanted["have"], 2) == (10, 2)
    assert [p["label"] for p in document["poses"]] == [p["label"] for p in wanted["poses"]]


@pytest.mark.slow
def test_fit_says_how_many_of_the_poses_it_left_out(folder: Path, triaxcal: Run) -> None:
    fitted = triaxcal("fit", folder / "rail.csv", "--json").json
    left_out = sum(not p["used"] for p in fitted["poses"])
    assert left_out >= 1
    assert f"26 poses, {left_out} of them left out: " in triaxcal("fit", folder / "rail.csv").out


@pytest.mark.slow
def test_diagnose_advises_to_take_such_a_pose_again(folder: Path, triaxcal: Run, asked: Run) -> None:
    said = triaxcal("diagnose", folder / "rail.csv").out
    assert "\nnext     take again the pose at 0.1 s: excluded (saturation)\n" in said
    advice = asked("diagnose", folder / "clean.csv", "--json").json["advice"]
    assert not [line for line in advice if "take again" in line]
