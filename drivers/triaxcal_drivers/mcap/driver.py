"""Sensors whose samples are messages in MCAP files: their profile, the decoder of
a stream (one sample a message, in the order in which they were logged), and the
entry point ``mcap``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Self, cast

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import Device, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.logs.can_frames import LONGEST_NS
from triaxcal_drivers.mcap.messages import MessageSchema, Read, reader
from triaxcal_drivers.profile import (
    CHANNELS_MOST,
    READING_CHANNELS,
    STREAMS_MOST,
    Bundle,
    Profile,
    Strict,
    require_readings,
)

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
        require_readings(self.channels)
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


class MessageDecoder:
    """Decodes one stream.

    **Time.** That at which the first message was logged, plus the time that has
    gone by since on its own stamp; where there is none, the time of logging.

    Records of the other streams are passed over: ``source`` is the number of
    the stream in the profile. A message that is not as it is defined counts as
    malformed.
    """

    def __init__(self, stream: MessageStream, read: Read, source: int) -> None:
        self._read, self._source = read, source
        self._names = tuple(stream.channels)
        self._scale = np.array([c.scale for c in stream.channels.values()])
        self._offset = np.array([c.offset for c in stream.channels.values()])
        self._count = 0
        self._origin_ns: int | None = None  # on the host's clock, less that of the stamp

    def feed(self, batch: RawBatch) -> SampleBlock:
        times: list[int] = []
        rows: list[list[float]] = []
        errors = malformed = at = 0
        bad = int(RawFlag.ERROR | RawFlag.INVALID)
        columns: Any = zip(
            batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist(), batch.length.tolist(), strict=True
        )
        for time_ns, source, flags, length in columns:
            data, at = batch.payload[at : at + length], at + length
            if flags & bad:
                errors += 1
            elif source == self._source:
                try:
                    found, stamp_ns = self._read(data)
                    times.append(self._time_ns(time_ns, stamp_ns))
                except ValueError:
                    malformed += 1
                    continue
                rows.append(found)
        return replace(self._block(times, rows), errors=errors, malformed=malformed)

    def _time_ns(self, logged_ns: int, stamp_ns: int | None) -> int:
        """Raises ValueError where the stamps are too far apart."""
        if stamp_ns is None:
            return logged_ns
        if self._origin_ns is None:
            self._origin_ns = logged_ns - stamp_ns
        time_ns = self._origin_ns + stamp_ns
        if not -LONGEST_NS < time_ns < LONGEST_NS:
            raise ValueError("a time beyond all measure")
        return time_ns

    def _block(self, times: list[int], rows: list[list[float]]) -> SampleBlock:
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(self._names)) * self._scale + self._offset
        counter = self._count + np.arange(len(rows))
        self._count += len(rows)
        columns = [self._names.index(name) for name in READING_CHANNELS]
        auxiliary = {n: values[:, i] for i, n in enumerate(self._names) if n not in READING_CHANNELS}
        return SampleBlock(np.array(times, dtype=np.int64), counter, values[:, columns], auxiliary)


class McapDriver:
    """Messages that others logged in MCAP files. There is nothing that could be
    opened."""

    profile_model = McapProfile
    bus_model = McapBus

    def device(self, bundle: Bundle, bus: McapBus) -> Device:
        """Raises ProfileError: there is none."""
        raise ProfileError(
            f"profile {bundle.profile.name}: driver 'mcap' reads logs and no bus: `triaxcal log import` takes them"
        )

    def decoder(self, bundle: Bundle, stream: str) -> MessageDecoder:
        """Raises ProfileError where the messages do not hold what it names, or
        nothing says how they are encoded."""
        profile = cast(McapProfile, bundle.profile)
        where = f"profile {profile.name}"
        if stream not in profile.streams:
            raise ProfileError(f"{where}: no stream '{stream}'{nearest(stream, profile.streams)}")
        name = schema_file(stream)
        if name not in bundle.files:
            raise ProfileError(
                f"{where}: the file '{name}', which says how messages are encoded, is made by `triaxcal log import`"
            )
        schema = MessageSchema.of(bundle.files[name], f"{where}: {name}")
        source = list(profile.streams).index(stream)
        return MessageDecoder(profile.streams[stream], stream_reader(profile, stream, schema), source)


def stream_reader(profile: McapProfile, name: str, schema: MessageSchema) -> Read:
    """Raises ProfileError."""
    stream = profile.streams[name]
    paths = [channel.field for channel in stream.channels.values()]
    time = None if schema.stamp_stands_still else stream.time
    return reader(schema, paths, time, f"profile {profile.name}, streams.{name}, messages '{schema.name}'")
