"""What a log gets of a run's progress, where standard error is no terminal."""

from __future__ import annotations

import pytest

from triaxcald.cli.bars import Bars
from triaxcald.station.guidance import Guide, NextPose


def test_a_log_gets_one_line_for_each_pose(capsys: pytest.CaptureFixture[str]) -> None:
    first, second = NextPose("+X", (1.0, 0.0, 0.0)), NextPose("-Y+Z", (0.0, -0.7, 0.7))
    guides = [
        Guide(0, 2, 0.0, 3.0, first),
        Guide(0, 2, 0.5, 3.0, first, too_short=True),
        Guide(0, 2, 1.0, 3.0, first, too_short=True),
        Guide(1, 2, 0.0, 3.0, second),
        Guide(1, 2, 0.0, 3.0, second),
        Guide(1, 2, 0.5, 3.0, second, too_short=True),
        Guide(1, 2, 0.0, 3.0, second),
        Guide(2, 2, 0.0, 3.0),
    ]
    with Bars() as bars:
        for guide in guides:
            bars.poses("can", "calibration", guide)
    assert capsys.readouterr().err.splitlines() == [
        "can: poses: 0 of 2 directions; next: +X up",
        "can: poses: 1 of 2 directions; next: -Y+Z up",
        "can: poses: 2 of 2 directions",
    ]
