"""The outcome of the work on a unit (`triaxcal.outcome/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc
from triaxcald.provision.state import DeviceState, Evidence, Observation
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.verification import Verification

WorkText = Annotated[str, Field(min_length=1, max_length=64)]
Figures = list[tc.schema.Figure | None]


class RegistersDone(tc.schema.Model):
    differing: Annotated[list[str], Field(description="registers that differed from what was wanted")]
    written: Annotated[list[str], Field(description="registers that were written, in this order")]
    marked: Annotated[
        list[str],
        Field(
            default_factory=list,
            description="registers that got a probe, a value that is in use and stored nowhere",
        ),
    ]
    stored: Annotated[bool, Field(description="whether the calibration is stored, as far as the device says")]
    cut_short_before: Annotated[
        bool, Field(description="whether an earlier provisioning had left the device in between")
    ]
    undoing_failed: Annotated[
        tc.schema.Text | None, Field(description="reason that the old calibration is not back; else `null`")
    ]
    steps: Annotated[list[str], Field(description="steps of the procedure, in order, in words")]


class LimitsOfOutcome(tc.schema.Model):
    rms_g: Annotated[tc.schema.Figure | None, Field(description="of the fit's residual, rms [g]")] = None
    cross_validated_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="of the fit, cross-validated rms [g]")
    ] = None
    verification_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="of the device's own output in the check poses, rms [g]")
    ] = None


class StandardErrors(tc.schema.Model):
    scale_factor: Annotated[Figures, Field(description="of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="of the three angles [rad]")]
    bias: Annotated[Figures, Field(description="of x, y, z [g]")]


class MeasuredCalibration(tc.schema.Model):
    """The linear part of a calibration, as the certificate has it."""

    scale_factor: Annotated[Figures, Field(description="of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="the three angles [rad]")]
    bias: Annotated[Figures, Field(description="of x, y, z [g]")]
    standard_error: Annotated[StandardErrors, Field(description="their standard errors")]


class Measured(tc.schema.Model):
    raw_sha256: Annotated[tc.schema.Sha256, Field(description="digest of the raw records of the phase `calibration`")]
    poses: Annotated[int, Field(description="number of still poses")]
    before: Annotated[
        tc.schema.Residual, Field(description="of the linear model; after `--rezero`, of the earlier calibration")
    ]
    after: Annotated[tc.schema.Residual, Field(description="of the final calibration; keys as `measured.before`")]
    terms: Annotated[list[str], Field(description="`linear`, and the effects of the final calibration")]
    left_to_host: Annotated[list[str], Field(description="effects for which the device has no registers")]
    calibration: Annotated[
        MeasuredCalibration | None, Field(description="coefficients of the fit, of a failed unit too")
    ] = None


class AttachmentListed(tc.schema.Model):
    name: Annotated[str, Field(description="its name")]
    media_type: Annotated[str, Field(description="its media type")]
    time_ns: Annotated[int, Field(description="log time, since 1970 UTC [ns]")]
    sha256: Annotated[tc.schema.Sha256, Field(description="digest of its bytes")]


class MetadataListed(tc.schema.Model):
    name: Annotated[str, Field(description="name of the record")]
    sha256: Annotated[tc.schema.Sha256, Field(description="digest of its keys and values, sorted")]


class TopicListed(tc.schema.Model):
    name: Annotated[str, Field(description="its name")]
    messages: Annotated[int, Field(description="number of its messages")]
    sha256: Annotated[tc.schema.Sha256, Field(description="digest of the times and bytes of its messages")]
    declared: Annotated[tc.schema.Sha256, Field(description="digest of its declarations: channels and schemas")]


class Contents(tc.schema.Model):
    attachments: Annotated[list[AttachmentListed], Field(description="attachments, in the order of the file")]
    metadata: Annotated[list[MetadataListed], Field(description="metadata records, by name")]
    topics: Annotated[list[TopicListed], Field(description="topics, by name")]


class Work(tc.schema.Model):
    """What a unit is measured for, as the operator, the station file or a program
    gave it. Texts have 1 to 64 printable characters; `null` where not given."""

    serial: Annotated[WorkText | None, Field(description="expected serial number")]
    operator: Annotated[WorkText | None, Field(description="operator")]
    order: Annotated[WorkText | None, Field(description="work order")]
    batch: Annotated[WorkText | None, Field(description="batch")]
    part_number: Annotated[WorkText | None, Field(description="part number")]
    fixture: Annotated[WorkText | None, Field(description="fixture")]
    slot: Annotated[str, Field(description="slot: name of the `[[units]]` entry")]
    attempt: Annotated[
        int | None, Field(ge=1, description="number of this attempt at the serial number in the folder, from 1")
    ]
    reason: Annotated[WorkText | None, Field(description="reason of a re-test")]


class Outcome(tc.schema.Model):
    """What became of a unit, and what its device holds."""

    format: Annotated[Literal["triaxcal.outcome/1"], Field(description="format of this document")]
    unit: Annotated[str, Field(description="name of the unit in the station file")]
    serial: Annotated[str | None, Field(description="serial number; `null` without one")]
    station: Annotated[str, Field(description="name of the station")]
    run: Annotated[
        str | None, Field(description="id of this attempt, a UUID of version 7; absent before version 0.2")
    ] = None
    started: Annotated[str | None, Field(description="start of the work, UTC, ISO 8601; absent before version 0.2")] = (
        None
    )
    ended: Annotated[str, Field(description="end of the work, UTC, ISO 8601")]
    work: Annotated[Work | None, Field(description="what it was measured for; absent before version 0.2")] = None
    recording: Annotated[tc.schema.Text | None, Field(description="file name of the recording; `null` without one")] = (
        None
    )
    settles: Annotated[
        str | None,
        Field(description="id of the run that a `provision --resume` or `restore` settles; else `null`"),
    ] = None
    verdict: Annotated[tc.schema.Word[Verdict], Field(description="[verdict](#verdict-and-code) on the unit")]
    code: Annotated[
        tc.schema.Word[Code] | None,
        Field(description="[reason for programs](#verdict-and-code); `null` after bad input and after a dry run"),
    ] = None
    reason: Annotated[tc.schema.Text, Field(description="reason for people, one sentence")]
    exit_code: Annotated[
        int | None, Field(description="exit code of the command for this unit; `null` after an internal error")
    ]
    device_state: Annotated[
        tc.schema.Word[DeviceState],
        Field(description="which calibration the device holds: [device state](#device-state)"),
    ]
    evidence: Annotated[
        tc.schema.Word[Evidence], Field(description="what `device_state` rests on: [evidence](#device-state)")
    ]
    observed: Annotated[
        list[tc.schema.Word[Observation]],
        Field(
            default_factory=list,
            description="what was seen of the device since the last write: [observations](#device-state)",
        ),
    ]
    registers: Annotated[
        RegistersDone | None,
        Field(description="what was done to the registers; `null` if nothing was to be written, and after a kill"),
    ]
    forced: Annotated[
        tc.schema.Text | None, Field(description="reason of `--force`, if it overruled sanity warnings; else `null`")
    ]
    journal: Annotated[
        tc.schema.Text | None, Field(description="path of the [journal](#journal) while it is needed; else `null`")
    ]
    limits: Annotated[
        LimitsOfOutcome,
        Field(description="limits of the station, `null` where there is none; empty after `provision` and `restore`"),
    ]
    outside: Annotated[list[str], Field(description="figures of the fit that are outside their limits, in words")]
    measured: Annotated[Measured | None, Field(description="figures of the fit; `null` if it did not come to one")]
    verification: Annotated[
        Verification | None,
        Field(description="[`triaxcal.verification/1`](certificate.md#verification); `null` without check poses"),
    ]
    wanted_poses: Annotated[list[str], Field(description="poses that would mend a refusal")]
    supersedes: Annotated[
        str | None, Field(description="SHA-256 of the unit's latest outcome before this one; else `null`")
    ]
    sha256: Annotated[
        dict[str, str | None], Field(description="SHA-256 of certificate and report, by the name of the attachment")
    ]
    software: Annotated[
        dict[str, str],
        Field(description="versions of `triaxcal`, `numpy`, `scipy`, `python`; `processor`, `blas`, `blas_kernel`"),
    ]
    contents: Annotated[
        Contents | None,
        Field(description="inventory of the recording before this attachment; `null` without a recording"),
    ]
