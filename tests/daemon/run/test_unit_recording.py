"""Units that are lost in the middle of a recording and come back, on real buses with simulated units."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.daemon.station.test_lock import another_process
from triaxcal_drivers.claim import claim_of
from triaxcal_drivers.profile import READINGS
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.recording.reader import Recording
from triaxcald.run.record_only import Kept, Roster, State, UnitRecording
from triaxcald.run.session import UnitSession
from triaxcald.schema.codes import Stage
from triaxcald.simulation.bench import load_device, simulate
from triaxcald.station.config import Station, load_station
from triaxcald.station.lock import locked
from triaxcald.station.reconnect import RetryPolicy
from triaxcald.text import IS_BACK, STAGES


class Told:
    """In the place of the operator: waits for the hints that are shown."""

    def __init__(self) -> None:
        self.stages: dict[str, list[str]] = {}

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def note(self, unit: str, text: str) -> None:
        self.stages.setdefault(unit, []).append(text)

    def lost(self, unit: str, code: object, trouble: str) -> None:
        self.note(unit, f"lost: {trouble}")

    def poses(self, *_: object) -> None: ...

    async def until(self, unit: str, done: Callable[[str], bool]) -> None:
        while not any(done(text) for text in self.stages.get(unit, ())):
            await asyncio.sleep(0.01)


class Bench:
    """Simulated units of a station, each of which can be taken away and put
    back."""

    def __init__(self, workshop: Any, devices: list[dict[str, Any]]) -> None:
        self.files = [workshop.device(f"device{i}.toml", speed=1.0, **d) for i, d in enumerate(devices)]
        self.serving: dict[int, Any] = {}
        self.buses: dict[int, dict[str, Any]] = {}

    async def put(self, i: int, **changed: Any) -> dict[str, Any]:
        device = load_device(self.files[i])
        device = device.model_copy(update={"bus": self.buses.get(i, dict(device.bus)), **changed})
        self.serving[i] = simulate(device, where="device.toml", stored=None).serve()
        server = await self.serving[i].__aenter__()
        bus = dict(device.bus)
        if "port" in bus:
            bus["port"] = server.bus.port
        self.buses[i] = bus
        return bus

    async def take(self, i: int) -> None:
        await self.serving.pop(i).__aexit__(None, None, None)


def recorded(station: Station, folder: Path, told: Told, *, seconds: float | None, policy: RetryPolicy) -> Any:
    recordings = []
    for place in station.places:
        session = UnitSession(station, place, told)
        recordings.append(UnitRecording(session, lambda _, name=session.name: folder / f"{name}.mcap"))
    roster = Roster(seconds, policy)
    roster.begin(recordings)
    return asyncio.ensure_future(roster.finish())


def told_by(path: Path) -> tuple[list[tuple[str, Any]], DecodedStream, np.ndarray]:
    with Recording.open(path) as recording:
        events = [(e.kind, e.detail) for e in recording.events() if e.kind != "recording_started"]
        decoded = DecodedStream(bundle_of(recording), READINGS)
        times = [decoded.feed(batch).time_ns for batch in recording.raw(CALIBRATION)]
        return events, decoded, np.concatenate(times)


CAN = {"profile": "triax-ref-can", "serial": 12}
MODBUS = {"profile": "triax-ref-modbus", "serial": 4711}


@pytest.mark.parametrize("most_s", [None, 60.0], ids=["without end", "a minute"])
async def test_whoever_waits_for_a_unit_without_end_is_told_how_to_set_one(workshop: Any, most_s: float | None) -> None:
    station = load_station(workshop.station({"name": "u", "bus": {"host": "127.0.0.1", "port": 1}}))
    told = Told()
    work = recorded(station, workshop.folder, told, seconds=None, policy=RetryPolicy(most_s=most_s))
    await told.until("u", lambda text: text.startswith("lost: "))
    work.cancel()
    with suppress(asyncio.CancelledError):
        await work
    told_so = [text for text in told.stages["u"] if text.startswith("lost: ")]
    assert ("--give-up-after" in told_so[0]) is (most_s is None)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["can", "modbus"])
async def test_a_unit_that_goes_and_comes_back_is_in_one_recording_with_the_gap(
    workshop: Any, kind: str, request: pytest.FixtureRequest
) -> None:
    bus = {"interface": "virtual", "channel": request.node.name, "node_id": 9} if kind == "can" else None
    device = {**(CAN if kind == "can" else MODBUS), **({"bus": bus} if bus else {})}
    bench, told = Bench(workshop, [device]), Told()
    where = await bench.put(0)
    profile = workshop.impatient_profile(str(device["profile"]))
    station = load_station(workshop.station({"bus": where, "profile": profile}))
    work = recorded(station, workshop.folder, told, seconds=3.0, policy=RetryPolicy())
    await told.until("unit0", lambda text: text == "recording")
    await asyncio.sleep(0.7)
    await bench.take(0)
    await told.until("unit0", lambda text: text.startswith("lost: "))
    await bench.put(0)
    (kept,) = await work
    await bench.take(0)
    assert kept.error is None
    events, decoded, times = told_by(workshop.folder / "unit0.mcap")
    assert [kind for kind, _ in events] == ["interrupted", "gap", "ended"]
    gap = events[1][1]
    assert gap["cause"] == events[0][1]["cause"]
    assert kept.gaps_s == pytest.approx((gap["to_ns"] - gap["from_ns"]) * 1e-9)
    assert kept.gaps_s > 0.5
    assert (np.diff(times) > 0).all()
    longest = int(np.argmax(np.diff(times)))
    heard_late_s = (gap["from_ns"] - times[longest]) * 1e-9, (gap["to_ns"] - times[longest + 1]) * 1e-9
    assert all(-0.2 < late_s < 2.0 for late_s in heard_late_s), "as late as a busy machine hears a frame"
    assert decoded.seconds >= 3.0


async def test_a_unit_of_which_nothing_has_come_is_not_said_to_be_recorded(workshop: Any) -> None:
    """It answers, and its FIFO is being emptied of what is old."""
    bench, told = Bench(workshop, [MODBUS]), Told()
    station = load_station(workshop.station({"bus": await bench.put(0), "profile": "triax-ref-modbus"}))
    session = UnitSession(station, station.places[0], told)
    recording = UnitRecording(session, lambda _: workshop.folder / "unit0.mcap")
    seen: list[tuple[State, str | None, int]] = []

    def look() -> bool:
        status = recording.status
        seen.append((status.state, status.trouble, status.counts["samples"]))
        return status.state is State.RECORDING

    work = asyncio.ensure_future(recording.run(None, RetryPolicy()))
    while not look():
        await asyncio.sleep(0.001)
    work.cancel()
    await work
    await bench.take(0)
    assert (seen[-1][1], seen[-1][2] > 0) == (None, True)
    assert (State.WAITING, "nothing has come yet", 0) in seen
    assert {state for state, _, samples in seen if not samples} == {State.WAITING}


@pytest.mark.parametrize("given_up", [False, True])
async def test_a_unit_that_another_process_works_with_is_waited_for(workshop: Any, given_up: bool) -> None:
    bench, told = Bench(workshop, [MODBUS]), Told()
    station = load_station(workshop.station({"bus": await bench.put(0), "profile": "triax-ref-modbus"}))
    policy = RetryPolicy(most_s=0.0 if given_up else None, in_use=True)
    claim = claim_of(station.places[0].bus)
    with another_process(device=claim.device, host=claim.host):
        work = recorded(station, workshop.folder, told, seconds=0.2, policy=policy)
        if given_up:
            await work
        else:
            await told.until("unit0", lambda text: " is in use by `" in text)
    (kept,) = await work
    await bench.take(0)
    assert kept.exit_code == (4 if given_up else 0)
    assert (kept.error is not None and " is in use by `" in kept.error) == given_up


async def test_a_unit_that_this_process_works_with_already_is_not_waited_for(workshop: Any) -> None:
    """By another name of its host, say: only the process itself could end that."""
    bench, told = Bench(workshop, [MODBUS]), Told()
    station = load_station(workshop.station({"bus": await bench.put(0), "profile": "triax-ref-modbus"}))
    async with locked(claim_of(station.places[0].bus)):
        work = recorded(station, workshop.folder, told, seconds=None, policy=RetryPolicy(in_use=True))
        (kept,) = await work
    await bench.take(0)
    assert kept.exit_code == 4
    assert kept.error is not None
    assert "which is this process" in kept.error


@pytest.mark.slow
async def test_another_unit_that_is_put_in_its_place_is_not_recorded_as_the_same(workshop: Any) -> None:
    bench, told = Bench(workshop, [MODBUS]), Told()
    where = await bench.put(0)
    station = load_station(workshop.station({"bus": where, "profile": workshop.impatient_profile()}))
    work = recorded(station, workshop.folder, told, seconds=None, policy=RetryPolicy(most_s=3.0))
    await told.until("unit0", lambda text: text == "recording")
    while not (workshop.folder / "unit0.mcap").stat().st_size > 20_000:
        await asyncio.sleep(0.01)
    await bench.take(0)
    await bench.put(0, serial=13)
    (kept,) = await work
    await bench.take(0)
    assert kept.exit_code == 4
    assert kept.error is not None
    assert "is serial 0013, expected 4711" in kept.error
    assert (kept.unconfirmed > 0, kept.counts["samples"]) == (True, 0), "it may have been there before the loss"
    with Recording.open(workshop.folder / "unit0.mcap") as recording:
        *_, marked, failed, ended = recording.events()
        assert all(batch.unconfirmed for _, batch in recording.joined_batches())
    assert marked.kind == "unconfirmed"
    assert (failed.kind, "is serial 0013" in failed.text) == ("failed", True)
    assert (ended.kind, ended.detail) == ("ended", {"reason": "unit gave up"})


@pytest.mark.slow
async def test_a_unit_that_is_not_there_keeps_nobody_waiting_and_is_recorded_once_it_is(
    workshop: Any, request: pytest.FixtureRequest
) -> None:
    can = {**CAN, "bus": {"interface": "virtual", "channel": request.node.name, "node_id": 9}}
    bench, told = Bench(workshop, [MODBUS, can]), Told()
    where = await bench.put(0)
    units = (
        {"bus": where, "profile": workshop.impatient_profile()},
        {"bus": can["bus"], "profile": workshop.impatient_profile("triax-ref-can")},
    )
    station = load_station(workshop.station(*units))
    work = recorded(station, workshop.folder, told, seconds=1.0, policy=RetryPolicy())
    await told.until("unit1", lambda text: text.startswith("lost: nothing answers at node 9"))
    await told.until("unit0", lambda text: text == "recording")
    await bench.put(1)
    kept: list[Kept] = await work
    await bench.take(0)
    await bench.take(1)
    assert [(k.error, k.seconds >= 1.0) for k in kept] == [(None, True)] * 2


async def test_a_recording_that_is_cancelled_is_whole_and_says_so(workshop: Any) -> None:
    bench, told = Bench(workshop, [MODBUS]), Told()
    where = await bench.put(0)
    station = load_station(workshop.station({"bus": where, "profile": workshop.impatient_profile()}))
    work = recorded(station, workshop.folder, told, seconds=None, policy=RetryPolicy())
    await told.until("unit0", lambda text: text == "recording")
    await asyncio.sleep(0.3)
    work.cancel()
    (kept,) = await work
    await bench.take(0)
    assert (kept.exit_code, kept.error) == (130, "unit unit0: interrupted")
    events, decoded, _ = told_by(workshop.folder / "unit0.mcap")
    assert events == [("ended", {"reason": "signal"})]
    assert decoded.counts["samples"] == kept.counts["samples"] > 0
