"""Columns beside the outputs are channels where they are measured, under a name that effects know."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.written import EVERY, lines, read


def test_other_columns_are_channels_where_they_are_whole_and_measured(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    u, supply = rng.normal(size=(50, 3)), rng.normal(5, 0.1, 50)
    rows = [
        f"{i * 0.01:.2f},{i},{x:.6f},{y:.6f},{z:.6f},{np.hypot(np.hypot(x, y), z):.6f},{s:.4f},,ok,{i % 7}"
        for i, ((x, y, z), s) in enumerate(zip(u, supply, strict=True))
    ]
    content = "\n".join(["time,counter,ax,ay,az,strength,Supply (V),gap,status,phase", *rows])
    table = read(tmp_path, content)
    assert list(table.samples.channels) == ["Supply (V)", "phase"]
    assert table.remarks[1] == (
        "left out: counter (an index); strength (computed from the outputs); gap (50 of 50 cells empty); "
        "status (no numbers)"
    )


def test_a_column_that_numbers_the_rows_is_no_channel_whatever_its_name(tmp_path: Path) -> None:
    table = read(tmp_path, "time,ax,ay,az,foo\n0.00,1,2,3,7\n0.01,1,2,3.5,8\n0.02,1,2,4,9\n")
    assert table.remarks[1] == "left out: foo (an index)"


@pytest.mark.parametrize("header", ["time_ms,ax,ay,az,T", "t [ms],ax,ay,az,T [°C]", "Zeit [ms],ax,ay,az,T"])
def test_t_is_a_temperature_beside_a_time(tmp_path: Path, header: str) -> None:
    table = read(tmp_path, lines([f"{10 * i},1,2,{i % 3},{20 + i % 7}" for i in range(40)], header))
    assert set(np.diff(table.samples.time_ns)) == {10_000_000}
    assert table.samples.channels["temp_c"][6] == 26
    assert ", temp_c = T" in table.remarks[0]


def test_a_column_that_says_temperature_comes_before_t(tmp_path: Path) -> None:
    rows = [f"{10 * i},1,2,{i % 3},{i % 5},{20 + i % 7}" for i in range(40)]
    channels = read(tmp_path, lines(rows, "t_ms,ax,ay,az,T,temp")).samples.channels
    assert channels["temp_c"][6] == 26
    assert channels["T"][6] == 1


def test_a_t_that_always_rises_beside_a_time_is_another_time(tmp_path: Path) -> None:
    rows = [f"{10 * i},1,2,{i % 3},{i / 100}" for i in range(40)]
    assert not read(tmp_path, lines(rows, "t_ms,ax,ay,az,T")).samples.channels


@pytest.mark.parametrize("name", ["temp_f", "Temp [°F]", "temp_raw", "temp_mv"])
def test_a_temperature_in_another_unit_keeps_its_name(tmp_path: Path, name: str) -> None:
    channels = read(tmp_path, lines([f"{row},{70 + i % 7}" for i, row in enumerate(EVERY)], f"time,ax,ay,az,{name}"))
    assert "temp_c" not in channels.samples.channels
