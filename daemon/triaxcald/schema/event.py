"""The events of a run, one JSON object a line (`triaxcal.event/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc
from triaxcald.schema.codes import Code, Stage
from triaxcald.schema.outcome import Outcome

Vector = Annotated[list[tc.schema.Figure], Field(min_length=3, max_length=3)]


class Head(tc.schema.Model):
    """The keys of every event."""

    format: Annotated[Literal["triaxcal.event/1"], Field(description="format of this document")]
    seq: Annotated[int, Field(ge=1, description="number of the event, from 1")]
    time: Annotated[str, Field(description="UTC with milliseconds, as `2026-01-31T12:00:00.123+00:00`")]
    run: Annotated[str | None, Field(description="id of the unit's run; `null` for `instruction` and `tray`")]
    tray: Annotated[str, Field(description="id of the tray: of all units that were started together")]
    unit: Annotated[str | None, Field(description="slot; `null` for `instruction` and `tray`")]


class StageEvent(Head):
    """A stage of the work on a unit begins."""

    event: Annotated[Literal["stage"], Field(description="kind of the event")]
    stage: Annotated[tc.schema.Word[Stage], Field(description="stage of the work that begins")]


class NextPose(tc.schema.Model):
    label: Annotated[str, Field(description="axes of the unit that point up, or the number of a direction")]
    vector: Annotated[Vector, Field(description="direction of up in the unit's axes, of length 1")]
    once_more: Annotated[bool, Field(description="whether this pose was taken before and is wanted again")]


class PosesEvent(Head):
    """The poses of a unit, or its next pose, have changed."""

    event: Annotated[Literal["poses"], Field(description="kind of the event")]
    found: Annotated[int, Field(description="distinct poses so far")]
    wanted: Annotated[int, Field(description="distinct poses that are wanted")]
    next: Annotated[NextPose | None, Field(description="the next pose; `null` if any other pose will do, or none")]


class InstructionEvent(Head):
    """The next pose of a fixture that turns all units."""

    event: Annotated[Literal["instruction"], Field(description="kind of the event")]
    label: Annotated[str, Field(description="the pose in the fixture's own face names")]
    face: Annotated[str | None, Field(description="face of the fixture that points up; `null` off the faces")]
    vector: Annotated[Vector, Field(description="direction of up in the fixture's axes, of length 1")]
    slots: Annotated[list[str], Field(description="slots that lack this pose")]


class LostEvent(Head):
    """A unit is lost, and waited for."""

    event: Annotated[Literal["lost"], Field(description="kind of the event")]
    code: Annotated[tc.schema.Word[Code], Field(description="reason for programs")]
    reason: Annotated[tc.schema.Text, Field(description="reason for people, one line")]


class BackEvent(Head):
    """A lost unit is back."""

    event: Annotated[Literal["back"], Field(description="kind of the event")]


class EndedEvent(Head):
    """A unit has ended."""

    event: Annotated[Literal["ended"], Field(description="kind of the event")]
    outcome: Annotated[Outcome, Field(description="the [`triaxcal.outcome/1`](outcome.md)")]


class TrayEvent(Head):
    """All units that were started together."""

    event: Annotated[Literal["tray"], Field(description="kind of the event")]
    state: Annotated[Literal["started", "ended"], Field(description="whether the tray has started or ended")]


KINDS = (StageEvent, PosesEvent, InstructionEvent, LostEvent, BackEvent, EndedEvent, TrayEvent)
Event = StageEvent | PosesEvent | InstructionEvent | LostEvent | BackEvent | EndedEvent | TrayEvent
