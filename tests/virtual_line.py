"""A station's run on a virtual clock: the same samples each time, however busy the machine is.

The units are the simulated ones, without a bus and without an event loop of their own: their time goes on by what is
asked of them, and by nothing else. So what judges figures is given the same recording on every run of the tests; how
the line behaves on a bus, live runs judge.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.errors import DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import READINGS, Bundle
from triaxcald.provision.access import Clock, RegisterLink
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run import session, unit_run, write_back
from triaxcald.simulation.bench import load_device, simulate
from triaxcald.simulation.can_unit import ABORT_CODES, tpdos
from triaxcald.simulation.modbus_unit import ModbusMap
from triaxcald.simulation.time_base import SteppedTimeBase
from triaxcald.simulation.unit import ReferenceUnit, RegisterFault, UnitSilent
from triaxcald.station import collection, on_demand
from triaxcald.station.config import Place

START_NS = 1_772_442_000_000_000_000  # 2026-03-02T09:00:00Z, when every unit is switched on
BATCH_S, REQUEST_S = 0.5, 0.02
LOOK_S = 2.0
"""The poses so far are looked at so often, by the samples' time alone: a phase then ends at the same one each time."""
DRAIN_BATCHES = 50
"""The disk is waited for as often: these units are quicker than it, and what it has no room for is not recorded."""

Record = tuple[int, int, int, bytes]


class VirtualDevice:
    """A Device whose time stands still but for `REQUEST_S` a request and `BATCH_S` a batch."""

    least_first = False

    def __init__(self, unit: ReferenceUnit, bundle: Bundle, bus: Any) -> None:
        self.unit, self.bundle, self.bus = unit, bundle, bus
        self.time_base = SteppedTimeBase()
        self.writer: RecordingWriter | None = None

    def now_ns(self) -> int:
        return START_NS + round(self.time_base.now_s() * 1e9)

    @property
    def clock(self) -> Clock:
        """What a deadline goes by. A pause takes none of this time, since nothing is asked in it."""
        return Clock(lambda _: asyncio.sleep(0), self.time_base.now_s)

    async def open(self) -> None:
        await self.time_base.advance(REQUEST_S)
        if not self.unit.alive(self.time_base.now_s()):
            raise DeviceAbsent("nothing answers")

    async def close(self) -> None:
        pass

    async def read(self, register: str) -> bytes:
        raw = await self._asked(register, lambda now_s: self.unit.read(register, now_s))
        return raw[::-1] if self.least_first else raw

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        raw = raw[::-1] if self.least_first else raw
        await self._asked(register, lambda now_s: self.unit.write(register, raw, now_s))

    async def _asked(self, register: str, request: Any) -> Any:
        await self.time_base.advance(REQUEST_S)
        try:
            return request(self.time_base.now_s())
        except RegisterFault as e:
            raise RegisterRefused(str(e), register=register, code=ABORT_CODES[e.kind]) from e
        except UnitSilent as e:
            raise DeviceSilent(f"register {register}: no reply") from e

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        self.records(names)  # what was sampled before is no part of it
        batches = 0
        while True:
            await self.time_base.advance(BATCH_S)
            yield RawBatch.of(self.records(names))
            batches += 1
            if self.writer is not None and batches % DRAIN_BATCHES == 0:
                await asyncio.to_thread(self.writer.drain)

    def records(self, names: Sequence[str]) -> list[Record]:
        """What the unit has to send of the streams by now, as it comes off its bus."""
        raise NotImplementedError


class OnCan(VirtualDevice):
    least_first = True

    def records(self, names: Sequence[str]) -> list[Record]:
        run = self.unit.advance(self.time_base.now_s())
        wanted = [of for name in names for of in ((0, 1) if name == READINGS else (2, 3))]
        return [
            (self.now_ns(), 0x180 + 0x100 * number + self.bus.node_id, 0, frames[number])
            for frames in zip(*tpdos(run), strict=True)
            for number in wanted
        ]


class OnModbus(VirtualDevice):
    def __init__(self, unit: ReferenceUnit, bundle: Bundle, bus: Any) -> None:
        super().__init__(unit, bundle, bus)
        self._map = ModbusMap(unit, self.time_base)

    def records(self, names: Sequence[str]) -> list[Record]:
        made = []
        for stream in (self.bundle.profile.streams[name] for name in names):
            remaining = True
            while remaining:
                reply = self._map.read(stream.function, stream.address, stream.words)
                made.append((self.now_ns(), stream.function << 16 | stream.address, 0, reply))
                remaining = any(reply[2:4])
        return made


class _VirtualRun(unit_run.UnitRun):
    """By the unit's own clock, at the disk's speed."""

    def __init__(self, station: Any, place: Any, progress: Any, **more: Any) -> None:
        self._device = place.device()
        super().__init__(station, place, progress, clock_ns=self._device.now_ns, **more)

    def writer(self, *arguments: Any, **more: Any) -> RecordingWriter:
        self._device.writer = super().writer(*arguments, **more)
        return self._device.writer


def _linked(device: VirtualDevice, *arguments: Any, **settings: Any) -> RegisterLink:
    """By the host's clock a store would stall while another unit's fit keeps this one from being asked."""
    return RegisterLink(device, *arguments, **settings, clock=device.clock)


def _at_once(work: Any) -> asyncio.Future[Any]:
    """In the virtual time of the unit a judgement takes none, however busy the machine is."""
    judged: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    judged.set_result(work())
    return judged


@contextlib.contextmanager
def virtual_line(*units: ReferenceUnit) -> Iterator[None]:
    """While it is entered, a station's places have these units, by their serials, and it goes by their clocks."""
    by_serial = {str(unit.serial_number): unit for unit in units}
    made: dict[str, VirtualDevice] = {}

    def device(place: Place) -> VirtualDevice:
        serial = str(place.unit.serial)
        if serial not in made:
            kind = OnCan if place.bundle.profile.driver == "can" else OnModbus
            made[serial] = kind(by_serial[serial], place.bundle, place.bus)
        return made[serial]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Place, "device", device)
        patch.setattr(unit_run, "UnitRun", _VirtualRun)
        for module in (session, write_back):
            patch.setattr(module, "RegisterLink", _linked)
        patch.setattr(collection, "LOOK_SAMPLES_S", LOOK_S)
        patch.setattr(collection, "LOOK_HOST_S", 0.0)
        patch.setattr(collection, "LOOK_SHARE", 0.0)
        patch.setattr(on_demand, "apart", _at_once)
        yield


def described(device: Path) -> ReferenceUnit:
    """The unit of a device file."""
    return simulate(load_device(device), where=str(device)).unit
