"""Lines that name their numbers, or that a serial monitor has stamped: all numbers with their signs, or asked about."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.written import asked, read
from triaxcald.tables.samples import Reading

N, RATE = 40, 50.0
U = np.round(np.random.default_rng(7).normal(0, 1, (N, 3)), 3)
T = np.arange(N) / RATE
Line = Callable[[str, float, float, float, float], str]
"""Of the time of day, seconds and the three outputs."""


def text_of(line: Line, head: str = "") -> str:
    rows = [(f"12:00:{t:06.3f}", float(t), *map(float, u)) for t, u in zip(T, U, strict=True)]
    return head + "".join(line(*row) + "\n" for row in rows)


TIMED: dict[str, Line] = {
    "equals": lambda c, t, x, y, z: f"t={t:.2f} ax={x} ay={y} az={z}",
    "colons and commas": lambda c, t, x, y, z: f"t: {t:.2f}, ax: {x}, ay: {y}, az: {z}, T: 25.1",
    "no blanks": lambda c, t, x, y, z: f"millis:{t * 1000:.0f},ax:{x},ay:{y},az:{z}",
    "tabs": lambda c, t, x, y, z: f"millis: {t * 1000:.0f}\tx: {x}\ty: {y}\tz: {z}",
    "bars": lambda c, t, x, y, z: f"millis = {t * 1000:.0f} | X = {x} | Y = {y} | Z = {z}",
    "units": lambda c, t, x, y, z: f"t={t:.2f} s ax={x} g ay={y} g az={z} g",
    "units without a blank": lambda c, t, x, y, z: f"t={t:.2f}s, ax={x}g, ay={y}g, az={z}g",
    "lists": lambda c, t, x, y, z: f"t={t:.2f} acc=[{x}, {y}, {z}] gyr=[1, 2, 3]",
    "brackets": lambda c, t, x, y, z: f"t={t:.2f} gyro=(1 2 3) accel=({x} {y} {z})",
    "decimal commas": lambda c, t, x, y, z: f"t={t:.2f} ax={x:.3f} ay={y:.3f} az={z:.3f}".replace(".", ","),
    "decimal commas in a list": lambda c, t, x, y, z: f"t: {t:.2f} acc: {x:.3f}; {y:.3f}; {z:.3f}".replace(".", ","),
    "words between": lambda c, t, x, y, z: f"state=OK t={t:.2f} ax={x} ay={y} az={z} mode=run",
    "sensors by prefix": lambda c, t, x, y, z: f"t={t:.2f} Acc: X={x} Y={y} Z={z}; Gyro: X=1 Y=2 Z=3",
    "time of day": lambda c, t, x, y, z: f"{c} ax={x} ay={y} az={z}",
    "labelled time of day": lambda c, t, x, y, z: f"time={c} ax={x} ay={y} az={z}",
    "ISO 8601": lambda c, t, x, y, z: f"2024-03-09T{c}Z, ax={x}, ay={y}, az={z}",
    "monitor, labels": lambda c, t, x, y, z: f"{c} -> ax={x} ay={y} az={z}",
    "monitor, one label": lambda c, t, x, y, z: f"{c} -> a/g:\t{x}\t{y}\t{z}\t-12\t30\t5",
    "monitor, brackets": lambda c, t, x, y, z: f"[2024-03-09 {c}] ax={x} ay={y} az={z}",
    "monitor, JSON": lambda c, t, x, y, z: f"{c} -> " + json.dumps({"acc": {"x": x, "y": y, "z": z}}),
    "monitor, own time": lambda c, t, x, y, z: f"[11:00:00] millis: {t * 1000:.0f}, ax: {x}, ay: {y}, az: {z}",
    "firmware's log": lambda c, t, x, y, z: f"I ({t * 1000:.0f}) imu: ax={x} ay={y} az={z}",
    "firmware's log, microseconds": lambda c, t, x, y, z: f"[{c},250] <inf> imu: ax={x} ay={y} az={z}",
    "words before": lambda c, t, x, y, z: f"IMU t={t:.2f} IMU ax={x} ay={y} az={z}",
    "other separators": lambda c, t, x, y, z: f"t={t:.2f}&ax={x}&ay={y}&az={z}",
    "braces": lambda c, t, x, y, z: f"imu {{millis: {t * 1000:.0f}, ax: {x}, ay: {y}, az: {z}}}",
    "a number first": lambda c, t, x, y, z: f"{t * 50:.0f}: t={t:.2f} ax={x} ay={y} az={z}",
    "JSON behind a word": lambda c, t, x, y, z: "data: " + json.dumps({"t": t, "ax": x, "ay": y, "az": z}),
    "JSON": lambda c, t, x, y, z: json.dumps({"t": t, "ax": x, "ay": y, "az": z}),
    "JSON, nested": lambda c, t, x, y, z: json.dumps({"millis": round(t * 1000), "acc": {"x": x, "y": y, "z": z}}),
    "JSON, lists": lambda c, t, x, y, z: json.dumps({"t": t, "name": "u", "acc": [x, y, z], "gyro": [1, 2, 3]}),
}


@pytest.mark.parametrize("kind", TIMED)
def test_lines_with_labels_are_read(tmp_path: Path, kind: str) -> None:
    table = read(tmp_path, text_of(TIMED[kind]), name="a.txt")
    np.testing.assert_array_equal(table.samples.readings, U)
    np.testing.assert_allclose((table.samples.time_ns - table.samples.time_ns[0]) * 1e-9, T, atol=1e-9)
    assert table.remarks[0].startswith("read as t = ")
    assert table.output_unit == ("g" if "units" in kind else "")


UNTIMED: dict[str, Line] = {
    "equals": lambda c, t, x, y, z: f"ax={x} ay={y} az={z}",
    "commas between whole numbers": lambda c, t, x, y, z: f"acc: {1000 * x:.0f},{1000 * y:.0f},{1000 * z:.0f}",
    "six of them": lambda c, t, x, y, z: f"a/g: {1000 * x:.0f},{1000 * y:.0f},{1000 * z:.0f},1,2,3",
    "no marks": lambda c, t, x, y, z: f"ax {x} ay {y} az {z}",
    "one label": lambda c, t, x, y, z: f"a/g:\t{x}\t{y}\t{z}\t-12\t30\t5",
    "after a word": lambda c, t, x, y, z: f"Accelerometer: X {x} Y {y} Z {z}",
    "unit at the end": lambda c, t, x, y, z: f"X: {x}  Y: {y}  Z: {z}  m/s^2 ",
    "lines of other sensors": lambda c, t, x, y, z: (
        f"Acceleration X: {x}, Y: {y}, Z: {z} m/s^2\nRotation X: 0.1, Y: 0.2, Z: 0.3 rad/s\nTemperature: 36.5 degC\n"
    ),
}


@pytest.mark.parametrize("kind", UNTIMED)
def test_lines_without_a_time_are_asked_about_and_counted(tmp_path: Path, kind: str) -> None:
    text = text_of(UNTIMED[kind])
    assert "--rate HZ" in asked(tmp_path, text)
    table = read(tmp_path, text, Reading(rate=RATE))
    whole = "whole" in kind or "six" in kind
    np.testing.assert_allclose(table.samples.readings, U * 1000 if whole else U, rtol=1e-12)
    np.testing.assert_array_equal(table.samples.time_ns, np.arange(N) * 20_000_000)
    assert table.output_unit == ("m/s^2" if "m/s^2" in text else "")
    if kind == "lines of other sensors":
        assert [remark for remark in table.remarks if "40 lines" in remark and "Rotation" in remark]


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("stamp", ["{} -> ", "{} > ", "[{}] ", "[2024-03-09 {}] ", "09.03.2024 {} -> "])
def test_a_plain_table_behind_the_stamps_of_a_monitor_is_read(tmp_path: Path, stamp: str, separator: str) -> None:
    header = "".join(stamp.format("11:59:59.9") + line + "\n" for line in ("ready", separator.join(("ax", "ay", "az"))))
    text = text_of(lambda c, t, x, y, z: stamp.format(c) + separator.join(map(str, (x, y, z))), header)
    table = read(tmp_path, text)
    np.testing.assert_array_equal(table.samples.readings, U)
    np.testing.assert_allclose((table.samples.time_ns - table.samples.time_ns[0]) * 1e-9, T, atol=1e-9)


def test_a_plain_table_behind_stamps_without_a_header_is_asked_about_with_the_right_columns(tmp_path: Path) -> None:
    text = text_of(lambda c, t, x, y, z: f"{c} -> {x},{y},{z}")
    assert "--columns t=4,ux=1,uy=2,uz=3" in asked(tmp_path, text)
    table = read(tmp_path, text, Reading({"t": "4", "ux": "1", "uy": "2", "uz": "3"}))
    np.testing.assert_array_equal(table.samples.readings, U)


DOCUMENTS = {
    "records": [{"t": t, "ax": u[0], "ay": u[1], "az": u[2]} for t, u in zip(T.tolist(), U.tolist(), strict=True)],
    "columns": {"device": "u", "t": T.tolist(), **dict(zip(("ax", "ay", "az"), U.T.tolist(), strict=True))},
}
DOCUMENTS["wrapped"] = {"device": "u", "rate": 50, "data": DOCUMENTS["records"]}


@pytest.mark.parametrize("indent", [None, 1])
@pytest.mark.parametrize("kind", DOCUMENTS)
def test_a_json_document_of_records_or_columns_is_read(tmp_path: Path, kind: str, indent: int | None) -> None:
    table = read(tmp_path, json.dumps(DOCUMENTS[kind], indent=indent), name="a.json")
    np.testing.assert_array_equal(table.samples.readings, U)
    np.testing.assert_allclose(table.samples.time_ns * 1e-9, T, atol=1e-9)


@pytest.mark.parametrize("kind", ["equals", "no blanks", "lists", "JSON", "monitor, labels", "time of day"])
@pytest.mark.parametrize("damage", [lambda line: line[:12], lambda line: line.replace("1", "$"), lambda line: "\x7f?"])
def test_a_garbled_line_is_named_and_left_out_on_demand(
    tmp_path: Path, kind: str, damage: Callable[[str], str]
) -> None:
    lines = text_of(TIMED[kind], "started\n\n").split("\n")
    lines[20] = damage(lines[20])
    fault = asked(tmp_path, "\n".join(lines))
    assert fault.startswith("line 21: ")
    assert "--skip-bad" in fault
    table = read(tmp_path, "\n".join(lines), Reading(skip_bad=True))
    np.testing.assert_array_equal(table.samples.readings, np.delete(U, 18, axis=0))


def test_a_label_that_comes_at_times_has_gaps(tmp_path: Path) -> None:
    text = text_of(lambda c, t, x, y, z: f"t={t:.2f} ax={x} ay={y} az={z}" + " temp=20" * (round(t * 50) % 5 == 0))
    table = read(tmp_path, text)
    np.testing.assert_array_equal(table.samples.readings, U)
    assert not table.samples.channels


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("sensor={0} t={1} x={2} y={3} z={4}", "--where sensor=ACC"),
        ('{{"sensor": "{0}", "t": {1}, "x": {2}, "y": {3}, "z": {4}}}', "--where sensor=ACC"),
        ("t={1} x={2} y={3} z={4} {0}", "--where words=ACC"),
        ("{0}: t={1} ax={2} ay={3} az={4}", "--where source=ACC"),
        ("[{0}] t={1} x={2} y={3} z={4}", "keep those of one sensor"),
    ],
)
def test_lines_of_two_sensors_in_turn_are_asked_about(tmp_path: Path, line: str, option: str) -> None:
    text = text_of(lambda c, t, x, y, z: line.format(["ACC", "GYR"][round(t * 50) % 2], round(t, 2), x, y, z))
    assert option in asked(tmp_path, text)


@pytest.mark.parametrize("text", ["walk{1},{2},{3},{4}", "walk {1} {2} {3} {4}", "12:00:00.{0},{2},{3},{4}"])
def test_a_table_whose_rows_begin_with_a_name_or_a_time_is_none_of_labels(tmp_path: Path, text: str) -> None:
    rows = text_of(lambda c, t, x, y, z: text.format(round(t * 1000) + 100, round(t, 2), x, y, z))
    assert "no header over" in asked(tmp_path, rows)
