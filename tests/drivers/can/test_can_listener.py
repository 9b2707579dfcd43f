"""All frames of a bus, shared with units of this process, with the adapter played by the test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing

import pytest

from tests.drivers.can.played import Played
from triaxcal_drivers.can import line as can_line
from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.device import CanDevice
from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.line import MUTE_S, OVERFLOW, REOPENED, BusListener, CanLine, join, leave
from triaxcal_drivers.can.model import BusSettings, CanBus
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag
from triaxcal_drivers.profile import Bundle

BEGUN_NS = 1_700_000_000_000_000_000
BUS = {"interface": "socketcan", "channel": "can0"}
LISTENED = BusSettings(**BUS)  # type: ignore[arg-type]
EXTENDED, REMOTE, ERROR, FD = RawFlag.EXTENDED_ID, RawFlag.REMOTE, RawFlag.ERROR, RawFlag.FD


def node(number: int) -> CanBus:
    return CanBus(**BUS, node_id=number)  # type: ignore[arg-type]


def frame(number: int, identifier: int = 0x185, flags: int = 0, lost: int = 0) -> Frame:
    return Frame(BEGUN_NS + number, identifier, flags, bytes([number]), lost)


@pytest.fixture
def unit(edited: Callable[..., Bundle]) -> CanDevice:
    """At node 5; it streams and has no registers."""
    bundle = edited(("silence_timeout_s = 2.0", "silence_timeout_s = 5.0"))
    text = bundle.text.decode()
    lonely = text[: text.index("[registers]")]
    lonely = "\n".join(li for li in lonely.splitlines() if not li.startswith(("serial_register", "expect")))
    return CanDriver().device(parse_bundle(lonely.encode(), bundle.files, where="unit.toml"), node(5))


async def heard(stream: AsyncGenerator[RawBatch, None], count: int) -> list[RawBatch]:
    """Batches with so many frames in all; those without any are left out."""
    batches: list[RawBatch] = []
    while sum(map(len, batches)) < count:
        batch = await anext(stream)
        batches += [batch] if len(batch) or batch.gap else []
    return batches


def numbers(batches: Sequence[RawBatch]) -> list[int]:
    return list(b"".join(batch.payload for batch in batches))


async def test_a_listener_has_every_frame_and_a_unit_on_the_same_adapter_its_own(
    opened: list[Played], unit: CanDevice
) -> None:
    listener = BusListener(LISTENED)
    await unit.open()
    of_unit = unit.stream(["readings"])
    coming = asyncio.ensure_future(anext(of_unit))
    await asyncio.sleep(0)
    assert opened[0].wanted == {(0x185, False), (0x285, False)}
    await listener.open()
    assert (len(opened), opened[0].wanted) == (1, None)
    frames = [
        frame(1),
        frame(2, 0x186),
        frame(3, 0x185, EXTENDED),
        frame(4, 0x20, ERROR),
        frame(5, 0x123, REMOTE),
        frame(6, 0x7FF, FD),
    ]
    opened[0].waiting.put(frames)
    async with aclosing(listener.stream()) as stream:
        (batch,) = await heard(stream, len(frames))
    assert [tuple(row) for row in zip(batch.time_ns, batch.source, batch.flags, strict=True)] == [
        (f.time_ns, f.source, f.flags) for f in frames
    ]
    assert numbers([await coming]) == [1, 4]
    await listener.close()
    assert opened[0].wanted == {(0x185, False), (0x285, False)}
    await of_unit.aclose()
    await unit.close()
    assert opened[0].closed


async def test_what_came_between_opening_and_the_stream_is_there(opened: list[Played]) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].waiting.put([frame(1)])
    await listener.settled(5.0)
    opened[0].waiting.put([frame(2)])
    async with aclosing(listener.stream()) as stream:
        assert numbers(await heard(stream, 2)) == [1, 2]
    await listener.close()


async def test_a_quiet_bus_is_no_fault_of_it(opened: list[Played]) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    await listener.settled(0.05)
    async with aclosing(listener.stream()) as stream:
        assert [len(await anext(stream)) for _ in range(2)] == [0, 0]
    assert not opened[0].closed
    await listener.close()


@pytest.mark.parametrize("echoes", [False, True])
async def test_what_this_program_sends_is_heard_once_and_flagged(opened: list[Played], echoes: bool) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].echoes = echoes
    line = await join(LISTENED)
    line.send(0x605, b"\x07")
    if echoes:
        opened[0].waiting.put([Frame(BEGUN_NS, 0x605, RawFlag.SENT, b"\x07")])
    opened[0].waiting.put([frame(8)])
    async with aclosing(listener.stream()) as stream:
        batches = await heard(stream, 2)
    assert numbers(batches) == [7, 8]
    assert [flags for b in batches for flags in b.flags.tolist()] == [RawFlag.SENT, 0]
    assert [source for b in batches for source in b.source.tolist()] == [0x605, 0x185]
    await leave(line)
    await listener.close()


async def test_a_loss_on_the_bus_is_told_with_its_place(opened: list[Played]) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].waiting.put([frame(1), frame(2, lost=9)])
    async with aclosing(listener.stream()) as stream:
        first, second = await heard(stream, 2)
    assert first.gap is None
    assert second.flags.tolist() == [RawFlag.LOST_BEFORE]
    assert second.gap == Gap(BEGUN_NS + 1, BEGUN_NS + 2, OVERFLOW, 9)
    await listener.close()


async def test_a_bus_that_fails_ends_the_stream_behind_what_came_before(opened: list[Played]) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].waiting.put([frame(1)])
    opened[0].waiting.put(BusError("can0: the network is down"))
    async with aclosing(listener.stream()) as stream:
        assert numbers(await heard(stream, 1)) == [1]
        with pytest.raises(BusError, match=r"^can0: the network is down; 7 frames before it were lost$"):
            await heard(stream, 1)
    await listener.open()
    opened[1].waiting.put([frame(2)])
    async with aclosing(listener.stream()) as stream:
        assert numbers(await heard(stream, 1)) == [2]
    await listener.close()


async def test_a_bus_that_fails_is_not_gone_on_with_when_somebody_else_has_opened_it_again(
    opened: list[Played],
) -> None:
    """Or the loss would be silent: frames of the new opening end where those of the old one did."""
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].waiting.put([frame(1)])
    opened[0].waiting.put(BusError("can0: the network is down"))
    while not opened[0].closed:
        await asyncio.sleep(0.01)
    line = await join(LISTENED)
    opened[1].waiting.put([frame(2)])
    while not opened[1].waiting.empty():
        await asyncio.sleep(0.01)
    async with aclosing(listener.stream()) as stream:
        assert numbers(await heard(stream, 1)) == [1]
        with pytest.raises(BusError, match="the network is down"):
            await heard(stream, 1)
    await leave(line)
    await listener.close()


def is_mute(line: CanLine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line, "_heard_s", line.clock.now_s() - MUTE_S)


async def test_a_bus_that_a_unit_has_opened_anew_has_a_gap(
    opened: list[Played], monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    opened[0].waiting.put([frame(1)])
    async with aclosing(listener.stream()) as stream:
        assert numbers(await heard(stream, 1)) == [1]
        line = await join(LISTENED)
        is_mute(line, monkeypatch)
        await leave(await join(node(5)))
        assert len(opened) == 2
        assert opened[1].wanted is None
        opened[1].waiting.put([frame(2)])
        (batch,) = await heard(stream, 1)
        assert batch.gap == Gap(BEGUN_NS + 1, BEGUN_NS + 2, REOPENED)
        assert batch.flags.tolist() == [RawFlag.LOST_BEFORE]
        opened[1].waiting.put([frame(3)])
        (batch,) = await heard(stream, 1)
        assert (batch.gap, batch.flags.tolist()) == (None, [0])
    await leave(line)
    await listener.close()


async def test_a_bus_that_cannot_be_opened_anew_is_told_to_the_listener_too(
    opened: list[Played], monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = BusListener(LISTENED)
    await listener.open()
    line = await join(LISTENED)
    is_mute(line, monkeypatch)

    def refuse(_: BusSettings) -> Played:
        raise BusError("cannot open socketcan can0: unplugged")

    monkeypatch.setattr(can_line, "open_bus", refuse)
    with pytest.raises(BusError, match="unplugged"):
        await join(node(5))
    async with aclosing(listener.stream()) as stream:
        with pytest.raises(BusError, match="unplugged"):
            await anext(stream)
    await leave(line)
    await listener.close()


@pytest.mark.parametrize(
    ("interface", "asked"),
    [
        ("socketcan", {"listen_only": True}),
        ("slcan", {"listen_only": True}),
        ("kvaser", {"driver_mode": False}),
        ("pcan", {"state": "PASSIVE"}),
        ("virtual", {}),
    ],
)
def test_an_adapter_is_asked_to_listen_only_in_the_words_of_its_interface(
    interface: str, asked: dict[str, object]
) -> None:
    assert BusSettings(interface=interface, channel="x").listening().options == asked


def test_what_the_options_say_of_listening_only_stands() -> None:
    settings = BusSettings(interface="socketcan", channel="can0", options={"listen_only": False, "fd": True})
    assert settings.listening().options == {"listen_only": False, "fd": True}
