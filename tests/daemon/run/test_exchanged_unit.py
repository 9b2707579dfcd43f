"""A unit exchanged behind a gateway without a gap in its stream: nothing is computed from what the other one sent."""

from __future__ import annotations

import asyncio
import csv
import io
import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.run.test_unit_recording import Told, recorded
from tests.devices.bench import Bench, Transport
from tests.devices.memory import Electronics, Silent
from tests.devices.motion import Motion, Triple
from tests.devices.place import Trouble
from tests.devices.profiles import Timing
from triaxcald.audit import audit
from triaxcald.recording.manifest import load_manifest
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import UNCONFIRMED
from triaxcald.run.unit_run import TrayRun
from triaxcald.schema.codes import Stage
from triaxcald.station import output_check as confirmation
from triaxcald.station.config import load_station
from triaxcald.station.reconnect import RetryPolicy
from triaxcald.text import IS_BACK, STAGES

OURS_V, THEIRS_V = -2.4, -2.1
OTHER_SERIAL = 888
PATIENT = Timing(reply_s=0.5, silence_s=5.0)


@dataclass
class Exchange:
    """Another unit takes the place after so many samples, and shows another voltage; ``back_after`` so many more the
    first one is there again. ``lost_after`` so many more it is lost: it restarts on CAN, else nothing answers for a
    second."""

    after: int
    back_after: int | None = None
    lost_after: int | None = None
    samples: int = 0
    bench: Any = None
    other: Electronics = field(default_factory=lambda: Electronics(serial_number=OTHER_SERIAL))

    def readings(self, now: float) -> Triple:
        self.samples += 1
        if self.samples == self.after:
            self.bench.place.swap(self.other)
        elif self.back_after is not None and self.samples == self.after + self.back_after:
            self.bench.place.swap(self.bench.unit)
        elif self.lost_after is not None and self.samples == self.after + self.lost_after:
            if self.bench.transport == "canopen":
                self.other.restart(now)
            else:
                self.bench.place.trouble = Trouble(dead_after=self.bench.place.requests + 1, dead_for_s=1.0)
        return (0.0, 0.0, THEIRS_V if self.bench.place.unit is self.other else OURS_V)


class Mute(Electronics):
    """Tells nobody who it is once it has streamed for a while: a node streams before it is identified."""

    def __init__(self, exchange: Exchange) -> None:
        super().__init__()
        self._exchange = exchange

    def read(self, register: str, now: float) -> bytes:
        if self._exchange.samples >= 50 and register in ("serial_number", "product_code"):
            raise Silent
        return super().read(register, now)


def bench_of(
    tmp_path: Path,
    triaxcal: Callable[..., Any],
    transport: Transport,
    exchange: Exchange,
    timing: Timing = PATIENT,
) -> Bench[Any]:
    node = {"announces": False} if transport == "canopen" else {}
    bench = Bench(tmp_path, triaxcal, transport, motion=Motion(exchange.readings), node=node, timing=timing)
    exchange.bench = bench
    return bench


def exported_v(triaxcal: Callable[..., Any], recording: Path) -> list[float]:
    """The readings in z that a recording has for who computes with it."""
    done = triaxcal("log", "export", recording)
    assert done.code == 0, done.err
    return [float(row["uz"]) for row in csv.DictReader(io.StringIO(done.out))]


def info_of(triaxcal: Callable[..., Any], recording: Path) -> Mapping[str, Any]:
    found: Mapping[str, Any] = json.loads(triaxcal("log", "info", recording, "--json").out)
    return found


@pytest.fixture(params=["tcp", "canopen"])
def transport(request: pytest.FixtureRequest) -> Transport:
    kind: Transport = request.param
    return kind


@pytest.mark.slow
def test_another_unit_is_noticed_while_it_is_recorded(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confirmation, "EVERY_S", 0.3)
    exchange = Exchange(after=120)
    out = tmp_path / "rec.mcap"
    with bench_of(tmp_path, triaxcal, transport, exchange) as bench:
        done = triaxcal("record", bench.station, "-o", out, "--seconds", "60")
    assert done.code == 4
    assert "0888" in done.err
    assert "4711" in done.err
    assert exchange.samples < 1000, "noticed within seconds, not at the end"
    found = exported_v(triaxcal, out)
    assert len(found) > 20
    assert found == pytest.approx([OURS_V] * len(found), abs=1e-4)
    info = info_of(triaxcal, out)
    raw = info["raw"]["calibration"]
    assert 0 < raw["unconfirmed"] < raw["records"]
    assert info["samples"]["calibration"]["readings"]["samples"] == len(found)
    assert f"{len(found)} samples in" in done.err, "the line counts what may be used"
    (event,) = (e["detail"] for e in info["events"] if e["kind"] == UNCONFIRMED)
    assert event["records"] == raw["unconfirmed"]
    with Recording.open(out) as recording:
        used = [int(t) for batch in recording.raw("calibration") for t in batch.time_ns]
        flagged = [b.unconfirmed for _, b in recording.joined_batches()]
    assert flagged == sorted(flagged)
    assert any(flagged)
    assert max(used) <= event["confirmed_ns"] + 50_000_000


@pytest.mark.slow
def test_another_unit_is_noticed_when_the_seconds_are_done(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport
) -> None:
    exchange = Exchange(after=60)
    out = tmp_path / "rec.mcap"
    with bench_of(tmp_path, triaxcal, transport, exchange) as bench:
        done = triaxcal("record", bench.station, "-o", out, "--seconds", "2.5")
        assert done.code == 4
    refused = triaxcal("log", "export", out)
    assert refused.code == 2, "it was confirmed when it was opened, and not since"
    raw = info_of(triaxcal, out)["raw"]["calibration"]
    assert raw["unconfirmed"] == raw["records"] > 100


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", [{"serial_number": OTHER_SERIAL}, {"product_code": 0x1111}], ids=["serial", "product"]
)
def test_another_unit_that_is_lost_before_anybody_asks_is_noticed_when_it_is_back(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, other: dict[str, int]
) -> None:
    exchange = Exchange(after=60, lost_after=60, other=Electronics(**other))
    out = tmp_path / "rec.mcap"
    with bench_of(tmp_path, triaxcal, transport, exchange, timing=Timing(reply_s=0.2, silence_s=0.4)) as bench:
        done = triaxcal("record", bench.station, "-o", out, "--seconds", "60")
    assert done.code == 4
    info = info_of(triaxcal, out)
    assert "interrupted" in [e["kind"] for e in info["events"]], "it was lost"
    raw = info["raw"]["calibration"]
    assert raw["unconfirmed"] == raw["records"] > 0, "it was confirmed when it was opened, and not since"


@pytest.mark.slow
def test_segments_that_were_closed_since_are_unconfirmed_too(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confirmation, "EVERY_S", 1.5)
    exchange = Exchange(after=260)
    out = tmp_path / "rec"
    out.mkdir()
    with bench_of(tmp_path, triaxcal, transport, exchange) as bench:
        done = triaxcal("record", bench.station, "-o", out, "--seconds", "60", "--segment-time", "0.5")
    assert done.code == 4
    (manifest,) = out.glob("*.segments.json")
    segments = load_manifest(manifest).segments
    marked = [s for s in segments if s.unconfirmed is not None]
    assert len(marked) > 1
    assert marked == list(segments[-len(marked) :])
    found = exported_v(triaxcal, manifest)
    assert found == pytest.approx([OURS_V] * len(found), abs=1e-4)
    assert len(found) > 20
    for segment in marked[1:]:
        with Recording.open(manifest.with_name(segment.file)) as alone:
            assert list(alone.raw("calibration")) == []


@pytest.mark.slow
def test_a_unit_that_does_not_say_who_it_is_while_it_streams_is_recorded(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Silence is not another unit: it is told once, and nothing is lost."""
    monkeypatch.setattr(confirmation, "EVERY_S", 0.2)
    monkeypatch.setattr(confirmation, "RETRY_S", 0.2)
    exchange = Exchange(after=10**9)
    out = tmp_path / "rec.mcap"
    with bench_of(tmp_path, triaxcal, transport, exchange) as bench:
        bench.place.swap(Mute(exchange))
        done = triaxcal("record", bench.station, "-o", out, "--seconds", "3")
    assert (done.code, done.err.count("still the same unit")) == (0, 1)
    info = info_of(triaxcal, out)
    assert "unconfirmed" not in info["raw"]["calibration"]
    assert [e["kind"] for e in info["events"]] == ["recording_started", "identity_unanswered", "ended"]


class Changing:
    """In the place of the operator: another unit is put in at ``moment`` of the unit of that name."""

    def __init__(self, unit: str, moment: Callable[[str, str, int], bool], change: Callable[[], None]) -> None:
        self._unit, self._moment, self._change = unit, moment, change

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def note(self, unit: str, text: str) -> None:
        self._at(unit, text, 0)

    def lost(self, unit: str, code: object, trouble: str) -> None: ...

    def poses(self, unit: str, phase: str, guide: Any) -> None:
        self._at(unit, phase, guide.found)

    def _at(self, unit: str, what: str, found: int) -> None:
        if unit == self._unit and self._moment(unit, what, found):
            self._change()


MOMENTS: Mapping[str, Callable[[str, str, int], bool]] = {
    "among the poses": lambda _, what, found: what == "calibration" and found >= 5,
    "at the last pose": lambda _, what, found: what == "calibration" and found >= 12,
    "while it is fitted": lambda _, what, found: what == "fitting",
    "among the check poses": lambda _, what, found: what == "verification",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["modbus", "can"])
@pytest.mark.parametrize("moment", MOMENTS)
async def test_the_run_of_a_unit_that_was_exchanged_is_aborted_and_the_others_go_on(
    workshop: Any, moment: str, kind: str, request: pytest.FixtureRequest
) -> None:
    quick = {"speed": 60.0, "fixture": {"poses": 12, "hold_s": 1.4, "move_s": 0.6}}
    places = []
    with ExitStack() as stack:
        served = []
        for i in range(2):
            on_can = {"interface": "virtual", "channel": f"{request.node.name}-{i}", "node_id": 5}
            device = {"profile": "triax-ref-can", "bus": on_can} if kind == "can" else {}
            path = workshop.device(f"device{i}.toml", serial=777 + 111 * i, **device, **quick)
            served.append(stack.enter_context(workshop.serve(path)))
            places.append({"bus": served[i].bus, "profile": f"triax-ref-{kind}"})
        plan = {"poses": 12, "hold_s": 0.6, "check_poses": 2, "comes_back_s": 0.5}
        station = load_station(workshop.station(*places, plan=plan))
        ours = served[0].unit.eeprom
        told = Changing("unit0", MOMENTS[moment], lambda: setattr(served[0].unit, "serial_number", 999))
        outcome, other = await TrayRun(station, told)
    assert other.error is None
    assert (outcome.exit_code, outcome.document["verdict"]) == (4, "aborted")
    assert "0999" in str(outcome.error)
    recording = outcome.recording
    assert recording is not None
    if moment == "among the check poses":
        assert outcome.document["measured"] is not None, "its poses were confirmed before it was written"
    else:
        assert served[0].unit.eeprom == ours, "nothing was written"
        assert outcome.document["device_state"] == "untouched"
    with Recording.open(recording) as held:
        phases = {phase for phase, batch in held.joined_batches() if batch.unconfirmed}
        events = [e.kind for e in held.events()]
    expected = {"among the poses": {"calibration"}, "among the check poses": {"verification"}}
    if moment == "while it is fitted":
        assert phases == set(), "the poses were the right unit's"
    elif moment in expected:
        assert phases == expected[moment]
        assert outcome.certificate is None
    assert (UNCONFIRMED in events) == bool(phases)
    assert audit(recording).differences == ()


@pytest.mark.slow
async def test_a_stop_asks_once_more_and_says_which_unit_was_exchanged(workshop: Any) -> None:
    told, places = Told(), []
    with ExitStack() as stack:
        served = [
            stack.enter_context(workshop.serve(workshop.device(f"device{i}.toml", serial=777 + i, speed=1.0)))
            for i in range(2)
        ]
        places = [{"bus": one.bus, "profile": "triax-ref-modbus"} for one in served]
        station = load_station(workshop.station(*places))
        work = recorded(station, workshop.folder, told, seconds=None, policy=RetryPolicy())
        for name in ("unit0", "unit1"):
            await told.until(name, lambda text: text == "recording")
        await asyncio.sleep(1.0)
        served[0].unit.serial_number = 999
        work.cancel()
        exchanged, other = await work
    assert (exchanged.exit_code, other.exit_code) == (4, 130)
    assert "0999" in exchanged.error
    assert exchanged.unconfirmed > 0
    assert exchanged.counts["samples"] == 0, "it was confirmed when it was opened, and not since"
    assert (other.unconfirmed, other.counts["samples"] > 0) == (0, True)
    for kept, reason in ((exchanged, "unit gave up"), (other, "signal")):
        with Recording.open(kept.path) as held:
            assert [e.detail["reason"] for e in held.events() if e.kind == "ended"] == [reason]
