"""Axes that are read one by one, on lines that lose, delay, damage and refuse: every sample is of one cycle.

The unit counts its requests for an axis and shows the count, with the axis in its last digit: whoever puts together
axes of two cycles, or takes one axis for another, has numbers that do not belong together.
"""

from __future__ import annotations

import asyncio
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from tests.devices.memory import Electronics
from tests.devices.modbus import ModbusUnit as Unit
from tests.devices.modbus_rtu import ModbusRtu
from tests.devices.modbus_tcp import ModbusTcp
from tests.devices.motion import Motion, Triple
from tests.devices.place import Place, Trouble
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import DeviceSilent
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcal_drivers.modbus.driver import ModbusDriver
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.profile import Bundle

PROFILE = """
format = "triaxcal.profile/1"
name = "axis-by-axis"
driver = "modbus"
max_read_words = 2
identity = { vendor = "v", product = "p" }
output = { unit = "counts" }
sampling = { rate_hz = 200.0, reply_timeout_s = 0.1, silence_timeout_s = 5.0 }

[streams.readings]
layout = "poll"
address = 0
poll_period_s = 0.0
max_gap = 0
[streams.readings.channels]
ux = { word = 0, type = "int32" }
uy = { word = 2, type = "int32" }
uz = { word = 4, type = "int32" }
temp_c = { address = 0x80, type = "uint16", latest_s = 2.0 }
"""


def bundle(*replaced: tuple[str, str]) -> Bundle:
    text = PROFILE
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    return parse_bundle(text.encode(), {}, where="axis-by-axis.toml")


BUNDLE = bundle()
SAMPLES = 40
SOURCES = [0x0004_0000, 0x0004_0002, 0x0004_0004]
TEMPERATURE = 0x0004_0080


@dataclass
class Counting:
    """Shows the number of the request so far, and the axis."""

    asked: int = 0
    temperatures: list[float] = field(default_factory=list)

    def __call__(self, now: float) -> Triple:
        self.asked += 1
        return tuple(1e-6 * (10 * self.asked + axis) for axis in range(3))  # type: ignore[return-value]

    def temperature(self, now: float) -> int:
        self.temperatures.append(now)
        return len(self.temperatures)


async def recorded(bus: Any, samples: int, made: Bundle = BUNDLE) -> RawBatch:
    """The raw records until so many samples are whole."""
    device, decoder = ModbusDevice(made.profile, bus), ModbusDriver().decoder(made, "readings")
    batches: list[RawBatch] = []
    async with asyncio.timeout(60):
        while samples > 0:
            with suppress(DeviceSilent):
                await device.open()
                async with aclosing(device.stream(["readings"])) as stream:
                    async for batch in stream:
                        batches.append(batch)
                        samples -= len(decoder.feed(batch))
                        if samples <= 0:
                            break
    await device.close()
    return RawBatch.joined(batches)


TROUBLES = {
    "sound": Trouble(),
    "loses replies": Trouble(lose_reply=0.08, seed=1),
    "does not hear requests": Trouble(lose_request=0.08, seed=2),
    "answers after the time-out": Trouble(late=0.08, late_s=0.13, seed=3),
    "refuses in the middle": Trouble(busy=0.15, seed=4),
    "refuses for another reason": Trouble(busy=0.15, busy_code=2, seed=5),
    "damages replies": Trouble(garble=0.08, garbage=("truncated",), seed=6),
    "answers with another length": Trouble(garble=0.15, garbage=("length",), seed=7),
}


@pytest.mark.parametrize("transport", [ModbusTcp, ModbusRtu])
@pytest.mark.parametrize("trouble", TROUBLES)
async def test_every_sample_is_of_one_cycle(transport: Any, trouble: str) -> None:
    counting = Counting()
    motion = Motion(counting, number="int32", apart=True, beside={0x80: counting.temperature})
    place = Place(Electronics(), TROUBLES[trouble])
    with transport(Unit(place, motion)) as served:
        batch = await recorded(ModbusBus(**served.bus), SAMPLES)
    whole = ModbusDriver().decoder(BUNDLE, "readings").feed(batch)
    assert len(whole) >= SAMPLES
    x, y, z = whole.readings.T
    # Each axis is what it says, and was asked right after the one before; up to two in between were repeated.
    assert [set(axis % 10) for axis in (x, y, z)] == [{0}, {1}, {2}]
    requests = np.array([x // 10, y // 10, z // 10])
    assert np.isin(np.diff(requests, axis=0), (1, 2, 3)).all()
    # No sample is made twice, and what is not in a sample is told.
    assert len(set(x)) == len(set(z)) == len(whole)
    good = (batch.flags & (RawFlag.ERROR | RawFlag.INVALID)) == 0
    firsts = int((good & (batch.source == SOURCES[0])).sum())
    assert firsts - 1 <= len(whole) + whole.incomplete <= firsts
    failed = int((~good).sum())
    assert whole.errors == failed
    assert failed or trouble == "sound"
    assert set(whole.channels["temp_c"]) <= set(range(1, len(counting.temperatures) + 1))


async def test_the_value_that_lasts_comes_first_and_again_after_half_its_time() -> None:
    counting = Counting()
    motion = Motion(counting, number="int32", apart=True, beside={0x80: counting.temperature})
    made = bundle(("latest_s = 2.0", "latest_s = 0.2"))
    with ModbusTcp(Unit(Place(Electronics()), motion)) as served:
        batch = await recorded(ModbusBus(**served.bus), 400, made)
    assert batch.source[:4].tolist() == [TEMPERATURE, *SOURCES]
    times_ns = batch.time_ns[batch.source == TEMPERATURE]
    assert len(times_ns) > 1
    assert (np.diff(times_ns) >= 0.09e9).all()  # due 0.1 s after the reply, by another clock than the records'
    after = batch.source[1:][batch.source[:-1] == TEMPERATURE]
    assert set(after.tolist()) == {SOURCES[0]}  # between samples, never within one


async def test_a_unit_without_the_register_of_a_value_gives_no_whole_sample() -> None:
    motion = Motion(Counting(), number="int32", apart=True)
    decoder = ModbusDriver().decoder(BUNDLE, "readings")
    with ModbusTcp(Unit(Place(Electronics()), motion)) as served:
        device = ModbusDevice(BUNDLE.profile, ModbusBus(**served.bus))
        await device.open()
        samples = incomplete = 0
        async with aclosing(device.stream(["readings"])) as stream:
            async for batch in stream:
                block = decoder.feed(batch)
                samples, incomplete = samples + len(block), incomplete + block.incomplete
                if incomplete == 20:
                    break
        await device.close()
    assert samples == 0


@pytest.mark.parametrize("key", ["", "max_gap = 2\n"])
async def test_a_refused_block_asks_for_the_key_that_divides_it(key: str) -> None:
    apart = [("int32", "int16"), ("silence_timeout_s = 5.0", "silence_timeout_s = 0.2")]
    motion = Motion(Counting(), number="int32", apart=True, beside={0x80: lambda _: 1})
    with ModbusTcp(Unit(Place(Electronics()), motion)) as served:
        bus = ModbusBus(**served.bus)
        whole = bundle(*apart, ("max_gap = 0\n", key), ("max_read_words = 2\n", ""))
        with pytest.raises(DeviceSilent, match=r"exception 0x02 .* to function 4 at 0x0000; .* max_gap = 0"):
            await first_batches(ModbusDevice(whole.profile, bus))
        await recorded(bus, 3, bundle(*apart))


async def first_batches(device: ModbusDevice) -> None:
    await device.open()
    try:
        async with aclosing(device.stream(["readings"])) as stream:
            async for _ in stream:
                pass
    finally:
        await device.close()
