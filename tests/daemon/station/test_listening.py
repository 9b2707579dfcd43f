"""A bus that is lost and comes back, on a clock of the test's own."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pytest

from tests.drivers.virtual_time import run, virtual
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag
from triaxcald.recording.bus import describe_bus, phase_of
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.listening import IDENTIFIERS_MOST, SLEPT, Listened, ReconnectingBus
from triaxcald.station.reconnect import FIRST_PAUSE_S, RetryPolicy

BEGUN_NS = 1_700_000_000_000_000_000
LOOK_S = 0.2
LOST = RawFlag.LOST_BEFORE
Step = Sequence[int] | Exception | float
"""Times of records in s; none where the bus is quiet; what is raised; for how
long nothing at all happens."""


def now_ns() -> int:
    return BEGUN_NS + round((virtual().time() - 1000.0) * 1e9)


@dataclass
class Played:
    """A bus that goes as it is written, once for each opening. ``settling`` is
    how each opening after the first goes on: what is raised, or nothing."""

    streams: list[list[Step]]
    settling: list[Exception | None] = field(default_factory=list)
    opened_s: list[float] = field(default_factory=list)
    told: list[str | None] = field(default_factory=list)
    asleep_ns: int = 0

    async def open(self) -> None:
        self.opened_s.append(virtual().time() - 1000.0)

    async def close(self) -> None: ...

    async def settled(self, timeout_s: float) -> None:
        if self.settling and (trouble := self.settling.pop(0)) is not None:
            raise trouble

    async def stream(self) -> AsyncGenerator[RawBatch, None]:
        for step in self.streams.pop(0):
            if isinstance(step, Exception):
                raise step
            if isinstance(step, float):
                await asyncio.sleep(step)
                continue
            if not step:
                await asyncio.sleep(LOOK_S)
            yield RawBatch.of([(BEGUN_NS + t * 10**9, 0x185, 0, b"") for t in step])

    def reconnecting(self, policy: RetryPolicy) -> ReconnectingBus:
        return ReconnectingBus(
            cast(Any, self), policy, self.told.append, now_ns=now_ns, slept_ns=lambda: self.asleep_ns
        )

    async def all(self, policy: RetryPolicy | None = None) -> list[RawBatch]:
        async with aclosing(self.reconnecting(policy or RetryPolicy()).stream()) as stream:
            return [batch async for batch in stream if len(batch) or batch.gap]


def shown(batches: Sequence[RawBatch]) -> list[tuple[list[int], list[int], Gap | None]]:
    return [(((b.time_ns - BEGUN_NS) // 10**9).tolist(), b.flags.tolist(), b.gap) for b in batches]


def gap(begin_s: float, end_s: float | None, cause: str) -> Gap:
    return Gap(BEGUN_NS + round(begin_s * 1e9), None if end_s is None else BEGUN_NS + round(end_s * 1e9), cause)


def test_frames_go_on_after_the_bus_is_open_again_with_the_gap_in_it() -> None:
    bus = Played([[3.0, [1, 2], BusError("the link is down")], [[5], [6]]])
    assert shown(run(bus.all())) == [
        ([1, 2], [0, 0], None),
        ([], [], gap(2, None, "the link is down")),
        ([], [], gap(2, 3, "the link is down")),
        ([5], [LOST], None),
        ([6], [0], None),
    ]
    assert bus.told == ["the link is down", None]


def test_on_a_quiet_bus_a_gap_is_as_long_as_nobody_listened() -> None:
    quiet: list[Step] = [[]] * 100
    bus = Played([[*quiet, BusError("unplugged")], [*quiet, [60]]])
    assert shown(run(bus.all())) == [
        ([], [], gap(20, None, "unplugged")),
        ([], [], gap(20, 20, "unplugged")),
        ([60], [LOST], None),
    ]


def test_silence_however_long_is_no_gap() -> None:
    quiet: list[Step] = [[]] * 500
    bus = Played([[[1], *quiet, [100]]])
    assert shown(run(bus.all())) == [([1], [0], None), ([100], [0], None)]


def test_a_bus_that_opens_and_fails_at_once_is_tried_ever_more_rarely_in_one_gap() -> None:
    trouble = BusError("bus-off")
    bus = Played([[[0], trouble], [[9]]], [trouble, trouble, None])
    batches = run(bus.all())
    assert bus.opened_s == [0.0, FIRST_PAUSE_S, 3 * FIRST_PAUSE_S]
    assert shown(batches)[1:] == [
        ([], [], gap(0, None, "bus-off")),
        ([], [], gap(0, 3 * FIRST_PAUSE_S, "bus-off")),
        ([9], [LOST], None),
    ]


def test_a_bus_that_does_not_come_back_is_given_up() -> None:
    trouble = BusError("unplugged")
    bus = Played([[[0], trouble]], [trouble] * 9)
    with pytest.raises(BusError, match="unplugged"):
        run(bus.all(RetryPolicy(most_s=3.0)))
    assert bus.opened_s[-1] <= 3.0


def test_a_machine_that_slept_heard_nothing_meanwhile() -> None:
    bus = Played([[[1], [], [], [4]]])

    async def slept() -> list[RawBatch]:
        batches = []
        async with aclosing(bus.reconnecting(RetryPolicy()).stream()) as stream:
            async for batch in stream:
                batches += [batch] if len(batch) or batch.gap else []
                if len(batches) == 1 and bus.asleep_ns == 0:
                    bus.asleep_ns = 7 * 10**9
        return batches

    assert shown(run(slept())) == [
        ([1], [0], None),
        ([], [], gap(1, 8, SLEPT)),
        ([4], [LOST], None),
    ]


def test_a_recording_counts_frames_identifiers_errors_and_gaps(tmp_path: Path) -> None:
    records = [
        (BEGUN_NS, 0x100, 0, b"\1"),
        (BEGUN_NS + 1, 0x100, RawFlag.EXTENDED_ID, b"\2"),
        (BEGUN_NS + 2, 0x100, RawFlag.SENT, b"\3"),
        (BEGUN_NS + 3, 0x40, RawFlag.ERROR, bytes(8)),
    ]

    class Bus:
        async def stream(self) -> AsyncGenerator[RawBatch, None]:
            yield RawBatch.of([]).after(gap(1, None, "down"))
            yield RawBatch.of([]).after(gap(1, 3, "down"))
            yield RawBatch.of(records)

    listened, path = Listened(phase_of("can0")), tmp_path / "bus.mcap"
    with RecordingWriter(path, metadata={"bus": {}}, preview_channels=None) as writer:
        run(listened.for_seconds(cast(Any, Bus()), writer, None))
    assert listened.counts == {"frames": 3, "identifiers": 2, "errors": 1}
    assert (listened.gaps, listened.gaps_s) == (1, 2.0)
    assert listened.last_ns == BEGUN_NS + 3
    with Recording.open(path) as recording:
        found = describe_bus(recording)["channels"]["can0"]
        assert [e.kind for e in recording.events()][-2:] == ["interrupted", "gap"]
    assert (found["frames"], found["identifiers"], found["errors"], found["sent"]) == (3, 2, 1, 1)


def test_random_identifiers_take_no_memory_without_end() -> None:
    listened = Listened(phase_of(None))
    for start in range(0, 2 * IDENTIFIERS_MOST, 8192):
        listened._count(RawBatch.of([(0, start + i, RawFlag.EXTENDED_ID, b"") for i in range(8192)]))
    assert listened.counts["identifiers"] == IDENTIFIERS_MOST
    assert listened.frames == 2 * IDENTIFIERS_MOST


@pytest.mark.parametrize("lost", [False, True])
def test_so_many_seconds_are_the_clock_s_whatever_comes(tmp_path: Path, lost: bool) -> None:
    quiet: list[Step] = [[]] * 1000
    trouble = BusError("down")
    bus = Played([[[0], trouble] if lost else [[0], *quiet]], [trouble] * 99)
    listened = Listened(phase_of("can0"))
    with RecordingWriter(tmp_path / "bus.mcap", metadata={"bus": {}}, preview_channels=None) as writer:
        run(listened.for_seconds(bus.reconnecting(RetryPolicy()), writer, 20.0))
    assert listened.seconds == pytest.approx(20.0)
    assert listened.frames == 1
