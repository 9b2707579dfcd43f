"""What the device holds: its calibration registers as raw bytes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import Bundle
from triaxcald.provision.identity import read_serial
from triaxcald.provision.image import calibration_registers


@dataclass(frozen=True)
class Snapshot:
    """Raw bytes as on the wire by register, in the order in which they are to
    be written, and whose they are (None where the profile has no serial
    number)."""

    raw: Mapping[str, bytes]
    serial: str | None = None

    def differing(self, other: Mapping[str, bytes]) -> tuple[str, ...]:
        """The registers in which ``other`` differs, in this snapshot's order."""
        return tuple(name for name, raw in self.raw.items() if name in other and other[name] != raw)


async def take_snapshot(device: Device, bundle: Bundle, names: Iterable[str] | None = None) -> Snapshot:
    """Read ``names``, by default every calibration register. Raises
    RegisterRefused, DeviceSilent."""
    serial = await read_serial(device, bundle)
    names = calibration_registers(bundle.profile) if names is None else names
    return Snapshot({name: await device.read(name) for name in names}, serial)
