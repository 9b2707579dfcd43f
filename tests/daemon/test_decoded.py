"""The rate, the bursts and the constant outputs that a stream shows while it is recorded."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Workshop
from tests.virtual_line import OnModbus, described
from triaxcal_drivers.catalogue import load_bundle, parse_bundle
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import READINGS, Bundle
from triaxcald.decoded import DecodedStream, SampleRate
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.schema import cut

T0_NS = 1_700_000_000_000_000_000
BUNDLE = load_bundle(Path("triax-ref-can"))
UNCOUNTED = parse_bundle(BUNDLE.text.replace(b'counter = "Counter"', b'together = "time"'), BUNDLE.files, where="test")
KINDS = pytest.mark.parametrize("bundle", [BUNDLE, UNCOUNTED], ids=["counter", "no counter"])
Delivery = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def evenly(taken_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return taken_s + rng.uniform(0, 1e-3, len(taken_s))


def in_bursts(taken_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    burst = np.floor(taken_s / 0.25 + 1e-9).astype(int)
    at_s = (np.arange(burst[-1] + 1) + 1 + rng.uniform(-0.1, 0.1, burst[-1] + 1)) * 0.25
    return np.asarray(at_s[burst] + (np.arange(len(burst)) - np.searchsorted(burst, burst)) * 1e-3)


def frames(
    rate_hz: float,
    seed: int,
    delivery: Delivery = evenly,
    *,
    seconds: float = 30.0,
    lost: float = 0.0,
    away: tuple[float, float] | None = None,
    constant: int = 0,
) -> list[tuple[int, int, int, bytes]]:
    """Of a unit that really samples at ``rate_hz``: its two messages with the readings, in the order of their bytes
    in the DBC."""
    rng = np.random.default_rng(seed)
    taken = np.arange(int(seconds * rate_hz)) / rate_hz
    kept = rng.random(len(taken)) >= lost
    if away is not None:
        kept &= (taken < away[0]) | (taken > away[1])
    arrival = delivery(taken, rng)
    out = []
    for number in np.flatnonzero(kept).tolist():
        x, y, z = (0 if axis < constant else int(v) for axis, v in enumerate(rng.integers(-100, 100, 3) + 2_000_000))
        count = struct.pack("<H", number & 0xFFFF)
        at_ns = T0_NS + round(arrival[number] * 1e9)
        out.append(
            (at_ns, 0x185, 0, x.to_bytes(3, "little", signed=True) + y.to_bytes(3, "little", signed=True) + count)
        )
        out.append((at_ns + 1000, 0x285, 0, z.to_bytes(3, "little", signed=True) + bytes(2) + count + bytes(1)))
    return out


def names(stream: DecodedStream) -> list[str]:
    return [line.partition(":")[0] for line in stream.faults()]


@KINDS
@pytest.mark.parametrize("delivery", [evenly, in_bursts])
@pytest.mark.parametrize(
    ("rate_hz", "is_wrong"),
    [
        (100.0, False),
        (105.0, False),
        (95.0, False),
        (112.0, True),
        (88.0, True),
        (130.0, True),
        (70.0, True),
        (300.0, True),
    ],
)
def test_a_rate_that_is_off_by_more_than_a_tenth_is_told(
    bundle: Bundle, delivery: Delivery, rate_hz: float, is_wrong: bool
) -> None:
    for seed in range(3):
        stream = DecodedStream(bundle, READINGS)
        stream.feed(RawBatch.of(frames(rate_hz, seed, delivery)))
        assert ("rate" in names(stream)) == is_wrong
        if is_wrong:
            said = float(stream.wrong_rate().split()[0])
            assert said == pytest.approx(rate_hz, rel=0.02)


@KINDS
def test_lost_samples_and_interruptions_are_no_wrong_rate(bundle: Bundle) -> None:
    for seed in range(3):
        for records in (frames(100.0, seed, lost=0.25), frames(100.0, seed, away=(10.0, 22.0))):
            stream = DecodedStream(bundle, READINGS)
            stream.feed(RawBatch.of(records))
            assert stream.wrong_rate() == ""
    wrong = DecodedStream(bundle, READINGS)
    wrong.feed(RawBatch.of(frames(130.0, 3, away=(10.0, 22.0))))
    assert float(wrong.wrong_rate().split()[0]) == pytest.approx(130.0, rel=0.02)


@KINDS
@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_a_simulated_unit_that_is_faster_than_life_has_no_wrong_rate(bundle: Bundle, speed: float) -> None:
    stream = DecodedStream(bundle, READINGS)
    stream.feed(RawBatch.of(frames(100.0 * speed, 0, seconds=100.0 / speed)))
    assert stream.faults() == []


@KINDS
@pytest.mark.parametrize("size", [1, 7, 500])
def test_what_is_told_does_not_depend_on_how_the_records_are_cut(bundle: Bundle, size: int) -> None:
    records = frames(120.0, 1, in_bursts, seconds=20.0, lost=0.01)
    whole, pieces = DecodedStream(bundle, READINGS), DecodedStream(bundle, READINGS)
    whole.feed(RawBatch.of(records))
    for batch in cut(RawBatch.of(records), size):
        pieces.feed(batch)
    assert pieces.faults() == whole.faults()
    assert "rate" in names(whole)


def test_what_is_rolled_back_is_not_told() -> None:
    stream = DecodedStream(BUNDLE, READINGS)
    records = RawBatch.of(frames(100.0, 1, seconds=10.0))
    stream.feed(records.part(0, 1000))
    before, kept = stream.faults(), stream.checkpoint()
    later = RawBatch.of([(t + 60 * 10**9, *rest) for t, *rest in frames(50.0, 2)])
    stream.feed(later)
    assert stream.faults() != before
    stream.roll_back(kept)
    assert stream.faults() == before == []


@pytest.mark.parametrize("constant", [1, 2, 3])
def test_outputs_that_never_change_are_told_in_a_mere_recording_too(constant: int) -> None:
    stream = DecodedStream(BUNDLE, READINGS)
    stream.feed(RawBatch.of(frames(100.0, 1, constant=constant)))
    assert stream.faults() == ["stuck_output: " + "; ".join(f"{axis} never changes" for axis in "xyz"[:constant])]


def test_bursts_are_those_of_times_of_arrival() -> None:
    for bundle, expected in ((BUNDLE, []), (UNCOUNTED, ["bursts"])):
        records = RawBatch.of(frames(100.0, 1, in_bursts))
        stream, pipeline = DecodedStream(bundle, READINGS), Pipeline(bundle, READINGS)
        stream.feed(records)
        assert names(stream) == expected
        pipeline.feed(records)
        pipeline.close()
        assert pipeline.data_quality() == stream.faults(), "the same words before a fit as while it is recorded"


def test_a_stream_too_short_to_judge_has_no_wrong_rate() -> None:
    rate = SampleRate(100.0)
    time_ns = np.arange(40) * 20_000_000
    rate.received(time_ns)
    rate.decoded(np.arange(40), time_ns)
    assert rate.wrong_hz() is None


@KINDS
@pytest.mark.parametrize("seconds", [0.1, 0.9, 1.1, 2.3, 3.9, 4.2])
@pytest.mark.parametrize("delivery", [evenly, in_bursts])
def test_a_short_recording_is_judged_as_far_as_it_goes(bundle: Bundle, delivery: Delivery, seconds: float) -> None:
    stream = DecodedStream(bundle, READINGS)
    stream.feed(RawBatch.of(frames(100.0, 1, delivery, seconds=seconds)))
    assert set(names(stream)) <= {"bursts"}


@pytest.mark.parametrize("size", [1, 10_000])
def test_a_unit_that_dies_and_is_still_asked_has_no_wrong_rate(size: int, workshop: Workshop) -> None:
    bundle = load_bundle(Path("triax-ref-modbus"))
    device = OnModbus(described(workshop.device(speed=1.0)), bundle, None)
    records = []
    for _ in range(20):
        asyncio.run(device.time_base.advance(1.0))
        records += device.records([READINGS])
    _, source, _, empty = device.records([READINGS])[-1]
    assert not any(empty[:2]), "no samples"
    records += [(records[-1][0] + 500_000_000 * i, source, 0, empty) for i in range(1, 100)]
    stream = DecodedStream(bundle, READINGS)
    for batch in cut(RawBatch.of(records), size):
        stream.feed(batch)
    assert stream.counts["samples"] > 1900
    assert stream.faults() == []
