"""A calibration in use: applied with every effect, saved, loaded, shown."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest

import triaxcal as tc
from triaxcal.effects import CATALOGUE, Effect
from triaxcal.effects.channel import ChannelBias, ChannelScaleFactor
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, is_derived
from triaxcal.effects.time import BiasStep
from triaxcal.estimate.calibration import Calibration as Fitted
from triaxcal.estimate.calibration import ReferenceEpoch, Residual
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.pictures import residuals_figure
from triaxcal.synthetic import noisy_poses

KNOWN: list[Effect] = [*CATALOGUE, ChannelBias("supply_v"), ChannelScaleFactor("supply_v")]
FORMS = [BiasStep(83.5) if form.name == "bias_step" else form for e in KNOWN for form in e.forms]
T_S, SINCE_MIDDLE_S = 260.0, 130.0


def calibration_with(sensor: Sensor, effect: Effect, rng: np.random.Generator) -> tc.Calibration:
    """A calibration whose truth is known: what it counts from is 20, of derived conditions 0."""
    q = (1e-9 if TIME in effect.needs else 1e-3) * rng.standard_normal(len(effect.coefficients))
    reference = {n: 100.0 if n == TIME else 0.0 if is_derived(n) else 20.0 for n in effect.needs}
    n = 9 + len(q)
    fitted = Fitted(
        Sensor(sensor.scale_factor, sensor.misalignment, sensor.bias, ((effect, q),)),
        np.diag(np.full(n, 1e-5) ** 2), 1.0, reference, Residual(0.0, 0.0, None, 0.0, None), (), 1.0, 1.0, 1.0, 100.0,
        holds_at=ReferenceEpoch(Moment.END, T_S, SINCE_MIDDLE_S),
    )  # fmt: skip
    return tc.Calibration(fitted, output_unit="V")


def truly(c: tc.Calibration, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """a (n,3), what the unit reads, and the channels, each off its reference."""
    a = rng.standard_normal((n, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    sensor, reference = c.fitted.sensor, c.fitted.channel_reference
    off = {name: 0.5 * rng.standard_normal(n) for name in reference if name not in (TIME, SINCE_START, DURATION)}
    clocks = {SINCE_START: T_S, TIME: SINCE_MIDDLE_S, DURATION: 0.0}
    held = off | {k: np.full(n, v - reference[k]) for k, v in clocks.items() if k in reference}
    return a, sensor.output(a, held), {k: v + reference[k] for k, v in off.items()}


@pytest.mark.parametrize("effect", FORMS, ids=lambda e: f"{e.name}-{len(e.coefficients)}")
@pytest.mark.parametrize("loaded", [False, True])
def test_readings_of_a_unit_with_any_effect_come_out_true(effect: Effect, loaded: bool, paper_unit: Sensor) -> None:
    rng = np.random.default_rng(3)
    c = calibration_with(paper_unit, effect, rng)
    if loaded:
        c = tc.Calibration.from_dict(json.loads(json.dumps(c.to_dict())))
    a, u, channels = truly(c, rng, 50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert c.apply(u, channels=channels) == pytest.approx(a, abs=1e-8)
        one = {name: float(v[7]) for name, v in channels.items()}
        assert c.apply(u[7], channels=one) == pytest.approx(a[7], abs=1e-8)


@pytest.mark.parametrize(
    "effect", [e for e in FORMS if set(e.needs) - {TIME, SINCE_START, DURATION}], ids=lambda e: e.name
)
def test_a_channel_that_is_not_given_counts_as_at_its_reference_and_is_said(effect: Effect, paper_unit: Sensor) -> None:
    c = calibration_with(paper_unit, effect, np.random.default_rng(4))
    a, _, channels = truly(c, np.random.default_rng(5), 20)
    still = {name: np.full(20, c.fitted.channel_reference[name]) for name in channels}
    u = c.apply(a, channels=still)  # any readings will do
    with pytest.warns(tc.MissingChannel, match=f"{next(iter(channels))}.* {effect.name} goes with") as said:
        assert c.apply(a).tolist() == u.tolist()
    assert said[0].filename == __file__


@pytest.mark.parametrize("effect", [e for e in FORMS if {TIME, SINCE_START} & set(e.needs)], ids=lambda e: e.name)
def test_effects_of_time_hold_at_one_moment_or_at_each_of_their_own_recording(
    effect: Effect, paper_unit: Sensor
) -> None:
    rng = np.random.default_rng(6)
    c = calibration_with(paper_unit, effect, rng)
    a, _, _ = truly(c, rng, 30)
    t = np.linspace(1.0, T_S, 30)
    reference = c.fitted.channel_reference
    clocks = {SINCE_START: t, TIME: t - (T_S - SINCE_MIDDLE_S), DURATION: np.zeros(30)}
    u = c.fitted.sensor.output(a, {k: v - reference[k] for k, v in clocks.items() if k in reference})
    assert c.apply(u, t=t, own_recording=True) == pytest.approx(a, abs=1e-8)
    assert c.apply(u)[-1] == pytest.approx(a[-1], abs=1e-8)
    assert np.abs(c.apply(u) - a).max() > 1e-8
    with pytest.raises(tc.InvalidData, match="own_recording: say by t"):
        c.apply(u, own_recording=True)
    with pytest.raises(tc.InvalidData, match="t has 29 times, and u has 30 samples"):
        c.apply(u, t=t[1:], own_recording=True)


@pytest.mark.parametrize("library", [pd, pl], ids=["pandas", "polars"])
def test_a_data_frame_comes_back_as_one_of_its_own_kind(library: Any, paper_unit: Sensor) -> None:
    c = calibration_with(paper_unit, ChannelBias("temp_c"), np.random.default_rng(7))
    a, u, channels = truly(c, np.random.default_rng(8), 10)
    columns = dict(zip(("ux", "uy", "uz"), u.T, strict=True)) | channels | {"label": list("abcdefghij")}
    table = library.DataFrame(columns)
    if library is pd:
        table.index = np.arange(100, 110)
    found = c.apply(table, uncertainty=True)
    assert isinstance(found, library.DataFrame)
    assert list(found.columns) == ["ax", "ay", "az", "u_ax", "u_ay", "u_az"]
    assert np.stack([found[n] for n in ("ax", "ay", "az")], axis=1) == pytest.approx(a, abs=1e-8)
    if library is pd:
        assert list(found.index) == list(table.index)
    renamed = table.rename({"ux": "x", "uy": "y", "uz": "z", "temp_c": "T"}, **({"axis": 1} if library is pd else {}))
    again = c.apply(renamed, columns={"ux": "x", "uy": "y", "uz": "z", "temp_c": "T"})
    assert again.to_numpy().tolist() == found[["ax", "ay", "az"]].to_numpy().tolist()
    with pytest.raises(tc.InvalidData, match="columns: for a DataFrame"):
        c.apply(u, columns={"ux": "x"})


@pytest.mark.slow
def test_uncertainties_are_those_that_the_errors_of_a_calibration_scatter_with(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(9)
    a = np.array([[0.0, 0.0, 1.0], [0.6, -0.64, 0.48], [2.0, 0.0, -1.0]])
    u, errors, stated = paper_unit.output(a, {}), [], []
    for _ in range(60):
        c = tc.Calibration(fit(noisy_poses(paper_unit, twenty_six, 1e-4, rng), signs=(-1, -1, -1), excluded=()))
        value, uncertainty = c.apply(u, uncertainty=True)
        errors.append(value - a)
        stated.append(uncertainty)
    # 60 errors know their rms to 9 %; nine of them together, which go with each other in part, to 5 % or so.
    assert np.mean(np.square(errors) / np.square(stated)) == pytest.approx(1.0, abs=0.35)


def test_what_the_budget_has_beside_the_fit_is_in_the_uncertainties(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    fitted = fit(noisy_poses(paper_unit, twenty_six, 1e-5, np.random.default_rng(1)), signs=(-1, -1, -1))
    u = paper_unit.output(np.array([[0.0, 0.0, 1.0]]), {})
    _, bare = tc.Calibration(fitted).apply(u, uncertainty=True)
    _, stated = tc.Calibration(fitted, stated=tc.Stated(reference=1e-3)).apply(u, uncertainty=True)
    assert bare[0, 2] < 1e-4
    assert stated[0, 2] == pytest.approx(1e-3, rel=0.1)


def test_without_a_budget_the_uncertainties_are_those_of_the_standard_errors(paper_unit: Sensor) -> None:
    c = calibration_with(paper_unit, ChannelBias("temp_c"), np.random.default_rng(1))
    assert "uncertainty" not in c.to_dict()
    _, stated = c.apply(paper_unit.output(np.array([[0.0, 0.0, 1.0]]), {}), channels={"temp_c": 20.0}, uncertainty=True)
    assert np.all((stated > 1e-6) & (stated < 1e-4))  # standard errors of 1e-5


def test_times_that_are_not_of_the_recording_are_refused_and_those_of_a_table_count_from_its_first_row(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-5, np.random.default_rng(1))
    c = tc.calibrate(poses, signs=(-1, -1, -1), effects=["bias_drift"])
    u = paper_unit.output(twenty_six, {})
    t = np.arange(26.0)
    for times in (t + 1.7e9, np.datetime64("2026-01-01", "ns") + np.arange(26), t - 100.0):
        with pytest.raises(tc.InvalidData, match="count from its first sample"):
            c.apply(u, t=times, own_recording=True)
    whole = 10 * t
    table = pd.DataFrame(dict(zip(("ux", "uy", "uz"), u.T, strict=True)) | {"t_s": whole + 1.7e9})
    found = c.apply(table, t=whole, own_recording=True)[["ax", "ay", "az"]].to_numpy()
    assert found == pytest.approx(c.apply(u, t=whole, own_recording=True), abs=1e-12)
    table["t_s"] += np.linspace(0, 12, 26)  # to the end of the last pose
    assert c.apply(table, own_recording=True)["ax"].notna().all()


def test_a_part_of_the_recording_needs_its_times(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """The first row of a part is not the first sample of the recording."""
    poses = noisy_poses(paper_unit, twenty_six, 1e-5, np.random.default_rng(1))
    c = tc.calibrate(poses, signs=(-1, -1, -1), effects=["bias_drift"])
    u, t = paper_unit.output(twenty_six, {}), np.linspace(0, 262, 26)
    table = pd.DataFrame(dict(zip(("ux", "uy", "uz"), u.T, strict=True)) | {"t_s": t})
    with pytest.raises(tc.InvalidData, match=r"the table spans .* s, and the recording that was fitted 260 s: give t,"):
        c.apply(table[10:], own_recording=True)
    part = c.apply(table[10:], t=t[10:], own_recording=True).to_numpy()
    assert part == pytest.approx(c.apply(table, own_recording=True).to_numpy()[10:], abs=1e-12)


def test_readings_far_beyond_what_an_effect_holds_for_are_refused(paper_unit: Sensor) -> None:
    c = calibration_with(
        paper_unit, next(f for f in FORMS if f.name == "second_order_nonlinearity"), np.random.default_rng(0)
    )
    with pytest.raises(tc.Refused, match="no inverse at reading 1"):
        c.apply(np.array([[0.0, 0.0, 2.4], [2.4e7, 2.4e7, 2.4e7]]))


def test_what_is_read_off_a_calibration_can_be_changed_without_changing_it(calibration: tc.Calibration) -> None:
    before = calibration.apply([0.0, 0.0, 2.4]).tolist()
    for values in (calibration.scale_factor, calibration.misalignment, calibration.bias):
        values *= 0
    assert calibration.apply([0.0, 0.0, 2.4]).tolist() == before
    with pytest.raises(AttributeError):
        calibration.output_unit = "mV"  # type: ignore[misc]


# Documents


@pytest.fixture(scope="module")
def calibration(paper_unit: Sensor, twenty_six: np.ndarray) -> tc.Calibration:
    poses = noisy_poses(paper_unit, twenty_six, 1e-4, np.random.default_rng(2))
    return tc.calibrate(poses, signs=(-1, -1, -1), output_unit="V")


def test_a_document_is_saved_and_loaded_without_loss(calibration: tc.Calibration, tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    calibration.save(path)
    found = tc.Calibration.load(path)
    assert found.to_dict() == calibration.to_dict()
    again = tmp_path / "again.json"
    found.save(str(again))
    assert again.read_bytes() == path.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.json", "cal.json"]
    assert found.matrix == pytest.approx(calibration.matrix, rel=1e-9)
    assert (found.output_unit, found.reference_unit) == ("V", "g")
    assert found.residual.rms_g == pytest.approx(calibration.residual.rms_g)
    assert list(found.standard_errors.values()) == pytest.approx(list(calibration.standard_errors.values()), rel=1e-4)
    assert found.warnings == calibration.warnings
    assert np.isnan(found.fitted.dof)


TRUTHS = {
    "fifth_order_nonlinearity": 1e-3, "compression": 3e-3, "scale_factor_drift": 3e-6, "temperature_lag": 3e-4,
    "remanence": 1e-3,
}  # fmt: skip


FURTHER = [form for e in CATALOGUE if e.name in TRUTHS for form in e.forms]


@pytest.mark.parametrize("effect", FURTHER, ids=lambda e: f"{e.name}-{len(e.coefficients[0].name)}")
def test_a_fit_with_a_further_effect_is_saved_and_loaded_without_loss(
    effect: Effect, paper_unit: Sensor, twenty_six: np.ndarray, tmp_path: Path
) -> None:
    rng = np.random.default_rng(10)
    sensor = replace(paper_unit, effects=((effect, TRUTHS[effect.name] * np.array([1.0, -1.0, 1.0])),))
    temp_c = {"temp_c": 25 + 3 * np.sin(np.arange(26) / 2)}
    poses = noisy_poses(sensor, twenty_six[rng.permutation(26)], 1e-5, rng, channels=temp_c)
    fitted = tc.Calibration(fit(poses, signs=(-1, -1, -1), effects=[effect], excluded=()), output_unit="V")
    fitted.save(tmp_path / "cal.json")
    found = tc.Calibration.load(tmp_path / "cal.json")
    assert found.to_dict() == fitted.to_dict()
    assert found.fitted.sensor.effects[0][0] == effect
    u = np.array([p.mean for p in poses])
    held = found.fitted.covariates_of(poses)
    assert found.fitted.sensor.specific_force(u, held) == pytest.approx(
        fitted.fitted.sensor.specific_force(u, held), abs=1e-8
    )
    length = np.linalg.norm(found.fitted.sensor.specific_force(u, held), axis=1)
    assert np.sqrt(np.mean((length - 1) ** 2)) < 2e-5


def test_a_document_can_be_changed_without_changing_the_calibration(calibration: tc.Calibration) -> None:
    calibration.to_dict()["scale_factor"] = "gone"
    assert calibration.to_dict()["scale_factor"] != "gone"


def test_a_document_of_0_1_holds_long_after_the_start(paper_unit: Sensor) -> None:
    warm_up = next(e for e in FORMS if e.name == "warm_up")
    document = calibration_with(paper_unit, warm_up, np.random.default_rng(1)).to_dict()
    for key in ("holds_at", "linear_only", "doubts"):
        document.pop(key, None)
    found = tc.Calibration.from_dict(document)
    assert found.holds_at is None
    a = np.array([[0.0, 0.6, 0.8]])
    assert found.apply(
        Sensor(paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias).output(a, {})
    ) == pytest.approx(a, abs=1e-8)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "line 1: no JSON"),
        ("[1]", "expected a JSON object"),
        ('{"format": "other"}', "format: expected a triaxcal.calibration/1"),
        ("[" * 100_000, "no JSON"),
    ],
)
def test_what_is_no_document_is_an_error_that_names_the_file(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "cal.json"
    path.write_text(content)
    with pytest.raises(tc.InvalidData, match="cal") as caught:
        tc.Calibration.load(path)
    assert said in str(caught.value)


def test_a_calibration_with_effects_whose_linear_one_nobody_fitted_says_so(paper_unit: Sensor) -> None:
    c = calibration_with(paper_unit, FORMS[0], np.random.default_rng(1))
    with pytest.raises(tc.InvalidData, match="no linear one was fitted"):
        _ = c.linear_only


# How it shows itself


def test_it_shows_itself_in_a_few_lines(calibration: tc.Calibration) -> None:
    shown = repr(calibration)
    assert len(shown.splitlines()) <= 8
    assert "scale factor" in shown
    assert "V/g" in shown
    assert "26 poses" in shown
    told = calibration.summary()
    assert "bias.z" in told
    assert re.search(r"scale_factor\.x +−2\.4[\d\u202f]+\(\d\d\) V/g\n", told)
    assert "<table>" in calibration._repr_html_()


def test_names_in_html_are_no_markup(paper_unit: Sensor) -> None:
    c = calibration_with(paper_unit, ChannelBias("<b>"), np.random.default_rng(1))
    assert "<b>" not in c._repr_html_()


@pytest.mark.slow
def test_residuals_are_plotted_loaded_or_not_and_without_a_window(calibration: tc.Calibration, tmp_path: Path) -> None:
    calibration.save(tmp_path / "cal.json")
    for c in (calibration, tc.Calibration.load(tmp_path / "cal.json")):
        figure = c.plot()
        assert len(figure.axes) == 3
        assert figure.axes[0].get_ylabel() == "residual of |a|, µg"
        figure.savefig(tmp_path / "plot.png")


def test_without_poses_there_is_nothing_to_plot(paper_unit: Sensor) -> None:
    with pytest.raises(tc.InvalidData, match="no pose to plot"):
        calibration_with(paper_unit, FORMS[0], np.random.default_rng(1)).plot()


@pytest.mark.parametrize("spoiled", [{"poses": [{}]}, {"poses": [5]}, {"poses": "all"}, {"units": 5}])
def test_a_document_whose_poses_cannot_be_plotted_is_said(paper_unit: Sensor, spoiled: dict[str, Any]) -> None:
    document = calibration_with(paper_unit, FORMS[0], np.random.default_rng(1)).to_dict()
    document |= {"poses": [{"used": True, "residual_g": 0.0, "standard_error_g": 1e-5, "direction": [0, 0, 1]}]}
    with pytest.raises(tc.InvalidData, match="cannot be plotted"):
        residuals_figure({**document, **spoiled})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"terms": ["linear", "temperature_bias"]}, "effects: no coefficients of temperature_bias, which terms has"),
        ({"scale_factor": [True, True, True]}, "not numbers where numbers belong"),
        ({"bias": ["0.1", "0.2", "0.3"]}, "not numbers where numbers belong"),
    ],
)
def test_a_document_that_contradicts_itself_is_refused(
    paper_unit: Sensor, twenty_six: np.ndarray, change: dict[str, object], words: str
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, 1e-5, np.random.default_rng(1))
    document = tc.calibrate(poses, signs=(-1, -1, -1)).to_dict()
    with pytest.raises(tc.InvalidData, match=words):
        tc.Calibration.from_dict(document | change, where="cal.json")
