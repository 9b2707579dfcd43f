"""What a log gets of a run's progress, where standard error is no terminal."""

from __future__ import annotations

import pytest

from triaxcald.cli.console import Bars
from triaxcald.station.guidance import Guide
from triaxcald.station.tray import Instruction


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


def _told(label: str, *slots: str) -> Instruction:
    return Instruction(label, None, (1.0, 0.0, 0.0), slots)


def test_a_log_gets_the_fixtures_instruction_once_and_no_other_turn(capsys: pytest.CaptureFixture[str]) -> None:
    with Bars() as bars:
        for told in (_told("A up", "left", "right"), _told("A up", "right"), _told("edge A/C up", "left", "right")):
            bars.instruction(told)
            bars.poses("left", "calibration", Guide(1, 2, 0.0, "next: +X up"))
        bars.instruction(None)
        bars.poses("left", "calibration", Guide(2, 2, 0.0, "done"))
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
        bars.poses("left", "calibration", Guide(1, 2, 0.0, "next: +X up"))
    shown = capsys.readouterr().err
    assert "edge A/C up (left, right)" in shown
    assert shown.rindex("edge A/C up") < shown.rindex("1/2 poses")
    assert "+X up" not in shown
