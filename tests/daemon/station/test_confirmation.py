"""When a unit is asked again who it is, and what comes of its answer; on a clock of the test's own."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from tests.drivers.virtual_time import run, virtual
from triaxcal_drivers.errors import BusError, DeviceBusy, DeviceRestarted, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcald.errors import StationError, TwoAnswer
from triaxcald.provision.identity import BlankIdentity, WrongUnit
from triaxcald.station.output_check import EVERY_S, LAST_S, RETRY_S, SURE_S, Confirmation
from triaxcald.station.reconnect import ReconnectingDevice, RetryPolicy

BLANK = BlankIdentity("the unit on node 5 is serial 0000, expected 0777")
OTHER = WrongUnit("the unit on node 5 is serial 0888, expected 0777")
UNANSWERED = (
    DeviceSilent("no reply"),
    DeviceBusy("busy", register="serial_number", code=6),
    RegisterRefused("not now", register="serial_number", code=4),
    BusError("the link is down"),
)
Answer = Exception | None


@dataclass
class Unit:
    """Streams a record each second; ``answers`` who it is from each of these seconds on."""

    answers: dict[float, Answer]
    seconds: float = 200.0
    lost: tuple[float, float] | None = None
    asked_s: list[float] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    events: list[tuple[str, Any]] = field(default_factory=list)
    marked: list[tuple[int, Any]] = field(default_factory=list)
    back: list[int] = field(default_factory=list)
    offered: int = 0
    takes_s: float = 0.0

    @property
    def now_s(self) -> float:
        return virtual().time() - 1000.0

    async def identify(self) -> None:
        self.asked_s.append(round(self.now_s, 3))
        await asyncio.sleep(self.takes_s)
        answer = next(a for s, a in reversed(self.answers.items()) if s <= self.now_s)
        if answer is not None:
            raise answer

    def complain(self, trouble: Exception) -> None: ...

    async def stream(self, _: Sequence[str]) -> AsyncIterator[RawBatch]:
        while self.now_s < self.seconds:
            await asyncio.sleep(1.0)
            if self.lost and self.lost[0] < self.now_s < self.lost[1]:
                yield RawBatch.of([]).after(Gap(0, None, "gone"))
                await asyncio.sleep(self.lost[1] - self.now_s)
                yield RawBatch.of([(1, 1, 0, b"")]).after(Gap(0, 1, "gone"))
            self.offered += 1
            yield RawBatch.of([(self.offered, 1, 0, b"")])

    # As the writer, and as what is recorded.

    def event(self, kind: str, detail: Any) -> None:
        self.events.append((kind, detail))

    def unconfirmed(self, first: int, detail: Any) -> None:
        self.marked.append((first, detail["error"]))

    def checkpoint(self) -> int:
        return self.offered

    def roll_back(self, checkpoint: int) -> None:
        self.back.append(checkpoint)

    def confirmation(self, *, asks: bool = True) -> Confirmation:
        return Confirmation(
            self.identify if asks else None, cast(Any, self), self, self.told.append, lambda: round(self.now_s * 1e9)
        )

    async def record(self, *, asks: bool = True) -> Confirmation:
        confirmation = self.confirmation(asks=asks)
        async with confirmation.phase(), aclosing(confirmation.of(self).stream(["readings"])) as stream:
            async for _ in stream:
                pass
        return confirmation


def test_it_is_asked_at_least_once_a_minute_and_at_the_end() -> None:
    unit = Unit({0.0: None})
    confirmation = run(unit.record())
    assert unit.asked_s == [EVERY_S * i for i in range(1, 5)] + [200.0]
    assert max(b - a for a, b in zip([0.0, *unit.asked_s], unit.asked_s, strict=False)) <= 60.0
    assert (confirmation.wrong, confirmation.unconfirmed, unit.marked) == (None, 0, [])


def test_a_unit_without_registers_is_not_asked() -> None:
    unit = Unit({})
    assert run(unit.record(asks=False)).wrong is None
    assert unit.asked_s == []


@pytest.mark.parametrize("changed_s", [1.0, 44.0, 46.0, 100.5, 199.5])
def test_another_unit_ends_it_and_what_came_since_the_last_confirmation_is_marked(changed_s: float) -> None:
    unit = Unit({0.0: None, changed_s: OTHER})
    with pytest.raises(WrongUnit, match="0888"):
        run(unit.record())
    confirmed = int(changed_s // EVERY_S * EVERY_S)
    ((first, error),) = unit.marked
    assert first in (confirmed, max(confirmed - 1, 0)), "a record of the same second may go either way"
    assert (error, unit.back) == (str(OTHER), [first])
    assert unit.offered <= changed_s + EVERY_S + SURE_S + 2.0


def test_a_single_wrong_reading_ends_nothing() -> None:
    unit = Unit({0.0: None, 44.9: OTHER, 45.1: None})
    assert run(unit.record()).wrong is None
    assert unit.asked_s[:2] == [EVERY_S, EVERY_S + SURE_S]
    assert unit.marked == []


@pytest.mark.parametrize("trouble", UNANSWERED, ids=lambda t: type(t).__name__)
def test_a_unit_that_does_not_answer_is_not_another_one_and_is_told_once(trouble: Exception) -> None:
    unit = Unit({0.0: trouble})
    assert run(unit.record()).wrong is None
    assert (unit.marked, unit.told) == ([], [str(trouble)])
    assert unit.events == [("identity_unanswered", {"error": str(trouble)})]
    assert unit.asked_s[:5] == [45.0, 45.0 + RETRY_S, 45.0 + 3 * RETRY_S, 45.0 + 7 * RETRY_S, 90.0 + 7 * RETRY_S]


def test_what_came_while_it_did_not_answer_is_marked_once_another_one_does() -> None:
    unit = Unit({0.0: None, 46.0: DeviceSilent("no reply"), 120.0: OTHER})
    with pytest.raises(WrongUnit):
        run(unit.record())
    assert unit.marked[0][0] in (44, 45)


def test_it_is_confirmed_up_to_the_request_and_not_to_the_answer() -> None:
    """What comes while the answer is under way may be another unit's already."""
    unit = Unit({0.0: None, 60.0: OTHER}, takes_s=5.0)
    with pytest.raises(WrongUnit):
        run(unit.record())
    assert unit.marked[0][0] in (44, 45)


def test_a_unit_that_is_lost_is_not_asked_and_one_that_is_back_at_once() -> None:
    unit = Unit({0.0: None}, lost=(40.5, 150.0))
    run(unit.record())
    assert unit.asked_s[:1] == [150.0]


def test_one_that_is_stopped_asks_once_more_and_says_so_in_place_of_the_stop() -> None:
    async def stopped(unit: Unit) -> None:
        work = asyncio.ensure_future(unit.record())
        await asyncio.sleep(20.5)
        work.cancel()
        await work

    same = Unit({0.0: None})
    with pytest.raises(asyncio.CancelledError):
        run(stopped(same))
    assert (same.asked_s, same.marked) == ([20.5], [])
    other = Unit({0.0: None, 10.0: OTHER})
    with pytest.raises(WrongUnit):
        run(stopped(other))
    assert other.marked == [(0, str(OTHER))]


def test_a_stop_is_not_held_up_by_a_unit_that_does_not_answer() -> None:
    async def stopped() -> float:
        work = asyncio.ensure_future(Unit({0.0: None}, takes_s=30.0).record())
        await asyncio.sleep(20.5)
        work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work
        return virtual().time() - 1020.5

    assert run(stopped()) == pytest.approx(LAST_S)


def test_what_else_the_asking_fails_with_ends_the_recording() -> None:
    unit = Unit({0.0: None, 10.0: StationError("two units answer at node 5")})
    with pytest.raises(StationError, match="two units"):
        run(unit.record())
    assert (unit.offered, unit.marked) == (46, [])


@dataclass
class Returned:
    """Two records, then a loss. After it ``answers`` says who is there, one reading after the other, and two more
    records come. ``confirmed`` of the first two came before the unit was last confirmed."""

    answers: list[Answer]
    confirmed: int = 0
    offered: int = 0
    streams: int = 0
    marked: list[int] = field(default_factory=list)
    told: list[str | None] = field(default_factory=list)

    async def open(self) -> None: ...

    async def close(self) -> None: ...

    async def identify(self) -> None:
        if self.answers and (answer := self.answers.pop(0)) is not None:
            raise answer

    async def stream(self, _: Sequence[str]) -> AsyncIterator[RawBatch]:
        self.streams += 1
        for i in (1, 2):
            yield RawBatch.of([(i, 1, 0, b"")])
        if self.streams == 1:
            raise self.trouble

    def complain(self, trouble: Exception) -> None: ...

    # As the writer, and as what is recorded.

    def unconfirmed(self, first: int, _: Any) -> None:
        self.marked.append(first)

    def checkpoint(self) -> int:
        return self.offered

    def roll_back(self, checkpoint: int) -> None: ...

    async def record(self, trouble: Exception) -> int:
        self.trouble = trouble
        confirmation = Confirmation(None, cast(Any, self), self)
        reconnecting = ReconnectingDevice(
            cast(Any, self), lambda: confirmation.returned(self.identify), RetryPolicy(most_s=60.0), self.told.append
        )
        async with confirmation.phase(), aclosing(reconnecting.stream(["readings"])) as stream:
            async for batch in stream:
                self.offered += len(batch)
                if len(batch) and self.offered == self.confirmed:
                    await confirmation.returned(self.identify)
        return self.offered


LOSSES = (DeviceRestarted("it has started anew"), DeviceSilent("gone"), BusError("the link is down"))


@pytest.mark.parametrize("trouble", LOSSES, ids=lambda t: type(t).__name__)
@pytest.mark.parametrize("before", [(), (DeviceSilent("gone"), BusError("not yet"))], ids=["at once", "later"])
def test_another_unit_after_a_loss_marks_what_came_since_the_right_one_was_confirmed(
    trouble: Exception, before: tuple[Answer, ...]
) -> None:
    """It may have taken the place before the loss."""
    unit = Returned([*before, OTHER, OTHER, None])
    with pytest.raises(WrongUnit, match="0888"):
        run(unit.record(trouble))
    assert unit.marked == [0]


def test_another_unit_that_is_lost_again_is_not_forgotten() -> None:
    unit = Returned([OTHER, DeviceSilent("gone"), None])
    with pytest.raises(WrongUnit, match="0888"):
        run(unit.record(DeviceSilent("gone")))
    assert unit.marked == [0]


@pytest.mark.parametrize(("blanks", "ends"), [(1, False), (10, False), (40, True)])
def test_a_unit_that_starts_may_show_a_blank_identity_for_some_seconds(blanks: int, ends: bool) -> None:
    unit = Returned([BLANK] * blanks + [None])
    if ends:
        with pytest.raises(WrongUnit):
            run(unit.record(DeviceSilent("gone")))
    else:
        assert run(unit.record(DeviceSilent("gone"))) == 4
    assert unit.marked == [0] * ends


def test_two_units_that_answer_after_a_loss_mark_what_came_since_the_confirmation() -> None:
    """The second one may have taken the place before the right one came back."""
    unit = Returned([TwoAnswer("two units answer")])
    with pytest.raises(TwoAnswer):
        run(unit.record(DeviceSilent("gone")))
    assert unit.marked == [0]


def test_two_units_that_answer_while_one_streams_mark_what_came_since_the_confirmation() -> None:
    unit = Unit({0.0: None, 60.0: TwoAnswer("two units answer")})
    with pytest.raises(TwoAnswer):
        run(unit.record())
    assert unit.marked[0][0] in (44, 45)


def test_a_single_wrong_reading_after_a_loss_ends_nothing() -> None:
    unit = Returned([OTHER, None])
    assert run(unit.record(DeviceSilent("gone"))) == 4
    assert unit.marked == []


def test_the_right_unit_is_waited_for_where_nothing_came_since_it_was_confirmed() -> None:
    unit = Returned([None, OTHER, OTHER, OTHER, None], confirmed=2)
    assert run(unit.record(DeviceSilent("gone"))) == 4
    assert unit.marked == []
