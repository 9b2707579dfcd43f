"""The result of a run for other systems (`triaxcal.result/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc
from triaxcald.provision.state import DeviceState
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.outcome import Outcome, Work


class Measurement(tc.schema.Model):
    name: Annotated[str, Field(description="name of the figure, as in `results`")]
    value: Annotated[tc.schema.Figure, Field(description="its value")]
    unit: Annotated[str, Field(description="its unit")]
    low: Annotated[tc.schema.Figure | None, Field(description="lower limit; `null` without one")]
    high: Annotated[tc.schema.Figure | None, Field(description="upper limit; `null` without one")]
    passed: Annotated[bool | None, Field(description="whether it is within its limits; `null` without one")]


class Result(tc.schema.Model):
    """What became of a unit, as a receiver of the station's results gets it."""

    format: Annotated[Literal["triaxcal.result/1"], Field(description="format of this document")]
    run: Annotated[str, Field(description="id of the run, a UUID of version 7; also the `Idempotency-Key`")]
    station: Annotated[str, Field(description="name of the station")]
    slot: Annotated[str, Field(description="name of the `[[units]]` entry")]
    work: Annotated[Work | None, Field(description="what it was measured for")]
    serial: Annotated[str | None, Field(description="serial number that the unit reported, else the expected one")]
    attempt: Annotated[int | None, Field(description="number of the attempt at the serial number, from 1")]
    started: Annotated[str | None, Field(description="start of the work, UTC, ISO 8601")]
    ended: Annotated[str, Field(description="end of the work, UTC, ISO 8601")]
    verdict: Annotated[tc.schema.Word[Verdict], Field(description="[verdict](outcome.md#verdict-and-code)")]
    code: Annotated[
        tc.schema.Word[Code] | None, Field(description="[reason for programs](outcome.md#verdict-and-code)")
    ]
    reason: Annotated[tc.schema.Text, Field(description="reason for people, one sentence")]
    device_state: Annotated[tc.schema.Word[DeviceState], Field(description="[device state](outcome.md#device-state)")]
    measurements: Annotated[list[Measurement], Field(description="figures with a limit, and the coefficients")]
    recording_sha256: Annotated[
        tc.schema.Sha256 | None, Field(description="SHA-256 of the recording; `null` without one")
    ]
    outcome: Annotated[Outcome, Field(description="the whole [`triaxcal.outcome/1`](outcome.md)")]
