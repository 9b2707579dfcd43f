"""Processes that provision a device on a virtual clock, one after another, each of which can be killed."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Literal

from tests.devices.habits import Habits
from tests.devices.in_memory import Errors, InMemoryDevice, VirtualClock
from tests.devices.memory import Electronics
from tests.devices.place import Place, Trouble
from tests.devices.profiles import Timing, profile_text
from tests.devices.table import NEW, OLD
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceBusy, DeviceSilent, DriverError, RegisterRefused
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.two_senders import ExtraAnswer
from triaxcald.errors import DaemonError
from triaxcald.provision.access import Clock, RegisterLink
from triaxcald.provision.journal import journaled_image, parse
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import RegisterImage, Snapshot, image_of

ERRORS = Errors(DeviceSilent, DeviceAbsent, BusError, DeviceSilent, RegisterRefused, DeviceBusy)
Truth = Literal["old", "new", "mixture"]


@cache
def _bundle(profile: str) -> Bundle:
    return parse_bundle(profile.encode(), {}, where="a profile")


class Killed(BaseException):
    """The process is gone: from this request on it does nothing any more."""


class Host:
    """A device with ``habits`` at the end of a line with ``trouble``, and the folder of a station.

    ``provision``, ``resume`` and ``restore`` are one process each; with ``kill_at`` the process is gone at that request
    of it, counted from 1, before the request is sent or, with ``kill_after``, once it is answered.
    """

    def __init__(self, folder: Path, habits: Habits, trouble: Trouble | None = None) -> None:
        self.folder = folder
        self.unit, self.clock = Electronics(habits, OLD.image(habits)), VirtualClock()
        self.place = Place(self.unit, trouble)
        self.bundle = _bundle(profile_text("modbus", habits, Timing()))
        self.old, self.new = self.unit.eeprom, NEW.image(habits)
        self.provisioning: Provisioning | None = None
        self.requests = 0

    # Processes.

    async def provision(self, kill_at: int | None = None, *, kill_after: bool = False) -> bool:
        """Whether it ended well."""
        return await self._process(self._provisioned(image_of(self.bundle.profile, self.new)), kill_at, kill_after)

    async def resume(self, kill_at: int | None = None, *, kill_after: bool = False) -> bool:
        return await self._process(self._resumed(), kill_at, kill_after)

    async def restore(self, kill_at: int | None = None, *, kill_after: bool = False) -> bool:
        """From the journal."""
        return await self._process(self._restored(), kill_at, kill_after)

    # What the device holds.

    def power_on(self) -> None:
        self.unit.power_on(self.clock.now())

    def starts_with(self) -> Truth:
        """After a loss of power, once a store under way has ended."""
        held = self.unit.starts_with()
        return "old" if held == self.old else "new" if held == self.new else "mixture"

    @property
    def journals(self) -> list[Path]:
        return sorted(self.folder.glob("journal/*.json"))

    async def _process(self, work: Any, kill_at: int | None, kill_after: bool) -> bool:
        self.requests = 0
        in_memory = InMemoryDevice(self.place, ERRORS, self.clock, extra=ExtraAnswer)
        device = _Mortal(self, in_memory, kill_at, kill_after)
        self._link = RegisterLink(device, self.bundle.profile, clock=Clock(self.clock.sleep, self.clock.now))
        try:
            with suppress(Killed):
                await device.open()
                await work
                return True
        except (DriverError, DaemonError):
            pass
        finally:
            work.close()
        return False

    async def _provisioned(self, image: RegisterImage) -> None:
        p = self.provisioning = self._begun(image)
        await p.examine()
        await self._finished(p.write())

    async def _finished(self, work: Awaitable[None]) -> None:
        assert self.provisioning is not None
        try:
            await work
        except Killed:
            raise
        except BaseException:
            self.provisioning.finish()
            raise
        self.provisioning.finish()

    async def _resumed(self) -> None:
        image, _ = await journaled_image(
            self._link, self.bundle, folder=self.folder, unit="unit", expected_serial=None, where="here"
        )
        await self._provisioned(image)

    async def _restored(self) -> None:
        entry = parse(self.journals[0].read_bytes(), where="the journal")
        self.provisioning = self._begun(image_of(self.bundle.profile, entry.before))
        await self._finished(self.provisioning.put_back(Snapshot(entry.before, entry.serial)))

    def _begun(self, image: RegisterImage) -> Provisioning:
        return Provisioning(
            self._link, self.bundle, image, unit="unit", folder=self.folder, expected_serial=None, where="here"
        )


class _Mortal:
    """The device as one process sees it."""

    def __init__(self, host: Host, device: InMemoryDevice, kill_at: int | None, kill_after: bool) -> None:
        self._host, self._device, self._kill_at, self._kill_after = host, device, kill_at, kill_after

    async def open(self) -> None:
        await self._device.open()

    async def close(self) -> None:
        await self._device.close()

    async def read(self, register: str) -> bytes:
        self._count(after=False)
        raw = await self._device.read(register)
        self._count(after=True)
        return raw

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        self._count(after=False)
        await self._device.write(register, raw, timeout_s=timeout_s)
        self._count(after=True)

    async def listen(self, seconds: float) -> list[Any]:
        return await self._device.listen(seconds)

    def stream(self, names: Sequence[str]) -> AsyncIterator[Any]:
        return self._device.stream(names)

    def _count(self, *, after: bool) -> None:
        self._host.requests += not after
        if self._kill_at is not None and self._host.requests >= self._kill_at and (after or not self._kill_after):
            raise Killed
        if self._kill_at is not None and self._host.requests > self._kill_at:
            raise Killed
