"""A device that goes on sending one stream and stops another keeps nobody waiting for ever."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from triaxcal_drivers.catalogue import driver_named, load_bundle
from triaxcal_drivers.errors import DeviceRestarted, DeviceSilent
from triaxcal_drivers.host_clock import SteadyClock
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcald.errors import TwoAnswer
from triaxcald.inputs import CALIBRATION, VERIFICATION
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.simulation.can_unit import CanUnit, tpdos
from triaxcald.simulation.modbus_unit import ModbusUnit
from triaxcald.simulation.time_base import SteppedTimeBase
from triaxcald.simulation.unit import ConstantPhysics, ReferenceUnit
from triaxcald.station.collection import Collection, Recorded, _Watch
from triaxcald.station.config import Plan
from triaxcald.station.listening import OVERRUN

Run = Callable[..., Any]
STOP_S, END_S, BATCH_S = 5.0, 60.0, 0.1
OF_READINGS, OF_CORRECTED = (0x185, 0x285), (0x385, 0x485)


@dataclass
class Bus:
    """A Device that sends a still unit's frames as fast as they are taken; from 5 s on not those of ``stopped``.

    They come back at ``again_s``. Its own time is the host's. Before the first
    batch ``discarding_s`` go by. At ``interrupted_s`` an interruption begins. At
    ``restarts_s`` the unit begins anew, without a word.
    """

    stopped: Sequence[int]
    again_s: float = float("inf")
    now_s: float = 0.0
    discarding_s: float = 0.0
    interrupted_s: float = float("inf")
    restarts_s: float = float("inf")

    def clock_s(self) -> float:
        return self.now_s

    def complain(self, trouble: Exception) -> None:
        raise trouble

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        assert list(names) == [READINGS, CORRECTED]
        unit, begun_s = ReferenceUnit(ConstantPhysics(), serial_number=1), 0.0
        self.now_s += self.discarding_s
        while self.now_s < END_S:
            self.now_s += BATCH_S
            if self.now_s >= self.interrupted_s:
                self.interrupted_s = float("inf")
                yield RawBatch.of([]).after(Gap(round(self.now_s * 1e9), None, "the link is down"))
            if self.now_s >= self.restarts_s + BATCH_S:
                unit, begun_s, self.restarts_s = (
                    ReferenceUnit(ConstantPhysics(), serial_number=1),
                    self.restarts_s,
                    float("inf"),
                )
            silent = self.stopped if STOP_S <= self.now_s < self.again_s else ()
            records = []
            for frames in zip(*tpdos(unit.advance(self.now_s - begun_s)), strict=True):
                for identifier, data in zip((*OF_READINGS, *OF_CORRECTED), frames, strict=True):
                    if identifier not in silent:
                        records.append((round(self.now_s * 1e9), identifier, 0, data))
            yield RawBatch.of(records)
        pytest.fail("nobody has noticed that the stream has stopped")


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return load_bundle(Path("triax-ref-can"))


@pytest.fixture
def timeout_s(bundle: Bundle) -> float:
    return 2 * bundle.profile.sampling.silence_timeout_s


async def _until_posed(bundle: Bundle, bus: Any, stream: str) -> None:
    collection = Collection(VERIFICATION if stream == CORRECTED else CALIBRATION, bundle, "node 5")
    await collection.until_posed(
        bus,
        None,
        Plan(),
        stream=stream,
        wanted=9,
        nominal_scale_factor=(1, 1, 1),
        tell=lambda guide: None,
        clock_s=bus.clock_s,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stream", "stopped"),
    [(CORRECTED, OF_CORRECTED), (CORRECTED, (0x485,)), (READINGS, OF_READINGS), (READINGS, (0x185,))],
)
async def test_a_stream_that_stops_while_another_goes_on_is_silence(
    bundle: Bundle, timeout_s: float, stream: str, stopped: tuple[int, ...]
) -> None:
    """Also where only one of the messages that make a sample is missing."""
    bus = Bus(stopped)
    with pytest.raises(DeviceSilent, match=f"^node 5: stream {stream}: the device sends, but no whole sample") as told:
        await _until_posed(bundle, bus, stream)
    assert ("that lack a message" in str(told.value)) == (len(stopped) == 1)
    assert timeout_s <= bus.now_s - STOP_S < timeout_s + 3 * BATCH_S


async def test_a_unit_that_restarts_in_between_is_opened_again(bundle: Bundle, tmp_path: Path) -> None:
    """Its start sequence is gone, and it may be another unit."""
    device: Any = Bus((), restarts_s=STOP_S)
    with (
        RecordingWriter(tmp_path / "rec.mcap", metadata={}, preview_channels=["temp_c", "status"]) as writer,
        pytest.raises(DeviceRestarted, match=r"^node 5: stream readings: it has started anew$"),
    ):
        await Collection(CALIBRATION, bundle, "node 5").for_seconds(device, writer, 50.0, device.clock_s)
    assert device.now_s == pytest.approx(STOP_S + BATCH_S, abs=BATCH_S)


@pytest.mark.parametrize("seconds", [None, 50.0])
async def test_recording_ends_with_the_readings_and_not_with_the_corrected_output(
    bundle: Bundle, timeout_s: float, tmp_path: Path, seconds: float | None
) -> None:
    bus = Bus(OF_READINGS)
    device: Any = bus
    with RecordingWriter(tmp_path / "rec.mcap", metadata={}, preview_channels=["temp_c", "status"]) as writer:
        with pytest.raises(DeviceSilent, match="node 5: stream readings: "):
            await Collection(CALIBRATION, bundle, "node 5").for_seconds(device, writer, seconds, bus.clock_s)
        assert timeout_s <= bus.now_s - STOP_S < timeout_s + 3 * BATCH_S


@pytest.mark.slow
async def test_a_pause_shorter_than_the_time_out_ends_nothing(bundle: Bundle, timeout_s: float, tmp_path: Path) -> None:
    bus = Bus(OF_READINGS, again_s=STOP_S + timeout_s - 2 * BATCH_S)
    device: Any = bus
    collection = Collection(CALIBRATION, bundle, "node 5")
    with RecordingWriter(tmp_path / "rec.mcap", metadata={}, preview_channels=["temp_c", "status"]) as writer:
        await collection.for_seconds(device, writer, 20.0, bus.clock_s)
    assert 20.0 <= collection.pipelines[READINGS].seconds < 20.0 + 2 * BATCH_S
    assert collection.pipelines[READINGS].counts["missing"] > 0


async def test_after_an_interruption_a_stream_has_its_whole_time_to_bring_a_sample(
    bundle: Bundle, timeout_s: float, tmp_path: Path
) -> None:
    """It was nearly over when the device was lost."""
    lost_s = STOP_S + timeout_s - 2 * BATCH_S
    bus = Bus(OF_READINGS, again_s=lost_s + timeout_s - 2 * BATCH_S, interrupted_s=lost_s)
    device: Any = bus
    collection = Collection(CALIBRATION, bundle, "node 5")
    with RecordingWriter(tmp_path / "rec.mcap", metadata={}, preview_channels=["temp_c", "status"]) as writer:
        await collection.for_seconds(device, writer, 20.0, bus.clock_s)
    assert collection.pipelines[READINGS].seconds >= 20.0


async def test_the_time_that_a_driver_spends_on_discarding_is_no_silence(
    bundle: Bundle, timeout_s: float, tmp_path: Path
) -> None:
    """Though the first batch holds another stream's samples alone."""
    discarding_s = STOP_S + 2 * timeout_s
    bus = Bus(OF_READINGS, again_s=discarding_s + 5 * BATCH_S, discarding_s=discarding_s)
    device: Any = bus
    collection = Collection(CALIBRATION, bundle, "node 5")
    with RecordingWriter(tmp_path / "rec.mcap", metadata={}, preview_channels=["temp_c", "status"]) as writer:
        await collection.for_seconds(device, writer, 2.0, bus.clock_s)
    assert collection.pipelines[READINGS].seconds >= 2.0


async def test_samples_from_before_the_start_are_no_part_of_the_recording(tmp_path: Path) -> None:
    """Forty seconds of them are in the unit's FIFO when it is begun: as many poses as a run asks for."""
    modbus, time_base = load_bundle(Path("triax-ref-modbus")), SteppedTimeBase()
    driver, path = driver_named("modbus"), tmp_path / "rec.mcap"
    collection = Collection(CALIBRATION, modbus, "the bench")
    async with ModbusUnit(ReferenceUnit(ConstantPhysics(), serial_number=1), time_base) as served:
        device = driver.device(modbus, served.bus)
        await device.open()
        await time_base.advance(40.0)
        with RecordingWriter(path, metadata={}, preview_channels=["temp_c"]) as writer:
            recording = asyncio.create_task(collection.for_seconds(device, writer, 1.0))
            while not recording.done():
                await asyncio.sleep(0.01)
                if device.discarded > 4000:  # what was there before has been read
                    await time_base.advance(0.5)
            await recording
        await device.close()
    with Recording.open(path) as held:
        decode = driver.decoder(modbus, READINGS)
        counters = [int(n) for batch in held.raw(CALIBRATION) for n in decode.feed(batch).counter]
    assert counters[0] == 4001
    assert len(counters) == collection.pipelines[READINGS].counts["samples"]


@pytest.mark.slow
def test_record_of_so_many_seconds_ends_where_the_readings_stop(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, sent = CanUnit._send, []

    def send_corrected(self: CanUnit, identifier: int, data: bytes) -> None:
        sent.append(identifier)
        if not (len(sent) > 2000 and identifier in OF_READINGS):
            send(self, identifier, data)

    monkeypatch.setattr(CanUnit, "_send", send_corrected)
    bus = {"interface": "virtual", "channel": f"half-silent-{id(sent)}", "node_id": 5}
    path = workshop.folder / "rec.mcap"
    with workshop.serve(workshop.device(profile="triax-ref-can", bus=bus)):
        station = workshop.station({"bus": bus, "profile": workshop.impatient_profile("triax-ref-can")})
        done = triaxcal("record", station, "-o", path, "--seconds", "600", "--give-up-after", "0")
    done.failed(4, "node_id=5: stream readings: the device sends, but no whole sample of it for 1 s")
    assert triaxcal("log", "info", path, "--json").json["finished"] is True


@dataclass
class Lossy:
    """A device that sends one frame a batch, with the gaps that it is given; the host's clock steps at the third."""

    gaps: Sequence[Gap | None]
    step_ns: int = 0

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        for number, gap in enumerate(self.gaps):
            batch = RawBatch.of([(number * 10**9, 0x185, 0, bytes(8))] if gap is None or gap.to_ns else [])
            self.step_ns = 3600 * 10**9 if number > 1 else 0
            yield batch if gap is None else batch.after(gap)


async def events_of(
    bundle: Bundle, path: Path, device: Lossy, writer_of: type[RecordingWriter] = RecordingWriter
) -> tuple[Recorded, list[tuple[str, Any]]]:
    clock = SteadyClock(lambda: device.step_ns, lambda: 0)
    recorded = Recorded(CALIBRATION, bundle, "node 5", clock=clock)
    with writer_of(path, metadata={}, preview_channels=["temp_c", "status"]) as writer:
        async for _ in recorded.records(device, writer):
            pass
    with Recording.open(path) as recording:
        assert recording.raw_digest().hexdigest() == recorded.digest.hexdigest()
        return recorded, [(e.kind, e.detail) for e in recording.events() if e.kind != "recording_started"]


async def test_gaps_are_events_and_their_time_is_summed(bundle: Bundle, tmp_path: Path) -> None:
    gaps = [None, Gap(0, None, "the link is down"), Gap(0, 3 * 10**9, "the link is down"), Gap(1, 2, "an overflow", 9)]
    recorded, events = await events_of(bundle, tmp_path / "rec.mcap", Lossy(gaps))
    assert [event for event in events if event[0] != "clock_step"] == [
        ("interrupted", {"from_ns": 0, "cause": "the link is down"}),
        ("gap", {"from_ns": 0, "to_ns": 3 * 10**9, "cause": "the link is down", "lost": None}),
        ("gap", {"from_ns": 1, "to_ns": 2, "cause": "an overflow", "lost": 9}),
    ]
    assert recorded.gaps_s == pytest.approx(3.0)
    assert recorded.streams[READINGS].counts["receiver_overflows"] == 2


async def test_a_step_of_the_hosts_clock_is_an_event(bundle: Bundle, tmp_path: Path) -> None:
    _, events = await events_of(bundle, tmp_path / "rec.mcap", Lossy([None] * 5))
    assert events == [("clock_step", {"by_s": 3600.0})]


async def test_what_the_disk_has_no_room_for_is_a_gap_before_the_next_records(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, raw = iter([True, False, False, True, True]), RecordingWriter.raw
    monkeypatch.setattr(RecordingWriter, "raw", lambda self, phase, batch: next(taken) and raw(self, phase, batch))
    recorded, events = await events_of(bundle, tmp_path / "rec.mcap", Lossy([None] * 5))
    assert events[1] == ("gap", {"from_ns": 10**9, "to_ns": 3 * 10**9, "cause": OVERRUN, "lost": 2})
    assert recorded.streams[READINGS].counts["receiver_overflows"] == 1


async def test_where_a_recording_goes_on_the_first_record_is_after_a_gap(bundle: Bundle, tmp_path: Path) -> None:
    class Later(RecordingWriter):
        resumes = Gap(-700 * 10**9, None, "nobody was there")

    recorded, events = await events_of(bundle, tmp_path / "rec.mcap", Lossy([None] * 2), Later)
    assert events == [("gap", {"from_ns": -700 * 10**9, "to_ns": 0, "cause": "nobody was there", "lost": None})]
    assert recorded.streams[READINGS].counts["receiver_overflows"] == 1
    assert (recorded.gaps, recorded.gaps_s) == (1, pytest.approx(700.0))


@pytest.mark.parametrize("held_up_s", [4.5, 3600.0])
def test_a_batch_without_a_sample_after_a_pause_of_ours_is_no_silence(held_up_s: float) -> None:
    """As of two streams polled in turn one comes first."""
    pipeline = SimpleNamespace(counts={"samples": 0})
    now_s = 0.0
    watch, device = _Watch(cast(Any, pipeline), "stream readings", 4.0, lambda: now_s), cast(Any, Bus(()))
    for _ in range(20):
        watch.look(device)
        now_s += held_up_s
        watch.look(device)
        pipeline.counts["samples"] += 1


@dataclass
class Mixed:
    """A node at which two units send side by side, one sample a batch; ``complaints`` are what was told of it."""

    units: int
    complaints: list[Exception] = field(default_factory=list)
    samples: int = 0

    def complain(self, trouble: Exception) -> None:
        self.complaints.append(trouble)

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        for i in range(500):
            for unit, first in zip(range(self.units), (50_000, 300), strict=False):
                self.samples += 1
                at_ns, counter = i * 10**7 + unit * 4 * 10**6, (first + i).to_bytes(2, "little")
                xy, z = bytes([unit, i % 5]) + bytes(4) + counter, bytes(5) + counter + bytes(1)
                yield RawBatch.of([(at_ns, 0x185, 0, xy), (at_ns + 1, 0x285, 0, z)])


async def test_two_units_at_one_node_are_told_and_not_opened_again_and_again(bundle: Bundle) -> None:
    device = Mixed(2)
    with pytest.raises(TwoAnswer, match=r"^two units answer at node 5: "):
        async for _ in Recorded(CALIBRATION, bundle, "node 5").records(device, None):
            pass
    assert device.samples < 300, "within a second or two"
    assert len(device.complaints) == 1


async def test_one_unit_at_a_node_is_not_two(bundle: Bundle) -> None:
    device = Mixed(1)
    async for _ in Recorded(CALIBRATION, bundle, "node 5").records(device, None):
        pass
    assert (device.samples, device.complaints) == (500, [])
