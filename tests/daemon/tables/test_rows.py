"""Lines that are no samples are named, and left out where the user says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.daemon.tables.written import GOOD, asked, lines, read
from triaxcald.tables.samples import Reading


@pytest.mark.parametrize(
    ("content", "fault", "left"),
    [
        (GOOD + "0.03,1,NaN,4\n0.04,1,2,5\n", "line 5: column ay: 'NaN', expected a finite number", 4),
        (GOOD + "0.03,1,,4\n0.04,1,2,5\n", "line 5: column ay: empty, expected a finite number", 4),
        (GOOD + "0.03,1,#N/A,4\n0.04,1,2,5\n", "line 5: column ay: '#N/A', expected a finite number", 4),
        (GOOD + "# pause\n\n0.03,1,2x,4\n", "line 7: column ay: '2x', expected a finite number", 3),
        (GOOD + "0.03,1,2,4\n0.04,1", "line 6: 2 fields, expected 4", 4),
        (GOOD + "0.03,1,2,4,5,6\n0.04,1,2,7\n", "line 5: 6 fields, expected 4", 4),
        (GOOD.replace("0.00,1,2,3", "0.00,,,"), "line 2: column ax: empty, expected a finite number", 2),
        (GOOD + "End of file\n", "line 5: 1 fields, expected 4", 3),
    ],
)
def test_lines_that_lack_a_number_are_named_and_left_out_where_the_user_says(
    tmp_path: Path, content: str, fault: str, left: int
) -> None:
    assert asked(tmp_path, content) == f"{fault}; 1 such lines: --skip-bad leaves them out"
    table = read(tmp_path, content, Reading(skip_bad=True))
    assert len(table.samples.time_ns) == left
    assert table.remarks[-1] == f"1 of {left + 1} lines left out (--skip-bad); {fault}"


def test_of_a_garbled_line_the_column_is_named_that_is_garbled(tmp_path: Path) -> None:
    lines = [f"{i / 100:.2f},1,2,3" for i in range(30)]
    lines[20] = "0.20,1,2e9,3"
    fault = asked(tmp_path, "time,ax,ay,az\n" + "\n".join(lines) + "\n")
    assert fault.startswith("line 22: column ay: '2e9', expected a number within 10000 times most others; 1 such")


def test_rows_that_repeat_exactly_count_once(tmp_path: Path) -> None:
    table = read(tmp_path, GOOD + "0.02,1,2,4\n0.03,1,2,4\n")
    assert table.samples.duplicates == 1
    assert len(table.samples.time_ns) == 4


def test_one_wrong_date_is_one_wrong_line(tmp_path: Path) -> None:
    rows = [f"2024-12-01 10:00:00.{i:02d},1,2,{i % 3}" for i in range(40)]
    rows[7] = rows[7].replace("2024-12", "2024-13")
    assert asked(tmp_path, lines(rows)).startswith("line 9: column time: '2024-13-01 10:00:00.07', expected")
    assert len(read(tmp_path, lines(rows), Reading(skip_bad=True)).samples.time_ns) == 39
