"""The entry point ``can``."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from triaxcal_drivers.can.decode import CanDecoder
from triaxcal_drivers.can.description import stream_layout
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.model import CanBus, CanProfile
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.nearest import nearest
from triaxcal_drivers.profile import Bundle

if TYPE_CHECKING:
    from triaxcal_drivers.can.device import CanDevice


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
