"""What the kernel loses is counted, and told where it belongs."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.guest.inside.witness import Sender, listeners, number, received, wait_until
from triaxcal_drivers.can.socketcan import open_socketcan
from triaxcal_drivers.interface import RawFlag

SMALL = 40_000  # bytes: some fifty frames


def test_what_overflows_is_counted_at_its_place(vcan: str, sender: Sender, opened: Callable[..., Any]) -> None:
    adapter = opened(vcan, receive_buffer=SMALL)
    frames = []
    for burst in range(5):  # of which each is ten times what may wait
        sender.count(0x123, range(burst * 500, (burst + 1) * 500))
        frames += adapter.receive(5.0)
    at_the_end = adapter.missed()
    assert len(frames) + sum(frame.lost for frame in frames) + at_the_end == 2500
    assert frames[0].lost == 0
    before = -1
    for frame in frames:
        assert number(frame) == before + 1 + frame.lost
        assert bool(frame.flags & RawFlag.LOST_BEFORE) is bool(frame.lost)
        before = number(frame)
    assert sum(bool(frame.lost) for frame in frames) == 4
    assert at_the_end == 2499 - before > 0


def test_what_was_lost_at_the_end_is_known_also_when_it_is_closed(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    adapter = opened(vcan, receive_buffer=SMALL)
    assert adapter.missed() == 0
    sender.count(0x123, range(500))
    taken = received(adapter, 1)
    lost = adapter.missed()
    assert len(taken) + lost == 500
    sender.count(0x123, [500])
    (reported,) = received(adapter, 1)
    assert (reported.lost, adapter.missed()) == (lost, 0)
    sender.count(0x123, range(500))
    adapter.close()
    assert adapter.missed() == lost


def test_as_many_frames_may_wait_as_the_buffer_is_said_to_hold(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    adapter = opened(vcan, receive_buffer=200_000)
    count = adapter.buffer_frames
    assert count == 200_000 // 768
    sender.count(0x123, range(count + 20))
    assert 0 <= len(received(adapter, count)) - count <= 1  # the kernel takes the one that exceeds it


def test_a_stopped_process_loses_nothing_and_stamps_are_of_arrival(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    """Stopped while 3,000 frames come, eleven times what the kernel keeps by default."""
    if (room := opened(vcan).buffer_frames) < 3000 and os.environ.get("TRIAXCAL_GUEST") != "inside":
        pytest.skip(f"this system lets an ordinary user keep {room} frames")
    before = listeners(vcan)
    reads, writes = os.pipe()
    child = os.fork()
    if child == 0:
        with open(writes, "w") as told:
            adapter = open_socketcan(vcan, {})
            frames = received(adapter, 3001)
            json.dump([[frame.time_ns, number(frame), frame.lost] for frame in frames], told)
        os._exit(0)
    os.close(writes)
    wait_until(lambda: listeners(vcan) > before)
    os.kill(child, signal.SIGSTOP)
    wait_until(lambda: _state(child) == "T")
    sender.count(0x123, range(3000))
    stopped_until_ns = time.time_ns()
    os.kill(child, signal.SIGCONT)
    sender.count(0x123, [3000])
    with open(reads) as said:
        frames = json.load(said)
    os.waitpid(child, 0)
    assert [count for _, count, _ in frames] == list(range(3001))
    assert {lost for _, _, lost in frames} == {0}
    stamps = [stamp for stamp, _, _ in frames]
    assert stamps == sorted(stamps)
    assert stamps[2999] < stopped_until_ns < stamps[3000]


def _state(process: int) -> str:
    return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0]
