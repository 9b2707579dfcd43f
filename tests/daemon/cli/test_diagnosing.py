"""What diagnose says at the console: conditions, shapes, probabilities, the empirical term, units side by side."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.calibration import Residual
from triaxcal.planning.directions import spiral
from triaxcal.sensor import Sensor
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble
from triaxcal.units import ErrorUnit
from triaxcald.cli.results import cross_validated
from triaxcald.cli.several import COLUMNS
from triaxcald.remarks import SHARE, overlap

Run = Callable[..., Any]
RATE_HZ, HOLD_S, MOVE_S = 25.0, 6.0, 1.0
K = 2.0


def write(path: Path, seed: int, *, settling_g: float = 0.0, step_g: float = 0.0, swell: float = 0.0,
          ripple: float = 0.0, warms_k: float = 0.0) -> Path:  # fmt: skip
    """A recording as text at 25 °C, or at so much more in the end, which does nothing. Biases settle within 40 s each,
    or step at 87.5 s; |a| is off by a ``swell`` of degree 4 over the sphere; the outputs are off by a ``ripple`` along
    their range."""
    rng = np.random.default_rng(seed)
    up = spiral(30)[rng.permutation(30)]
    sensor = Sensor(np.full(3, K), np.array([2e-3, -1e-3, 1e-3]), np.array([1e-3, 2e-3, -1e-3]))
    unit = SyntheticUnit(sensor, Tumble(up, HOLD_S, MOVE_S), np.full(3, 2e-4), Environment(), seed=seed)
    t_s = np.arange(int(30 * (HOLD_S + MOVE_S) * RATE_HZ)) / RATE_HZ
    u = unit.sample(t_s)[0]
    s = u / K
    u = u * (1 + swell * (s[:, :1] ** 3 * s[:, 1:2] - s[:, :1] * s[:, 1:2] ** 3)) + K * ripple * np.sin(25 * s)
    moves = settling_g * np.exp(-t_s / 40.0) + step_g * (t_s > 87.5)
    u = u + K * moves[:, None] * np.array([1.0, -0.8, 1.0])
    temp_c = 25.0 + warms_k * t_s / t_s[-1]
    rows = "\n".join(f"{t:.3f},{x:.9f},{y:.9f},{z:.9f},{c:.6f}" for t, (x, y, z), c in zip(t_s, u, temp_c, strict=True))
    path.write_text(f"t_s,ux,uy,uz,temp_c\n{rows}\n", "utf-8")
    return path


@pytest.fixture(scope="module")
def folder(once: Callable[..., Path]) -> Path:
    def make(folder: Path) -> None:
        write(folder / "settling.csv", 1, settling_g=5e-3)
        write(folder / "rippled.csv", 3, ripple=1e-3)
        write(folder / "warm.csv", 6, settling_g=5e-3, warms_k=1.0)

    return once("diagnosing", make)


@pytest.fixture
def settling(folder: Path) -> Path:
    return folder / "settling.csv"


@pytest.fixture
def knocked(tmp_path: Path) -> Path:
    return write(tmp_path / "knocked.csv", 2, step_g=2e-3)


@pytest.fixture
def rippled(folder: Path) -> Path:
    return folder / "rippled.csv"


@pytest.fixture
def warm(folder: Path) -> Path:
    return folder / "warm.csv"


def empirical_lines(said: str) -> list[str]:
    return [line for line in said.splitlines() if "empirical: " in line]


def cells(said: str, name: str) -> list[str]:
    """Of the row of that name."""
    row = next(line for line in said.splitlines() if f" {name} " in line)
    return [cell.strip() for cell in row.strip("│ ").split("│")]


def test_a_warm_up_is_told_with_its_time_constant_and_the_values_are_said_to_hold_long_after_it(
    settling: Path, asked: Run
) -> None:
    said = asked("diagnose", settling).out
    document = asked("diagnose", settling, "--json").json
    _, value, error, _, unit = cells(said, "warm_up.time_constant")
    assert float(value) == pytest.approx(40.0, abs=5 * float(error))
    assert unit == "s"
    shape = document["calibration"]["effects"]["warm_up"]["time_constant"]
    assert (shape["value"], shape["unit"]) == (pytest.approx(float(value), rel=1e-5), "s")
    assert shape["standard_error"] == pytest.approx(float(error), rel=0.1)
    assert "scale factor, misalignment and bias hold long after the start\n" in said
    assert document["calibration"]["holds"] == ["long after the start"]
    assert "since_start_s" not in said


def test_a_step_is_told_with_its_moment_and_the_values_are_said_to_hold_after_it(knocked: Path, triaxcal: Run) -> None:
    said = triaxcal("diagnose", knocked).out
    _, moment, error, _, unit = cells(said, "bias_step.at")
    assert float(moment) == pytest.approx(87.5, abs=HOLD_S + MOVE_S)
    assert unit == "s"
    assert abs(float(moment) - 87.5) < 3 * float(error)
    assert f"bias hold after the step at {float(moment):.1f} s\n" in said
    assert "held_s" not in said


def test_values_that_hold_always_are_not_said_to_hold_anywhere(rippled: Path, asked: Run) -> None:
    assert "hold" not in asked("fit", rippled).out.split("uncertainty")[0]
    assert asked("fit", rippled, "--json").json["holds"] == []


def test_values_without_an_effect_of_temperature_are_said_to_be_those_at_the_mean_of_the_poses(
    warm: Path, rippled: Path, asked: Run
) -> None:
    said = "scale factor, misalignment and bias are those at temp_c = "
    assert f"{said}25 °C\n" in asked("fit", rippled).out
    shown = asked("fit", warm).out
    poses = asked("fit", warm, "--json").json["poses"]
    temp_c = [pose["channels"]["temp_c"] for pose in poses if pose["used"]]
    mean, low, high = (f"{v:.4g}" for v in (np.mean(temp_c), min(temp_c), max(temp_c)))
    assert f"{said}{mean} °C, the mean of the poses ({low} to {high} °C)\n" in shown


def test_a_budget_that_temperature_dominates_says_what_of_it_is_assumed(
    warm: Path, rippled: Path, tmp_path: Path, triaxcal: Run, asked: Run
) -> None:
    assumed = "s far as the poses do not tell, this rests on an assumption, typical of data sheets: bias 500 "
    said = f"temperature: a{assumed}"
    assert f"{said}µg/K and scale factor 300 ppm/K; " in asked("fit", warm).out
    assert f"{said}ppm of the reference per K and scale" in triaxcal("fit", warm, "--reference", "9.80665").out
    page = tmp_path / "assumed.html"
    triaxcal("fit", warm, "--report", page)
    assert f"A{assumed}" in page.read_text()
    assert "assumption" not in asked("fit", rippled).out


def test_no_probability_is_said_to_be_nothing_and_no_error_has_an_exponent(
    rippled: Path, settling: Path, asked: Run
) -> None:
    said = asked("diagnose", rippled).out + asked("diagnose", settling).out
    assert "lack of fit p < 1e-12" in said
    assert "familywise p < 1e-12" in said
    assert not re.search(r"p 0(?![.\d])|e[+-]\d+ µg", said)


def test_the_reason_has_the_errors_of_the_table_above_it(settling: Path, asked: Run) -> None:
    said = asked("diagnose", settling).out
    _, before, after = cells(said, "cross-validated rms")
    assert f"falls from {before} µg to {after} µg (noise floor" in said


def test_what_no_effect_explains_is_described_only_where_that_is_asked_for(tmp_path: Path, triaxcal: Run) -> None:
    recording = write(tmp_path / "swollen.csv", 4, swell=4e-3)
    plainly = triaxcal("diagnose", recording, "--json").json
    assert not empirical_lines("\n".join(plainly["advice"]))
    assert "empirical" not in plainly["calibration"]["terms"]
    assert plainly["unexplained"]["significant"]
    assert plainly["unexplained"]["lead"].count(SHARE) == 1
    assert overlap(plainly["unexplained"]["lead"]) == ""
    described = triaxcal("diagnose", recording, "--empirical", "--json").json
    assert described["calibration"]["terms"][-1] == described["findings"][-1]["effect"] == "empirical"
    errors = [d["after"]["cross_validated_rms_g"] for d in (plainly, described)]
    assert errors[1] < errors[0] / 1.4
    assert f"from {errors[0] * 1e6:.1f} µg to {errors[1] * 1e6:.1f} µg" in described["findings"][-1]["reason"]
    assert not described["unexplained"]["significant"]


def test_the_console_explains_the_shares_of_what_is_left(
    rippled: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("triaxcald.cli.results.overlap", lambda lead: f"of {lead}")
    said = triaxcal("diagnose", rippled).out
    assert re.search(r"unexplained: \S+ µg rms; (.+)\nshares of what is unexplained: of \1\n", said)


def test_one_line_says_why_the_empirical_term_is_not_in_the_model(
    rippled: Path, settling: Path, triaxcal: Run, asked: Run
) -> None:
    (tried,) = empirical_lines(triaxcal("diagnose", rippled, "--empirical").out)
    after = asked("diagnose", rippled, "--json").json["after"]["cross_validated_rms_g"]
    assert tried.startswith("advice: empirical: tried, but not in the model: ")
    assert f"the cross-validated error goes from {after * 1e6:.1f} µg to " in tried
    (not_tried,) = empirical_lines(triaxcal("diagnose", settling, "--empirical").out)
    assert not_tried.startswith("advice: empirical: not tried, as what is left is no more than noise explains (p ")


def test_units_side_by_side_each_say_it_too_and_every_column_is_explained(
    rippled: Path, settling: Path, triaxcal: Run
) -> None:
    said = triaxcal("diagnose", "--units", settling, rippled, "--empirical").out
    assert [line.split(": ")[0] for line in empirical_lines(said)] == [str(settling), str(rippled)]
    tables, explained = said.split("\ncross-validated: ", 1)
    for column in COLUMNS:
        assert column in tables
        assert column == "cross-validated" or f"\n{column}: " in explained


@pytest.mark.parametrize("column", COLUMNS)
def test_the_reference_explains_the_columns_of_units_in_the_same_words(column: str) -> None:
    page = (Path(__file__).parents[3] / "docs/reference/cli.md").read_text("utf-8")
    assert f"| {column} | {COLUMNS[column].replace('|a|', chr(92) + '|a' + chr(92) + '|')} |" in page


def test_of_poses_that_can_show_no_effect_the_console_says_so_and_not_that_there_is_none(
    tmp_path: Path, rippled: Path, triaxcal: Run, asked: Run
) -> None:
    few = tmp_path / "ten.csv"
    few.write_text("".join(rippled.read_text("utf-8").splitlines(keepends=True)[: int(10 * 7 * RATE_HZ)]), "utf-8")
    assert "no effect of the catalogue shows; none could in full, with so few or such poses\n" in (
        triaxcal("diagnose", few).out
    )
    assert "none could" not in asked("diagnose", rippled).out


def test_an_error_that_cannot_be_cross_validated_is_no_dash_in_a_sentence() -> None:
    unit = ErrorUnit()
    assert cross_validated(Residual(1e-6, 2e-6, 3.5e-6, 1e-6, None), unit) == "cross-validated 3.5 µg"
    assert cross_validated(Residual(1e-6, 2e-6, None, 1e-6, None), unit) == (
        "not cross-validated (without one of the poses the others carry no fit)"
    )
