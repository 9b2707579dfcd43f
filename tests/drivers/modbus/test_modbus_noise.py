"""Noise on an RTU line: one spoiled reply costs one retry, and no time-out.

The time-out is half an hour and the period a minute, so that a test that waits for either fails.
"""

from __future__ import annotations

import asyncio
import os
import random
from collections.abc import Callable
from contextlib import aclosing
from typing import Any

import pytest

from tests.devices.table import crc16
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.modbus.protocol import DamagedReply

Make = Callable[..., Any]
PROBE = ("11 04 00 08 00 01 B2 98", "11 04 02 00 0A F8 F4")
POLL = ("11 03 00 6B 00 03 76 87", "11 03 06 AE 41 56 52 43 40 49 AD")
PATIENT = (
    ("reply_timeout_s = 5.0, silence_timeout_s = 10.0", "reply_timeout_s = 1800.0, silence_timeout_s = 3600.0"),
    ("poll_period_s = 0.001", "poll_period_s = 60.0"),
)


def framed(text: str) -> str:
    """Hex with its CRC."""
    body = bytes.fromhex(text)
    return (body + crc16(body).to_bytes(2, "little")).hex()


FIFO_ASKED = framed("11 04 0020 000A")
EMPTY = framed("11 04 14 0000 0000" + "0000" * 8)
RECORDS = framed("11 04 14 0002 0000 0001 0002 0003 0007 0001 0002 0003 0008")


def flipped(at: int) -> Callable[[bytes], bytes]:
    return lambda frame: bytes(b ^ (0x10 if i == at % len(frame) else 0) for i, b in enumerate(frame))


def without(at: int) -> Callable[[bytes], bytes]:
    return lambda frame: frame[: at % len(frame)] + frame[at % len(frame) + 1 :]


def put(at: int, value: int) -> Callable[[bytes], bytes]:
    return lambda frame: frame[:at] + bytes([value]) + frame[at + 1 :]


def sealed(spoil: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """With a CRC that fits."""
    return lambda frame: bytes.fromhex(framed(spoil(frame)[:-2].hex()))


SPOILED: dict[str, Callable[[bytes], bytes]] = {
    "address": flipped(0),
    "function": flipped(1),
    "length": flipped(2),
    "data": flipped(4),
    "checksum": flipped(-1),
    "first lost": without(0),
    "function lost": without(1),
    "length lost": without(2),
    "last lost": without(-1),
    "length of 255": put(2, 255),
    "length of 0": put(2, 0),
    "an exception's function": put(1, 0x83),
    "a function that nobody knows": put(1, 0x63),
    "as another unit": sealed(put(0, 18)),
    "one before": lambda frame: b"\x00" + frame,
    "the address twice": lambda frame: frame[:1] + frame,
    "a burst before": lambda frame: bytes.fromhex("ff 00 55 aa 11 03 ff") + frame,
    "a burst in its place": lambda frame: bytes.fromhex("55 aa 00 ff"),
    "one byte in its place": lambda frame: b"\xff",
    "half of it": lambda frame: frame[: len(frame) // 2],
    "ones": lambda frame: b"\xff" * len(frame),
    "zeros": lambda frame: bytes(len(frame)),
} | {f"random {seed}": lambda frame, seed=seed: random.Random(seed).randbytes(len(frame)) for seed in range(6)}  # type: ignore[misc]


async def opened(bundle: Make, path: str, *replaced: tuple[str, str]) -> ModbusDevice:
    device = ModbusDevice(bundle(*replaced).profile, ModbusBus(serial_port=path, parity="N", unit_id=17))
    await device.open()
    return device


async def first(device: ModbusDevice, stream: str, count: int) -> list[RawBatch]:
    batches: list[RawBatch] = []
    async with asyncio.timeout(50), aclosing(device.stream([stream])) as records:  # type: ignore[type-var]
        async for batch in records:
            batches.append(batch)
            if len(batches) == count:
                break
    return batches


@pytest.mark.parametrize("how", SPOILED)
async def test_a_reply_that_was_spoiled_is_asked_for_again_at_once(bundle: Make, serial_device: Make, how: str) -> None:
    spoiled = SPOILED[how](bytes.fromhex(POLL[1])).hex()
    async with serial_device(PROBE, (POLL[0], spoiled), POLL) as heard:
        device = await opened(bundle, heard.path, *PATIENT)
        bad, good = await first(device, "readings", 2)
        await device.close()
    assert (int(bad.flags[0]), bad.payload) == (RawFlag.ERROR, b"")
    assert (int(good.flags[0]), good.payload.hex()) == (0, "ae4156524340")


@pytest.mark.parametrize("how", SPOILED)
async def test_a_window_of_a_fifo_that_was_spoiled_is_followed_by_the_next_at_once(
    bundle: Make, serial_device: Make, how: str
) -> None:
    spoiled = SPOILED[how](bytes.fromhex(RECORDS)).hex()
    script = PROBE, (FIFO_ASKED, EMPTY), (FIFO_ASKED, spoiled), (FIFO_ASKED, RECORDS)
    async with serial_device(*script) as heard:
        device = await opened(bundle, heard.path, *PATIENT)
        bad, good = await first(device, "queue", 2)
        await device.close()
    assert (int(bad.flags[0]), bad.payload) == (RawFlag.ERROR, b"")
    assert (int(good.flags[0]), good.payload.hex()) == (0, bytes.fromhex(RECORDS)[3:-2].hex())


async def test_bytes_after_a_reply_cost_nothing(bundle: Make, serial_device: Make) -> None:
    async with serial_device(PROBE, (POLL[0], POLL[1] + "00")) as heard:
        device = await opened(bundle, heard.path, *PATIENT)
        (good,) = await first(device, "readings", 1)
        await device.close()
    assert good.payload.hex() == "ae4156524340"


async def test_of_replies_that_are_all_spoiled_one_is_asked_for_again(bundle: Make, serial_device: Make) -> None:
    """The next one comes at its time."""
    spoiled = POLL[0], flipped(4)(bytes.fromhex(POLL[1])).hex()
    async with serial_device(PROBE, *[spoiled] * 9) as heard:
        device = await opened(bundle, heard.path, *PATIENT)
        third = asyncio.ensure_future(first(device, "readings", 3))
        await asyncio.wait([third], timeout=0.5)
        third.cancel()
        await asyncio.wait([third])
        await device.close()
    assert len(heard) == 1 + 2


async def test_a_register_whose_reply_was_spoiled_can_be_read_again_at_once(bundle: Make, serial_device: Make) -> None:
    asked, reply = framed("11 03 0001 0001"), framed("11 03 02 000B")
    script = PROBE, (asked, "55 aa"), (asked, reply)
    async with serial_device(*script) as heard, asyncio.timeout(50):
        device = await opened(bundle, heard.path, *PATIENT)
        with pytest.raises(DamagedReply, match="2 bytes came, and no whole reply"):
            await device.read("setting")
        assert await device.read("setting") == b"\x00\x0b"
        await device.close()


async def test_the_reply_that_follows_noise_is_not_taken_for_that_of_another_register(bundle: Make) -> None:
    """The noise came before the reply, which is waited out as any late one."""
    master, slave = os.openpty()
    loop = asyncio.get_running_loop()
    late, own = framed("11 03 02 AAAA"), framed("11 03 04 BBBB CCCC")
    replies, heard = [PROBE[1], "55 aa", late], list[bytes]()

    def answer() -> None:
        heard.append(os.read(master, 64))
        os.write(master, bytes.fromhex(replies.pop(0)))
        if not replies:
            loop.call_later(0.01, os.write, master, bytes.fromhex(own))

    loop.add_reader(master, answer)
    device = await opened(bundle, os.ttyname(slave), *PATIENT)
    with pytest.raises(DamagedReply):
        await device.read("setting")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.2):
            await device.read("level")  # its reply is as long
    assert len(heard) == 2, "it was not asked"
    async with asyncio.timeout(50):
        assert await device.read("pair") == bytes.fromhex("BBBB CCCC")
    await device.close()
    loop.remove_reader(master)
    os.close(master)
    os.close(slave)


async def test_a_write_whose_reply_was_spoiled_waits_for_its_time_out(bundle: Make, serial_device: Make) -> None:
    """The unit may still be storing what was written."""
    write = framed("11 10 0001 0001 02 0003")
    async with serial_device(PROBE, (write, "55 aa")) as heard:
        device = await opened(bundle, heard.path, *PATIENT)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await device.write("setting", b"\x00\x03")
        await device.close()
