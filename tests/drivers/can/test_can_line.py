"""One open bus for all units of this process on it, with the adapter played by the test."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest

from tests.drivers.can.played import Played
from triaxcal_drivers.can import line as can_line
from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.device import CanDevice
from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.line import MUTE_S, OVERFLOW, join, leave, opened
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import BusError, DeviceRestarted
from triaxcal_drivers.host_clock import SteadyClock
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import Bundle

BEGUN_NS = 1_700_000_000_000_000_000


@pytest.fixture
def unit(edited: Callable[..., Bundle]) -> Callable[[int], CanDevice]:
    """A unit that streams and has no registers, at a node."""
    bundle = edited(("silence_timeout_s = 2.0", "silence_timeout_s = 5.0"))
    text = bundle.text.decode()
    lonely = text[: text.index("[registers]")]
    lonely = "\n".join(li for li in lonely.splitlines() if not li.startswith(("serial_register", "expect")))
    made = parse_bundle(lonely.encode(), bundle.files, where="unit.toml")
    return lambda node: CanDriver().device(made, settings(node))


def settings(node: int = 5, bitrate: int | None = None) -> CanBus:
    return CanBus(interface="socketcan", channel="can0", node_id=node, bitrate=bitrate)


def frame(node: int, number: int = 0, lost: int = 0) -> Frame:
    return Frame(BEGUN_NS + number, 0x180 + node, 0, bytes([number]), lost)


async def streaming(device: CanDevice) -> asyncio.Future[RawBatch]:
    await device.open()
    coming = asyncio.ensure_future(anext(device.stream(["readings"])))
    await asyncio.sleep(0)
    return coming


async def test_eight_units_share_one_adapter_and_each_has_its_own_frames(opened: list[Played], unit) -> None:
    units = {node: unit(node) for node in range(1, 9)}
    coming = {node: await streaming(device) for node, device in units.items()}
    assert len(opened) == 1
    assert opened[0].wanted == {(offset + node, False) for node in units for offset in (0x180, 0x280)}
    opened[0].waiting.put([frame(node, node) for node in units])
    for node, batch in coming.items():
        assert (await batch).payload == bytes([node])
    for device in units.values():
        assert not opened[0].closed
        await device.close()
    assert opened[0].closed


async def test_a_loss_on_the_bus_is_told_to_every_unit_on_it(opened: list[Played], unit) -> None:
    units = [unit(node) for node in (1, 2)]
    coming = [await streaming(device) for device in units]
    opened[0].waiting.put([frame(1, 1, lost=9), frame(2, 2)])
    gaps = [(await batch).gap for batch in coming]
    assert [(gap.cause, gap.lost) for gap in gaps if gap] == [(OVERFLOW, 9)] * 2
    for device in units:
        await device.close()


async def test_a_bus_that_fails_ends_every_stream_and_is_opened_anew_once(opened: list[Played], unit) -> None:
    units = [unit(node) for node in (1, 2)]
    coming = [await streaming(device) for device in units]
    opened[0].waiting.put(BusError("can0: the network is down"))
    for batch in coming:
        with pytest.raises(BusError, match=r"^can0: the network is down; 7 frames before it were lost$"):
            await batch
    while not opened[0].closed:  # by the receive thread, which has just told of its failure
        await asyncio.sleep(0)
    coming = [await streaming(device) for device in units]
    assert len(opened) == 2
    opened[1].waiting.put([frame(1), frame(2)])
    for batch in coming:
        assert len(await batch) == 1
    for device in units:
        await device.close()


async def test_a_unit_that_is_opened_again_leaves_the_bus_to_the_others(opened: list[Played], unit) -> None:
    steady, other = unit(1), unit(2)
    coming = await streaming(steady)
    for _ in range(3):
        await other.open()
        await other.close()
    opened[0].waiting.put([frame(1)])
    assert len(await coming) == 1
    assert len(opened) == 1
    await steady.close()


async def test_a_bus_on_which_nobody_is_heard_is_opened_anew_with_the_next_unit(
    opened: list[Played], unit, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = unit(1)
    coming = await streaming(first)
    line = await join(settings(1))
    monkeypatch.setattr(line, "_heard_s", line.clock.now_s() - MUTE_S)
    await leave(line)
    await (second := unit(2)).open()
    assert [adapter.closed for adapter in opened] == [True, False]
    opened[1].waiting.put([frame(1)])
    assert len(await coming) == 1, "the stream of the other unit goes on"
    await first.close()
    await second.close()


async def test_a_step_of_the_hosts_clock_does_not_move_the_frames(
    opened: list[Played], unit, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = {"running": 0, "step": 0}
    clock = SteadyClock(lambda: BEGUN_NS + host["running"] + host["step"], lambda: host["running"])
    monkeypatch.setattr(can_line, "HOST", clock)
    device = unit(1)
    await device.open()
    times = []
    stream = device.stream(["readings"])
    for second, step in enumerate([0, 0, 3600, 3600, -7200]):
        host.update(running=second * 10**9, step=step * 10**9)
        coming = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(0)
        opened[0].waiting.put([Frame(clock._now_ns(), 0x181, 0, b"")])
        times += (await coming).time_ns.tolist()
    assert times == [BEGUN_NS + second * 10**9 for second in range(5)]
    await device.close()


async def test_units_that_drive_one_bus_differently_are_refused(opened: list[Played], unit) -> None:
    first = await join(settings(1, bitrate=250_000))
    with pytest.raises(
        BusError, match=r"^socketcan can0: another unit has it with bitrate 250000; this one asks for bitrate 500000$"
    ):
        await join(settings(2, bitrate=500_000))
    await leave(first)


async def test_a_boot_up_message_ends_the_stream_at_once(opened: list[Played], bundle: Bundle) -> None:
    device = CanDriver().device(bundle, settings())

    async def answer() -> None:
        answers = ["43 18 10 01 41 49 52 54", "43 18 10 02 01 7a 00 00", "43 18 10 04 4d 00 00 00"]
        for number, hexed in enumerate(answers):
            while not opened or sum(identifier == 0x605 for identifier, _ in opened[0].sent) <= number:
                await asyncio.sleep(0)
            opened[0].waiting.put([Frame(BEGUN_NS, 0x585, 0, bytes.fromhex(hexed))])

    await asyncio.gather(device.open(), answer())
    assert (0x705, False) in opened[0].wanted
    before = [Frame(BEGUN_NS, 0x705, 0, b"\x00"), Frame(BEGUN_NS, 0x585, 0, bytes.fromhex("4b 00 20 00 05 00 00 00"))]
    read = asyncio.ensure_future(device.read("status"))
    while opened[0].sent[-1][1] != "40 00 20 00 00 00 00 00":
        await asyncio.sleep(0)
    opened[0].waiting.put(before)
    assert await read == b"\5\0"  # so that the boot-up message before it has been seen, while no stream was open
    stream = device.stream(["readings"])
    coming = asyncio.ensure_future(anext(stream))
    await asyncio.sleep(0)
    opened[0].waiting.put([Frame(BEGUN_NS, 0x705, 0, b"\x05"), frame(5)])
    assert len(await coming) == 1
    opened[0].waiting.put([frame(5, 1), Frame(BEGUN_NS, 0x705, 0, b"\x00")])
    assert len(await anext(stream)) == 1, "what came before it is still given"
    with pytest.raises(DeviceRestarted, match=r"^a unit at node 5 on socketcan can0 has started"):
        await anext(stream)
    await device.close()


async def test_a_bus_that_was_given_up_while_it_opened_is_closed() -> None:
    asked, answered, closed = threading.Event(), threading.Event(), threading.Event()

    def slow() -> str:
        asked.set()
        answered.wait(10)
        return "a bus"

    def close(bus: str) -> None:
        assert bus == "a bus"
        closed.set()

    opening = asyncio.create_task(opened(slow, close))
    await asyncio.to_thread(asked.wait, 10)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    answered.set()
    assert await asyncio.to_thread(closed.wait, 10)


async def test_a_bus_that_is_waited_for_stays_open() -> None:
    closed = threading.Event()
    assert await opened(lambda: "a bus", lambda _: closed.set()) == "a bus"
    assert not closed.is_set()
