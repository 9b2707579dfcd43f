"""Units of J1939: told by the parameter group and the source address, at any priority and to any destination. What an
identifier says is taken apart here as SAE J1939-21 defines it."""

from __future__ import annotations

import asyncio
import contextlib
import os
from typing import Any

import can
import pytest

from triaxcal_drivers.can.driver import CanDecoder, CanDriver
from triaxcal_drivers.can.layout import Layout, stream_layout
from triaxcal_drivers.can.model import CanBus, DbcStream
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import DeviceSilent, ProfileError
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.profile import Bundle

BROADCAST, ADDRESSED = 61485, 0xEF00  # a group of PDU format 240 and more, and one below
EXTENDED = int(RawFlag.EXTENDED_ID)


def identifier(group: int, *, source: int, priority: int = 2, destination: int = 0xFF) -> int:
    if group >> 8 & 0xFF < 240:
        group = group & 0x3FF00 | destination
    return priority << 26 | group << 8 | source


def dbc(group: int, extended: bool = True) -> bytes:
    number = identifier(group, source=0xE2) | 1 << 31 if extended else 0x123
    signals = "".join(f' SG_ {n} : {8 * i}|8@1+ (1,0) [0|0] "" S\n' for i, n in enumerate(("X", "Y", "Z")))
    return f'VERSION ""\nBU_: S\nBO_ {number} M: 8 S\n{signals}'.encode()


def layout(group: int, *, extended: bool = True) -> Layout:
    keys = {"layout": "dbc", "file": "f.dbc", "j1939": True, "channels": {"ux": "X", "uy": "Y", "uz": "Z"}}
    return stream_layout(DbcStream.model_validate(keys), {"f.dbc": dbc(group, extended)}, where="test")


@pytest.mark.parametrize("group", [BROADCAST, ADDRESSED])
def test_a_message_is_told_by_its_group_whatever_its_priority(group: int) -> None:
    records = [
        (k, identifier(group, source=0xE2, priority=k % 8, destination=16 * k), EXTENDED, bytes([k, 0, 0]))
        for k in range(16)
    ]
    records += [
        (20, identifier(group ^ 0x100, source=0xE2), EXTENDED, b"\x99\0\0"),  # another group
        (21, identifier(group, source=0x17), EXTENDED, b"\x99\0\0"),  # another source
        (22, identifier(group, source=0xE2) & 0x7FF, 0, b"\x99\0\0"),  # no identifier of 29 bits
    ]
    block = CanDecoder(layout(group), rate_hz=100.0).feed(RawBatch.of(records))
    assert block.readings[:, 0].tolist() == list(range(16))


def bundle() -> Bundle:
    text = """format = "triaxcal.profile/1"
name = "j"
driver = "can"
[identity]
vendor = "V"
product = "P"
[output]
unit = "g"
[sampling]
rate_hz = 100
silence_timeout_s = 0.3
[streams.readings]
layout = "dbc"
file = "f.dbc"
j1939 = true
channels = { ux = "X", uy = "Y", uz = "Z" }
"""
    return parse_bundle(text.encode(), {"f.dbc": dbc(BROADCAST)}, where="unit.toml")


def bus(**settings: Any) -> CanBus:
    return CanBus(interface="virtual", channel=f"j1939-{os.getpid()}", **settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "source_address: missing; j needs it, 0 to 253"),
        ({"node_id": 5}, "source_address: missing; j needs it, 0 to 253"),
        ({"source_address": 5}, None),
        ({"source_address": "first"}, None),
    ],
)
def test_a_unit_of_j1939_has_a_source_address(settings: dict[str, Any], words: str | None) -> None:
    if words is None:
        assert CanDriver().device(bundle(), bus(**settings))
        return
    with pytest.raises(ProfileError) as caught:
        CanDriver().device(bundle(), bus(**settings))
    assert words in str(caught.value)


def test_only_a_unit_of_j1939_has_one(edited: Any) -> None:
    with pytest.raises(ProfileError, match="node_id: missing"):
        CanDriver().device(edited(), bus())
    with pytest.raises(ProfileError, match="leave it out"):
        CanDriver().device(edited(), bus(node_id=5, source_address=5))


def test_a_message_of_11_bits_is_none_of_j1939() -> None:
    with pytest.raises(ProfileError, match="'M' has an identifier of 11 bits"):
        layout(BROADCAST, extended=False)


@pytest.mark.parametrize(("address", "kept"), [(0xE2, [2, 4]), (0x17, [1, 3]), ("first", [1, 3])])
async def test_frames_of_other_sources_are_not_recorded(address: Any, kept: list[int]) -> None:
    settings = bus(source_address=address)
    device = CanDriver().device(bundle(), settings)
    frames = [
        (identifier(BROADCAST, source=0x17), 1),
        (identifier(BROADCAST, source=0xE2), 2),
        (identifier(BROADCAST, source=0x17, priority=6), 3),
        (identifier(BROADCAST, source=0xE2, priority=6), 4),
        (identifier(BROADCAST + 1, source=0xE2), 5),
    ]
    with can.Bus(settings.channel, interface="virtual") as sender:
        await device.open()
        try:
            stream = device.stream(["readings"])
            first = await _started(stream, sender, frames)
            assert first == kept
            # The same source counts after the device was opened again, although another speaks first.
            await device.close()
            await device.open()
            assert await _started(device.stream(["readings"]), sender, frames[::-1]) == kept[::-1]
        finally:
            await device.close()


async def _started(stream: Any, sender: can.BusABC, frames: list[tuple[int, int]]) -> list[int]:
    got: list[int] = []
    waiting = asyncio.ensure_future(anext(stream))
    await asyncio.sleep(0)  # the stream is open now
    for number, value in frames:
        sender.send(can.Message(arbitration_id=number, data=[value, 0, 0]))
    with contextlib.suppress(DeviceSilent):  # once all have come
        while True:
            got += (await waiting).payload[::3]
            waiting = asyncio.ensure_future(anext(stream))
    return got
