"""Time-outs on Modbus: a reply that waits unread is in time, however late the event loop is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.drivers.virtual_time import run, virtual
from triaxcal_drivers.errors import BusError, DeviceSilent
from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcal_drivers.modbus.line import ModbusClient
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.modbus.protocol import READ_HOLDING, TcpAddress
from triaxcal_drivers.stall_clock import TICK_S

HELD_UP_S = 30.0
Reply = Callable[[bytes], bytes]


@asynccontextmanager
async def served(reply: Reply) -> AsyncIterator[int]:
    """Answers each Modbus request of 12 bytes; yields the port."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while request := await reader.read(12):
            writer.write(reply(request))
        writer.close()

    server = await asyncio.start_server(talk, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()


def _words(request: bytes, *words: int) -> bytes:
    data = b"".join(w.to_bytes(2, "big") for w in words)
    return request[:4] + (len(data) + 3).to_bytes(2, "big") + request[6:8] + bytes([len(data)]) + data


def test_a_modbus_reply_that_waits_unread_is_in_time() -> None:
    async def work() -> bytes:
        def reply(request: bytes) -> bytes:
            virtual().now_s += HELD_UP_S
            return _words(request, 7)

        async with served(reply) as port:
            client = await ModbusClient.joined(TcpAddress("127.0.0.1", port), unit_id=1, reply_timeout_s=1.0)
            try:
                return await client.read(READ_HOLDING, 0, 1)
            finally:
                await client.close()

    assert run(work()) == b"\x00\x07"


def test_a_modbus_unit_that_does_not_reply_is_silent_in_its_time() -> None:
    async def work() -> float:
        async with served(lambda request: b"") as port:
            client = await ModbusClient.joined(TcpAddress("127.0.0.1", port), unit_id=1, reply_timeout_s=1.0)
            begun_s = virtual().time()
            with pytest.raises(DeviceSilent, match="no reply in 1 s"):
                await client.read(READ_HOLDING, 0, 1)
            took_s = virtual().time() - begun_s
            await client.close()
            return took_s

    assert 1.0 <= run(work()) <= 1.0 + 2 * TICK_S


def test_a_closed_connection_has_no_timer_left() -> None:
    async def work() -> int:
        async with served(lambda request: b"") as port:
            client = await ModbusClient.joined(TcpAddress("127.0.0.1", port), unit_id=1, reply_timeout_s=1.0)
            await client.close()
        with pytest.raises(BusError, match="cannot connect"):
            await ModbusClient.joined(TcpAddress("127.0.0.1", port), unit_id=1, reply_timeout_s=1.0)
        await asyncio.sleep(0)
        return sum(not handle.cancelled() for handle in virtual()._scheduled)  # type: ignore[attr-defined]

    assert run(work()) == 0


REFUSED = bytes([0x83, 4])


def _stream(bundle: Callable[..., Any], reply: Reply, between: Callable[[], None], batches: int) -> tuple[int, float]:
    """Batches of the readings, ``between`` after each: how many came before it was silent, and how long it took."""

    async def work() -> tuple[int, float]:
        async with served(reply) as port:
            profile = bundle(("poll_period_s = 0.001", "poll_period_s = 0.05")).profile
            device = ModbusDevice(profile, ModbusBus(host="127.0.0.1", port=port, unit_id=17))
            await device.open()
            begun_s, came = virtual().time(), 0
            try:
                async for _ in device.stream(["readings"]):
                    came += 1
                    if came == batches:
                        break
                    between()
            except DeviceSilent:
                pass
            finally:
                await device.close()
            return came, virtual().time() - begun_s

    return run(work())


def _refused(request: bytes) -> bytes:
    return request[:4] + b"\x00\x03" + request[6:7] + REFUSED


def test_a_poll_that_fails_after_a_pause_of_ours_is_no_silence(bundle: Callable[..., Any]) -> None:
    def held_up() -> None:
        virtual().now_s += HELD_UP_S

    came, took_s = _stream(bundle, _refused, held_up, batches=50)
    assert came == 50
    assert took_s >= 49 * HELD_UP_S


def test_polls_that_all_fail_are_a_silence_in_its_time(bundle: Callable[..., Any]) -> None:
    came, took_s = _stream(bundle, _refused, lambda: None, batches=1_000_000)
    assert came > 50
    assert 10.0 <= took_s <= 10.1


def test_a_reply_that_waits_unread_has_come_when_it_was_asked_for(bundle: Callable[..., Any]) -> None:
    """What the unit did while this process was stopped comes after it, and not before."""

    async def work() -> tuple[list[float], list[float]]:
        asked_s: list[float] = []

        def reply(request: bytes) -> bytes:
            asked_s.append(virtual().time())
            virtual().now_s += HELD_UP_S
            return _refused(request)

        async with served(reply) as port:
            bus = ModbusBus(host="127.0.0.1", port=port, unit_id=17)
            device = ModbusDevice(bundle().profile, bus, now_ns=lambda: round(virtual().time() * 1e9))
            await device.open()
            probes, came_s = len(asked_s), list[float]()
            async for batch in device.stream(["readings"]):
                came_s += (batch.time_ns / 1e9).tolist()
                if len(came_s) == 5:
                    break
            await device.close()
        return asked_s[probes : probes + 5], came_s

    asked_s, came_s = run(work())
    assert len(came_s) == 5
    assert all(0 <= came - asked < 0.1 for asked, came in zip(asked_s, came_s, strict=True))
