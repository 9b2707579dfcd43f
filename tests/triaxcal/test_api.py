"""From samples to a calibration in use, as a caller does it, against the truth of a simulated unit."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import triaxcal as tc
from triaxcal.effects import effect_of
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.quality.finding import INVALIDATING
from triaxcal.synthetic import Environment, SyntheticUnit, Tumble
from triaxcal.text import traces as text_of_traces

MINUS = (-1, -1, -1)


class Recorded(NamedTuple):
    unit: SyntheticUnit
    t: np.ndarray
    u: np.ndarray
    temp_c: np.ndarray

    def frame(self) -> pd.DataFrame:
        outputs = dict(zip(("ux", "uy", "uz"), self.u.T, strict=True))
        return pd.DataFrame({"t_s": self.t, **outputs, "temp_c": self.temp_c})


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    effect = effect_of("temperature_bias", {"x": 4e-4, "y": -2e-4, "z": 3e-4})
    sensor = Sensor(
        np.array([-2.41, -2.4, -2.37]), np.array([6e-3, 4e-3, -6e-4]), np.array([5e-3, -3e-3, 4e-3]), (effect,)
    )
    path = Tumble(np.array([v for _, v in directions(26)]), 2.0, 1.0)
    unit = SyntheticUnit(sensor, path, np.full(3, 2e-4), Environment(25.0, 0.02, 4.0, 37.0))
    t = np.arange(0.0, 79.0, 0.01)
    u, temp_c = unit.sample(t)
    return Recorded(unit, t, u, temp_c)


@pytest.fixture(scope="module")
def poses(recorded: Recorded) -> Any:
    return tc.find_poses(recorded.t, recorded.u, channels={"temp_c": recorded.temp_c})


@pytest.fixture(scope="module")
def diagnosed(poses: Any) -> tc.Diagnosis:
    return tc.diagnose(poses, signs=MINUS, output_unit="V")


# Poses


def test_poses_say_themselves_in_a_few_lines(poses: Any) -> None:
    assert repr(poses).startswith(f"{len(poses)} still poses from {poses[0].start_s:.1f} to {poses[-1].end_s:.1f} s")
    assert len(repr(poses)) < 500


@pytest.mark.slow
def test_a_unit_that_was_said_of_the_poses_is_the_calibrations(recorded: Recorded) -> None:
    found = tc.find_poses(recorded.frame(), output_unit="V")
    assert tc.calibrate(found, signs=MINUS).output_unit == "V"
    assert tc.diagnose(found, signs=MINUS).calibration.output_unit == "V"
    assert tc.calibrate(found, signs=MINUS, output_unit="mV").output_unit == "mV"


def test_rows_may_be_labelled_by_their_times(recorded: Recorded, poses: Any) -> None:
    frame = recorded.frame()
    stamps = pd.to_datetime("2026-03-09") + pd.to_timedelta(frame.pop("t_s"), unit="s")
    for index, columns in ((pd.DatetimeIndex(stamps), None), (pd.DatetimeIndex(stamps, name="at"), {"t": "at"})):
        found = tc.find_poses(frame.set_index(index), columns=columns)
        assert [p.samples for p in found] == [p.samples for p in poses]


@pytest.mark.slow
def test_numbers_whose_name_states_another_unit_are_not_seconds(recorded: Recorded) -> None:
    frame = recorded.frame()
    for name, unit, scale in (("millis", "ms", 1e3), ("time (us)", "us", 1e6), ("t_ns", "ns", 1e9)):
        frame[name] = frame["t_s"] * scale
        with pytest.raises(tc.InvalidData, match=f"floats count as seconds; if they are in {unit}: time_unit='{unit}'"):
            tc.find_poses(frame.drop(columns="t_s"), columns={"t": name})
        assert len(tc.find_poses(frame.drop(columns="t_s"), columns={"t": name}, time_unit=unit)) > 20
        frame = frame.drop(columns=name)
    frame["seconds"] = frame.pop("t_s")
    assert len(tc.find_poses(frame, columns={"t": "seconds"})) > 20


def test_what_is_meant_as_an_output_is_no_channel(recorded: Recorded) -> None:
    with pytest.raises(tc.InvalidData, match="columns: u_x is no role; expected t, ux, uy, uz, or the name a channel"):
        tc.find_poses(recorded.frame(), columns={"u_x": "ux"})


@pytest.mark.slow
def test_times_may_be_seconds_datetimes_or_integers_of_a_unit(recorded: Recorded, poses: Any) -> None:
    ns = np.round(recorded.t * 1e9).astype(np.int64)
    started_problem = np.datetime64("2026-03-01T08:00:00", "ns")
    zoned = pd.date_range("2026-03-01 10:00", periods=len(ns), freq="10ms", tz="Europe/Kyiv")
    for times in (zoned, pd.Series(zoned), zoned.to_pydatetime().tolist(), [str(t) for t in started_problem + ns]):
        found = tc.find_poses(times, recorded.u)
        assert [p.start_s for p in found] == pytest.approx([p.start_s for p in poses], abs=1e-6)
    for t, unit in (
        (ns, "ns"),
        (ns // 1000, "us"),
        (started_problem + ns, None),
        (recorded.t * 1e3, "ms"),
        (recorded.t + 1.7e9, None),
    ):
        found = tc.find_poses(t, recorded.u, time_unit=unit)
        assert [p.start_s for p in found] == pytest.approx([p.start_s for p in poses], abs=1e-6)


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_data_frame_gives_the_same_poses(recorded: Recorded, poses: Any, library: str) -> None:
    frame = recorded.frame()
    table = frame if library == "pandas" else pl.from_pandas(frame)
    found = tc.find_poses(table)
    assert [p.mean.tolist() for p in found] == [p.mean.tolist() for p in poses]
    assert found[0].channels == poses[0].channels
    renamed = frame.rename(columns={"t_s": "time", "ux": "X", "temp_c": "T"})
    named = renamed if library == "pandas" else pl.from_pandas(renamed)
    found = tc.find_poses(named, columns={"t": "time", "ux": "X", "temp_c": "T"})
    assert found[0].channels == poses[0].channels


@pytest.mark.slow
def test_what_a_stream_is_to_be_blamed_for_is_said(recorded: Recorded) -> None:
    u = recorded.u.copy()
    u[1000:1300, 1] = u[1000, 1]
    found = tc.find_poses(recorded.t, u)
    assert [line.split(":")[0] for line in found.data_quality] == ["stuck_output"]
    assert {p.fault for p in found} - {""} <= set(INVALIDATING)


@pytest.mark.parametrize(
    ("t", "u", "more", "said"),
    [
        (
            np.arange(9.0),
            np.zeros((9, 3)),
            {},
            "too short: a still pose takes at least 15 samples .14 s at this rate., and it has 9 in 8 s",
        ),
        (["early", "late"], np.zeros((2, 3)), {}, "t: expected seconds or datetimes, not str"),
        (np.arange(9), np.zeros((9, 3)), {}, "t are integers: say their unit by time_unit, one of s, ms, us, ns"),
        (np.arange(9.0), np.zeros((3, 9)), {}, r"u: expected shape \(n, 3\) or \(3,\), not \(3, 9\); transpose it"),
        (np.arange(8.0), np.zeros((9, 3)), {}, "t has 8 times, and u has 9 samples"),
        (np.arange(9.0), np.zeros(9), {}, r"u: expected shape \(n, 3\) or \(3,\), not \(9,\)"),
        (
            np.arange(9.0),
            np.zeros((9, 3)),
            {"channels": {"temp_c": np.zeros(8)}},
            "channel temp_c: expected one number or 9",
        ),
        (np.arange(9.0), np.zeros((9, 3)), {"time_unit": "h"}, "time_unit: expected s, ms, us, ns, not 'h'"),
        (1e9 * np.arange(1.0, 20.0), np.zeros((19, 3)), {}, "t goes to 1.9e.10, too much for seconds: say its unit"),
        (np.arange(9.0), [["a", 1, 2]] * 9, {}, "u: expected numbers, not int and str"),
        (np.zeros((9, 3)), None, {}, r"expected t \(n,\) and u \(n,3\), or a table"),
        (pd.DataFrame({"t_s": [0.0], "ux": [0.0]}), None, {}, "the table has no column uy; it has t_s, ux"),
        (np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)), {}, "time does not increase at sample 2"),
    ],
)
def test_what_cannot_be_samples_is_said_with_what_was_expected(t: Any, u: Any, more: dict[str, Any], said: str) -> None:
    with pytest.raises(tc.InvalidData, match=said):
        tc.find_poses(t, u, **more)


# Calibrations


@pytest.mark.slow
def test_the_truth_is_recovered_and_the_linear_one_is_beside_it(recorded: Recorded, diagnosed: tc.Diagnosis) -> None:
    found, truth = diagnosed.calibration, recorded.unit.sensor
    assert found.terms == ("linear", "temperature_bias")
    error = found.fitted.standard_errors
    assert np.all(np.abs(found.scale_factor - truth.scale_factor) < 5 * error[:3])
    assert np.all(np.abs(found.misalignment - truth.misalignment) < 5 * error[3:6])
    assert found.linear_only.terms == ("linear",)
    assert found.linear_only.residual.rms_g > 5 * found.residual.rms_g
    assert diagnosed.before.residual == found.linear_only.residual


@pytest.mark.slow
def test_poses_samples_and_tables_give_the_same_calibration(recorded: Recorded, poses: Any) -> None:
    by_poses = tc.calibrate(poses, signs=MINUS)
    by_samples = tc.calibrate(recorded.t, recorded.u, signs=MINUS, channels={"temp_c": recorded.temp_c})
    by_table = tc.calibrate(recorded.frame(), signs=MINUS)
    assert by_poses.matrix.tolist() == by_samples.matrix.tolist() == by_table.matrix.tolist()


def test_effects_are_fitted_by_name(poses: Any) -> None:
    found = tc.calibrate(poses, signs=MINUS, effects=["temperature_bias"])
    assert found.effects["temperature_bias"]["x"][0] == pytest.approx(4e-4, abs=2e-5)
    with pytest.raises(tc.InvalidData, match="no effect of the name flat_earth"):
        tc.calibrate(poses, effects=["flat_earth"])


def test_poses_that_cannot_carry_it_are_refused(poses: Any) -> None:
    with pytest.raises(tc.Refused) as caught:
        tc.calibrate(poses[:6], signs=MINUS)
    assert caught.value.wanted


@pytest.mark.slow
def test_a_calibration_is_verified_on_poses_that_no_fit_saw(recorded: Recorded, diagnosed: tc.Diagnosis) -> None:
    t = recorded.t + 200.0
    u, temp_c = recorded.unit.sample(t)
    found = tc.verify(diagnosed.calibration, t, u, channels={"temp_c": temp_c})
    assert len(found.poses) == len(found.error) >= 25
    assert found.noise_floor < found.expected
    assert found.rms < 2 * found.expected
    assert "expected of noise and the calibration's uncertainty" in repr(found)
    assert tc.verify(diagnosed.before, t, u).rms > 5 * found.rms
    with pytest.raises(tc.Refused, match="no still pose"):
        tc.verify(diagnosed.calibration, [])


@pytest.mark.slow
def test_the_moment_for_which_it_holds_is_chosen(poses: Any) -> None:
    held = {at: tc.diagnose(poses, signs=MINUS, at=at).calibration.holds_at for at in ("end", "mean", 12.5)}
    assert [h.t_s for h in held.values() if h] == pytest.approx(
        [poses[-1].end_s, np.mean([p.t_s for p in poses]), 12.5]
    )
    for wrong in ("later", "seconds", -1.0):
        with pytest.raises(tc.InvalidData):
            tc.diagnose(poses, signs=MINUS, at=wrong)


def test_the_budget_is_that_of_the_fit_and_a_loaded_calibration_has_it_in_its_document(diagnosed: tc.Diagnosis) -> None:
    found = tc.budget(diagnosed.calibration, tc.Stated(reference=1e-4))
    assert "reference" in {line.source for line in found.components}
    with pytest.raises(tc.InvalidData, match="to_dict"):
        tc.budget(tc.Calibration.from_dict(diagnosed.calibration.to_dict()))


def test_a_plan_comes_back_to_its_first_pose() -> None:
    found = tc.plan(14)
    assert len(found) == 15
    assert found[0] == found[-1]
    assert all(np.linalg.norm(p.up) == pytest.approx(1) for p in found)
    with pytest.raises(tc.InvalidData):
        tc.plan(3)


# What is given and cannot be taken


def test_a_channel_with_gaps_is_left_out_of_a_table_and_that_is_said(recorded: Recorded) -> None:
    table = recorded.frame()
    table.loc[5, "temp_c"] = np.nan
    with pytest.warns(tc.MissingChannel, match="channel temp_c left out: 1 of 7900 values missing"):
        assert tc.find_poses(table)[0].channels == {}
    with pytest.raises(tc.InvalidData, match="channel temp_c: value 5 is not a finite number"):
        tc.find_poses(recorded.t, recorded.u, channels={"temp_c": table["temp_c"]})


@pytest.mark.parametrize("given", [{"channels": {"temp_c": 25.0}}, {"time_unit": "ms"}, {"columns": {"t": "time"}}])
def test_what_belongs_to_samples_is_not_dropped_where_poses_are_given(poses: Any, given: dict[str, Any]) -> None:
    with pytest.raises(tc.InvalidData, match=f"{next(iter(given))}: the poses are found already"):
        tc.calibrate(poses, **given)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"signs": (1, 1)}, "signs: expected three of 1 and -1"),
        ({"signs": None}, "signs: expected three of 1 and -1"),
        ({"effects": ["warm_up", "warm_up"]}, "warm_up is asked for twice"),
    ],
)
def test_wrong_options_of_a_calibration_are_said(poses: Any, more: dict[str, Any], said: str) -> None:
    with pytest.raises(tc.InvalidData, match=said):
        tc.calibrate(poses, **more)


def test_one_effect_may_be_named_without_a_list(poses: Any) -> None:
    assert tc.calibrate(poses, signs=MINUS, effects="temperature_bias").terms == ("linear", "temperature_bias")


@pytest.mark.slow
def test_a_check_recording_may_be_a_table(recorded: Recorded, poses: Any) -> None:
    assert tc.diagnose(poses, signs=MINUS, check=recorded.frame()).held_out is not None


def test_integer_times_beyond_what_can_be_counted_are_refused(recorded: Recorded) -> None:
    with pytest.raises(tc.InvalidData, match="beyond what can be counted in ns"):
        tc.find_poses(np.round(recorded.t * 1e9).astype(np.int64), recorded.u, time_unit="s")


def test_a_table_with_two_columns_of_a_name_is_refused_and_one_with_a_number_for_a_name_is_not(
    recorded: Recorded,
) -> None:
    table = recorded.frame()
    assert len(tc.find_poses(table.assign(ignored=1.0).rename(columns={"ignored": 0}))) > 20
    with pytest.raises(tc.InvalidData, match="two columns ux"):
        tc.find_poses(table.rename(columns={"uy": "ux"}))


def test_the_budget_counts_what_the_calibration_was_made_with(poses: Any) -> None:
    found = tc.calibrate(poses, signs=MINUS, stated=tc.Stated(reference=1e-3))
    assert float(tc.budget(found).magnitude.standard) > 1e-3


def test_a_diagnosis_says_itself_in_a_few_lines(diagnosed: tc.Diagnosis) -> None:
    lines = repr(diagnosed).splitlines()
    assert lines[0] == "Diagnosis"
    assert lines[1] == f"  {diagnosed.call}"
    assert lines[2].startswith(f"  {diagnosed.findings[0].effect} (")
    assert lines[3].startswith("  cross-validated rms ")
    assert lines[3].index("χ² per degree of freedom") < lines[3].index("residual rms")
    assert len(lines) == 5


def test_a_diagnosis_is_plotted_without_a_window(diagnosed: tc.Diagnosis, tmp_path: Path) -> None:
    figure = diagnosed.plot()
    panels = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left") for axes in panels] == [text_of_traces.title(t) for t in diagnosed.traces]
    (effect,) = {t.effect for t in diagnosed.traces}
    assert effect == diagnosed.findings[0].effect
    for axes, trace in zip(panels, diagnosed.traces, strict=True):
        curve = next(line for line in axes.lines if len(line.get_xdata()) == len(trace.grid))
        np.testing.assert_allclose(curve.get_ydata(), trace.curve * 1e6)
        assert axes.get_ylabel().endswith("µg")
    figure.savefig(tmp_path / "plot.png")
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_a_diagnosis_has_what_acts_with_its_probability(diagnosed: tc.Diagnosis) -> None:
    (finding,) = diagnosed.findings
    assert diagnosed.probabilities[finding.effect] == finding.probability > 0.99
    assert list(diagnosed.probabilities.values()) == sorted(diagnosed.probabilities.values(), reverse=True)
    assert diagnosed.candidates == ()
    assert diagnosed.unexplained.probability < 0.5
    assert diagnosed.next_recording.expanded_uncertainty > diagnosed.next_recording.start_to_start


def test_a_calibration_has_three_uncertainties_of_the_magnitude(diagnosed: tc.Diagnosis) -> None:
    calibration = diagnosed.calibration
    expanded = calibration.expanded_uncertainty
    assert list(expanded) == ["this_fit", "this_sessions_poses", "another_day"]
    assert 0 < expanded["this_fit"] < expanded["another_day"]
    assert expanded["another_day"] == pytest.approx(diagnosed.next_recording.expanded_uncertainty, rel=1e-3)
    document = calibration.to_dict()
    assert expanded == document["expanded_uncertainty_g"]
    del document["expanded_uncertainty_g"]
    assert tc.Calibration.from_dict(document).expanded_uncertainty == {}


@pytest.mark.parametrize("reference", ["1", None, 0.0, -1.0, float("nan"), [1.0]])
def test_a_reference_that_is_no_positive_number_is_said(poses: tc.Poses, reference: Any) -> None:
    with pytest.raises(tc.InvalidData, match="reference: expected a positive number"):
        tc.calibrate(poses, signs=MINUS, reference=reference)


@pytest.mark.slow
def test_an_arrow_table_is_taken_and_a_lazy_one_is_to_be_collected(recorded: Recorded) -> None:
    frame = recorded.frame()
    found = tc.find_poses(pa.Table.from_pandas(frame, preserve_index=False))
    assert [p.samples for p in found] == [p.samples for p in tc.find_poses(frame)]
    with pytest.raises(tc.InvalidData, match="a lazy table: collect it first"):
        tc.find_poses(pl.LazyFrame({"t_s": [0.0]}))


def test_a_column_that_numbers_the_rows_is_no_channel(recorded: Recorded) -> None:
    frame = recorded.frame()
    frame["n"] = np.arange(len(frame)) + 7
    with pytest.warns(tc.MissingChannel, match="column n left out: it numbers the rows"):
        found = tc.find_poses(frame)
    assert set(found[0].channels) == {"temp_c"}


def test_outputs_of_a_table_are_taken_by_their_names(recorded: Recorded, poses: Any) -> None:
    frame = recorded.frame()
    found = tc.find_poses(frame["t_s"], frame[["uz", "uy", "ux"]])
    assert [list(p.mean) for p in found] == [list(p.mean) for p in poses]


def test_a_gap_in_a_channel_is_a_gap_in_what_is_calibrated(recorded: Recorded, diagnosed: tc.Diagnosis) -> None:
    temp_c = recorded.temp_c.copy()
    temp_c[3] = np.nan
    a = diagnosed.calibration.apply(recorded.u, channels={"temp_c": temp_c})
    assert np.isnan(a[3]).any()
    assert np.isfinite(np.delete(a, 3, axis=0)).all()


def test_floats_that_are_no_seconds_of_a_logger_are_asked_about() -> None:
    times_ms, u = np.arange(500) * 10.0, np.tile([0.0, 0.0, 1.0], (500, 1))
    with pytest.raises(tc.InvalidData, match="10 apart: say their unit by time_unit"):
        tc.find_poses(times_ms, u)
    assert len(tc.find_poses(times_ms, u, time_unit="ms")) <= 1
