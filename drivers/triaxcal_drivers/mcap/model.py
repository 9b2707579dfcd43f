"""A profile of messages in an MCAP file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from triaxcal_drivers.profile import AXES, CHANNELS_MOST, STREAMS_MOST, Profile, Strict

READING_CHANNELS = tuple("u" + axis for axis in AXES)
FieldPath = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.([A-Za-z_][A-Za-z0-9_]*|[0-9]{1,6}))*$",
        max_length=256,
        description="fields from the message inwards, and places in arrays from 0: linear_acceleration.x, data.2",
    ),
]


class MessageChannel(Strict):
    """value = field * scale + offset."""

    field: Annotated[FieldPath, Field(description="its place in the message: imu.acceleration.x, data.2")]
    scale: Annotated[float, Field(description="value = field * scale + offset")] = 1.0
    offset: Annotated[float, Field(description="value = field * scale + offset")] = 0.0

    @model_validator(mode="after")
    def _not_zero(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be zero")
        return self


_NAMED = BeforeValidator(
    lambda given: {"field": given} if isinstance(given, str) else given, json_schema_input_type=str | MessageChannel
)


class MessageStream(Strict):
    """The messages of one topic, a sample each."""

    topic: Annotated[str, Field(description="whose messages are the samples")]
    time: Annotated[
        FieldPath | None,
        Field(
            description="the message's own time stamp: a stamp of seconds and nanoseconds, a number of seconds, or a "
            "whole number of nanoseconds; without it, or where it stands still, the time of logging"
        ),
    ] = None
    channels: Annotated[Mapping[str, Annotated[MessageChannel, _NAMED]], Field(max_length=CHANNELS_MOST)]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        for name in READING_CHANNELS:
            if name not in self.channels:
                raise ValueError(f"channels.{name} is missing")
        return self


class McapProfile(Profile):
    """A sensor whose samples are messages in MCAP files. There is no bus, so
    that it has no registers."""

    streams: Annotated[Mapping[str, MessageStream], Field(max_length=STREAMS_MOST)]
    registers: Annotated[Mapping[str, Any], Field(max_length=0, description="none: there is no bus")] = {}

    def optional_files(self) -> tuple[str, ...]:
        return tuple(map(schema_file, self.streams))


def schema_file(stream: str) -> str:
    """The file that says how a stream's messages are encoded; a recording
    carries it, made from the log."""
    return f"{stream}.schema.json"


class McapBus(Strict):
    """There is none."""
