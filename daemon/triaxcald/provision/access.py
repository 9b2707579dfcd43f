"""Every register access told to a recorder, by standing between the caller and the device."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.interface import Device, RawBatch


@dataclass(frozen=True)
class RegisterAccess:
    """``raw`` as on the wire, written or read (empty where a read failed); ``error`` the driver's message."""

    kind: Literal["read", "write"]
    register: str
    raw: bytes
    error: str | None = None


class RecordedDevice:
    """A Device that passes everything on and tells ``record`` of each register access once it has ended."""

    def __init__(self, device: Device, record: Callable[[RegisterAccess], None]) -> None:
        self._device = device
        self._record = record

    async def open(self) -> None:
        await self._device.open()

    async def close(self) -> None:
        await self._device.close()

    def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        return self._device.stream(names)

    async def read(self, register: str) -> bytes:
        try:
            raw = await self._device.read(register)
        except DriverError as e:
            self._record(RegisterAccess("read", register, b"", str(e)))
            raise
        self._record(RegisterAccess("read", register, raw))
        return raw

    async def write(self, register: str, raw: bytes) -> None:
        try:
            await self._device.write(register, raw)
        except DriverError as e:
            self._record(RegisterAccess("write", register, raw, str(e)))
            raise
        self._record(RegisterAccess("write", register, raw))
