"""From a bus's receive thread to asyncio, with the thread played by the test."""

import asyncio
import threading

import pytest

from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.line import BATCH_FRAMES, CONTROLLER_OVERFLOW, OVERFLOW, OVERRUN, FrameQueue
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawFlag
from triaxcal_drivers.stall_clock import StallTolerantClock

WANTED = {(0x185, False)}


BEGUN_NS = 1_700_000_000_000_000_000


def frame(number: int = 0, identifier: int = 0x185, flags: int = 0, lost: int = 0) -> Frame:
    return Frame(BEGUN_NS + number, identifier, flags, number.to_bytes(2, "little"), lost)


async def opened(capacity: int = 1000) -> FrameQueue:
    frames = FrameQueue(StallTolerantClock(asyncio.get_running_loop()), capacity=capacity)
    frames.open(WANTED)
    return frames


async def test_only_the_streams_identifiers_and_error_frames_are_taken() -> None:
    frames = await opened()
    frames.put(
        [
            frame(1),
            frame(2, 0x186),
            frame(3, flags=RawFlag.EXTENDED_ID),
            frame(4, 0x20, flags=RawFlag.ERROR),
            frame(5, flags=RawFlag.REMOTE),
            frame(6, flags=RawFlag.FD),
        ]
    )
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.source.tolist() == [0x185, 0x20, 0x185, 0x185]
    assert batch.flags.tolist() == [0, RawFlag.ERROR, RawFlag.REMOTE, RawFlag.FD]
    assert batch.payload == bytes.fromhex("0100 0400 0500 0600")
    assert batch.time_ns.tolist() == [BEGUN_NS + n for n in (1, 4, 5, 6)]


async def test_nothing_is_taken_while_no_stream_is_open() -> None:
    frames = FrameQueue(StallTolerantClock(asyncio.get_running_loop()))
    frames.put([frame()])
    opened = frames.open(WANTED)
    frames.put([frame(1)])
    frames.close(opened)
    frames.put([frame(2)])
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.payload == bytes.fromhex("0100")


async def test_closing_a_stream_does_not_touch_the_one_opened_after_it() -> None:
    frames = FrameQueue(StallTolerantClock(asyncio.get_running_loop()))
    earlier = frames.open(WANTED)
    frames.put([frame(1)])
    frames.open(WANTED)
    frames.close(earlier)
    frames.put([frame(2)])
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.payload == bytes.fromhex("0200")


async def test_batches_hold_no_more_than_256_frames() -> None:
    frames = await opened()
    for number in range(600):
        frames.put([frame(number)])
    batches = [await frames.batch(1.0) for _ in range(3)]
    assert [len(b) for b in batches if b is not None] == [BATCH_FRAMES, BATCH_FRAMES, 88]
    assert b"".join(b.payload for b in batches if b) == b"".join(n.to_bytes(2, "little") for n in range(600))
    assert await frames.batch(0.001) is None


async def test_an_overflow_is_counted_and_flagged_on_the_next_frame_kept() -> None:
    frames = await opened(capacity=3)
    for number in range(5):
        frames.put([frame(number)])
    first = await frames.batch(1.0)
    frames.put([frame(5)])
    frames.put([frame(6)])
    second = await frames.batch(1.0)
    assert first is not None
    assert second is not None
    assert frames.dropped == 2
    assert first.flags.tolist() == [0, 0, 0]
    assert first.gap is None
    assert second.gap == Gap(BEGUN_NS + 2, BEGUN_NS + 5, OVERRUN, 2)
    assert second.flags.tolist() == [RawFlag.LOST_BEFORE, 0]
    assert second.payload == bytes.fromhex("0500 0600")


async def test_a_controller_that_overflowed_lost_frames_before_the_next_though_it_does_not_say_how_many() -> None:
    frames = await opened()
    overflow = Frame(BEGUN_NS + 2, 0x20000004, RawFlag.ERROR, bytes.fromhex("0001000000000000"))
    passive = Frame(BEGUN_NS + 4, 0x20000004, RawFlag.ERROR, bytes.fromhex("0010000000000000"))
    frames.put([frame(1), overflow, frame(3, lost=5), passive, frame(5)])
    before, after = await frames.batch(1.0), await frames.batch(1.0)
    assert before is not None
    assert after is not None
    assert (before.flags.tolist(), before.gap) == ([0, RawFlag.ERROR], None)
    assert after.flags.tolist() == [RawFlag.LOST_BEFORE, RawFlag.ERROR, 0]
    assert after.gap == Gap(BEGUN_NS + 2, BEGUN_NS + 3, OVERFLOW, None)
    frames.put([overflow, frame(6)])
    assert (batch := await frames.batch(1.0)) is not None
    assert batch.gap is None
    assert (batch := await frames.batch(1.0)) is not None
    assert batch.gap == Gap(BEGUN_NS + 2, BEGUN_NS + 6, CONTROLLER_OVERFLOW, None)


@pytest.mark.parametrize("turns", range(8))
async def test_a_cancellation_is_heeded_also_while_a_frame_arrives(turns: int) -> None:
    frames = await opened()
    waiting = asyncio.create_task(frames.batch(5.0))
    await asyncio.sleep(0)
    frames.put([frame()])
    for _ in range(turns):  # of the event loop, on the frame's way to whoever waits for it
        await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting


async def test_frames_from_another_thread_all_arrive_in_order() -> None:
    frames = await opened(capacity=100_000)
    sender = threading.Thread(target=lambda: [frames.put([frame(n)]) for n in range(20_000)], daemon=True)
    sender.start()
    payload = b""
    while len(payload) < 40_000:
        batch = await frames.batch(5.0)
        assert batch is not None
        payload += batch.payload
    sender.join()
    assert payload == b"".join(n.to_bytes(2, "little") for n in range(20_000))


async def test_what_the_bus_lost_parts_the_batches_though_the_frame_that_tells_is_another_units() -> None:
    frames = await opened()
    frames.put([frame(1), frame(2, 0x186, lost=3), frame(4, 0x187, lost=4), frame(5), frame(6)])
    before, after = await frames.batch(1.0), await frames.batch(1.0)
    assert before is not None
    assert after is not None
    assert (before.payload, before.gap) == (bytes.fromhex("0100"), None)
    assert after.payload == bytes.fromhex("0500 0600")
    assert after.gap == Gap(BEGUN_NS + 1, BEGUN_NS + 5, OVERFLOW, 7)
    assert after.flags.tolist() == [RawFlag.LOST_BEFORE, 0]


async def test_a_failed_receiver_ends_the_stream_after_the_frames_it_had() -> None:
    frames = await opened()
    frames.put([frame(1)])
    frames.fail(BusError("receiving failed: network is down"))
    batch = await frames.batch(1.0)
    assert batch is not None
    assert len(batch) == 1
    with pytest.raises(BusError, match=r"receiving failed: network is down"):
        await frames.batch(1.0)


@pytest.mark.parametrize("turns", range(6))
async def test_no_cancellation_is_lost_that_comes_with_a_frame(turns: int) -> None:
    """As many turns of the event loop after it, down to the very one in which the waiting ends."""
    frames = await opened()
    frames.put([frame()])
    await frames.batch(1.0)
    task = asyncio.create_task(frames.batch(10.0))
    await asyncio.sleep(0)
    for number in range(BATCH_FRAMES):
        frames.put([frame(number)])
    for _ in range(turns):
        await asyncio.sleep(0)
    if task.cancel():
        with pytest.raises(asyncio.CancelledError):
            await task


async def test_a_frame_that_comes_when_the_event_loop_has_ended_is_nobodys() -> None:
    loop = asyncio.new_event_loop()
    frames = FrameQueue(StallTolerantClock(loop))
    frames.open(WANTED)
    loop.close()
    frames.put([frame()])
