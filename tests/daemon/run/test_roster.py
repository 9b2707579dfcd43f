"""Recordings side by side, some of which leave and others begin."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.errors import DISK, INTERRUPTED, DiskError, RecordingError
from triaxcald.recording.schema import Phase
from triaxcald.run.record_only import AtRecording, Kept, Roster, State
from triaxcald.schema.codes import Stage
from triaxcald.station.guidance import Guide
from triaxcald.station.listening import RawRecords
from triaxcald.station.reconnect import RetryPolicy
from triaxcald.text import DISK_IS_BEHIND, DISK_KEEPS_UP, IS_BACK, STAGES, nothing_deleted


class Shown:
    """What the operator is shown."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def note(self, unit: str, text: str) -> None:
        self.lines.append(text)

    def lost(self, unit: str, code: object, trouble: str) -> None:
        self.lines.append(f"lost: {trouble}")

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None: ...


class Played(AtRecording):
    """Records until it is told to end, or to fail."""

    kind = "unit"

    def __init__(self, name: str) -> None:
        self.shown = Shown()
        super().__init__(name, RawRecords("calibration"), self.shown)
        self.ends = asyncio.Event()
        self.fault: Exception | None = None

    @property
    def _counts(self) -> dict[str, int]:
        return {}

    @property
    def _seconds(self) -> float:
        return 0.0

    async def _work(self, seconds: float | None, policy: RetryPolicy) -> None:
        self._state = State.RECORDING
        await self.ends.wait()
        if self.fault is not None:
            raise self.fault


class Writer:
    """As much of one as a recording looks at."""

    def __init__(self, path: Path) -> None:
        self.current, self.is_behind, self.queued = path, False, 0
        self.keeps_for: str | None = None
        self.warning: str | None = None
        self.losses: dict[str, int] = {}

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None: ...

    def check(self) -> None: ...

    def close(self, because: str | None = None) -> None: ...


class Written(Played):
    """Through a writer."""

    writer: Any

    async def _work(self, seconds: float | None, policy: RetryPolicy) -> None:
        async def record(_: object) -> None:
            await self.ends.wait()

        await self._recorded_by(lambda: self.writer, record, None)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.001)


@pytest.fixture
def told() -> list[Kept]:
    return []


@pytest.fixture
def roster(told: list[Kept]) -> Roster:
    return Roster(None, RetryPolicy(), told.append)


def states(roster: Roster) -> dict[str, State]:
    return {one.unit: one.state for one in roster.statuses()}


async def turned() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


async def test_who_leaves_ends_as_asked_and_is_on_the_roster_no_more(roster: Roster, told: list[Kept]) -> None:
    first, second = Played("a"), Played("b")
    roster.begin([first, second])
    finished = asyncio.ensure_future(roster.finish())
    await turned()
    await roster.change({"a", "unknown"}, [Played("c")])
    await turned()
    assert [(kept.unit, kept.error) for kept in told] == [("a", None)]
    assert states(roster) == {"b": State.RECORDING, "c": State.RECORDING}
    finished.cancel()
    assert [(kept.unit, kept.exit_code) for kept in await finished] == [("b", INTERRUPTED), ("c", INTERRUPTED)]


async def test_what_the_disk_ended_is_told_apart_and_says_why(roster: Roster) -> None:
    full, other, whole = Played("a"), Played("b"), Played("c")
    full.fault, other.fault = DiskError("x.mcap: ended, as 7 bytes are free"), RecordingError("no such file")
    roster.begin([full, other, whole])
    for one in (full, other):
        one.ends.set()
    await turned()
    assert roster.ended_with(DISK) == {"a"}
    assert [one.trouble for one in roster.statuses()] == ["x.mcap: ended, as 7 bytes are free", "no such file", None]
    whole.ends.set()
    await roster.finish()


async def test_nothing_begins_once_all_are_to_end(roster: Roster) -> None:
    roster.begin([Played("a")])
    finished = asyncio.ensure_future(roster.finish())
    await turned()
    finished.cancel()
    await asyncio.sleep(0)
    roster.begin([Played("b")])
    assert [kept.unit for kept in await finished] == ["a"]


async def test_one_that_is_stopped_before_its_first_step_costs_no_result_of_others(roster: Roster) -> None:
    roster.begin([Played("a")])
    finished = asyncio.ensure_future(roster.finish())
    await turned()
    finished.cancel()
    roster.begin([Played("b")])
    assert [kept.unit for kept in await finished] == ["a"]


async def test_what_was_wrong_with_the_manifest_is_shown(tmp_path: Path) -> None:
    one = Written("a")
    one.writer = Writer(tmp_path / "a-000002.mcap")
    one.writer.warning = "a.segments.json: not JSON"
    work = asyncio.ensure_future(one.run(None, RetryPolicy()))
    await until(lambda: one.shown.lines == ["warning: a.segments.json: not JSON"])
    one.ends.set()
    await work


async def test_one_that_loses_what_comes_is_not_said_to_be_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("triaxcald.run.record_only.LOOK_S", 0.001)
    one = Written("a")
    one.writer = Writer(tmp_path / "a-000002.mcap")
    work = asyncio.ensure_future(one.run(None, RetryPolicy()))
    await until(lambda: one.status.state is State.RECORDING)
    one.writer.is_behind = True
    assert (one.status.state, one.status.trouble) == (State.WAITING, DISK_IS_BEHIND)
    await until(lambda: one.shown.lines == [f"lost: {DISK_IS_BEHIND}"])
    one.writer.is_behind = False
    await until(lambda: one.shown.lines[1:] == [DISK_KEEPS_UP])
    assert one.status.state is State.RECORDING
    one.writer.keeps_for = "x.outcome.json"
    await until(lambda: one.shown.lines[2:] == [nothing_deleted("x.outcome.json")])
    one.ends.set()
    await work
    assert (one.status.state, one.status.path) == (State.ENDED, tmp_path / "a-000002.mcap")


async def test_a_name_that_failed_may_begin_again_and_its_last_recording_counts(roster: Roster) -> None:
    first, other, again = Played("a"), Played("b"), Played("a")
    roster.begin([first, other])
    finished = asyncio.ensure_future(roster.finish())
    first.fault = RecordingError("the disk is gone")
    first.ends.set()
    await turned()
    assert states(roster) == {"a": State.ENDED, "b": State.RECORDING}
    assert roster.at_work() == {"b"}
    await roster.change((), [again])
    await turned()
    assert states(roster) == {"a": State.RECORDING, "b": State.RECORDING}
    for one in (other, again):
        one.ends.set()
    assert [kept.error for kept in await finished] == [None, None]


async def test_it_is_not_at_its_end_while_those_that_left_give_way_to_others(roster: Roster) -> None:
    roster.begin([Played("a")])
    finished = asyncio.ensure_future(roster.finish())
    await turned()
    later = Played("b")
    await roster.change({"a"}, [later])
    await turned()
    assert not finished.done()
    later.ends.set()
    assert [kept.unit for kept in await finished] == ["b"]


async def test_a_fault_of_the_program_says_where_it_came_from(
    roster: Roster, capsys: pytest.CaptureFixture[str]
) -> None:
    failing = Played("a")
    roster.begin([failing])
    failing.fault = ValueError("a fault of the program")
    failing.ends.set()
    (failed,) = await roster.finish()
    assert failed.error == "unit a: internal error: ValueError('a fault of the program')"
    assert failed.trace is not None
    assert "in _work" in failed.trace
    assert capsys.readouterr().err == "", "standard error may be read by a machine"


async def test_one_that_fails_says_so_with_its_exit_code_and_stops_no_other(roster: Roster) -> None:
    failing, other = Played("a"), Played("b")
    roster.begin([failing, other])
    failing.fault = RecordingError("the recording is closed")
    failing.ends.set()
    other.ends.set()
    failed, kept = await roster.finish()
    assert (failed.error, failed.exit_code != 0) == ("unit a: the recording is closed", True)
    assert (kept.error, kept.exit_code) == (None, 0)


async def test_who_begins_as_all_are_stopped_is_stopped_too(roster: Roster) -> None:
    roster.begin([Played("a")])
    finished = asyncio.ensure_future(roster.finish())
    await turned()
    asyncio.get_running_loop().call_soon(finished.cancel)
    roster.begin([Played("b")])
    assert [kept.exit_code for kept in await finished] == [INTERRUPTED, INTERRUPTED]
