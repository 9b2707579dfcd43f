"""`triaxcal apply`, against the truth of a simulated unit."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import triaxcal as tc
from triaxcal.effects import effect_of
from triaxcal.effects.contract import lag_in
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble

GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
BEGIN_S = 12.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose times begin at 12.5 s, its calibration, and the specific force that the unit felt."""
    folder = tmp_path_factory.mktemp("applying")
    effect = effect_of("temperature_bias", {"x": 4e-4, "y": -2e-4, "z": 3e-4})
    sensor = Sensor(
        np.array([2.4, 2.41, 2.37]), np.array([6e-3, 4e-3, -6e-4]), np.array([5e-3, -3e-3, 4e-3]), (effect,)
    )
    unit = SyntheticUnit(
        sensor,
        Tumble(np.array([v for _, v in directions(26)]), 1.6, 0.9),
        np.full(3, 1e-4),
        Environment(25, 0.02, 4, 37),
    )
    t = np.arange(0.0, 65.0, 0.02)
    u, temp_c = unit.sample(t)
    table = pd.DataFrame({"t_s": t + BEGIN_S, "ux": u[:, 0], "uy": u[:, 1], "uz": u[:, 2], "temp_c": temp_c})
    table.to_csv(folder / "rec.csv", index=False)
    table.drop(columns="temp_c").to_csv(folder / "bare.csv", index=False)
    found = tc.diagnose(table).calibration
    assert found.terms == ("linear", "temperature_bias")
    found.save(folder / "cal.json")
    np.save(folder / "truth.npy", unit.path.specific_force(t))
    return folder


@pytest.mark.slow
def test_the_columns_of_the_input_stay_and_the_calibrated_ones_are_behind_them(
    folder: Path, triaxcal, tmp_path: Path
) -> None:
    done = triaxcal("apply", folder / "cal.json", folder / "rec.csv", "-o", tmp_path / "out.csv")
    assert done.code == 0, done.err
    assert "3250 samples, linear, temperature_bias, in g" in done.err
    given, found = pd.read_csv(folder / "rec.csv"), pd.read_csv(tmp_path / "out.csv")
    assert list(found.columns) == ["t_s", "ux", "uy", "uz", "temp_c", "ax", "ay", "az"]
    assert found["t_s"].to_numpy() == pytest.approx(given["t_s"].to_numpy(), abs=1e-9)
    assert np.array_equal(found["uy"], given["uy"])
    off = found[["ax", "ay", "az"]].to_numpy() - np.load(folder / "truth.npy")
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1e-4, rel=0.1)  # the noise of the readings, and hardly more


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_of_a_foreign_table_every_column_stays_as_it_stood(folder: Path, triaxcal, tmp_path: Path, kind: str) -> None:
    given = pd.read_csv(folder / "rec.csv")
    foreign = pd.DataFrame({
        "stamp": [f"2024-03-09 14:05:{i % 60:02d},{i:04d}" for i in range(40)],
        "pose, label": ["left \"up\""] * 40,
        **{f"acc_{axis}": given[f"u{axis}"][:40] for axis in "xyz"},
        "ax": range(0, 80, 2),
        "T [°C]": given["temp_c"][:40],
        "note": ["", "a"] * 20,
    })  # fmt: skip
    foreign["stamp"] = pd.to_datetime("2024-03-09 14:05:00") + pd.to_timedelta(np.arange(40) * 20, unit="ms")
    if kind == "csv":
        foreign.to_csv(tmp_path / "rec.csv", index=False)
    else:
        foreign.to_parquet(tmp_path / "rec.parquet", index=False)
    columns = "ux=acc_x,uy=acc_y,uz=acc_z,temp_c=T [°C]"
    out = tmp_path / f"out.{kind}"
    done = triaxcal("apply", folder / "cal.json", tmp_path / f"rec.{kind}", "-o", out, "--columns", columns)
    assert done.code == 0, done.err
    found = pd.read_csv(out) if kind == "csv" else pd.read_parquet(out)
    own = ["t_s", "ux", "uy", "uz", "temp_c"]
    assert list(found.columns) == [*own, "ax (input)", "stamp", "pose, label", "T [°C]", "note", "ax", "ay", "az"]
    assert list(pd.to_datetime(found["stamp"])) == list(foreign["stamp"])
    assert list(found["pose, label"]) == ['left "up"'] * 40
    assert list(found["ax (input)"].astype(int)) == list(foreign["ax"])


@pytest.mark.slow
def test_a_channel_is_found_under_the_name_it_has_in_the_calibration(folder: Path, triaxcal, tmp_path: Path) -> None:
    """Python keeps names as they are; of a file by itself the one temperature is temp_c."""
    table = pd.read_csv(folder / "rec.csv").rename(columns={"temp_c": "temperature_degC"})
    found = tc.diagnose(table).calibration
    assert found.terms == ("linear", "channel_bias:temperature_degC")
    found.save(tmp_path / "cal.json")
    table.to_csv(tmp_path / "rec.csv", index=False)
    done = triaxcal("apply", tmp_path / "cal.json", tmp_path / "rec.csv", "-o", tmp_path / "out.csv")
    assert done.code == 0
    assert "not given" not in done.err
    assert "temp_c" not in pd.read_csv(tmp_path / "out.csv").columns
    done = triaxcal("verify", tmp_path / "cal.json", tmp_path / "rec.csv")
    assert done.code == 0, done.err


@pytest.mark.slow
def test_outputs_in_another_unit_than_those_calibrated_are_refused(folder: Path, triaxcal, tmp_path: Path) -> None:
    table = pd.read_csv(folder / "rec.csv").drop(columns="temp_c")
    names = {f"u{axis}": f"a{axis} [m/s2]" for axis in "xyz"}
    table.rename(columns=names).to_csv(tmp_path / "rec.csv", index=False)
    assert triaxcal("fit", tmp_path / "rec.csv", "-o", tmp_path / "cal.json").code == 0
    table.rename(columns={u: a.replace("m/s2", "g") for u, a in names.items()}).to_csv(tmp_path / "g.csv", index=False)
    for command in (("verify",), ("apply", "-o", tmp_path / "out.csv")):
        done = triaxcal(command[0], tmp_path / "cal.json", tmp_path / "g.csv", *command[1:])
        assert done.code == 2
        assert "g, and the calibration is of outputs in m/s2; nothing is converted; --output-unit is" in done.err
        done = triaxcal(command[0], tmp_path / "cal.json", tmp_path / "g.csv", *command[1:], "--output-unit", "m/s²")
        assert done.code == 0, done.err


@pytest.mark.parametrize("kind", ["csv.gz", "parquet"])
def test_compressed_and_in_columns_it_says_the_same(folder: Path, triaxcal, tmp_path: Path, kind: str) -> None:
    for name in (f"out.{kind}", "out.csv"):
        done = triaxcal("apply", folder / "cal.json", folder / "rec.csv", "-o", tmp_path / name, "--uncertainty")
        assert done.code == 0, done.err
    plain = pd.read_csv(tmp_path / "out.csv")
    other = pd.read_parquet(tmp_path / "out.parquet") if kind == "parquet" else pd.read_csv(tmp_path / "out.csv.gz")
    assert list(other.columns) == list(plain.columns)
    assert list(other.columns)[-3:] == ["u_ax", "u_ay", "u_az"]
    assert other.to_numpy() == pytest.approx(plain.to_numpy(), abs=1e-12)
    assert plain["u_ax"].between(1e-6, 1e-4).all()


@pytest.mark.slow
def test_a_recording_is_read_block_by_block_as_its_export_is(triaxcal, tmp_path: Path) -> None:
    exported, cal = tmp_path / "rec.csv", tmp_path / "cal.json"
    assert triaxcal("log", "export", GOLDEN, "-o", exported).code == 0
    assert triaxcal("diagnose", GOLDEN, "-o", cal).code == 0
    for name, rec in (("a.csv", GOLDEN), ("b.csv", exported)):
        assert triaxcal("apply", cal, rec, "-o", tmp_path / name).code == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    a = pd.read_csv(tmp_path / "a.csv")
    still = np.abs(np.linalg.norm(a[["ax", "ay", "az"]], axis=1) - 1) < 2e-3
    assert still.mean() > 0.3


def test_a_channel_that_the_recording_lacks_is_said_once(folder: Path, triaxcal, tmp_path: Path) -> None:
    done = triaxcal("apply", folder / "cal.json", folder / "bare.csv", "-o", tmp_path / "out.csv")
    assert done.code == 0
    assert done.err.count("warning: temp_c not given, which temperature_bias goes with: taken at the reference") == 1


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("thermal_gradient", {"x": 5e-3, "y": -4e-3, "z": 6e-3}),
        ("temperature_lag", {"x": 2e-4, "y": -3e-4, "z": 4e-4, "time_constant": 30.0}),
    ],
)
def test_rates_and_lags_are_those_of_the_recording(
    name: str, values: dict[str, float], triaxcal, tmp_path: Path
) -> None:
    """A unit that warms up while it is turned: no reading by itself says how fast, and how late."""
    t = np.arange(0.0, 200.0, 0.02)
    warmed, rate = 12 * -np.expm1(-t / 60), 0.2 * np.exp(-t / 60)

    def condition(need: str) -> np.ndarray:
        if lag := lag_in(need):  # τ y′ = T − y, from rest
            return -(rate - 0.2 * np.exp(-t / lag[1])) / (1 / lag[1] - 1 / 60)
        return rate if need == "temp_c.rate" else warmed

    effect, coefficients = effect_of(name, values)
    unit = Sensor(
        np.array([2.4, 2.41, 2.37]), np.array([6e-3, 4e-3, -6e-4]), np.array([5e-3, -3e-3, 4e-3]),
        ((effect, coefficients),),
    )  # fmt: skip
    a = np.array([v for _, v in directions(26)])[(t // 8).astype(int)]
    u = unit.output(a, {need: condition(need) for need in effect.needs})
    table = pd.DataFrame({"t_s": t, "ux": u[:, 0], "uy": u[:, 1], "uz": u[:, 2], "temp_c": 25 + warmed})
    table.to_csv(tmp_path / "rec.csv", index=False)
    document = {
        "format": "triaxcal.calibration/1",
        "scale_factor": unit.scale_factor.tolist(), "misalignment": unit.misalignment.tolist(),
        "bias": unit.bias.tolist(), "effects": {name: {n: {"value": v} for n, v in values.items()}},
        "channel_reference": {need: 25.0 if need == "temp_c" else 0.0 for need in effect.needs},
    }  # fmt: skip
    (tmp_path / "cal.json").write_text(json.dumps(document))
    done = triaxcal("apply", tmp_path / "cal.json", tmp_path / "rec.csv", "-o", tmp_path / "out.csv")
    assert done.code == 0, done.err
    assert "not given" not in done.err
    assert "of the recording's own channels and times" in done.err
    found = pd.read_csv(tmp_path / "out.csv")[["ax", "ay", "az"]].to_numpy()
    assert tc.Calibration.load(tmp_path / "cal.json").apply(table)[["ax", "ay", "az"]].to_numpy() == pytest.approx(
        found, abs=1e-7
    )
    off = found - a
    whole = {need: (warmed if need == "temp_c" else 0 * t) for need in effect.needs}
    without = unit.specific_force(u, whole) - a
    assert np.sqrt(np.mean(off**2)) < 0.03 * np.sqrt(np.mean(without**2))


def test_effects_of_time_hold_at_each_time_of_their_own_recording(triaxcal, tmp_path: Path, folder: Path) -> None:
    document = json.loads((folder / "cal.json").read_text())
    per_axis = {axis: {"value": 1e-5 * (axis == "x"), "standard_error": 0, "unit": "g/s"} for axis in "xyz"}
    document["effects"] = {"bias_drift": per_axis}
    document["channel_reference"] = {"t_s": 0.0}
    document["holds_at"] = {"moment": "seconds", "t_s": 0.0}
    for key in ("correlation", "parameters", "linear_only"):
        document.pop(key)
    cal = tmp_path / "cal.json"
    cal.write_text(json.dumps(document))
    for name, more in (("at.csv", ()), ("own.csv", ("--own-recording",))):
        done = triaxcal("apply", cal, folder / "rec.csv", "-o", tmp_path / name, *more)
        assert done.code == 0, done.err
        assert ("--own-recording" in done.err) == (not more)
    at, own = (pd.read_csv(tmp_path / n)["ax"].to_numpy() for n in ("at.csv", "own.csv"))
    since_first = pd.read_csv(tmp_path / "own.csv")["t_s"].to_numpy() - BEGIN_S
    assert at - own == pytest.approx(1e-5 * since_first, abs=1e-6)


def test_compressed_twice_it_is_the_same_file(folder: Path, triaxcal, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        assert (
            triaxcal("apply", folder / "cal.json", folder / "rec.csv", "-o", tmp_path / name / "out.csv.gz").code == 0
        )
    assert (tmp_path / "one/out.csv.gz").read_bytes() == (tmp_path / "two/out.csv.gz").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (
            ("cal.json", "rec.csv", "-o", "out.csv", "--own-recording", "--phase", "verification"),
            2,
            "the verification phase has no times of the recording that was fitted",
        ),
        (("cal.json", "rec.csv", "-o", "out.txt"), 2, "expected a name that ends in .csv, .csv.gz, .parquet"),
        (("cal.json", "rec.csv", "-o", "nowhere/out.csv"), 2, "there is no folder"),
        (("rec.csv", "rec.csv", "-o", "out.csv"), 2, "rec.csv"),
        (("cal.json", "gone.csv", "-o", "out.csv"), 2, "gone.csv"),
        (("cal.json", "rec.csv", "-o", "rec.csv"), 2, "it would overwrite what is read"),
    ],
)
def test_what_cannot_be_done_is_said_and_leaves_nothing(
    folder: Path, triaxcal, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int, said: str
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(p.name for p in folder.iterdir())
    triaxcal("apply", *arguments).failed(code, said)
    assert sorted(p.name for p in folder.iterdir()) == before


def test_an_earlier_result_stays_where_a_new_one_fails(folder: Path, triaxcal, tmp_path: Path) -> None:
    out = tmp_path / "out.csv.gz"
    out.write_bytes(gzip.compress(b"t_s\n"))
    cut = tmp_path / "cut.csv"
    cut.write_text("t_s,ux,uy,uz\n0,0,0,1\n1,0,x,1\n")
    triaxcal("apply", folder / "cal.json", cut, "-o", out).failed(2, "line 3")
    assert gzip.decompress(out.read_bytes()) == b"t_s\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.csv", "out.csv.gz"]


def test_rows_that_repeat_the_one_before_are_left_out_and_said(folder: Path, triaxcal, tmp_path: Path) -> None:
    table = pd.read_csv(folder / "rec.csv").drop(columns="temp_c").rename(columns={"t_s": "time"})
    pd.concat([table[:5], table[4:]]).to_csv(tmp_path / "rec.csv", index=False)
    done = triaxcal("apply", folder / "cal.json", tmp_path / "rec.csv", "-o", tmp_path / "out.csv")
    assert "1 row left out, the same as the one before" in done.err
    assert len(pd.read_csv(tmp_path / "out.csv")) == len(table)
