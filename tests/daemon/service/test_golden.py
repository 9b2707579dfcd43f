"""A slot waits for its golden unit: by the rule alone, by the folder, and by a service at work on simulated units."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.run.test_golden_unit import EXACT, OFF, calibration
from tests.daemon.service.conftest import START, outcome
from tests.virtual_line import START_NS, described, virtual_line
from triaxcald.documents import to_text
from triaxcald.schema.codes import Code
from triaxcald.schema.station_state import StationState
from triaxcald.service import floor as floor_module
from triaxcald.service.api_data import ROWS
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.floor import Floor
from triaxcald.service.golden import HOUR_US, LastCheck, blocked_slots, next_due_us, problem_of, told, worst
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.service.quality import quality_of
from triaxcald.service.stream import Stream
from triaxcald.station.config import Golden, Rules, Station, load_station

RULES = Rules(golden=Golden(serial="0815", every_h=8.0, calibration="golden.json"))
DUE, FAILED = Problem.GOLDEN_DUE, Problem.GOLDEN_FAILED
NOW_US = 1_900_000_000_000_000


@pytest.mark.parametrize(
    ("last", "expected"),
    [
        (None, DUE),
        (LastCheck(NOW_US, True), None),
        (LastCheck(NOW_US - 8 * HOUR_US, True), None),
        (LastCheck(NOW_US - 8 * HOUR_US - 1, True), DUE),
        (LastCheck(NOW_US, False), FAILED),
        (LastCheck(NOW_US - 9 * HOUR_US, False), FAILED),
        (LastCheck(NOW_US + 1_000_000, True), None),  # a clock was set back by a step
        (LastCheck(NOW_US + HOUR_US, True), DUE),  # a clock was wrong
        (LastCheck(NOW_US + HOUR_US, False), FAILED),
    ],
)
def test_a_slot_runs_as_long_as_its_golden_unit_has_verified_lately(
    last: LastCheck | None, expected: Problem | None
) -> None:
    assert problem_of(last, NOW_US, 8.0) is expected


def test_each_slot_of_a_tray_waits_for_its_own_verification() -> None:
    fresh, failed = LastCheck(NOW_US, True), LastCheck(NOW_US, False)
    due = {"a": "815", "b": "1", "c": "2", "d": None}
    assert blocked_slots(RULES, due, {"c": fresh}, NOW_US) == {"b": DUE, "d": DUE}
    blocked = blocked_slots(RULES, due, {"a": failed, "b": failed, "c": fresh}, NOW_US)
    assert (blocked, worst(blocked)) == ({"b": FAILED, "d": DUE}, FAILED)
    assert told(RULES, blocked) == (
        "the golden unit 0815 has failed in slot b; the golden unit 0815 has not verified in slot d within the last "
        "8 h; scan it for slots b, d and start it there first"
    )
    assert blocked_slots(Rules(), due, {}, NOW_US) == {}
    assert worst({}) is None


def test_the_next_moment_is_when_the_first_verification_gets_too_old() -> None:
    last = {
        "a": LastCheck(NOW_US - HOUR_US, True), "b": LastCheck(NOW_US - 2 * HOUR_US, True),
        "c": LastCheck(NOW_US - 9 * HOUR_US, True), "d": LastCheck(NOW_US - 7 * HOUR_US, False),
    }  # fmt: skip
    assert next_due_us(RULES, last, NOW_US) == NOW_US + 6 * HOUR_US
    assert next_due_us(RULES, {}, NOW_US) is None
    assert next_due_us(Rules(), last, NOW_US) is None


FOUND = {
    "format": "triaxcal.verification/1", "raw_sha256": "0" * 64, "before_rms_g": 1e-5, "after_rms_g": 1e-5,
    "after_max_abs_g": 2e-5, "noise_floor_g": 1e-6, "limit_rms_g": 1e-4, "verdict": "within limits", "poses": [],
    "data_quality": [], "expanded_uncertainty_g": 1e-6, "poses_apart": 0,
}  # fmt: skip


def put(
    folder: Path, number: int, slot: str, code: Code = Code.WITHIN_LIMITS, *, fit: bool = False, **work: Any
) -> int:
    """Write the outcome of the golden unit 0815; its end in microseconds."""
    document = outcome(number, code, **{"slot": slot, "serial": "0815", **work})
    if not fit:
        document |= {"measured": None, "verification": None if code.verdict == "aborted" else FOUND}
    (folder / f"{slot}-{number:06d}.outcome.json").write_text(to_text(document))
    return round((START + timedelta(minutes=number, seconds=50)).timestamp() * 1e6)


def test_the_last_verification_of_each_slot_is_in_the_folder(
    make_station: Callable[..., Station], open_ledger: Callable[[Station], Ledger], tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    put(tmp_path, 1, "a")
    failed = put(tmp_path, 2, "a", Code.VERIFICATION_OUTSIDE)
    put(tmp_path, 3, "a", Code.ABSENT)
    put(tmp_path, 4, "a", fit=True)  # a calibration of that unit, before it was the golden one
    put(tmp_path, 5, "a", serial="1")
    passed = put(tmp_path, 6, "b", serial="815")
    ledger.take()
    found = ledger.golden("0815", ["a", "b", "c"], NOW_US)
    assert found == {"a": LastCheck(failed, False), "b": LastCheck(passed, True)}
    assert ledger.golden("0815", ["c"], NOW_US) == ledger.golden("9", ["a"], NOW_US) == {}
    later = put(tmp_path, 7, "a")
    ledger.take()
    assert ledger.golden("0815", ["a"], NOW_US) == {"a": LastCheck(later, True)}


def test_a_verification_by_a_clock_that_was_ahead_opens_nothing_and_is_no_hindrance(
    make_station: Callable[..., Station], open_ledger: Callable[[Station], Ledger], tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    put(tmp_path, 1_000_000, "a")
    put(tmp_path, 1_000_000, "b")
    now_us = put(tmp_path, 7, "b")  # verified again, by the right clock
    failed = put(tmp_path, 1_000_000, "c", Code.VERIFICATION_OUTSIDE)
    put(tmp_path, 7, "c")
    ledger.take()
    found = ledger.golden("0815", ["a", "b", "c"], now_us)
    assert found == {"b": LastCheck(now_us, True), "c": LastCheck(failed, False)}  # to be safe


def test_verifications_of_the_golden_unit_are_no_units_of_the_yield(
    make_station: Callable[..., Station], open_ledger: Callable[[Station], Ledger], tmp_path: Path
) -> None:
    ledger = open_ledger(make_station())
    put(tmp_path, 1, "a", Code.VERIFICATION_OUTSIDE)
    put(tmp_path, 2, "a", fit=True, serial="1")
    ledger.take()
    found = quality_of(ledger.columns(RunFilter(), ROWS))
    assert (found["units"], found["attempts"], found["yield"]) == (1, 1, 1.0)
    assert "verification_rms_g" not in {c["name"] for c in found["characteristics"]}


# A service at work.

BUSES = {"a": {"host": "127.0.0.1", "port": 502}, "b": {"host": "127.0.0.1", "port": 503}}


class Line:
    """Two slots; the golden unit 4711, and 4713 and 4714, which are no good. By the clock of the rule it is ten minutes
    after the units were switched on, and ``later_us`` more."""

    def __init__(self, workshop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        self.workshop = workshop
        self.later_us = 0
        calibration(workshop.folder)
        self.station(2e-4)
        begun_us = START_NS // 1000 + 600_000_000 - time.monotonic_ns() // 1000
        monkeypatch.setattr(floor_module, "_now_us", lambda: begun_us + time.monotonic_ns() // 1000 + self.later_us)

    def station(self, limit_g: float) -> None:
        self.path = self.workshop.station(
            *({"name": slot, "serial": serial, "bus": BUSES[slot]} for slot, serial in (("a", "4713"), ("b", "4714"))),
            plan={"poses": 9, "hold_s": 1.0, "check_poses": 3},
            limits={"verification_rms_g": limit_g},
            rules={"golden": {"serial": "4711", "every_h": 8, "calibration": "golden.json"}},
        )

    def serve(self, work: Callable[[Floor], Any]) -> None:
        """Do ``work`` with a service that begins now."""

        async def served(station: Station, ledger: Ledger) -> None:
            floor = Floor(station, ledger, partial(Stream, ledger), load=lambda: load_station(self.path), log=print)
            await floor.stream.begin()
            streaming = asyncio.ensure_future(floor.stream.run())
            try:
                await floor.begin()
                await work(floor)
            finally:
                await floor.end()
                await floor.stream.drained()
                streaming.cancel()

        station = load_station(self.path)
        ledger = Ledger.open(station)
        try:
            asyncio.run(served(station, ledger))
        finally:
            ledger.close()


@pytest.fixture(params=[EXACT])
def line(request: pytest.FixtureRequest, workshop: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    devices = [
        described(workshop.device(f"{serial}.toml", bus=BUSES["a"], sensor=request.param, serial=serial))
        for serial in (4711, 4713, 4714)
    ]
    with virtual_line(*devices):
        yield Line(workshop, monkeypatch)


async def ended(floor: Floor) -> None:
    assert floor._task is not None
    await floor._task


async def verified(floor: Floor, code: str) -> None:
    """Runs the golden unit in slot a."""
    await floor.scan("4711")
    await floor.start(None)
    await ended(floor)
    assert floor.state(0)["slots"][0]["code"] == code


async def refused(floor: Floor, problem: Problem, slots: list[str]) -> str:
    """The message of a start that is refused; the state says the same."""
    with pytest.raises(ApiError) as caught:
        await floor.start(None)
    assert caught.value.problem is problem
    assert caught.value.problem.status == 409
    state = StationState.model_validate(floor.state(0)).document()
    assert (state["blocked"], state["blocked_slots"]) == (problem.value, slots)
    assert [slot["slot"] for slot in state["slots"] if slot["blocked"]] == slots
    assert problem.value in [slot["blocked"] for slot in state["slots"]]
    return caught.value.message


def test_a_slot_starts_after_its_golden_unit_has_verified_and_not_before(line: Line) -> None:
    async def first(floor: Floor) -> None:
        await floor.scan("4713")
        assert "slot a within the last 8 h" in await refused(floor, Problem.GOLDEN_DUE, ["a"])
        await floor.clear()
        await floor.put({"a": "4711", "b": "4714"}, {})
        await refused(floor, Problem.GOLDEN_DUE, ["b"])
        await floor.put({"b": None}, {})
        assert floor.state(0)["blocked"] is None
        await floor.start(None)
        await ended(floor)
        assert floor.state(0)["slots"][0]["code"] == "within_limits"

    async def second(floor: Floor) -> None:
        await floor.put({"a": "4713", "b": "4714"}, {})
        await refused(floor, Problem.GOLDEN_DUE, ["b"])  # that in slot a says nothing of slot b
        await floor.put({"b": None}, {})
        line.later_us = 9 * HOUR_US
        await refused(floor, Problem.GOLDEN_DUE, ["a"])
        line.later_us = 0
        await floor.start(None)
        assert floor.state(0)["blocked"] is None
        await floor.stop("enough")
        await ended(floor)
        assert floor.state(0)["slots"][0]["code"] == "stopped"

    line.serve(first)
    line.serve(second)  # after a restart, by the folder alone


@pytest.mark.parametrize("line", [OFF], indirect=True)
def test_a_slot_whose_golden_unit_has_failed_is_blocked_until_it_passes(line: Line) -> None:
    async def fails(floor: Floor) -> None:
        await verified(floor, "verification_outside")
        await floor.scan("4713")
        assert "has failed in slot a" in await refused(floor, Problem.GOLDEN_FAILED, ["a"])
        await floor.clear()

    async def passes(floor: Floor) -> None:
        await verified(floor, "within_limits")
        await floor.scan("4713")
        await floor._take()
        assert (floor.state(0)["blocked"], floor.state(0)["blocked_slots"]) == (None, [])

    line.serve(fails)
    line.station(1e-2)
    line.serve(passes)


def test_the_state_is_sent_when_a_verification_gets_too_old(line: Line) -> None:
    async def work(floor: Floor) -> None:
        await verified(floor, "within_limits")
        await floor.scan("4713")
        await floor._take()
        await floor.stream.drained()
        last_us = floor._checks["a"].ended_us
        line.later_us = last_us + 8 * HOUR_US - floor_module._now_us() - 50_000
        floor._await_due()
        sent = floor.stream.listen()
        state = (await anext(sent)).data
        assert state["blocked"] is None
        async with asyncio.timeout(60):
            while state.get("blocked") is None:
                state = (await anext(sent)).data
        assert (state["blocked"], state["blocked_slots"]) == ("golden_due", ["a"])
        await sent.aclose()

    line.serve(work)
