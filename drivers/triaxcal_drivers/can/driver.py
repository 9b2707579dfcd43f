"""The entry point ``can``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

from triaxcal_drivers.can.adapter import Identifier
from triaxcal_drivers.can.decode import CanDecoder
from triaxcal_drivers.can.description import stream_layout
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.model import CanBus, CanProfile
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import LineLoad
from triaxcal_drivers.profile import Bundle

if TYPE_CHECKING:
    from triaxcal_drivers.can.device import CanDevice

STANDARD_BITS, EXTENDED_BITS = 47, 67
"""Bits of a classic frame without its data, with the three bits to the next frame and
without stuff bits (ISO 11898-1): a lower limit of the load."""


class CanDriver:
    """Devices on CAN: streams laid out by a DBC or an EDS file, registers by
    CANopen SDO."""

    profile_model = CanProfile
    bus_model = CanBus
    packages = ("can", "canopen")

    def device(self, bundle: Bundle, bus: CanBus) -> CanDevice:
        """Raises ProfileError where the profile's files do not hold what it
        names."""
        from triaxcal_drivers.can.device import CanDevice  # python-can and canopen, which no recording needs

        profile = cast(CanProfile, bundle.profile)
        return CanDevice(profile, bus, {name: _layout(bundle, name) for name in profile.streams})

    def loads(self, bundle: Bundle, bus: CanBus) -> Mapping[str, LineLoad]:
        """Load of each stream; a message of several streams counts in the first. None
        without a bit rate, or if the bus may carry CAN FD, whose data is faster."""
        if bus.bitrate is None or not bus.classic:
            return {}
        found: dict[str, LineLoad] = {}
        counted: set[Identifier] = set()
        for name in bundle.profile.streams:
            layout = _layout(bundle, name)
            bits = []
            for number, message in enumerate(layout.messages):
                key = message.identifier_of(bus.node_id), message.extended
                if key not in counted:
                    bits.append(8 * layout.size(number) + (EXTENDED_BITS if message.extended else STANDARD_BITS))
                counted.add(key)
            if bits:
                frames_per_s = len(bits) * bundle.profile.sampling.rate_hz
                frame_s = sum(bits) / len(bits) / bus.bitrate
                found[name] = LineLoad(bus.name, f"{bus.bitrate} bit/s", frames_per_s, frame_s)
        return found

    def decoder(self, bundle: Bundle, stream: str) -> CanDecoder:
        """Raises ProfileError where the profile's files do not hold what it
        names."""
        return CanDecoder(_layout(bundle, stream), rate_hz=bundle.profile.sampling.rate_hz)


def _layout(bundle: Bundle, stream: str) -> Layout:
    profile = cast(CanProfile, bundle.profile)
    if stream not in profile.streams:
        raise ProfileError(f"profile {profile.name}: no stream '{stream}'{nearest(stream, profile.streams)}")
    where = f"profile {profile.name}, streams.{stream}"
    return stream_layout(profile.streams[stream], bundle.files, where=where)
