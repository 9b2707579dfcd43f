"""diagnose of several recordings: of one unit, and of several units side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble
from triaxcald.cli.commands import parser
from triaxcald.cli.syntax import parsed
from triaxcald.documents import to_text

Run = Callable[..., Any]
RATE_HZ, HOLD_S, MOVE_S = 25.0, 6.0, 1.0
EFFECT = {
    "effect", "probability", "common_values_probability", "units_probability", "named_by", "listed_by", "not_found_by",
    "shapes",
}  # fmt: skip
OF_0_1 = {"worse", "gain", "units_gain", "shown_by"}
BY_RECORDING = {"recording", "poses", "before_rms_g", "after_rms_g", "noise_floor_g"}


def write(
    path: Path, seed: int, *, count: int = 14, bias: float = 0.0, settling_g: float = 0.0, k: float = 2.0
) -> Path:
    """A recording as text; all biases higher by ``bias`` g, and by what settles within half a minute."""
    rng = np.random.default_rng(seed)
    up = np.array([v for _, v in directions(count)])[rng.permutation(count)]
    sensor = Sensor(np.full(3, k), np.array([2e-3, -1e-3, 1e-3]), np.array([1e-3, 2e-3, -1e-3]) + bias)
    unit = SyntheticUnit(sensor, Tumble(up, HOLD_S, MOVE_S), np.full(3, 2e-4), Environment(), seed=seed)
    t_s = np.arange(int(count * (HOLD_S + MOVE_S) * RATE_HZ)) / RATE_HZ
    u = unit.sample(t_s)[0] + k * settling_g * np.exp(-t_s / 30.0)[:, None]
    rows = "\n".join(f"{t:.3f},{x:.9f},{y:.9f},{z:.9f}" for t, (x, y, z) in zip(t_s, u, strict=True))
    path.write_text(f"t_s,ux,uy,uz\n{rows}\n", "utf-8")
    return path


@pytest.fixture(scope="module")
def runs(once: Callable[..., Path]) -> list[Path]:
    def make(folder: Path) -> None:
        write(folder / "one.csv", 1)
        write(folder / "two.csv", 2, bias=3e-3)

    folder = once("several-runs", make)
    return [folder / "one.csv", folder / "two.csv"]


@pytest.fixture(scope="module")
def settling(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("units")
    return [
        write(folder / f"{name}.csv", seed, settling_g=3e-3, k=k, count=18)
        for name, seed, k in (("a", 5, 2.0), ("b", 6, 3.0))
    ]


@pytest.mark.slow
def test_recordings_of_different_units_given_as_one_are_remarked_on(
    tmp_path: Path, runs: list[Path], triaxcal: Run, asked: Run
) -> None:
    one, other = (write(tmp_path / f"{k:g}.csv", seed, k=k) for seed, k in ((1, 2.0), (2, 2.3)))
    remark = f"{one} and {other} do not look like one unit: |a| is off by 0."
    assert any(w.startswith(remark) for w in triaxcal("diagnose", one, other, "--json").json["calibration"]["warnings"])
    assert "do not look like" not in asked("diagnose", *runs).err


@pytest.mark.slow
def test_the_document_says_which_pose_is_of_which_recording(runs: list[Path], triaxcal: Run) -> None:
    document = triaxcal("diagnose", *runs, "--json").json
    assert document["format"] == "triaxcal.loop/1"
    assert document["recordings"] == [str(p) for p in runs]
    of = [p["recording"] for p in document["calibration"]["poses"]]
    assert of == [str(runs[0])] * 14 + [str(runs[1])] * 14
    by = document["by_recording"]
    assert [set(r) for r in by] == [BY_RECORDING] * 2
    assert [r["recording"] for r in by] == document["recordings"]
    assert by[0]["poses"] == 14
    assert by[0]["after_rms_g"] < by[0]["before_rms_g"] / 5
    assert [f["effect"] for f in document["findings"]] == ["run_bias"]
    for name, value in document["findings"][0]["coefficients"].items():
        assert name.endswith("_run2")
        assert value["value"] == pytest.approx(1.5e-3, abs=5 * value["standard_error"])
    assert document["calibration"]["channel_reference"] == {"run_index": 0.0}
    read = tc.schema.Loop.read(document)
    assert read is not None
    assert to_text(read.document()) == to_text(document)


def test_options_may_stand_between_recordings(runs: list[Path], triaxcal: Run) -> None:
    one, two = runs
    between = ["diagnose", str(one), "--sign=+,+,+", str(two), "--json", "--output-unit", "V"]
    behind = ["diagnose", str(one), str(two), "--sign=+,+,+", "--output-unit", "V", "--json"]
    assert parsed(parser(), between) == parsed(parser(), behind)
    triaxcal("diagnose", one, "--sign=+,+,+", one, "--json").failed(2, "one.csv", "given twice")
    audits = parsed(parser(), ["audit", str(one), "--json", str(two)])
    assert (audits.recordings, audits.json) == ([str(one), str(two)], True)
    provision = parsed(parser(), ["provision", "cal.json", "--dry-run", "station.toml"])
    assert (provision.calibration, str(provision.station), provision.dry_run) == ("cal.json", "station.toml", True)


@pytest.mark.parametrize(
    ("arguments", "left"),
    [
        (["diagnose", "a.csv", "--peculiar", "b.csv"], "--peculiar b.csv"),
        (["provision", "a.json", "b.toml", "c.toml"], "c.toml"),
        (["fit", "a.csv", "--sgn=+,-,+"], "--sgn=+,-,+; did you mean --sign?"),
    ],
)
def test_what_no_command_knows_is_told(triaxcal: Run, arguments: list[str], left: str) -> None:
    done = triaxcal(*arguments)
    done.failed(2)
    assert done.err == f"triaxcal {arguments[0]}: unrecognized arguments: {left}\n"


@pytest.mark.parametrize("arguments", [["fit", "a.csv", "--json", "b.csv"], ["verify", "cal.json", "a.csv", "b.csv"]])
def test_a_second_recording_points_to_the_command_that_takes_several(triaxcal: Run, arguments: list[str]) -> None:
    triaxcal(*arguments).failed(2, "b.csv", "one recording", "triaxcal diagnose")


@pytest.mark.slow
def test_the_calibration_of_two_runs_serves_another(runs: list[Path], triaxcal: Run, tmp_path: Path) -> None:
    cal, page = tmp_path / "cal.json", tmp_path / "page.html"
    assert triaxcal("diagnose", *runs, "-o", cal, "--report", page).code == 0
    assert page.read_text("utf-8").startswith("<!")
    verified = triaxcal("verify", cal, write(tmp_path / "three.csv", 3, bias=1.5e-3), "--json")
    assert verified.code == 0
    assert verified.json["rms_g"] < 2 * verified.json["noise_floor_g"]  # the mean bias of the two is that of the third


@pytest.mark.slow
def test_a_person_sees_a_line_for_each_recording(runs: list[Path], asked: Run) -> None:
    said = asked("diagnose", *runs).out
    assert "by recording, µg rms" in said
    assert "one.csv" in said
    assert "two.csv" in said


@pytest.mark.slow
def test_one_recording_has_no_word_of_several(runs: list[Path], triaxcal: Run) -> None:
    document = triaxcal("diagnose", runs[0], "--json").json
    assert not {"recordings", "by_recording"} & set(document)
    assert "recording" not in document["calibration"]["poses"][0]


@pytest.mark.slow
def test_units_that_warm_up_alike_agree_on_it(settling: list[Path], triaxcal: Run, tmp_path: Path) -> None:
    out = tmp_path / "agreement.json"
    document = triaxcal("diagnose", "--units", *settling, "--json", "-o", out).json
    assert document["format"] == "triaxcal.agreement/1"
    assert out.read_text("utf-8").startswith('{\n  "format": "triaxcal.agreement/1"')
    assert document["verdict"] == "agree on warm_up"
    assert document["agreed"] == ["warm_up"]
    first = document["effects"][0]
    assert set(first) == EFFECT | OF_0_1
    assert {first[key] for key in OF_0_1} == {None}
    assert first["effect"] == "warm_up"
    assert first["probability"] >= 0.99
    assert 0 <= first["common_values_probability"] <= 1
    assert len(first["units_probability"]) == 2
    assert document["nothing_probability"] < 0.01
    found = [*first["named_by"], *first["listed_by"], *first["not_found_by"]]
    assert sorted(found) == [str(p) for p in settling]
    shared = first["shapes"]["time_constant"]
    assert set(shared) == {"value", "standard_error", "unit", "p_value", "own"}
    assert shared["value"] == pytest.approx(30.0, abs=5 * shared["standard_error"])
    assert shared["p_value"] is None
    assert [o["recording"] for o in shared["own"]] == [str(p) for p in settling]
    assert [u["result"]["format"] for u in document["units"]] == ["triaxcal.loop/1"] * 2
    assert [u["recording"] for u in document["units"]] == [str(p) for p in settling]


@pytest.mark.slow
def test_a_person_sees_what_units_agree_on(settling: list[Path], triaxcal: Run) -> None:
    done = triaxcal("diagnose", "--units", *settling, "--limit", "1e-9")
    assert done.code == 1
    assert "the units agree on warm_up" in done.out
    assert "warm_up: time_constant" in done.out


def test_what_does_not_go_together_is_said_in_a_line(runs: list[Path], triaxcal: Run, tmp_path: Path) -> None:
    triaxcal("diagnose", runs[0], runs[0]).failed(2, "one.csv", "given twice")
    other_spelling = runs[0].parent / ".." / runs[0].parent.name / runs[0].name
    triaxcal("diagnose", runs[0], other_spelling).failed(2, "one.csv", "given twice")
    triaxcal("diagnose", "--units", runs[0]).failed(2, "--units", "two recordings")
    triaxcal("diagnose", "--units", *runs, "--check", runs[0]).failed(2, "--check", "not with --units")
    triaxcal("diagnose", "--units", *runs, "--report", tmp_path / "r.html").failed(2, "--report", "not with --units")
    short = tmp_path / "short.csv"
    short.write_text("\n".join(runs[0].read_text("utf-8").splitlines()[:15]) + "\n", "utf-8")
    triaxcal("diagnose", runs[0], short).failed(3, "short.csv", "no still pose")


@pytest.mark.slow
def test_a_channel_that_one_of_several_recordings_lacks_is_told(
    runs: list[Path], triaxcal: Run, asked: Run, tmp_path: Path
) -> None:
    head, *rows = runs[1].read_text("utf-8").splitlines()
    warm = tmp_path / "warm.csv"
    warm.write_text(f"{head},temp_c\n" + "".join(f"{row},{20 + 1e-3 * i}\n" for i, row in enumerate(rows)), "utf-8")
    told = f"channel temp_c: in {warm}, but not in {runs[0]}; no effect of it was tried"
    done = triaxcal("diagnose", runs[0], warm)
    assert done.err.count("temp_c") == done.err.count(f"warning: {told}\n") == 1
    assert told in triaxcal("diagnose", runs[0], warm, "--json").json["calibration"]["warnings"]
    assert "temp_c" not in asked("diagnose", *runs).err


def test_help_says_that_the_order_of_several_recordings_is_that_of_time(triaxcal: Run) -> None:
    assert "in order of time" in " ".join(triaxcal("diagnose", "--help").out.split())


@pytest.mark.slow
def test_two_units_are_told_apart_behind_a_recording_that_names_none(triaxcal: Run) -> None:
    folder = Path(__file__).parents[3] / "recordings"
    names = ("paper-unit.csv.gz", "can-second-order.mcap", "modbus-temperature-bias.mcap")
    done = triaxcal("diagnose", *(folder / name for name in names), "--sign=-,-,-", "--output-unit", "V")
    done.failed(2, "modbus-temperature-bias.mcap: unit: 1002", "can-second-order.mcap has 1001", "--units")


def test_recordings_with_other_settings_are_not_of_one_unit(finished_run: Any, runs: list[Path], triaxcal: Run) -> None:
    """The station's recording has signs, a unit and volts of its own."""
    triaxcal("diagnose", finished_run.can, runs[0]).failed(2, "one.csv", "signs of the scale factors: +,+,+", "-,-,-")
