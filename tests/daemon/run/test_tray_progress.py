"""Of a tray the operator is told one instruction, when it changes."""

from __future__ import annotations

from typing import Any

from triaxcal.model.directions import directions
from triaxcald.run.tray_progress import TrayProgress
from triaxcald.schema.codes import Code, Stage
from triaxcald.station.faces import OWN_NAMES
from triaxcald.station.guidance import Guide
from triaxcald.station.tray import Instruction, Tray

PLAN = directions(14)
LABELS = [label for label, _ in PLAN]


class Shown:
    def __init__(self) -> None:
        self.told: list[Any] = []

    def stage(self, unit: str, stage: Stage) -> None:
        self.told.append((unit, stage.value))

    def lost(self, unit: str, code: Code, trouble: str) -> None:
        self.told.append((unit, "lost", trouble))

    def poses(self, unit: str, phase: str, guide: Guide) -> None:
        self.told.append((unit, guide.found))

    def instruction(self, instruction: Instruction | None) -> None:
        self.told.append(instruction and (instruction.face, instruction.slots))


def test_an_instruction_is_told_before_the_poses_that_changed_it_and_once() -> None:
    tray = Tray({"a": "+x+y+z", "b": "+x+y+z"}, OWN_NAMES, hold_s=3.0, apart_deg=10.0)
    shown = Shown()
    progress = TrayProgress(shown, tray)
    for slot in "ab":
        tray.targets(slot, PLAN)
    progress.stage("a", Stage.POSES)
    progress.poses("a", "calibration", Guide(0, 14, 0.0, 3.0, missing=tuple(LABELS)))
    progress.poses("b", "calibration", Guide(0, 14, 0.0, 3.0, missing=tuple(LABELS)))
    progress.poses("a", "calibration", Guide(1, 14, 0.0, 3.0, missing=tuple(LABELS[1:])))
    progress.lost("b", Code.LOST, "nothing answers")
    progress.poses("a", "calibration", Guide(14, 14, 0.0, 3.0))
    progress.poses("b", "calibration", Guide(0, 14, 0.0, 3.0, missing=tuple(LABELS)))
    progress.ended("b")
    progress.ended("a")
    assert shown.told == [
        ("a", "poses"),
        ("+X", ("a", "b")),
        ("a", 0),
        ("b", 0),
        ("+X", ("b",)),
        ("a", 1),
        ("b", "lost", "nothing answers"),
        (None, ("a",)),
        None,
        ("a", 14),
        ("+X", ("b",)),
        ("b", 0),
        None,
    ]
