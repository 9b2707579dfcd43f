"""The host's clock is set while a unit is recorded: the kernel's stamps jump with it, and the recording's times do
not."""

from __future__ import annotations

import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.guest.inside.program import Command, events, records
from tests.guest.inside.test_reconnect import decoded, send, station_file
from tests.guest.inside.witness import Sender

HOUR_S = 3600.0
SAMPLES = 300
LATE_S = 1.0
"""A guest on a busy machine sends a frame so late at most after its time was noted; the clock moves by an hour."""


@pytest.fixture
def set_clock() -> Iterator[Callable[[float], None]]:
    """Moves it by so many seconds; back at the end. Never a host's."""
    if os.environ.get("TRIAXCAL_GUEST") != "inside":
        pytest.skip("a clock is set in a guest alone")
    moved_s: list[float] = []

    def move(by_s: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + by_s)
        moved_s.append(by_s)

    yield move
    move(-sum(moved_s))


def test_a_clock_that_is_set_moves_no_sample(vcan: str, tmp_path: Path, set_clock: Callable[[float], None]) -> None:
    path = tmp_path / "rec.mcap"
    command = Command(tmp_path, "record", station_file(tmp_path, vcan), "-o", path)
    command.says("recording")
    sender, sent_s = Sender(vcan), []
    for counter in range(SAMPLES):
        if counter == 100:
            set_clock(HOUR_S)
        if counter == 200:
            set_clock(-2 * HOUR_S)
        sent_s.append(time.clock_gettime(time.CLOCK_BOOTTIME))
        send(sender, [counter])
        time.sleep(0.01)
    time.sleep(1.0)  # what waits is recorded
    command.signal(signal.SIGINT)
    assert command.ends() == 130, command.said.read_text()
    sender.close()

    told = events(path)
    steps_s = [detail["by_s"] for kind, detail in told if kind == "clock_step"]
    assert steps_s == pytest.approx([HOUR_S, -2 * HOUR_S], abs=LATE_S)
    assert not {kind for kind, _ in told} & {"gap", "interrupted"}

    frames = [(t, struct.unpack_from("<H", data, 6)[0]) for t, source, _, data in records(path) if source == 0x185]
    first = frames[0][1]
    assert first < 100, "the stream opens before the clock is set"
    assert [counter for _, counter in frames] == list(range(first, SAMPLES))
    late_s = np.array([t / 1e6 - sent_s[counter] for t, counter in frames])
    assert np.ptp(late_s) < LATE_S

    stream, counters = decoded(path)
    assert len(counters) == SAMPLES - first
    assert stream.counts["missing"] == stream.counts["out_of_order"] == 0
    assert stream.seconds == pytest.approx((SAMPLES - first - 1) / 100, rel=1e-6)
