"""The state of a station between and during its runs (`triaxcal.station_state/1`)."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc
from triaxcald.schema.codes import Code, Stage
from triaxcald.schema.event import NextPose
from triaxcald.schema.outcome import WorkText


class SlotIs(StrEnum):
    """State of a slot."""

    EMPTY = "empty"
    """It waits for a serial number."""
    SCANNED = "scanned"
    """Its unit waits for the start."""
    RUNNING = "running"
    """Its unit is at work."""
    LOST = "lost"
    """Its unit is at work, fell silent, and is waited for."""
    PASSED = "passed"
    """The run has ended with the verdict `pass`."""
    FAILED = "failed"
    """The run has ended with the verdict `fail`."""
    ABORTED = "aborted"
    """The run was refused, stopped or failed."""
    NOT_JUDGED = "not_judged"
    """The run has ended without a limit to judge it by."""


class SlotState(tc.schema.Model):
    slot: Annotated[str, Field(description="name of the `[[units]]` entry")]
    serial: Annotated[str | None, Field(description="serial number: scanned, else as the unit reported it")]
    run: Annotated[str | None, Field(description="id of the run; `null` before the start")]
    state: Annotated[tc.schema.Word[SlotIs], Field(description="state of the slot")]
    stage: Annotated[tc.schema.Word[Stage] | None, Field(description="stage of the run; `null` out of a run")]
    found: Annotated[int, Field(description="distinct poses so far")]
    wanted: Annotated[int, Field(description="distinct poses that are wanted; 0 before it is known")]
    code: Annotated[
        tc.schema.Word[Code] | None, Field(description="reason for programs: of the end, or why the unit is lost")
    ]
    reason: Annotated[tc.schema.Text | None, Field(description="the same for people, one sentence")]
    next: Annotated[NextPose | None, Field(description="the next pose of this unit; `null` if there is none")] = None
    since: Annotated[str, Field(description="time since which the slot is in this state, UTC")]
    blocked: Annotated[
        str | None, Field(description="code of what keeps this slot from the next start; else `null`")
    ] = None


class WorkOfTray(tc.schema.Model):
    """What the next tray is measured for."""

    operator: Annotated[WorkText | None, Field(description="operator")] = None
    order: Annotated[WorkText | None, Field(description="work order")] = None
    batch: Annotated[WorkText | None, Field(description="batch")] = None
    part_number: Annotated[WorkText | None, Field(description="part number")] = None
    fixture: Annotated[WorkText | None, Field(description="fixture")] = None
    reason: Annotated[WorkText | None, Field(description="reason of a re-test")] = None


class InstructionOfTray(tc.schema.Model):
    """The pose to put up next: of the fixture, or of the only unit at work."""

    label: Annotated[str, Field(description="the pose in words")]
    face: Annotated[str | None, Field(description="face of the fixture that points up; `null` off the faces")]
    vector: Annotated[
        list[float], Field(min_length=3, max_length=3, description="direction of up in the fixture's axes")
    ]
    slots: Annotated[list[str], Field(description="slots that lack this pose")]


class StationState(tc.schema.Model):
    """What the station does now."""

    format: Annotated[Literal["triaxcal.station_state/1"], Field(description="format of this document")]
    seq: Annotated[int, Field(description="`seq` of the last event that is contained; 0 before the first")]
    station: Annotated[str, Field(description="name of the station")]
    tray: Annotated[str | None, Field(description="id of the tray that is under way or has ended last")]
    operator: Annotated[str | None, Field(description="operator")]
    work: Annotated[WorkOfTray, Field(description="what the units are measured for")]
    instruction: Annotated[InstructionOfTray | None, Field(description="what to do with the tray; `null` if nothing")]
    blocked: Annotated[str | None, Field(description="code of what keeps the next start from happening; else `null`")]
    blocked_slots: Annotated[
        list[str],
        Field(
            default_factory=list,
            description="slots of the next start whose golden unit is due or has failed, if `blocked` says so",
        ),
    ]
    chosen: Annotated[
        str | None,
        Field(description="slot that was scanned for the next serial number; `null`: the next empty one takes it"),
    ] = None
    slots: Annotated[list[SlotState], Field(description="the slots, in the order of the station file")]
