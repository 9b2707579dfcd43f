"""Several units on one line: one port or connection, a turn for each, and what a dead one costs the others."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, nullcontext
from typing import Any

import pytest

from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent
from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcal_drivers.modbus.line import serve_serial
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.modbus.protocol import Handler, SerialLine, answer
from triaxcald.simulation.modbus_unit import pty_pair

Make = Callable[..., Any]


class Unit:
    """Answers every read with its own number, and counts what it is asked."""

    def __init__(self, number: int) -> None:
        self.number, self.asked, self.there = number, 0, True

    def alive(self) -> bool:
        self.asked += 1
        return self.there

    def read(self, function: int, address: int, count: int) -> bytes:
        return struct.pack(f">{count}H", *[self.number] * count)

    def write(self, address: int, data: bytes) -> None:
        raise AssertionError("nothing is written here")


@asynccontextmanager
async def rs485(units: Mapping[int, Handler]) -> AsyncIterator[str]:
    """A line with several units at its far end."""
    async with pty_pair() as (near, far), serve_serial(units, SerialLine(far, parity="N")):
        yield near


@asynccontextmanager
async def gateway(units: Mapping[int, Handler], connections: list[int]) -> AsyncIterator[int]:
    """A gateway to units behind it; ``connections`` gets an entry for each that was made."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connections.append(1)
        while head := await reader.read(7):
            length = int.from_bytes(head[4:6], "big")
            pdu = await reader.readexactly(length - 1)
            handler = units.get(head[6])
            if handler is not None and handler.alive():
                reply = answer(handler, pdu)
                writer.write(head[:4] + struct.pack(">HB", len(reply) + 1, head[6]) + reply)
        writer.close()

    server = await asyncio.start_server(talk, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]


async def _readings(device: ModbusDevice, count: int) -> list[bytes]:
    found: list[bytes] = []
    async for batch in device.stream(["readings"]):
        found += [batch.payload] if not batch.flags.any() else []
        if len(found) >= count:
            break
    return found


async def test_two_units_on_one_serial_port_are_read_side_by_side(bundle: Make) -> None:
    units = {1: Unit(11), 2: Unit(22)}
    async with rs485(units) as port:
        devices = [ModbusDevice(bundle().profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in units]
        await asyncio.gather(*(d.open() for d in devices))
        found = await asyncio.gather(*(_readings(d, 20) for d in devices))
        for device in devices:
            await device.close()
    for unit, payloads in zip(units.values(), found, strict=True):
        assert set(payloads) == {struct.pack(">3H", *[unit.number] * 3)}


async def test_a_unit_that_leaves_does_not_close_the_port_of_the_others(bundle: Make) -> None:
    async with rs485({1: Unit(11), 2: Unit(22)}) as port:
        one, other = (
            ModbusDevice(bundle().profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in (1, 2)
        )
        await one.open()
        await other.open()
        await one.close()
        assert await other.read("level") == struct.pack(">H", 22)
        await one.open()  # and may come back
        assert await one.read("level") == struct.pack(">H", 11)
        await other.close()
        await one.close()


async def test_units_behind_one_gateway_share_one_connection(bundle: Make) -> None:
    connections: list[int] = []
    async with gateway({1: Unit(11), 2: Unit(22), 3: Unit(33)}, connections) as port:
        devices = [ModbusDevice(bundle().profile, ModbusBus(host="127.0.0.1", port=port, unit_id=i)) for i in (1, 2, 3)]
        await asyncio.gather(*(d.open() for d in devices))
        levels = await asyncio.gather(*(d.read("level") for d in devices))
        for device in devices:
            await device.close()
    assert levels == [struct.pack(">H", n) for n in (11, 22, 33)]
    assert len(connections) == 1


async def test_units_that_ask_for_other_settings_of_one_port_are_refused(bundle: Make) -> None:
    async with rs485({1: Unit(11), 2: Unit(22)}) as port:
        one = ModbusDevice(bundle().profile, ModbusBus(serial_port=port, parity="N", unit_id=1))
        other = ModbusDevice(
            bundle().profile, ModbusBus(serial_port=port, parity="N", unit_id=2, baudrate=9600, stopbits=2)
        )
        await one.open()
        with pytest.raises(BusError, match="another unit has it with 19200 baud, parity N, 1 stop bits; this one asks"):
            await other.open()
        assert await one.read("level") == struct.pack(">H", 11)
        await one.close()


async def test_an_absent_unit_is_absent_and_the_others_go_on(bundle: Make) -> None:
    async with rs485({1: Unit(11)}) as port:
        profile = bundle(hasty=True).profile
        one, absent = (ModbusDevice(profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in (1, 9))
        await one.open()
        with pytest.raises(DeviceAbsent, match="unit 9"):
            await absent.open()
        assert await one.read("level") == struct.pack(">H", 11)
        await one.close()


@pytest.mark.slow
async def test_a_dead_unit_is_asked_ever_more_rarely_until_it_is_silent(bundle: Make) -> None:
    """Were it asked again at once, it would be asked twenty times and have the line all the time."""
    unit, dead = Unit(11), Unit(22)
    patience = ("reply_timeout_s = 5.0, silence_timeout_s = 10.0", "reply_timeout_s = 0.1, silence_timeout_s = 2.0")
    async with rs485({1: unit, 2: dead}) as port:
        profile = bundle(patience).profile
        one, other = (ModbusDevice(profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in (1, 2))
        await one.open()
        await other.open()
        dead.there, dead.asked = False, 0
        reading = asyncio.create_task(_readings(one, 100_000))
        with pytest.raises(DeviceSilent, match="unit 2"):
            await _readings(other, 1)
        assert 3 <= dead.asked <= 6
        assert not reading.done()  # the other has heard nothing of it
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        await one.close()
        await other.close()


async def test_a_time_out_of_one_unit_leaves_the_line_to_the_others(bundle: Make) -> None:
    """The late reply of the first may still come, and only the first has to wait for that."""
    dead, unit = Unit(11), Unit(22)
    async with rs485({1: dead, 2: unit}) as port:
        profile = bundle(hasty=True).profile
        one, other = (ModbusDevice(profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in (1, 2))
        await one.open()
        await other.open()
        dead.there = False
        loop = asyncio.get_running_loop()
        order: list[str] = []

        async def ask(device: ModbusDevice, name: str) -> None:
            with pytest.raises(DeviceSilent) if name == "dead" else nullcontext():
                await device.read("level")
            order.append(name)

        begun_s = loop.time()
        first = asyncio.create_task(ask(one, "dead"))
        await asyncio.sleep(0)
        again = asyncio.create_task(ask(one, "dead"))
        await asyncio.gather(first, ask(other, "alive"))
        assert loop.time() - begun_s < 0.4 - 0.01  # one time-out of 0.2 s, and no wait for the late reply
        await again
        assert order == ["dead", "alive", "dead"]
        await one.close()
        await other.close()


async def test_a_neighbour_that_is_dead_makes_no_healthy_unit_silent(bundle: Make) -> None:
    """The good unit loses one reply, and then has to wait for the time-outs of three others."""
    units = {i: Unit(i) for i in (1, 2, 3, 4)}
    patience = ("reply_timeout_s = 5.0, silence_timeout_s = 10.0", "reply_timeout_s = 0.2, silence_timeout_s = 0.4")
    async with rs485(units) as port:
        profile = bundle(patience).profile
        devices = [ModbusDevice(profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in units]
        await asyncio.gather(*(d.open() for d in devices))
        for i in (2, 3, 4):
            units[i].there = False
        others = [asyncio.create_task(_readings(d, 1)) for d in devices[1:]]
        await asyncio.sleep(0)
        units[1].there = False
        reading = asyncio.create_task(_readings(devices[0], 30))
        while units[1].asked < 2:
            await asyncio.sleep(0.01)
        units[1].there = True
        assert len(await reading) == 30
        for result in await asyncio.gather(*others, return_exceptions=True):
            assert isinstance(result, DeviceSilent)
        for device in devices:
            await device.close()


async def test_a_device_that_is_closed_asks_nothing_more_and_waits_for_nothing(bundle: Make) -> None:
    """Of two requests one is under way and one waits; another unit keeps the line open."""
    dead, unit = Unit(11), Unit(22)
    async with rs485({1: dead, 2: unit}) as port:
        one, other = (
            ModbusDevice(bundle().profile, ModbusBus(serial_port=port, parity="N", unit_id=i)) for i in (1, 2)
        )
        await one.open()
        await other.open()
        dead.there = False
        requests = [asyncio.create_task(one.read("level")) for _ in range(2)]
        while dead.asked < 2:
            await asyncio.sleep(0.01)
        requests[0].cancel()
        await one.close()
        await other.close()
        async with asyncio.timeout(4.0):  # less than the time-out of a reply
            first, second = await asyncio.gather(*requests, return_exceptions=True)
        assert isinstance(first, asyncio.CancelledError)
        assert isinstance(second, BusError)


async def test_a_connection_that_went_mute_is_made_anew_though_another_unit_uses_it(bundle: Make) -> None:
    """A gateway that keeps the first connection open and serves it no more."""
    connections: list[int] = []
    units = {1: Unit(11), 2: Unit(22)}
    async with gateway(units, connections) as port:
        profile = bundle(hasty=True).profile
        one, other = (ModbusDevice(profile, ModbusBus(host="127.0.0.1", port=port, unit_id=i)) for i in units)
        await one.open()
        await other.open()
        for unit in units.values():
            unit.there = False
        with pytest.raises(DeviceSilent):
            await one.read("level")
        for unit in units.values():
            unit.there = True
        await one.open()
        assert len(connections) == 2
        assert [await d.read("level") for d in (one, other)] == [struct.pack(">H", n) for n in (11, 22)]
        await one.close()
        await other.close()


async def test_a_host_that_no_name_can_be_is_one_line(bundle: Make) -> None:
    device = ModbusDevice(bundle(hasty=True).profile, ModbusBus(host="a..b", port=502, unit_id=1))
    with pytest.raises(BusError, match=r"cannot connect to a\.\.b:502"):
        await device.open()
