"""What the catalogue finds under the name ``modbus``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from triaxcal_drivers.claim import canonical_port
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import Decoder, Device, LineLoad
from triaxcal_drivers.modbus.decoder import ModbusDecoder
from triaxcal_drivers.modbus.model import ModbusBus, ModbusProfile
from triaxcal_drivers.modbus.protocol import SerialLine
from triaxcal_drivers.profile import Bundle


class ModbusDriver:
    """Modbus TCP and RTU."""

    profile_model = ModbusProfile
    bus_model = ModbusBus
    packages = ("pymodbus",)

    def device(self, bundle: Bundle, bus: Any) -> Device:
        if not isinstance(bus, ModbusBus):
            raise TypeError(f"expected a ModbusBus, not {type(bus).__name__}")
        from triaxcal_drivers.modbus.device import ModbusDevice  # pymodbus, which no recording needs

        return ModbusDevice(_profile(bundle), bus)

    def loads(self, bundle: Bundle, bus: Any) -> Mapping[str, LineLoad]:
        """By stream; nothing where no baud rate tells how fast the line is:
        over TCP, and on a pseudo-terminal."""
        where = bus.where
        if not isinstance(where, SerialLine) or (port := canonical_port(where.port)).startswith("/dev/pts/"):
            return {}
        profile = _profile(bundle)
        return {
            name: LineLoad(port, where.settings, s.reads_per_s(profile.sampling.rate_hz), where.read_s(s.words))
            for name, s in profile.streams.items()
        }

    def decoder(self, bundle: Bundle, stream: str) -> Decoder:
        profile = _profile(bundle)
        if stream not in profile.streams:
            raise ProfileError(f"profile {profile.name}: no stream named '{stream}'{nearest(stream, profile.streams)}")
        return ModbusDecoder(profile, stream)


def _profile(bundle: Bundle) -> ModbusProfile:
    if not isinstance(bundle.profile, ModbusProfile):
        raise ProfileError(f"profile {bundle.profile.name} is for the driver '{bundle.profile.driver}', not 'modbus'")
    return bundle.profile
