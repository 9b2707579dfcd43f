"""Lines that are drawn, as printed tables have them, are neither names nor samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.written import EVERY, asked, read

ROWS = [row.split(",") for row in EVERY]
NAMES = ["time", "ax", "ay", "az"]


def printed(separator: str, rule: str, border: str = "", around: str = "") -> str:
    lines = [around + separator.join(row) + around[::-1] for row in [NAMES, *ROWS]]
    lines.insert(1, rule)
    return "\n".join([border, *lines, border]) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        printed(",", "-" * 20),
        printed(",", "-" * 20 + ",,,"),
        printed(",", "----,--,--,--"),
        printed(";", "====;==;==;=="),
        printed("\t", "----\t--\t--\t--"),
        printed("   ", "----  ---  ---  ---"),
        printed(" | ", "------+----+----+----"),
        printed(" | ", "|---|---:|---:|:--|", around="| "),
        printed(" | ", "+------+----+----+----+", "+------+----+----+----+", around="| "),
        printed(",", "s,g,g,g\n-----,---,---,---"),
        printed(",", "__________"),
        printed(",", "----", "-" * 40),
    ],
)
def test_a_rule_below_the_header_is_no_header(tmp_path: Path, text: str) -> None:
    table = read(tmp_path, text)
    np.testing.assert_array_equal(table.samples.readings, [[float(f) for f in row[1:]] for row in ROWS])
    np.testing.assert_array_equal(table.samples.time_ns, np.arange(40) * 10_000_000)
    assert "t = time" in table.remarks[0]


def test_a_rule_below_the_header_of_our_own_layout_is_none(tmp_path: Path) -> None:
    table = read(tmp_path, "t_s,ux,uy,uz\n-----,---,---,---\n" + "\n".join(EVERY) + "\n")
    assert len(table.samples.time_ns) == 40


def test_a_table_of_rules_and_numbers_alone_is_asked_about_with_its_columns(tmp_path: Path) -> None:
    assert "--columns t=1,ux=2,uy=3,uz=4" in asked(tmp_path, "-----,,,\n" + "\n".join(EVERY) + "\n")
    untimed = [",".join(row[1:]) for row in ROWS]
    assert "--columns ux=1,uy=2,uz=3 --rate HZ" in asked(tmp_path, "-----,,\n" + "\n".join(untimed) + "\n")


def test_the_time_in_the_last_column_is_found_for_the_option(tmp_path: Path) -> None:
    rows = [",".join([*row[1:], row[0]]) for row in ROWS]
    assert "--columns t=4,ux=1,uy=2,uz=3" in asked(tmp_path, "\n".join(rows) + "\n")


def test_a_row_of_dashes_among_the_samples_is_a_fault(tmp_path: Path) -> None:
    assert asked(tmp_path, "time,ax,ay,az\n" + "\n".join([*EVERY, "---,---,---,---"]) + "\n").startswith("line 42: ")
