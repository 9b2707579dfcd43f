"""What diagnose says: conditions, shapes, probabilities, what no effect describes, units side by side."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.estimate.calibration import Residual
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble
from triaxcal.units import ErrorUnit
from triaxcald.cli.fitting import COLUMNS
from triaxcald.cli.show_fit import cross_validated

Run = Callable[..., Any]
RATE_HZ, HOLD_S, MOVE_S = 25.0, 6.0, 1.0
K = 2.0
FINDING = {"effect", "verdict", "probability", "coefficients", "alternatives", "probabilities", "reason", "remedy"}
OF_0_1 = {"p_value", "spoiled", "coincidence", "held_out_rms_g", "apart", "residual", "pose_residual_g"}


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
        write(folder / "settling.csv", 1, settling_g=2e-3)
        write(folder / "rippled.csv", 3, ripple=1e-3)
        write(folder / "plain.csv", 3)
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


@pytest.fixture
def plain(folder: Path) -> Path:
    return folder / "plain.csv"


def cells(said: str, name: str) -> list[str]:
    """Of the row of that name."""
    row = next(line for line in said.splitlines() if line.startswith(f"│ {name} "))
    return [cell.strip() for cell in row.strip("│ ").split("│")]


def value_and_error(cell: str) -> tuple[float, float, str]:
    """Of `31.4(1.2) s`, without a power of ten."""
    found = re.fullmatch(r"([−\d.\u202f]+)\(([\d.]+)\) (.*)", cell)
    assert found is not None, cell
    value, error = found[1].replace("\u202f", "").replace("−", "-"), found[2]
    decimals = 0 if "." in error else len(value.partition(".")[2])
    return float(value), float(error) * 10.0**-decimals, found[3]


@pytest.mark.slow
def test_a_warm_up_is_told_with_its_time_constant_and_the_values_are_said_to_hold_long_after_it(
    settling: Path, asked: Run
) -> None:
    said = asked("diagnose", settling, "--verbose").out
    document = asked("diagnose", settling, "--json").json
    value, error, unit = value_and_error(cells(said, "warm_up.time_constant")[1])
    assert value == pytest.approx(40.0, abs=5 * error)
    assert unit == "s"
    shape = document["calibration"]["effects"]["warm_up"]["time_constant"]
    assert (shape["value"], shape["unit"]) == (pytest.approx(value, abs=0.1 * error), "s")
    assert shape["standard_error"] == pytest.approx(error, rel=0.1)
    assert "scale factor, misalignment and bias hold long after the start\n" in said
    assert document["calibration"]["holds"] == ["long after the start"]
    assert "since_start_s" not in said


@pytest.mark.slow
def test_a_step_is_told_with_its_moment_and_the_values_are_said_to_hold_after_it(knocked: Path, triaxcal: Run) -> None:
    said = triaxcal("diagnose", knocked, "--verbose").out
    moment, error, unit = value_and_error(cells(said, "bias_step.at")[1])
    assert moment == pytest.approx(87.5, abs=HOLD_S + MOVE_S)
    assert unit == "s"
    assert abs(moment - 87.5) < 3 * error
    (after,) = re.findall(r"bias hold after the step at ([\d.]+) s\n", said)
    assert float(after) == pytest.approx(moment, abs=0.1 * error + 0.05)
    assert "held_s" not in said


@pytest.mark.slow
def test_values_that_hold_always_are_not_said_to_hold_anywhere(rippled: Path, asked: Run) -> None:
    assert "hold" not in asked("fit", rippled).out.split("uncertainty")[0]
    assert asked("fit", rippled, "--json").json["holds"] == []


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_no_probability_is_said_to_be_nothing_or_certainty_and_no_error_has_an_exponent(
    rippled: Path, settling: Path, asked: Run
) -> None:
    said = "".join(asked("diagnose", recording, "--verbose").out for recording in (rippled, settling))
    assert "lack of fit p < 1e-12" in said
    assert cells(said, "something that no known effect describes")[1] == "more than 0.999"
    assert cells(said, "nothing")[1] == "less than 0.001"
    assert not re.search(r"(p|probability|\() ?[01](?![.\d])|e[+-]\d+ µg", said)


@pytest.mark.slow
def test_what_is_said_of_errors_and_probabilities_has_the_figures_of_the_tables(settling: Path, asked: Run) -> None:
    said = asked("diagnose", settling, "--verbose").out
    lines = " ".join(said.split())
    for name in ("cross-validated rms", "residual rms"):
        _, before, after = cells(said, f"{name}, µg")
        assert f" {name} {before} µg before, {after} µg after; " in lines
    _, likely = cells(said, "warm_up")
    assert f"\ncause    warm_up ({likely}) acts\n" in said
    assert f"\nadopted: warm_up (it acts with probability {likely})\n" in said


@pytest.mark.slow
def test_a_finding_has_its_probability_and_keys_that_mean_nothing_any_more_are_null(settling: Path, asked: Run) -> None:
    document = asked("diagnose", settling, "--json").json
    (finding,) = document["findings"]
    assert set(finding) == FINDING | OF_0_1
    assert {finding[key] for key in OF_0_1} == {None}
    assert (finding["effect"], finding["verdict"]) == ("warm_up", "adopted")
    assert finding["probability"] == document["probabilities"]["warm_up"] >= 0.99
    assert (finding["alternatives"], finding["probabilities"]) == ([], {})
    assert document["calibration"]["effects"]["warm_up"]["weight"] == 1.0
    assert (document["call"], document["not_corrected"], document["another_unit"]) == ("usable", None, None)


@pytest.mark.slow
def test_what_no_effect_describes_is_told_with_its_probability_and_nothing_is_corrected(
    tmp_path: Path, triaxcal: Run
) -> None:
    recording = write(tmp_path / "swollen.csv", 4, swell=4e-3)
    document = triaxcal("diagnose", recording, "--json").json
    part = document["unexplained"]
    assert part["significant"]
    assert part["probability"] >= 0.99
    assert part["lead"].startswith("something acts that no known effect describes (probability more than 0.999), ")
    assert f" {ErrorUnit().in_full(part['rms_g'])} rms; it goes with " in part["lead"]
    assert document["summary"][:2] == ["investigate", part["lead"]]
    assert (document["findings"], document["candidates"], document["not_corrected"]) == ([], [], "unmodelled")
    assert document["calibration"]["terms"] == ["linear"]
    assert document["after"] == document["before"]


@pytest.mark.slow
def test_units_side_by_side_are_told_each_by_itself_and_every_column_is_explained(
    plain: Path, settling: Path, triaxcal: Run
) -> None:
    done = triaxcal("diagnose", "--units", settling, plain)
    assert f"warning: {settling}: creeping_pose: " in done.err
    assert f"warning: {plain}: " not in done.err
    tables, explained = done.out.split(f"\n{next(iter(COLUMNS))}: ", 1)
    for column in COLUMNS:
        assert column in tables
        assert f"\n{column}: {COLUMNS[column]}\n" in f"\n{next(iter(COLUMNS))}: {explained}"
    assert cells(tables, str(settling))[1] == "warm_up"
    assert cells(tables, str(plain))[1] == "none"


@pytest.mark.parametrize("column", COLUMNS)
def test_the_reference_explains_the_columns_of_units_in_the_same_words(column: str) -> None:
    page = (Path(__file__).parents[3] / "docs/reference/cli.md").read_text("utf-8")
    assert f"| {column} | {COLUMNS[column].replace('|a|', chr(92) + '|a' + chr(92) + '|')} |" in page


@pytest.mark.slow
def test_of_poses_that_can_show_no_effect_the_console_says_so_and_why(
    tmp_path: Path, plain: Path, triaxcal: Run, asked: Run
) -> None:
    few = tmp_path / "ten.csv"
    few.write_text("".join(plain.read_text("utf-8").splitlines(keepends=True)[: int(10 * 7 * RATE_HZ)]), "utf-8")
    said = triaxcal("diagnose", few, "--verbose").out
    assert "\ncause    no effect shows (nothing acts with probability 0." in said
    (line,) = re.findall("note: these poses cannot show in full (.*): the poses point in too few directions\n", said)
    assert {"second_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling"} <= set(line.split(", "))
    assert "too few" not in asked("diagnose", plain, "--verbose").out


def test_an_error_that_cannot_be_cross_validated_is_no_dash_in_a_sentence() -> None:
    unit = ErrorUnit()
    assert cross_validated(Residual(1e-6, 2e-6, 3.5e-6, 1e-6, None), unit) == "cross-validated 3.50 µg"
    assert cross_validated(Residual(1e-6, 2e-6, None, 1e-6, None), unit) == (
        "not cross-validated (without one of the poses the others carry no fit)"
    )
