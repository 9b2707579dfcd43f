"""The entry point ``can``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, cast

from triaxcal_drivers.can.decode import CanDecoder
from triaxcal_drivers.can.description import stream_layout
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.model import CanBus, CanProfile
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.load import LineLoad
from triaxcal_drivers.nearest import nearest
from triaxcal_drivers.profile import Bundle

if TYPE_CHECKING:
    from triaxcal_drivers.can.device import CanDevice

CLASSIC_BYTES = 8
STANDARD_BITS, EXTENDED_BITS = 47, 67
"""Of a classic frame beside its data, with the three bits to the next and
without stuffed ones (ISO 11898-1): a bus carries no more than by these."""


class CanDriver:
    """Devices on CAN: streams laid out by a DBC or an EDS file, registers by
    CANopen SDO."""

    profile_model = CanProfile
    bus_model = CanBus
    packages = ("can", "canopen", "cantools")

    def device(self, bundle: Bundle, bus: CanBus) -> CanDevice:
        """Raises ProfileError where the profile's files do not hold what it
        names."""
        from triaxcal_drivers.can.device import CanDevice  # python-can and canopen, which no recording needs

        profile = cast(CanProfile, bundle.profile)
        return CanDevice(profile, bus, {name: _layout(bundle, name) for name in profile.streams})

    def loads(self, bundle: Bundle, bus: CanBus) -> Mapping[str, LineLoad]:
        """By stream; nothing where no bit rate says how fast the bus is, and
        for frames that are longer than classic ones."""
        if bus.bitrate is None:
            return {}
        found: dict[str, LineLoad] = {}
        for name in bundle.profile.streams:
            layout = _layout(bundle, name)
            sizes = [layout.size(number) for number in range(len(layout.messages))]
            if max(sizes) > CLASSIC_BYTES:
                continue
            bits = sum(
                8 * size + (EXTENDED_BITS if message.extended else STANDARD_BITS)
                for size, message in zip(sizes, layout.messages, strict=True)
            )
            frames_per_s = len(sizes) * bundle.profile.sampling.rate_hz
            frame_s = bits / len(sizes) / bus.bitrate
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
