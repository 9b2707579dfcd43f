"""What a log gets of a run's progress, where standard error is no terminal."""

from __future__ import annotations

import pytest

from triaxcald.cli.bars import Bars
from triaxcald.station.guidance import Guide, NextPose
from triaxcald.station.tray import Instruction


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


def _told(label: str, *slots: str) -> Instruction:
    return Instruction(label, None, (1.0, 0.0, 0.0), slots)


def test_a_log_gets_the_fixtures_instruction_once_and_no_other_turn(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        for told in (_told("A up", "left", "right"), _told("A up", "right"), _told("edge A/C up", "left", "right")):
            bars.instruction(told)
            bars.poses("left", "calibration", Guide(1, 2, 0.0, 3.0, NextPose("+X", (1.0, 0.0, 0.0))))
        bars.instruction(None)
        bars.poses("left", "calibration", Guide(2, 2, 0.0, 3.0))
    assert capsys.readouterr().err.splitlines() == [
        "the fixture: A up",
        "left: poses: 1 of 2 directions",
        "the fixture: edge A/C up",
        "left: poses: 2 of 2 directions",
    ]


def test_the_instruction_is_above_the_bars_of_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "110")
    with Bars() as bars:
        bars.instruction(_told("edge A/C up", "left", "right"))
        bars.poses("left", "calibration", Guide(1, 2, 0.0, 3.0, NextPose("+X", (1.0, 0.0, 0.0))))
    shown = capsys.readouterr().err
    assert "edge A/C up (left, right)" in shown
    assert shown.rindex("edge A/C up") < shown.rindex("1/2 poses")
    assert "+X up" not in shown
