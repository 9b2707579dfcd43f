"""What `devices check` prints with ``--json`` (`triaxcal.profile_check/1`)."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc


class Fault(StrEnum):
    """A problem of a profile, of a log, or of one by the other."""

    REGISTER_RANGE = "register_range"
    """A register cannot hold the nominal value of its role."""
    NO_FRAMES = "no_frames"
    """The log has no frame, message or reply of the profile's readings."""
    SEVERAL_UNITS = "several_units"
    """Frames of several nodes, buses or publishers fit the profile."""
    NO_SAMPLES = "no_samples"
    """The frames of a stream make no sample."""
    SAMPLES_LOST = "samples_lost"
    """More than half of a stream's samples are missing or unusable."""
    RATE = "rate"
    """The samples come at another rate than `sampling.rate_hz`, by the log's times."""
    CONSTANT_READING = "constant_reading"
    """An axis has the same value in all samples."""
    AT_REST = "at_rest"
    """|u| in the still poses is not about the nominal scale factor."""


class MessageOf(tc.schema.Model):
    name: Annotated[tc.schema.Text, Field(description="name of the message in the file")]
    identifier: Annotated[str, Field(description="identifier, with `+ node` where it shifts with the node")]


class ChannelOf(tc.schema.Model):
    name: Annotated[tc.schema.Text, Field(description="name of the channel")]
    place: Annotated[tc.schema.Text, Field(description="where it is, and its scaling, in words")]


class StreamOf(tc.schema.Model):
    name: Annotated[tc.schema.Text, Field(description="name of the stream")]
    place: Annotated[tc.schema.Text, Field(description="where it is, in words")]
    messages: Annotated[list[MessageOf], Field(description="CAN messages that make a sample; else empty")]
    channels: Annotated[list[ChannelOf], Field(description="channels of a sample")]


class RegisterOf(tc.schema.Model):
    name: Annotated[tc.schema.Text, Field(description="name of the register")]
    place: Annotated[tc.schema.Text, Field(description="where it is, in words")]
    type: Annotated[str, Field(description="[type](register-types.md)")]
    access: Annotated[str, Field(description="`ro`, `rw` or `wo`")]
    unit: Annotated[tc.schema.Text, Field(description="unit of its value")]
    role: Annotated[tc.schema.Text | None, Field(description="role; `null` without one")]


class RoleOf(tc.schema.Model):
    role: Annotated[tc.schema.Text, Field(description="role in a calibration")]
    name: Annotated[tc.schema.Text, Field(description="name of its register")]
    least_g: Annotated[
        tc.schema.Figure | None,
        Field(
            description="least value that the register holds, as what it makes of 1 g; `null` without a bound, or "
            "where the nominal scale factor is not known"
        ),
    ]
    most_g: Annotated[tc.schema.Figure | None, Field(description="largest value, likewise")]
    resolution_g: Annotated[
        tc.schema.Figure | None,
        Field(description="step of the register, likewise; of a float about the value of 1 g"),
    ]
    per: Annotated[str, Field(description="what the figures are divided by: `K`, `K²`; else empty")]


class CalibrationOf(tc.schema.Model):
    form: Annotated[str | None, Field(description="`[correction] form`; `null` for the model of the nine roles")]
    readings: Annotated[str | None, Field(description="`[correction] readings`; `null` without")]
    not_written: Annotated[
        tc.schema.Text | None, Field(description="why a run would not write the registers; else `null`")
    ]
    roles: Annotated[list[RoleOf], Field(description="roles of the calibration that have a register")]


class FrameOf(tc.schema.Model):
    identifier: Annotated[
        tc.schema.Text,
        Field(description="CAN identifier (`x` marks an extended one), topic, or Modbus table and address"),
    ]
    kind: Annotated[tc.schema.Text, Field(description="`data`, `fd`, `remote`, `error`, `reply`, or type of message")]
    channel: Annotated[tc.schema.Text, Field(description="bus of the log, or channel of an MCAP file; may be empty")]
    count: Annotated[int, Field(description="how many there are")]
    rate_hz: Annotated[tc.schema.Figure | None, Field(description="how many a second [Hz]; `null` of one, or no time")]
    bytes_least: Annotated[int, Field(description="bytes of the shortest")]
    bytes_most: Annotated[int, Field(description="bytes of the longest")]
    streams: Annotated[list[tc.schema.Text], Field(description="streams that use it; empty if nobody does")]
    canopen: Annotated[str | None, Field(description="what CANopen uses the identifier for; else `null`")]


class ValuesOf(tc.schema.Model):
    least: Annotated[tc.schema.Figure | None, Field(description="least value")]
    most: Annotated[tc.schema.Figure | None, Field(description="largest value")]


class SamplesOf(tc.schema.Model):
    samples: Annotated[int, Field(description="number of samples")]
    lost: Annotated[dict[str, int], Field(description="number of samples or records that give none, by kind")]
    seconds: Annotated[tc.schema.Figure, Field(description="from first to last sample, by their own time [s]")]
    seconds_by_log: Annotated[tc.schema.Figure | None, Field(description="by the log's times [s]; `null` without")]
    rate_hz: Annotated[
        tc.schema.Figure | None, Field(description="samples a second by the log's times, without pauses [Hz]")
    ]
    constant: Annotated[list[tc.schema.Text], Field(description="channels that have one value in all samples")]
    channels: Annotated[dict[tc.schema.Text, ValuesOf], Field(description="values by channel")]
    still_poses: Annotated[int, Field(description="number of still poses")]
    at_rest: Annotated[
        tc.schema.Figure | None, Field(description="median of |u| over the still poses [unit of the stream]")
    ]
    at_rest_g: Annotated[
        tc.schema.Figure | None,
        Field(description="the same over the nominal output per g, axis by axis: about 1 [g]; `null` without either"),
    ]


class LogOf(tc.schema.Model):
    file: Annotated[tc.schema.Text, Field(description="path of the log")]
    kind: Annotated[str, Field(description="kind of the log")]
    node: Annotated[int | None, Field(description="node of the unit; `null` if identifiers do not shift with it")]
    frames: Annotated[list[FrameOf], Field(description="what is in the log, used ones first")]
    other_records: Annotated[dict[tc.schema.Text, int], Field(description="records that are no frames, by kind")]
    damaged: Annotated[int, Field(description="number of damaged places")]
    damage: Annotated[tc.schema.Text | None, Field(description="the first of them; `null` without any")]
    streams: Annotated[dict[tc.schema.Text, SamplesOf], Field(description="samples by stream")]


class Problem(tc.schema.Model):
    code: Annotated[tc.schema.Word[Fault], Field(description="code for programs")]
    text: Annotated[tc.schema.Text, Field(description="the same for people, one line")]


class ProfileCheck(tc.schema.Model):
    """What resolves of a profile, and what a log holds by it."""

    format: Annotated[Literal["triaxcal.profile_check/1"], Field(description="format of this document")]
    profile: Annotated[tc.schema.Text, Field(description="name of the profile")]
    title: Annotated[tc.schema.Text, Field(description="title of the profile")]
    source: Annotated[tc.schema.Text, Field(description="document and page that it was made from; may be empty")]
    driver: Annotated[str, Field(description="driver of the profile")]
    files: Annotated[list[tc.schema.Text], Field(description="files that belong to it")]
    streams: Annotated[list[StreamOf], Field(description="streams")]
    registers: Annotated[list[RegisterOf], Field(description="registers")]
    sequences: Annotated[dict[str, list[tc.schema.Text]], Field(description="steps of each sequence, in words")]
    calibration: Annotated[CalibrationOf | None, Field(description="what the registers hold; `null` without roles")]
    log: Annotated[LogOf | None, Field(description="the log by the profile; `null` without one")]
    problems: Annotated[list[Problem], Field(description="what is wrong; exit code 1 with any")]
    notes: Annotated[list[tc.schema.Text], Field(description="what else to know, one line each")]
