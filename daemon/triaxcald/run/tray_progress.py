"""Progress of units that one fixture turns together: the fixture's instruction goes
with it."""

from __future__ import annotations

from dataclasses import dataclass, field

from triaxcald.recording.schema import Phase
from triaxcald.schema.codes import Code, Stage
from triaxcald.station.collection import Progress
from triaxcald.station.guidance import Guide
from triaxcald.station.tray import Instruction, Tray


@dataclass
class TrayProgress:
    """A `Progress` that passes everything on to ``shown`` and reports an instruction of
    the ``tray`` when it changes."""

    shown: Progress
    tray: Tray
    _told: Instruction | None = field(default=None, init=False)

    def stage(self, unit: str, stage: Stage) -> None:
        self.shown.stage(unit, stage)

    def note(self, unit: str, text: str) -> None:
        self.shown.note(unit, text)

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self.shown.lost(unit, code, reason)
        self.instruction(self.tray.left(unit))

    def back(self, unit: str) -> None:
        self.shown.back(unit)
        self.instruction(self.tray.back(unit))

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        self.instruction(self.tray.poses(unit, guide))
        self.shown.poses(unit, phase, guide)

    def ended(self, unit: str) -> None:
        """The unit has no more poses to take."""
        self.instruction(self.tray.left(unit))

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction != self._told:
            self._told = instruction
            self.shown.instruction(instruction)
