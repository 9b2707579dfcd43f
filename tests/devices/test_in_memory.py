"""A unit behind an asynchronous device on a virtual clock."""

from __future__ import annotations

from collections import Counter
from contextlib import aclosing, suppress
from dataclasses import replace

import pytest

from tests.devices.habits import Habits
from tests.devices.in_memory import Errors, InMemoryDevice, VirtualClock
from tests.devices.memory import Electronics
from tests.devices.motion import Motion
from tests.devices.place import Place, Trouble
from tests.devices.table import NEW, OLD
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent, DriverError, RegisterRefused
from triaxcal_drivers.interface import RawBatch

ERRORS = Errors(DeviceSilent, DeviceAbsent, BusError, BusError, RegisterRefused)
FIRST = frozenset({1})
STORE = b"\x65\x76\x61\x73"


def device(
    habits: Habits | None = None, trouble: Trouble | None = None, **settings
) -> tuple[InMemoryDevice, VirtualClock]:
    clock = VirtualClock()
    place = Place(Electronics(habits or Habits()), trouble)
    return InMemoryDevice(place, ERRORS, clock, **settings), clock


async def test_registers_are_read_and_written() -> None:
    unit, clock = device(Habits(unlock=False))
    await unit.open()
    await unit.write("bias_x", b"\x3f\x80\0\0")
    assert await unit.read("bias_x") == b"\x3f\x80\0\0"
    assert clock.now() == pytest.approx(0.003)


async def test_registers_may_go_least_significant_byte_first() -> None:
    unit, _ = device(Habits(unlock=False), little_endian=True)
    await unit.open()
    await unit.write("bias_x", b"\0\0\x80\x3f")
    assert unit.place.unit.in_use["bias_x"] == b"\x3f\x80\0\0"
    assert await unit.read("bias_x") == b"\0\0\x80\x3f"


async def test_a_device_that_is_not_open_cannot_be_asked() -> None:
    unit, _ = device()
    with pytest.raises(BusError, match="not open"):
        await unit.read("bias_x")


@pytest.mark.parametrize(
    ("trouble", "expected", "after_s"),
    [
        (Trouble(lose_reply=FIRST), DeviceSilent, 0.102),
        (Trouble(late=FIRST, late_s=0.2), DeviceSilent, 0.102),
        (Trouble(late=FIRST, late_s=0.05), None, 0.052),
        (Trouble(garble=FIRST), BusError, 0.002),
        (Trouble(drop=FIRST), BusError, 0.002),
        (Trouble(busy=FIRST, busy_code=5), RegisterRefused, 0.002),
        (Trouble(duplicate=FIRST), None, 0.002),
    ],
)
async def test_trouble_is_raised_as_the_drivers_errors_and_takes_its_time(
    trouble: Trouble, expected: type[Exception] | None, after_s: float
) -> None:
    unit, clock = device(trouble=trouble)
    await unit.open()
    if expected is None:
        await unit.read("bias_x")
    else:
        with pytest.raises(expected) as caught:
            await unit.read("bias_x")
        assert getattr(caught.value, "code", 5) == 5
    assert clock.now() == pytest.approx(after_s)


async def test_a_connection_may_not_survive_a_restart_and_be_refused_after_it() -> None:
    unit, clock = device(trouble=Trouble(restart_drops=True, refuse_connections_s=2.0))
    await unit.open()
    await unit.write("reset", b"\x52\x53")
    with pytest.raises(BusError, match="lost"):
        await unit.read("bias_x")
    with pytest.raises(BusError, match="refused"):
        await unit.open()
    await clock.sleep(2.0)
    await unit.open()
    assert await unit.read("serial_number") == (4711).to_bytes(4, "big")


async def test_a_dark_device_is_absent_but_a_bus_opens_blindly() -> None:
    unit, clock = device()
    unit.place.unit.power_off(0.0)
    with pytest.raises(DeviceAbsent):
        await unit.open()
    blind = InMemoryDevice(unit.place, ERRORS, clock, blind_open=True)
    await blind.open()
    with pytest.raises(DeviceSilent):
        await blind.read("bias_x")


async def test_samples_are_streamed_as_they_are_and_corrected() -> None:
    unit, _ = device(motion=Motion(lambda t: (t, 0.0, 0.0)), batch=RawBatch.of)
    await unit.open()
    async with aclosing(unit.stream(["readings", "corrected"])) as batches:
        first = await anext(batches)
    assert isinstance(first, RawBatch)
    assert first.source.tolist() == [0x40000, 0x40040]
    assert first.time_ns.tolist() == [21_000_000] * 2
    assert len(first.payload) == 24


async def test_a_request_may_have_a_time_out_of_its_own() -> None:
    unit, clock = device(Habits(unlock=False, store_seconds=8.0, store_blocks=True))
    await unit.open()
    with pytest.raises(DeviceSilent):
        await unit.write("store", STORE)
    await clock.sleep(8.0)
    await unit.write("store", STORE, timeout_s=10.0)
    assert clock.now() == pytest.approx(0.001 + 0.101 + 8.0 + 8.001)


async def test_busy_may_be_an_error_of_its_own() -> None:
    class DeviceBusy(RegisterRefused):
        pass

    place = Place(Electronics(), Trouble(busy=1.0))
    unit = InMemoryDevice(place, replace(ERRORS, busy=DeviceBusy), VirtualClock())
    await unit.open()
    with pytest.raises(DeviceBusy):
        await unit.read("bias_x")


OLD_IMAGE, NEW_IMAGE = OLD.image(Habits()), NEW.image(Habits())


async def write_and_look(unit: InMemoryDevice) -> dict[str, bytes]:
    """A master that is stopped by the first trouble: writes, stores, restarts, and reads."""
    await unit.open()
    await unit.write("unlock_key", b"\xc0\xde")
    for register, raw in NEW_IMAGE.items():
        await unit.write(register, raw)
    await unit.write("store", STORE)
    await unit.write("reset", b"\x52\x53")
    await unit.open()
    return {name: await unit.read(name) for name in OLD_IMAGE}


async def test_what_hundreds_of_runs_on_a_bad_line_leave_is_known() -> None:
    """Without its calibration read after a restart a master does not know; the device does."""
    ends: Counter[str] = Counter()
    for seed in range(300):
        unit, _ = device(trouble=Trouble(seed=seed, lose_reply=0.01, brown_out=0.01, busy=0.01))
        with suppress(DriverError):
            await unit.open()
            held = await write_and_look(unit)
            assert unit.place.unit.holds(held)
            ends["read"] += 1
        ends["old"] += unit.place.unit.holds(OLD_IMAGE)
        ends["new"] += unit.place.unit.holds(NEW_IMAGE)
    assert ends["read"] > 120
    assert ends["new"] > ends["read"] / 2
    assert ends["old"] > 30
    assert ends["old"] + ends["new"] == 300  # a brown-out locks, so that nothing more is stored
