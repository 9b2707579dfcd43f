"""The events of a tray as documents (`triaxcal.event/1`), made from the progress of its
units."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from triaxcald.schema.codes import Code, Stage
from triaxcald.utc import iso_time

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.run.unit_run import Outcome
    from triaxcald.station.guidance import Guide, NextPose
    from triaxcald.station.tray import Instruction

FORMAT: Final = "triaxcal.event/1"


class Events:
    """A `Progress` that hands each event of a tray to ``emit``. ``tray`` is the id of
    the tray, ``runs`` maps its slots to the ids of their runs. ``number`` gives the
    `seq` of the next event, ``clock_ns`` the time since 1970."""

    def __init__(
        self,
        emit: Callable[[dict[str, Any]], None],
        tray: str,
        runs: Mapping[str, str],
        *,
        number: Callable[[], int],
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._emit, self._tray, self._runs, self._number, self._clock_ns = emit, tray, runs, number, clock_ns
        self._latest: dict[str, object] = {}

    def started(self) -> None:
        """The tray has started."""
        self._say("tray", None, state="started")

    def all_ended(self) -> None:
        """The tray has ended."""
        self._say("tray", None, state="ended")

    def ended(self, outcome: Outcome) -> None:
        self.settled(outcome.document)

    def settled(self, outcome: Mapping[str, Any]) -> None:
        """A run has ended with this `triaxcal.outcome/1`; a killed one too."""
        self._say("ended", outcome["unit"], outcome=outcome)

    # Progress.

    def stage(self, unit: str, stage: Stage) -> None:
        self._latest.pop(unit, None)
        self._say("stage", unit, stage=stage.value)

    def note(self, unit: str, text: str) -> None:
        """For people alone."""

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self._say("lost", unit, code=code.value, reason=reason)

    def back(self, unit: str) -> None:
        self._say("back", unit)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        event = {"found": guide.found, "wanted": guide.wanted, "next": _next(guide.next)}
        if self._latest.get(unit) != event:  # it comes several times a second
            self._latest[unit] = event
            self._say("poses", unit, **event)

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction is not None:
            self._say(
                "instruction",
                None,
                label=instruction.label,
                face=instruction.face,
                vector=[round(v, 6) for v in instruction.vector],
                slots=list(instruction.slots),
            )

    def _say(self, event: str, unit: str | None, **more: Any) -> None:
        self._emit(
            {
                "format": FORMAT,
                "seq": self._number(),
                "time": iso_time(self._clock_ns()),
                "run": None if unit is None else self._runs.get(unit),
                "tray": self._tray,
                "unit": unit,
                "event": event,
                **more,
            }
        )


def _next(pose: NextPose | None) -> dict[str, Any] | None:
    if pose is None:
        return None
    return {
        "label": pose.label,
        "vector": [round(v, 6) for v in pose.vector],
        "once_more": pose.once_more,
    }
