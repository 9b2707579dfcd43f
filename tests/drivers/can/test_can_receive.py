"""From python-can's receive thread to asyncio, with the thread played by the test."""

import asyncio
import threading

import can
import pytest

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.can.receive import BATCH_FRAMES, FrameQueue, HostClock
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

WANTED = {(0x185, False)}


def frame(number: int = 0, identifier: int = 0x185, **more: object) -> can.Message:
    made = {"arbitration_id": identifier, "is_extended_id": False, "data": number.to_bytes(2, "little")}
    return can.Message(timestamp=1_700_000_000.5, **(made | more))


async def opened(capacity: int = 1000) -> FrameQueue:
    frames = FrameQueue(Attention(asyncio.get_running_loop()), capacity=capacity)
    frames.open(WANTED)
    return frames


async def test_only_the_streams_identifiers_and_error_frames_are_taken() -> None:
    frames = await opened()
    for message in (
        frame(1),
        frame(2, 0x186),
        frame(3, is_extended_id=True),
        frame(4, 0x20, is_error_frame=True),
        frame(5, data=None, dlc=8, is_remote_frame=True),
        frame(6, is_fd=True),
    ):
        frames.on_message_received(message)
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.source.tolist() == [0x185, 0x20, 0x185, 0x185]
    assert batch.flags.tolist() == [0, RawFlag.ERROR, RawFlag.REMOTE, RawFlag.FD]
    assert batch.length.tolist() == [2, 2, 0, 2]
    assert batch.payload == bytes.fromhex("0100 0400 0600")


async def test_nothing_is_taken_while_no_stream_is_open() -> None:
    frames = FrameQueue(Attention(asyncio.get_running_loop()))
    frames.on_message_received(frame())
    opened = frames.open(WANTED)
    frames.on_message_received(frame(1))
    frames.close(opened)
    frames.on_message_received(frame(2))
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.payload == bytes.fromhex("0100")


async def test_closing_a_stream_does_not_touch_the_one_opened_after_it() -> None:
    frames = FrameQueue(Attention(asyncio.get_running_loop()))
    earlier = frames.open(WANTED)
    frames.on_message_received(frame(1))
    frames.open(WANTED)
    frames.close(earlier)
    frames.on_message_received(frame(2))
    batch = await frames.batch(1.0)
    assert batch is not None
    assert batch.payload == bytes.fromhex("0200")


async def test_batches_hold_no_more_than_256_frames() -> None:
    frames = await opened()
    for number in range(600):
        frames.on_message_received(frame(number))
    batches = [await frames.batch(1.0) for _ in range(3)]
    assert [len(b) for b in batches if b is not None] == [BATCH_FRAMES, BATCH_FRAMES, 88]
    assert b"".join(b.payload for b in batches if b) == b"".join(n.to_bytes(2, "little") for n in range(600))
    assert await frames.batch(0.001) is None


async def test_an_overflow_is_counted_and_flagged_on_the_next_frame_kept() -> None:
    frames = await opened(capacity=3)
    for number in range(5):
        frames.on_message_received(frame(number))
    first = await frames.batch(1.0)
    frames.on_message_received(frame(5))
    frames.on_message_received(frame(6))
    second = await frames.batch(1.0)
    assert first is not None
    assert second is not None
    assert frames.dropped == 2
    assert first.flags.tolist() == [0, 0, 0]
    assert second.flags.tolist() == [RawFlag.LOST_BEFORE, 0]
    assert second.payload == bytes.fromhex("0500 0600")


@pytest.mark.parametrize("turns", range(8))
async def test_a_cancellation_is_heeded_also_while_a_frame_arrives(turns: int) -> None:
    frames = await opened()
    waiting = asyncio.create_task(frames.batch(5.0))
    await asyncio.sleep(0)
    frames.on_message_received(frame())
    for _ in range(turns):  # of the event loop, on the frame's way to whoever waits for it
        await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting


async def test_frames_from_another_thread_all_arrive_in_order() -> None:
    frames = await opened(capacity=100_000)
    sender = threading.Thread(target=lambda: [frames.on_message_received(frame(n)) for n in range(20_000)], daemon=True)
    sender.start()
    payload = b""
    while len(payload) < 40_000:
        batch = await frames.batch(5.0)
        assert batch is not None
        payload += batch.payload
    sender.join()
    assert payload == b"".join(n.to_bytes(2, "little") for n in range(20_000))


async def test_a_failed_receiver_ends_its_thread_and_the_stream_after_the_frames_it_had() -> None:
    frames = await opened()
    frames.on_message_received(frame(1))
    with pytest.raises(SystemExit):
        frames.on_error(can.CanOperationError("network is down"))
    batch = await frames.batch(1.0)
    assert batch is not None
    assert len(batch) == 1
    with pytest.raises(BusError, match=r"receiving failed: network is down"):
        await frames.batch(1.0)


def test_epoch_stamps_are_taken_as_they_are() -> None:
    now_ns = 1_700_000_000_000_000_000
    clock = HostClock(lambda: now_ns)
    assert abs(clock.time_ns(1_699_999_999.25) - (now_ns - 750_000_000)) < 500  # as exact as a float


def test_an_adapters_own_clock_is_laid_on_the_hosts() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    first = clock.time_ns(12.5)
    assert first == now_ns[0]
    now_ns[0] += 900_000_000  # the host was late
    assert clock.time_ns(12.75) - first == 250_000_000


def test_an_adapters_clock_that_wraps_is_laid_on_the_hosts_anew() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    clock.time_ns(4294.9)
    now_ns[0] += 100_000_000
    assert clock.time_ns(0.03) == now_ns[0]


def test_without_a_stamp_the_hosts_time_is_taken() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    assert clock.time_ns(0.0) == now_ns[0]
    now_ns[0] += 5_000_000
    assert clock.time_ns(0.0) == now_ns[0]


@pytest.mark.parametrize("turns", range(6))
async def test_no_cancellation_is_lost_that_comes_with_a_frame(turns: int) -> None:
    """As many turns of the event loop after it, down to the very one in which the waiting ends."""
    frames = await opened()
    frames.on_message_received(frame())
    await frames.batch(1.0)
    task = asyncio.create_task(frames.batch(10.0))
    await asyncio.sleep(0)
    for number in range(BATCH_FRAMES):
        frames.on_message_received(frame(number))
    for _ in range(turns):
        await asyncio.sleep(0)
    if task.cancel():
        with pytest.raises(asyncio.CancelledError):
            await task


async def test_a_frame_that_comes_when_the_event_loop_has_ended_is_nobodys() -> None:
    loop = asyncio.new_event_loop()
    frames = FrameQueue(Attention(loop))
    frames.open(WANTED)
    loop.close()
    frames.on_message_received(frame())
