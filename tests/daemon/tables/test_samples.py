"""Tables as programs write them are read rightly, or asked about; none is read wrongly without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.exports import EXPORTS, Export
from tests.daemon.tables.written import EVERY, GOOD, asked, lines, read
from triaxcald.errors import InputError
from triaxcald.tables.samples import Reading, Table, read_table

CLEAR = [e for e in EXPORTS if e.hint is None]
ASKED = [e for e in EXPORTS if e.hint is not None]


def written(folder: Path, export: Export) -> str:
    path = folder / f"export{export.suffix}"
    path.write_bytes(export.data)
    return str(path)


def require_right(table: Table, export: Export) -> None:
    times = (table.samples.time_ns - table.samples.time_ns[0]) * 1e-6
    np.testing.assert_allclose(times, export.times_ms() - export.times_ms()[0], atol=1e-3)
    np.testing.assert_allclose(table.samples.readings, export.outputs(), rtol=1e-9, atol=6e-5)
    if export.channels is not None:
        assert tuple(table.samples.channels) == export.channels


@pytest.mark.parametrize("export", CLEAR, ids=lambda e: e.program)
def test_a_clear_table_is_read_and_how_is_said(tmp_path: Path, export: Export) -> None:
    table = read_table(written(tmp_path, export))
    require_right(table, export)
    assert table.remarks[0].startswith("read as t = ")


@pytest.mark.parametrize("export", ASKED, ids=lambda e: e.program)
def test_a_table_with_two_readings_is_asked_about_and_read_as_the_option_says(tmp_path: Path, export: Export) -> None:
    path = written(tmp_path, export)
    with pytest.raises(InputError) as caught:
        read_table(path)
    assert export.asked in str(caught.value)
    require_right(read_table(path, export.hint), export)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("time,ax,ay,az\n0.01,1,2,3\n0.00,1,2,4\n0.02,1,2,5\n", "line 3: column time: the time is before that"),
        ("time,ax,ay,az\n0.00,1,2,3\n0.00,1,2,4\n0.02,1,2,5\n", "line 3: column time: the time is that of the line"),
        ("time,ax,ay,az\n0.0,low,2,3\n0.1,low,2,3\n0.2,low,2,3\n", "line 2: column ax: 'low', expected a finite"),
        ("time,ax,ay,az\n0.0,1e300,2,3\n0.1,1,2,3\n0.2,1,2,3\n", "line 2: column ax: a value of 1e+100 or more"),
        ("a,b,c\nx,y,z\n", "no line with three numbers"),
        ('{"a": [1, 2, 3]}', "no line with three numbers"),
        ("", "empty file, expected"),
        ("  \n \n", "empty file, expected"),
        (b"PK\x03\x04\x00\x00", "binary data (a ZIP archive or a spreadsheet; save it as CSV)"),
        (b"\x1f\x8b\x08\x00", "binary data (gzip; name it .gz)"),
        (b"PAR1\x00\x00", "binary data (Parquet; name it .parquet)"),
        ("\n<!DOCTYPE html>\n<html><body>a, b, c\n0.1, 0.2, 0.3\n0.2, 0.3, 0.4\n</body></html>",
         "HTML, expected a text table"),
        (b"\x00\x01\x02\x03" * 50, "binary data, expected a text table"),
        ("time,ax,ay,az\n0,01,0,98,0,03,-0,11\n0,02,0,97,0,03,-0,10\n", "line 1: 4 names, and 8 fields in the lines"),
        ("t,ax,ay,az,bx [µT],by [µT],bz [µT]\n0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n", None),
        ("t,ax,ay,az,bx,by,bz\n0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n",
         "2 triples of outputs (ax, ay, az; bx, by, bz); choose by --columns ux=ax,"),
        ("t,Sensor A x,Sensor A y,Sensor A z,Sensor B x,Sensor B y,Sensor B z\n0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n",
         "2 triples of outputs (Sensor A x, Sensor A y, Sensor A z; Sensor B x"),
        ("ms,ax,ay,az\n4294967280,1,2,3\n4294967290,1,2,3\n4,1,2,3\n14,1,2,3\n",
         "line 4: column ms: the time falls back, as a counter does that starts again; --rate HZ"),
        ("t,left_x,left_y,left_z,right_x,right_y,right_z\n0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n",
         "2 triples of outputs (left_x, left_y, left_z; right_x, right_y, right_z); choose by --columns ux=left_x,"),
        ("t,x,y,z,x,y,z\n0.0,1,2,3,4,5,6\n0.1,1,2,3,4,5,6\n", "choose by --columns ux=2,uy=3,uz=4"),
        ("t,gx,gy,gz\n0.0,1,2,3\n0.1,1,2,3\n", "no column that is called as an accelerometer's output; if gx, gy, gz"),
        ("t,linear_x,linear_y,linear_z\n0.0,1,2,3\n0.1,1,2,3\n", "linear_z seem to be without gravity"),
        ("t,ch3,ch2,ch1\n0.0,1,2,3\n0.1,1,2,3\n", "no three outputs among the columns t, ch3, ch2, ch1"),
        ("ax,ay,az\n1,2,3\n1,2,3\n", "no column of time; name it (--columns t=NAME,…), or say how many samples"),
        ("time,clock,ax,ay,az\n0.0,0.0,1,2,3\n0.1,0.15,1,2,3\n0.2,0.3,1,2,3\n10.3,22.1,1,2,3\n",
         "columns of time that do not agree how long it took (column time 10.3 s, column clock 22.1 s)"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_in_one_way_alone_is_said(tmp_path: Path, content: str | bytes, words: str | None) -> None:
    if words is None:
        assert read(tmp_path, content).remarks[0].endswith("ux = ax, uy = ay, uz = az (else: --columns)")
    else:
        assert words in asked(tmp_path, content)


@pytest.mark.parametrize(
    ("reading", "words"),
    [
        (Reading({"t": "tim"}), "--columns: the table has no column tim; it has time, ax, ay, az"),
        (Reading({"ux": "ax"}), "--columns names no uy, uz; name all three outputs"),
        (Reading({"ux": "ax", "uy": "ax", "uz": "az"}), "--columns: ux and uy are the same column ax"),
        (Reading(rate=100.0, time_unit="ms"), "--rate, --time-unit ms: give one or the other"),
        (Reading(time_unit="iso"), "--time-unit iso: column time holds numbers, no dates"),
        (Reading(time_unit="index"), "--time-unit index: say how many samples a second it counts: --rate HZ"),
        (Reading(where={"unit": "A"}), "--where unit=A: 0 columns of that name"),
        (Reading(where={"ax": "7"}), "--where ax=7: no row has that; it has 1"),
    ],
)
def test_an_option_that_does_not_fit_the_table_is_said(tmp_path: Path, reading: Reading, words: str) -> None:
    assert asked(tmp_path, GOOD, reading).startswith(words)


def test_names_may_be_given_without_the_blanks_quotes_and_marks_of_the_file(tmp_path: Path) -> None:
    content = "#  t ; Acc X ; Acc Y ; Acc Z \n0,00;1;2;3\n0,01;1;2;3,5\n"
    for names in (("t", "Acc X", "Acc Y", "Acc Z"), ("# t", "acc x", " Acc Y ", "Acc Z"), ("1", "2", "3", "4")):
        reading = Reading(dict(zip(("t", "ux", "uy", "uz"), names, strict=True)))
        assert read(tmp_path, content, reading).samples.readings.tolist() == [[1, 2, 3], [1, 2, 3.5]]


def test_rows_that_are_means_of_poses_need_no_time(tmp_path: Path) -> None:
    content = "pose;X [V];Y [V];Z [V];std X;std Y;std Z;se_ux;se_uy;se_uz\n" + "".join(
        f"{i};{i};{-i};{i * i};0,1;0,1;0,1;0,01;0,02;0,03\n" for i in range(1, 5)
    )
    assert "if each row is the mean of a pose: --pose-means" in asked(tmp_path, "x,y,z\n1,2,3\n1,2,4\n")
    table = read(tmp_path, content, Reading(pose_means=True))
    assert table.samples.time_ns.tolist() == [0, 10**9, 2 * 10**9, 3 * 10**9]
    assert sorted(table.samples.channels) == ["se_ux", "se_uy", "se_uz"]
    assert table.output_unit == "V"


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ("se_x;se_y;se_z", True),
        ("x stderr [V];y stderr [V];z stderr [V]", True),
        ("SEM aX;SEM aY;SEM aZ", True),
        ("Standard Error X;Standard Error Y;Standard Error Z", True),
        ("se_x [mV];se_y [mV];se_z [mV]", False),  # another unit than the outputs
        ("se_x;se_y;other", False),
        ("std_x;std_y;std_z", False),  # the spread of the samples
    ],
)
def test_standard_errors_of_pose_means_are_found_by_their_names(tmp_path: Path, columns: str, expected: bool) -> None:
    rows = "".join(f"{i};{-i};{i * i};0,01;0,03;0,02\n" for i in range(1, 5))
    table = read(tmp_path, f"X [V];Y [V];Z [V];{columns}\n{rows}", Reading(pose_means=True))
    held = {name: float(values[0]) for name, values in table.samples.channels.items() if name.startswith("se_u")}
    assert held == ({"se_ux": 0.01, "se_uy": 0.03, "se_uz": 0.02} if expected else {})


def test_forty_exports_and_more_are_tried_each_of_another_program() -> None:
    assert len(EXPORTS) >= 40
    assert len({e.program for e in EXPORTS}) == len(EXPORTS)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("0.01;1,024;985;8,069\n0.02;1,020;984;8,071\n0.03;1,021;980;8,070\n", "numbers with a comma and with a point"),
        ('10,"1,024",985,"8,069"\n20,"1,020",984,"8,071"\n', "1,024 may have a decimal comma or part thousands"),
        (lines([row.replace(",0.9", "") for row in EVERY[:5]] + EVERY), "line 2: 3 fields, expected 4; 5 such lines"),
        (lines([r.rpartition(",")[0] for r in EVERY[:12]], "t,a,b") + lines(EVERY + EVERY),
         "line 2: another table, of 3 fields, above that of 4; part them in two files"),
        (lines(["0.11,0.2,0.9,24.1", "0.12,0.2,0.9,24.1", "0.11,0.2,0.9,24.2"], "ax,ay,az"),
         "line 1: 3 names, and 4 fields in the lines of numbers below"),
        (lines([*EVERY[:5], '0.05,0.1,0.2,"5 in', *EVERY[6:20], '0.2,0.1,0.2,"', *EVERY[21:]]),
         "a stray quotation mark: samples stand between it and the next one (0.06,"),
        (lines([f"{i // 2 / 100:.2f},{i % 2 + 1},{row[5:]}" for i, row in enumerate(EVERY)], "time,sensor_id,ax,ay,az"),
         "rows of several sensors in turn (column sensor_id: 1, 2); choose those of one: --where sensor_id=1"),
        (lines([f"{row},{('left', 'right')[i % 2]}" for i, row in enumerate(EVERY)], "time,ax,ay,az,where"),
         "rows of several sensors in turn (column where: left, right); choose those of one: --where where=left"),
        (lines([f"{i * 0.625},1,2,3" for i in range(20)]), "numbers in steps of 0.625 in a unit that nothing states"),
        (lines([f"{i / 6000:.6f},1,2,3" for i in range(20)]), "in a unit that nothing states"),
        (lines([f"{140559 + i / 10 + 40 * (i >= 10):.1f},1,2,3" for i in range(30)]), "in a unit that nothing states"),
        (lines([f"{i / 100},1,2,3" for i in range(20)], "Time [ticks],ax,ay,az"), "in a unit that nothing states"),
        (lines([f"{row},0.1,0.2,0.9" for row in EVERY],
               "time,body_acc_x,body_acc_y,body_acc_z,total_acc_x,total_acc_y,total_acc_z"), "2 triples of outputs"),
        (lines(EVERY, "time,acc_earth_x,acc_earth_y,acc_earth_z"), "no three outputs among the columns"),
        (lines([f"{row},0.1,0.2,0.9" for row in EVERY], "t_s,ux,uy,uz,ux,uy,uz").replace(",", ";"),
         "2 triples of outputs"),
        (lines(["s,g,mg,g", *EVERY]), "outputs in g, mg, g; expected one unit for all three"),
        (lines([f"{i / 100},1,2," for i in range(20)]), "column az holds no number"),
    ],
)  # fmt: skip
def test_what_a_second_reader_found_read_wrongly_is_asked_about(tmp_path: Path, content: str, words: str) -> None:
    assert words in asked(tmp_path, content)


def test_numbered_accelerations_are_taken_rather_than_letters_of_something_else(tmp_path: Path) -> None:
    table = read(tmp_path, lines([f"{row},0.1,0.2,0.9" for row in EVERY], "time,a1,a2,a3,ex,ey,ez"))
    assert "ux = a1, uy = a2, uz = a3" in table.remarks[0]
