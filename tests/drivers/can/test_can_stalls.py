"""Time-outs on CAN: frames and answers that wait unread are in time, however late the event loop is."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from typing import Any, cast

import canopen
import pytest
from canopen.sdo.exceptions import SdoCommunicationError

from tests.drivers.virtual_time import run, virtual
from triaxcal_drivers.can.adapter import Frame
from triaxcal_drivers.can.device import PatientSdo
from triaxcal_drivers.can.line import BATCH_S, FrameQueue
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.stall_clock import TICK_S, StallTolerantClock
from triaxcal_drivers.two_senders import Answers

HELD_UP_S = 30.0
ANSWER = bytes.fromhex("43 18 10 01 41 49 52 54")
FRAME = Frame(1_700_000_000_000_000_000, 0x185, 0, b"\1\2")


def opened() -> FrameQueue:
    frames = FrameQueue(StallTolerantClock(asyncio.get_running_loop()))
    frames.open({(0x185, False)})
    return frames


def test_frames_that_wait_unread_are_in_time() -> None:
    async def work() -> bytes:
        loop, frames = virtual(), opened()

        def held_up() -> None:
            loop.now_s += HELD_UP_S
            frames.put([FRAME])

        loop.call_later(0.99, held_up)
        batch = await frames.batch(1.0)
        assert batch is not None
        return batch.payload

    assert run(work()) == b"\1\2"


def test_a_frame_is_seen_before_giving_up_though_nobody_has_told_of_it_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """The receive thread has put it there, and was kept from telling the event loop."""

    async def work() -> bytes:
        frames = opened()
        monkeypatch.setattr(frames, "_tell", lambda event: None)
        frames.put([FRAME])
        batch = await frames.batch(1.0)
        assert batch is not None
        return batch.payload

    assert run(work()) == b"\1\2"


def test_where_no_frame_comes_that_is_told_in_its_time() -> None:
    async def work() -> float:
        frames, begun_s = opened(), virtual().time()
        assert await frames.batch(2.0) is None
        return virtual().time() - begun_s

    assert 2.0 <= run(work()) <= 2.0 + 2 * TICK_S


class Clock:
    """In the place of an event loop's clock: one second per call, or none where the loop is ``held_up``."""

    def __init__(self, held_up: bool) -> None:
        self.held_up = held_up
        self.calls = 0

    def now_s(self) -> float:
        self.calls += 1
        return 0.0 if self.held_up else float(self.calls)


def client(clock: Clock) -> tuple[PatientSdo, list[bytes]]:
    sdo, sent = PatientSdo(5, cast(Any, clock), Answers()), []

    class Network(canopen.Network):
        def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
            sent.append(bytes(data))

    sdo.network = Network()
    sdo.RESPONSE_TIMEOUT = 3.0
    return sdo, sent


@pytest.fixture
def answering() -> Iterator[Any]:
    """Answers once the waiting client has looked at the clock so many times."""
    threads = []

    def start(sdo: PatientSdo, clock: Clock, calls: int) -> None:
        def answer() -> None:
            while clock.calls < calls:
                pass
            sdo.on_response(0x585, ANSWER, 0.0)

        threads.append(threading.Thread(target=answer, daemon=True))
        threads[-1].start()

    yield start
    for thread in threads:
        thread.join()


def test_an_answer_is_waited_for_while_the_event_loop_is_held_up(answering: Any) -> None:
    clock = Clock(held_up=True)
    sdo, _ = client(clock)
    answering(sdo, clock, 8)
    assert sdo.upload(0x1018, 1) == ANSWER[4:]


def test_without_an_answer_the_transfer_is_aborted_in_its_time() -> None:
    clock = Clock(held_up=False)
    sdo, sent = client(clock)
    with pytest.raises(SdoCommunicationError):
        sdo.upload(0x1018, 1)
    assert clock.calls == 4, "begun at 1 s, it has run out at 4 s"
    assert sent[-1].hex(" ") == "80 00 00 00 00 00 04 05"


def test_an_answer_that_is_there_when_the_time_runs_out_is_in_time() -> None:
    clock = Clock(held_up=False)
    sdo, _ = client(clock)
    sdo.RESPONSE_TIMEOUT = 0.0
    sdo.network.send_message = lambda *_: sdo.on_response(0x585, ANSWER, 0.0)
    assert sdo.upload(0x1018, 1) == ANSWER[4:]


def test_of_a_stream_that_flows_a_batch_is_what_came_in_its_time() -> None:
    """From the second on nobody is told of the first frame of each."""

    async def work() -> tuple[list[int], float]:
        frames, loop = opened(), virtual()
        for number in range(100):
            loop.call_later(0.0101 * number, frames.put, [FRAME])
        begun_s, sizes = loop.time(), []
        while sum(sizes) < 100:
            batch = await frames.batch(5.0)
            assert batch is not None
            sizes.append(len(batch))
        return sizes, loop.time() - begun_s

    sizes, took_s = run(work())
    assert sizes[:-1] == pytest.approx([BATCH_S / 0.0101] * (len(sizes) - 1), abs=2)
    assert took_s <= 1.01 + BATCH_S


def test_frames_that_wait_behind_losses_are_given_without_a_pause() -> None:
    """However many losses there are, each of which begins a batch."""

    async def work() -> float:
        frames, begun_s = opened(), virtual().time()
        frames.put([FRAME._replace(lost=1)] * 100)
        for _ in range(100):
            batch = await frames.batch(5.0)
            assert batch is not None
            assert len(batch) == 1
        return virtual().time() - begun_s

    assert run(work()) <= 2 * BATCH_S


def test_a_stream_that_flowed_and_stops_is_silent_in_its_time() -> None:
    async def work() -> float:
        frames = opened()
        frames.put([FRAME])
        assert await frames.batch(2.0) is not None
        begun_s = virtual().time()
        assert await frames.batch(2.0) is None
        frames.fail(BusError("gone"))
        with pytest.raises(BusError, match="gone"):
            await frames.batch(2.0)
        return virtual().time() - begun_s

    assert 2.0 <= run(work()) <= 2.0 + BATCH_S + 2 * TICK_S
