"""Times are read in the unit that they have, or counted by a rate; what is unclear is asked about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.written import asked, lines, read
from triaxcald.errors import InputError
from triaxcald.tables.samples import Reading


def test_an_index_with_gaps_shows_the_samples_that_were_lost(tmp_path: Path) -> None:
    content = "index,ax,ay,az\n10,1,2,3\n11,1,2,3\n14,1,2,3\n15,1,2,3\n"
    assert read(tmp_path, content, Reading(rate=10.0)).samples.time_ns.tolist() == [0, 10**8, 4 * 10**8, 5 * 10**8]


def test_nanoseconds_since_1970_keep_their_last_digits(tmp_path: Path) -> None:
    content = "ns,ax,ay,az\n1700000000000000001,1,2,3\n1700000000010000003,1,2,4\n"
    assert read(tmp_path, content).samples.time_ns.tolist() == [1700000000000000001, 1700000000010000003]


def test_times_with_a_zone_are_compared_as_what_they_are(tmp_path: Path) -> None:
    content = (
        "when,x,y,z\n2026-01-31T12:00:00.5+01:00,1,2,3\n2026-01-31T11:00:01Z,1,2,4\n2026-01-31 11:00:01.25 UTC,1,2,5\n"
    )
    assert np.diff(read(tmp_path, content).samples.time_ns).tolist() == [500_000_000, 250_000_000]


@pytest.mark.parametrize(
    "line",
    [
        "# baud rate: 115200", "# Abtastzeit: 0,01 s", "# sample rate: 10 ms", "# Sampling rate [ms]: 10",
        "# Sample frequency (Hz): 1,000", "# FS: +-8 g", "# low-pass filter at 42 Hz",
    ],
)  # fmt: skip
def test_a_number_that_is_no_rate_in_hertz_is_none(tmp_path: Path, line: str) -> None:
    content = f"{line}\n" + lines([f"{i},1,2,3" for i in range(20)], "sample,ax,ay,az")
    assert "column sample is an index, and nothing states a rate: --rate HZ" in asked(tmp_path, content)


@pytest.mark.parametrize("name", ["ms_elapsed", "time ms since boot", "Time (ms)"])
def test_a_unit_of_time_counts_wherever_it_stands_in_the_name(tmp_path: Path, name: str) -> None:
    table = read(tmp_path, lines([f"{i * 10.5},1,2,3" for i in range(20)], f"{name},ax,ay,az"))
    assert table.samples.time_ns[-1] == round(19 * 10.5e6)


def test_rows_of_another_sensor_take_no_time_where_the_rate_is_told(tmp_path: Path) -> None:
    content = lines([f"{('ACC', 'GYR')[i % 2]},1,2,{i}" for i in range(40)], "sensor,x,y,z")
    table = read(tmp_path, content, Reading(where={"sensor": "ACC"}, rate=100.0))
    assert set(np.diff(table.samples.time_ns)) == {10_000_000}


def test_an_index_that_counts_no_samples_is_not_said_to(tmp_path: Path) -> None:
    content = lines([f"{2 * i},1,2,{i % 3}" for i in range(40)], "packet,ax,ay,az")
    assert read(tmp_path, content, Reading(rate=100.0)).remarks[0].startswith("read as t = rows, 100 Hz")


@pytest.mark.parametrize("column", ["time", "Datum", "when"])
@pytest.mark.parametrize(
    "form",
    ["Do 16. Mai 2024 18:16:{:06.3f}", "16.05.2024 18.16.{:06.3f}", "18h16m{:06.3f}", "20240516T1816{:06.3f}",
     "06:16:{:06.3f} nachm."],
)  # fmt: skip
def test_a_date_that_is_not_understood_is_quoted(tmp_path: Path, column: str, form: str) -> None:
    content = lines([f"{form.format(i / 100)},1,2,{i % 3}" for i in range(40)], f"{column},ax,ay,az")
    told = asked(tmp_path, content)
    assert f"'{form.format(0)}'" in told
    assert "not understood" in told
    assert len(read(tmp_path, content, Reading(rate=100.0)).samples.time_ns) == 40


def test_t_alone_is_a_time_where_it_rises_and_else_a_temperature(tmp_path: Path) -> None:
    rising = lines([f"{i / 100},1,2,{i % 3}" for i in range(40)], "T,ax,ay,az")
    assert set(np.diff(read(tmp_path, rising).samples.time_ns)) == {10_000_000}
    falling = lines([f"{20 + i % 7},1,2,{i % 3}" for i in range(40)], "T,ax,ay,az")
    with pytest.raises(InputError, match="no column of time"):
        read(tmp_path, falling)
    assert "temp_c" in read(tmp_path, falling, Reading(rate=100.0)).samples.channels


def test_t_is_the_time_that_the_user_says_it_is_whatever_it_does(tmp_path: Path) -> None:
    once_back = lines([f"{(i % 30) / 100},1,2,{i % 3}" for i in range(40)], "T,ax,ay,az")
    with pytest.raises(InputError, match="column T: the time is before that of the line before"):
        read(tmp_path, once_back, Reading(columns={"t": "T"}))
    with pytest.raises(InputError, match="column T: the time falls back"):
        read(tmp_path, lines([f"{(i % 39) / 100},1,2,{i % 3}" for i in range(40)], "T,ax,ay,az"))
    assert len(read(tmp_path, once_back, Reading(columns={"t": "T"}, rate=100.0)).samples.time_ns) == 40


def test_without_a_column_that_counts_the_rows_are_counted(tmp_path: Path) -> None:
    content = lines([f"{i % 5},1,2,{i % 3}" for i in range(40)], "q,ax,ay,az")
    assert set(np.diff(read(tmp_path, content, Reading(time_unit="index", rate=100.0)).samples.time_ns)) == {10**7}


def test_times_of_day_go_on_after_midnight(tmp_path: Path) -> None:
    rows = [f"23:59:59.{i:02d},1,2,{i % 3}" for i in range(50, 100)] + [
        f"00:00:00.{i:02d},1,2,{i % 3}" for i in range(50)
    ]
    assert set(np.diff(read(tmp_path, lines(rows)).samples.time_ns)) == {10_000_000}
