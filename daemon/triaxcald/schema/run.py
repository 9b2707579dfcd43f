"""What `run` and `demo` print with ``--json`` (`triaxcal.run/1`,
`triaxcal.demo/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc
from triaxcald.schema.outcome import Outcome
from triaxcald.schema.verification import Verification


class UnitOfRun(tc.schema.Model):
    unit: Annotated[str, Field(description="name of the unit in the station file")]
    exit_code: Annotated[int, Field(description="exit code that this unit alone would give the command")]
    error: Annotated[tc.schema.Text | None, Field(description="why the work was aborted, one line; else `null`")]
    wanted_poses: Annotated[list[str], Field(description="after a refusal: poses that would mend it")]
    data_quality: Annotated[list[str], Field(description="after a refusal: faults of the readings, one line each")]
    serial: Annotated[str | None, Field(description="serial number of a calibrated unit; `null` without one")]
    recording: Annotated[tc.schema.Text | None, Field(description="path of the recording; `null` without one")]
    certificate: Annotated[tc.schema.Text | None, Field(description="path of the certificate; `null` without one")]
    report: Annotated[tc.schema.Text | None, Field(description="path of the report; `null` without one")]
    before: Annotated[
        tc.schema.Residual | None,
        Field(description="residual of the linear model, or of the earlier calibration; `null` without a fit"),
    ]
    after: Annotated[
        tc.schema.Residual | None, Field(description="residual of the final calibration; `null` without a fit")
    ]
    findings: Annotated[list[tc.schema.Finding], Field(description="findings of the [loop](loop.md)")]
    candidates: Annotated[list[tc.schema.Candidate], Field(description="candidates of the [loop](loop.md)")]
    choices: Annotated[list[tc.schema.Choice], Field(description="choices of the [loop](loop.md)")]
    registers_written: Annotated[list[str], Field(description="registers that were written, in this order")]
    device_state: Annotated[
        tc.schema.Text | None,
        Field(
            description="what the device holds, in words (`outcome` has it for programs); "
            "`null` if nothing was to be written"
        ),
    ]
    outcome: Annotated[Outcome, Field(description="the [`triaxcal.outcome/1`](outcome.md)")]
    outcome_file: Annotated[tc.schema.Text | None, Field(description="its path; `null` without a file")]
    signature_file: Annotated[
        tc.schema.Text | None, Field(description="path of the signature; `null` where the station has no key")
    ] = None
    records_lost: Annotated[int, Field(description="number of raw records that did not reach the disk")]
    verification: Annotated[
        Verification | None,
        Field(description="the [`triaxcal.verification/1`](certificate.md#verification); `null` without check poses"),
    ]


class Run(tc.schema.Model):
    """What became of the units of a station."""

    format: Annotated[Literal["triaxcal.run/1"], Field(description="format of this document")]
    units: Annotated[list[UnitOfRun], Field(description="the units, in the order of the station file")]


class UnitOfDemo(UnitOfRun):
    hidden: Annotated[
        dict[str, dict[str, float]], Field(description="true coefficients of the simulated unit, by effect")
    ]
    found: Annotated[bool, Field(description="whether just these effects were found")]
    kept: Annotated[bool, Field(description="whether the output after a power cycle is within 50 µg")]
    after_power_cycle_rms_g: Annotated[tc.schema.Figure | None, Field(description="rms error of that output [g]")]


class Demo(tc.schema.Model):
    """The same of simulated units, with what is hidden in them."""

    format: Annotated[Literal["triaxcal.demo/1"], Field(description="format of this document")]
    units: Annotated[list[UnitOfDemo], Field(description="the simulated units")]
