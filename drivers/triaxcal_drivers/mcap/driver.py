"""The entry point ``mcap``."""

from __future__ import annotations

from typing import cast

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.interface import Device
from triaxcal_drivers.mcap.decode import MessageDecoder
from triaxcal_drivers.mcap.fields import Read, reader
from triaxcal_drivers.mcap.model import McapBus, McapProfile, schema_file
from triaxcal_drivers.mcap.schema import MessageSchema
from triaxcal_drivers.nearest import nearest
from triaxcal_drivers.profile import Bundle


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
