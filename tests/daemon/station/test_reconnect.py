"""Units that are lost and come back, on a clock of the test's own."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from tests.drivers.virtual_time import run, virtual
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceRestarted, DeviceSilent, ProfileError
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag
from triaxcald.provision.identity import WrongUnit
from triaxcald.station.reconnect import (
    LONGEST_PAUSE_S,
    UNHEARD,
    ActiveUnits,
    ReconnectingDevice,
    RetryPolicy,
    until_open,
)

BEGUN_NS = 1_700_000_000_000_000_000
Step = list[tuple[int, int]] | RawBatch | Exception | float


def records(*times: int, flags: int = 0) -> list[tuple[int, int]]:
    return [(t, flags) for t in times]


def of_source(source: int, *times: int, flags: int = 0) -> RawBatch:
    return RawBatch.of([(BEGUN_NS + t, source, flags, b"") for t in times])


@dataclass
class Played:
    """A device whose streams and openings go as they are written: batches,
    those of one source by (time, flags), seconds that pass, or what is
    raised."""

    streams: list[list[Step]]
    openings: list[Exception | None] = field(default_factory=list)
    identities: list[Exception | None] = field(default_factory=list)
    opened_s: list[float] = field(default_factory=list)
    told: list[str | None] = field(default_factory=list)
    asked: list[list[str]] = field(default_factory=list)

    async def open(self) -> None:
        self.opened_s.append(virtual().time() - 1000.0)
        if self.openings and (trouble := self.openings.pop(0)) is not None:
            raise trouble

    async def close(self) -> None: ...

    async def identify(self) -> None:
        if self.identities and (trouble := self.identities.pop(0)) is not None:
            raise trouble

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        self.asked.append(list(names))
        for step in self.streams.pop(0):
            if isinstance(step, Exception):
                raise step
            if isinstance(step, float):
                await asyncio.sleep(step)
                continue
            yield step if isinstance(step, RawBatch) else of_source(0x185, *(t for t, _ in step), flags=step[0][1])

    async def all(self, policy: RetryPolicy, names: Sequence[str] = ("readings",), **more: float) -> list[RawBatch]:
        unit = ReconnectingDevice(
            cast(Any, self), self.identify, policy, self.told.append, lambda: BEGUN_NS - 1, **more
        )
        async with aclosing(unit.stream(names)) as stream:
            found = [batch async for batch in stream]
        assert all({*asked} <= {*names} for asked in self.asked)
        return found


def shown(batches: Sequence[RawBatch]) -> list[tuple[list[int], list[int], Gap | None]]:
    return [((b.time_ns - BEGUN_NS).tolist(), b.flags.tolist(), b.gap) for b in batches]


def gap(begin: int, end: int | None, cause: str) -> Gap:
    return Gap(BEGUN_NS + begin, None if end is None else BEGUN_NS + end, cause)


def test_a_stream_goes_on_after_the_device_is_opened_again_with_the_gap_in_it() -> None:
    device = Played([[records(1, 2), DeviceRestarted("it booted")], [records(50, 51), records(52)]])
    batches = run(device.all(RetryPolicy()))
    assert shown(batches) == [
        ([1, 2], [0, 0], None),
        ([], [], gap(2, None, "it booted")),
        ([50, 51], [RawFlag.LOST_BEFORE, 0], gap(2, 50, "it booted")),
        ([52], [0], None),
    ]
    assert device.opened_s == [0.0], "at once: a unit that restarts is there again soon"
    assert device.told == ["it booted", None]


def test_a_gap_ends_with_the_first_record_that_is_no_error_however_often_the_unit_is_lost_meanwhile() -> None:
    device = Played(
        [
            [records(1), BusError("the link is down")],
            [records(7, flags=RawFlag.ERROR), DeviceSilent("still nothing")],
            [records(8, flags=RawFlag.ERROR), records(9), records(10)],
        ],
        [BusError("no such interface"), None, None],
    )
    batches = run(device.all(RetryPolicy()))
    assert shown(batches) == [
        ([1], [0], None),
        ([], [], gap(1, None, "the link is down")),
        ([7], [RawFlag.ERROR], None),
        ([8], [RawFlag.ERROR], None),
        ([9], [RawFlag.LOST_BEFORE], gap(1, 9, "the link is down")),
        ([10], [0], None),
    ]
    assert device.told == ["the link is down", "no such interface", "still nothing", None]


BOTH = ("readings", "corrected")


def test_where_one_stream_is_silent_the_others_go_on_until_it_is_back() -> None:
    silent = DeviceSilent("readings: illegal data address", stream="readings", source=7, silent_s=5e-9)
    device = Played(
        [
            [of_source(9, 1), silent],
            [of_source(9, 12), 0.5, of_source(9, 13), of_source(9, 14)],
            [of_source(9, 15), of_source(7, 16)],
        ]
    )
    assert shown(run(device.all(RetryPolicy(), BOTH))) == [
        ([1], [0], None),
        ([], [], gap(-6, None, str(silent))),
        ([12], [0], None),
        ([13], [0], None),
        ([15], [0], None),
        ([16], [RawFlag.LOST_BEFORE], gap(-6, 16, str(silent))),
    ]
    assert device.asked == [[*BOTH], ["corrected"], [*BOTH]]
    assert (device.told, device.opened_s) == ([str(silent), None], [])


def test_a_stream_that_stays_silent_is_asked_ever_more_rarely_and_given_up() -> None:
    silent = DeviceSilent("readings: illegal data address", stream="readings", source=7, silent_s=2.0)
    alone = [of_source(9, 2), 0.5, of_source(9, 3), 1.0, of_source(9, 4)]
    device = Played([[of_source(9, 1), silent], alone, [2.0, silent], [*alone], [2.0, silent]])
    with pytest.raises(DeviceSilent, match="illegal data address"):
        run(device.all(RetryPolicy(most_s=6.0), BOTH))
    assert device.asked == [[*BOTH], ["corrected"], [*BOTH], ["corrected"], [*BOTH]]
    assert device.told == [str(silent)]


def test_a_unit_of_which_the_other_streams_fall_silent_too_is_opened_anew() -> None:
    silent = [DeviceSilent(name, stream=name, source=source) for name, source in zip(BOTH, (7, 9), strict=True)]
    device = Played([[of_source(9, 1), silent[0]], [silent[1]], [of_source(9, 5)]])
    assert len(run(device.all(RetryPolicy(), BOTH))) == 3
    assert device.asked == [[*BOTH], ["corrected"], [*BOTH]]
    assert device.opened_s == [0.0]


def test_a_unit_that_was_never_heard_is_lost_from_the_moment_it_was_missed() -> None:
    device = Played([[DeviceSilent("nothing came")], [records(5)]])
    assert [b.gap for b in run(device.all(RetryPolicy()))] == [
        gap(-1, None, "nothing came"),
        gap(-1, 5, "nothing came"),
    ]


def test_attempts_are_ever_rarer_and_go_on_for_ever() -> None:
    device = Played([[DeviceSilent("gone")], []], [DeviceAbsent("nothing answers")] * 12 + [None])
    run(device.all(RetryPolicy()))
    pauses = [b - a for a, b in zip(device.opened_s, device.opened_s[1:], strict=False)]
    assert pauses == pytest.approx([0.5, 1, 2, 4, 8, *[LONGEST_PAUSE_S] * 7])
    assert device.told == ["gone", "nothing answers"], "said once"


def test_another_unit_in_its_place_is_not_taken_for_it() -> None:
    other = WrongUnit("the unit on node 5 is serial 12, expected 11")
    device = Played([[records(1), DeviceSilent("gone")], [records(2)]], identities=[other, other, None])
    assert len(run(device.all(RetryPolicy()))) == 3
    assert device.told == ["gone", str(other), None]
    assert len(device.opened_s) == 3


def test_a_device_whose_records_are_not_those_wanted_is_opened_anew_ever_more_rarely() -> None:
    device = Played([[records(10 * i, 10 * i + 1)] for i in range(12)])

    async def complained() -> list[RawBatch]:
        unit = ReconnectingDevice(cast(Any, device), device.identify, RetryPolicy(), device.told.append)
        seen: list[RawBatch] = []
        async with aclosing(unit.stream(["readings"])) as stream:
            async for batch in stream:
                seen.append(batch)
                if len(batch) and len(device.streams) > 5:
                    unit.complain(DeviceSilent("no whole sample"))
        return seen

    batches = run(complained())
    assert device.opened_s == pytest.approx([0, 0.5, 1.5, 3.5, 7.5, 15.5])
    assert device.told == ["no whole sample", None] * 6
    assert shown(batches)[:4] == [
        ([0, 1], [0, 0], None),
        ([], [], gap(1, None, "no whole sample")),
        ([10, 11], [RawFlag.LOST_BEFORE, 0], gap(1, 10, "no whole sample")),
        ([], [], gap(11, None, "no whole sample")),
    ]


def test_a_unit_that_restarts_again_and_again_is_opened_at_once_each_time_and_never_given_up() -> None:
    """It delivers in between; a policy is for a unit that does not."""
    device = Played([[records(10 * i), 41.0, records(10 * i + 1)] for i in range(6)])

    async def restarting() -> None:
        policy = RetryPolicy(most_s=30.0)
        unit = ReconnectingDevice(cast(Any, device), device.identify, policy, device.told.append, lambda: BEGUN_NS)
        async with aclosing(unit.stream(["readings"])) as stream:
            async for batch in stream:
                if len(batch) and int(batch.time_ns[0]) % 10 == 1 and device.streams:
                    unit.complain(DeviceRestarted("it has started anew"))

    run(restarting())
    assert device.opened_s == pytest.approx([41.0 * (i + 1) for i in range(5)])


def test_a_restart_is_heeded_though_one_stream_is_awaited() -> None:
    silent = DeviceSilent("readings: nothing", stream="readings", source=7, silent_s=2.0)
    device = Played([[silent], [of_source(8, 1), of_source(8, 2), of_source(8, 3)], [of_source(7, 9)]])

    async def restarting() -> None:
        unit = ReconnectingDevice(
            cast(Any, device), device.identify, RetryPolicy(), device.told.append, lambda: BEGUN_NS
        )
        async with aclosing(unit.stream(["readings", "corrected"])) as stream:
            async for batch in stream:
                if len(batch) and int(batch.time_ns[0]) == BEGUN_NS + 2:
                    unit.complain(DeviceRestarted("it has started anew"))

    run(restarting())
    assert len(device.opened_s) == 1
    assert device.asked == [["readings", "corrected"], ["corrected"], ["readings", "corrected"]]


@pytest.mark.parametrize(("most_s", "attempts"), [(0.0, 1), (0.4, 2), (0.5, 2), (10.0, 6)])
def test_who_gives_up_says_the_last_trouble(most_s: float, attempts: int) -> None:
    device = Played([[records(1), DeviceSilent("gone")]], [BusError(f"attempt {i}") for i in range(20)])
    with pytest.raises(BusError, match=rf"^attempt {attempts - 1}$"):
        run(device.all(RetryPolicy(most_s=most_s)))
    assert device.opened_s[-1] == pytest.approx(most_s)


def test_a_unit_that_opens_and_sends_nothing_is_lost_all_the_same() -> None:
    """It answers, and its stream is silent: said once, asked ever more rarely, and given up in its time."""
    device = Played([[records(1), DeviceSilent("it sends nothing")], *([[DeviceSilent("it sends nothing")]] * 20)])
    with pytest.raises(DeviceSilent):
        run(device.all(RetryPolicy(most_s=20.0)))
    assert device.told == ["it sends nothing"]
    assert device.opened_s == pytest.approx([0, 0.5, 1.5, 3.5, 7.5, 15.5, 20.0])


def test_a_unit_that_sends_nothing_is_given_up_when_the_others_are_done() -> None:
    async def work() -> None:
        others = ActiveUnits(2)
        device = Played([[DeviceSilent("it sends nothing")]] * 50)
        waiting = asyncio.ensure_future(device.all(RetryPolicy(others=others)))
        await asyncio.sleep(100)
        assert not waiting.done()
        others.leave()
        with pytest.raises(DeviceSilent):
            await waiting

    run(work())


def test_a_hole_that_nobody_was_told_of_is_a_gap_too() -> None:
    hour = 3600 * 10**9
    device = Played(
        [[records(1, 2, 2 + hour, 3 + hour), records(3 + 2 * hour, flags=RawFlag.ERROR), records(4 + 2 * hour)]]
    )
    assert shown(run(device.all(RetryPolicy()))) == [
        ([1, 2], [0, 0], None),
        ([2 + hour, 3 + hour], [RawFlag.LOST_BEFORE, 0], gap(2, 2 + hour, UNHEARD)),
        ([3 + 2 * hour], [RawFlag.ERROR], None),
        ([4 + 2 * hour], [RawFlag.LOST_BEFORE], gap(3 + hour, 4 + 2 * hour, UNHEARD)),
    ]


@pytest.mark.parametrize(("hole_s", "gaps"), [(10.0, 1), (30.0, 0)])
def test_a_unit_of_which_a_sample_is_rare_has_no_hole_before_it_counts_as_silent(hole_s: float, gaps: int) -> None:
    device = Played([[records(1), records(12 * 10**9)]])
    batches = run(device.all(RetryPolicy(), hole_s=hole_s))
    assert sum(batch.gap is not None for batch in batches) == gaps


def test_a_count_of_the_kernels_that_comes_with_the_return_is_kept() -> None:
    class Counting(Played):
        async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
            async for batch in super().stream(names):
                yield batch.after(Gap(0, 1, "overflow", 7)) if batch.time_ns[0] == BEGUN_NS + 9 else batch

    device = Counting([[records(1), DeviceSilent("gone")], [records(9)]])
    assert run(device.all(RetryPolicy()))[-1].gap == Gap(BEGUN_NS + 1, BEGUN_NS + 9, "gone", 7)


def test_a_fault_of_the_profile_is_not_waited_for() -> None:
    device = Played([[ProfileError("no stream 'reading'")]])
    with pytest.raises(ProfileError):
        run(device.all(RetryPolicy()))
    assert device.opened_s == []


def lost(policy: RetryPolicy, attempts: list[float]) -> Any:
    async def attempt() -> None:
        attempts.append(virtual().time() - 1000.0)
        raise DeviceAbsent("nothing answers")

    return until_open(attempt, policy, lambda _: None)


def test_a_lost_unit_is_given_up_when_the_others_are_done() -> None:
    async def work() -> list[float]:
        attempts: list[float] = []
        others = ActiveUnits(2)
        waiting = asyncio.ensure_future(lost(RetryPolicy(others=others), attempts))
        await asyncio.sleep(100)
        assert not waiting.done()
        others.leave()
        with pytest.raises(DeviceAbsent):
            await waiting
        assert virtual().time() - 1000.0 == 100.0, "at once"
        return attempts

    assert len(run(work())) > 10


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        (lambda: RetryPolicy(most_s=0.0), []),
        (lambda: RetryPolicy(most_s=3.0), ["nothing answers"]),
        (lambda: RetryPolicy(others=ActiveUnits(1)), []),
        (lambda: RetryPolicy(least_s=3.0, others=ActiveUnits(1)), ["nothing answers"]),
    ],
    ids=["at once", "later", "alone", "alone, later"],
)
def test_only_what_is_waited_for_is_told(policy: Callable[[], RetryPolicy], told: list[str]) -> None:
    async def work() -> list[str]:
        said: list[str] = []

        async def attempt() -> None:
            raise DeviceAbsent("nothing answers")

        with pytest.raises(DeviceAbsent):
            await until_open(attempt, policy(), lambda trouble: said.append(str(trouble)))
        return said

    assert run(work()) == told


def test_units_that_are_all_lost_are_all_given_up() -> None:
    async def work() -> None:
        others = ActiveUnits(2)
        both = [lost(RetryPolicy(others=others), []) for _ in range(2)]
        outcomes = await asyncio.gather(*both, return_exceptions=True)
        assert [type(o) for o in outcomes] == [DeviceAbsent, DeviceAbsent]
        assert virtual().time() == 1000.0

    run(work())


def test_a_unit_alone_is_waited_for_as_long_as_the_plan_says() -> None:
    async def work() -> list[float]:
        attempts: list[float] = []
        with pytest.raises(DeviceAbsent):
            await lost(RetryPolicy(least_s=10.0, others=ActiveUnits(1)), attempts)
        return attempts

    assert run(work()) == pytest.approx([0, 0.5, 1.5, 3.5, 7.5, 10.0])


def test_a_unit_that_is_back_counts_as_at_work_again() -> None:
    async def work() -> None:
        others = ActiveUnits(2)
        troubles: list[Exception] = [DeviceAbsent("once")]

        async def attempt() -> None:
            if troubles:
                raise troubles.pop()

        await until_open(attempt, RetryPolicy(others=others), lambda _: None)
        waiting = asyncio.ensure_future(lost(RetryPolicy(others=others), []))
        await asyncio.sleep(1000)
        assert not waiting.done()
        waiting.cancel()

    run(work())
