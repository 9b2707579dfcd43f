"""A recorder decodes together what came in a second, and tells the same as one that decodes at once."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from triaxcal_drivers.catalogue import load_bundle
from triaxcal_drivers.errors import DeviceRestarted, DeviceSilent
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import CALIBRATION
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import PREVIEWS
from triaxcald.recording.writer import RecordingWriter
from triaxcald.simulation.can_unit import tpdos
from triaxcald.simulation.unit import ConstantPhysics, ReferenceUnit
from triaxcald.station.collection import DECODE_S, Recorded

IDENTIFIERS = (0x185, 0x285, 0x385, 0x485)
BATCH_S = 0.1


@dataclass
class Unit:
    """Sends batches of a tenth of a second; at the times given there is a mark of a loss, an interruption, a new start,
    an end."""

    ends_s: float = 100.0
    loses_s: float = -1.0
    interrupted_s: float = -1.0
    restarts_s: float = -1.0
    silent_s: float = float("inf")
    pace: float = 1.0
    now_s: float = 0.0
    complaints: list[tuple[float, Exception]] = field(default_factory=list)

    def clock_s(self) -> float:
        return self.now_s

    def complain(self, trouble: Exception) -> None:
        self.complaints.append((self.now_s, trouble))

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        unit, begun_s = ReferenceUnit(ConstantPhysics(), serial_number=1), 0.0
        while self.now_s < self.ends_s - 1e-9:
            self.now_s = round(self.now_s + BATCH_S, 6)
            host_ns = round(1e9 + self.now_s * 1e9)
            if self.now_s == self.interrupted_s:
                yield RawBatch.of([]).after(Gap(host_ns, None, "the link is down"))
            if self.now_s == self.restarts_s:
                unit, begun_s = ReferenceUnit(ConstantPhysics(), serial_number=1), self.now_s - BATCH_S
            records = [
                (host_ns, identifier, 0, data)
                for frames in zip(*tpdos(unit.advance(self.pace * (self.now_s - begun_s))), strict=True)
                for identifier, data in zip(IDENTIFIERS, frames, strict=True)
                if self.now_s < self.silent_s or identifier not in IDENTIFIERS[:2]
            ]
            batch = RawBatch.of(records)
            yield batch.after(Gap(host_ns, host_ns, "lost", 7)) if self.now_s == self.loses_s else batch


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return load_bundle(Path("triax-ref-can"))


async def recorded(bundle: Bundle, unit: Unit, path: Path, seconds: float | None = None) -> Recorded:
    work = Recorded(CALIBRATION, bundle, "node 5")
    with RecordingWriter(path, metadata={}, preview_channels=["temp_c", "status"]) as writer:
        await work.for_seconds(cast(Any, unit), writer, seconds, unit.clock_s)
    return work


@pytest.mark.parametrize(
    "unit", [Unit(ends_s=5.05), Unit(ends_s=0.1), Unit(ends_s=5.0, loses_s=2.4), Unit(ends_s=5.0, interrupted_s=3.3)]
)
async def test_all_that_was_recorded_is_decoded_in_the_end(bundle: Bundle, unit: Unit, tmp_path: Path) -> None:
    work = await recorded(bundle, unit, tmp_path / "rec.mcap")
    with Recording.open(tmp_path / "rec.mcap") as recording:
        previews = {topic: len(list(recording.messages(topic))) for topic in PREVIEWS}
        batches = list(recording.raw(CALIBRATION))
    for stream in (READINGS, CORRECTED):
        at_once = DecodedStream(bundle, stream)
        blocks = [at_once.feed(batch) for batch in batches]
        assert work.streams[stream].counts == at_once.counts
        assert work.streams[stream].seconds == at_once.seconds
        assert at_once.counts["samples"] > 0
    marks = sum(int(np.count_nonzero(batch.flags & RawFlag.LOST_BEFORE)) for batch in batches)
    assert work.streams[READINGS].counts["receiver_overflows"] == marks == (unit.loses_s > 0)
    assert work.latest["temp_c"] == [b for b in blocks if len(b)][-1].channels["temp_c"][-1]
    assert previews[PREVIEWS[0]] == previews[PREVIEWS[1]] == pytest.approx(20 * unit.ends_s, abs=2)


@pytest.mark.parametrize("pace", [0.95, 1.0, 1.05, 20.0])
@pytest.mark.parametrize("seconds", [0.05, 0.95, 7.25])
async def test_it_ends_with_the_batch_in_which_the_seconds_are_over(
    bundle: Bundle, pace: float, seconds: float, tmp_path: Path
) -> None:
    """Though it is decoded seldom before; by the unit's own time, not the host's."""
    work = await recorded(bundle, Unit(pace=pace), tmp_path / "rec.mcap", seconds)
    over_s = work.streams[READINGS].seconds - seconds
    assert 0.0 <= over_s <= 2 * pace * BATCH_S


async def test_records_are_decoded_once_a_second(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed, fed = DecodedStream.feed, []

    def counted(self: DecodedStream, batch: RawBatch) -> Any:
        fed.append(len(batch))
        return feed(self, batch)

    monkeypatch.setattr(DecodedStream, "feed", counted)
    await recorded(bundle, Unit(ends_s=20.0), tmp_path / "rec.mcap")
    assert len(fed) / 2 == pytest.approx(20.0 / DECODE_S, abs=2)


async def test_a_restart_is_told_within_a_second(bundle: Bundle, tmp_path: Path) -> None:
    unit = Unit(ends_s=10.0, restarts_s=5.5)
    await recorded(bundle, unit, tmp_path / "rec.mcap")
    (at_s, trouble), *_ = unit.complaints
    assert isinstance(trouble, DeviceRestarted)
    assert 5.5 <= at_s <= 5.5 + DECODE_S


async def test_a_stream_that_stops_is_told_in_its_time(bundle: Bundle, tmp_path: Path) -> None:
    unit = Unit(ends_s=20.0, silent_s=5.5)
    await recorded(bundle, unit, tmp_path / "rec.mcap")
    (at_s, trouble), *_ = unit.complaints
    timeout_s = 2 * bundle.profile.sampling.silence_timeout_s
    assert isinstance(trouble, DeviceSilent)
    assert timeout_s <= at_s - 5.5 <= timeout_s + 2 * DECODE_S
