"""What a log gets of a run's progress, where standard error is no terminal."""

from __future__ import annotations

import pytest

from triaxcald.cli.bars import Bars
from triaxcald.station.guidance import Guide


def test_a_log_gets_one_line_for_each_pose(capsys: pytest.CaptureFixture[str]) -> None:
    hints = [
        (0, "next: +X up"),
        (0, "hold still, 0.5 of 3.0 s"),
        (0, "hold still, 1.0 of 3.0 s"),
        (1, "next: -Y+Z up"),
        (1, "next: -Y+Z up"),
        (1, "hold still, 0.5 of 3.0 s"),
        (1, "next: -Y+Z up"),
        (2, "done"),
    ]
    with Bars() as bars:
        for found, hint in hints:
            bars.poses("can", "calibration", Guide(found, 2, 0.0, hint))
    assert capsys.readouterr().err.splitlines() == [
        "can: poses: 0 of 2 directions; next: +X up",
        "can: poses: 1 of 2 directions; next: -Y+Z up",
        "can: poses: 2 of 2 directions",
    ]
