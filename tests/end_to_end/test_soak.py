"""The soak's own account can fail: it finds what is lost in silence, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.soak.account import Account, account, manifest_faults, replayed
from benchmarks.soak.bench import units_of
from benchmarks.soak.faults import QUIET_S, schedule
from benchmarks.soak.units import SENT, WhiteNoise, rows
from triaxcal_drivers.catalogue import load_bundle
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcal_drivers.profile import READINGS
from triaxcald.inputs import CALIBRATION, PROFILE
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.simulation.can_unit import tpdos
from triaxcald.simulation.unit import ReferenceUnit

NODE, SAMPLES, PERIOD_NS = 3, 1000, 10_000_000
COUNTED = 1 << 16  # samples until the unit's counter begins anew
Batches = list[RawBatch]


def of_unit(samples: int, batch: int) -> tuple[np.ndarray, Batches]:
    """What a unit sends, and the same as it comes off the bus: ten milliseconds a sample, four frames each."""
    unit = ReferenceUnit(WhiteNoise(seed=1), serial_number=1)
    run = unit.advance((samples - 1) * PERIOD_NS / 1e9)
    sent = np.concatenate([rows(run, 0, 0.0)])
    sent["time_ns"] = np.arange(samples) * PERIOD_NS
    frames = list(zip(*tpdos(run), strict=True))
    records = [
        (i * PERIOD_NS, 0x180 + 0x100 * number + NODE, 0, data)
        for i, sample in enumerate(frames)
        for number, data in enumerate(sample)
    ]
    size = 4 * batch
    return sent, [RawBatch.of(records[at : at + size]) for at in range(0, len(records), size)]


def recorded(folder: Path, recorders: Sequence[Sequence[RawBatch]]) -> Path:
    """One after the other, each in a segment of its own."""
    bundle = load_bundle(Path("triax-ref-can"))
    for batches in recorders:
        with SegmentedWriter(folder / "unit.mcap", metadata={}, waits=True) as writer:
            writer.attach(PROFILE, "application/toml", bundle.text)
            for name, data in bundle.files.items():
                writer.attach(f"profile/{name}", "application/octet-stream", data)
            for batch in batches:
                writer.raw(CALIBRATION, batch)
    return folder / "unit.segments.json"


Judge = Callable[..., Account]


@pytest.fixture
def judge(tmp_path: Path) -> Judge:
    def judged(sent: np.ndarray, *recorders: Sequence[RawBatch]) -> Account:
        manifest = recorded(tmp_path, recorders)
        assert manifest_faults(manifest) == []
        return account(sent, READINGS, replayed(manifest, NODE), [], int(sent["time_ns"][-1]))

    return judged


def test_what_is_there_is_there(judge: Judge) -> None:
    sent, batches = of_unit(SAMPLES, 10)
    assert sent.dtype == SENT
    made = judge(sent, batches)
    assert (made.sent, made.recorded, made.silent, made.foreign, made.astray) == (SAMPLES, SAMPLES, 0, 0, 0)


def test_what_the_units_count_tells_of_is_not_lost_in_silence(judge: Judge) -> None:
    sent, batches = of_unit(SAMPLES, 10)
    made = judge(sent, batches[:40] + batches[43:])
    assert (made.recorded, made.lost["count"], made.silent, made.miscounted) == (SAMPLES - 30, 30, 0, 0)


def a_turn_of_the_count() -> tuple[np.ndarray, Batches, RawBatch]:
    """Of which a whole turn is not among the batches; the one after it, apart."""
    sent, batches = of_unit(COUNTED + 2048, 256)
    after = 4 + COUNTED // 256
    return sent, batches[:4] + batches[after + 1 :], batches[after]


def test_a_whole_turn_of_the_count_that_nothing_tells_of_is_found(judge: Judge) -> None:
    sent, batches, after = a_turn_of_the_count()
    made = judge(sent, [*batches[:4], after, *batches[4:]])
    assert (made.recorded, made.silent) == (2048, COUNTED)
    assert "65536 of 65536 after count 1023, before 1024" in made.remarks[0]


def test_it_is_told_of_by_the_mark_of_a_gap(judge: Judge) -> None:
    sent, batches, after = a_turn_of_the_count()
    marked = after.after(Gap(0, int(after.time_ns[0]), "away"))
    made = judge(sent, [*batches[:4], marked, *batches[4:]])
    assert (made.lost["gaps"], made.silent) == (COUNTED, 0)


def test_samples_that_are_missing_at_the_end_are_found(judge: Judge) -> None:
    sent, batches = of_unit(SAMPLES, 10)
    made = judge(sent, batches[:-30])
    assert (made.recorded, made.silent, made.after) == (SAMPLES - 300, 49, 251)


def test_a_sample_that_is_not_the_units_is_found(judge: Judge) -> None:
    sent, batches = of_unit(SAMPLES, 10)
    sent["readings"][500] += 1
    made = judge(sent, batches)
    assert (made.foreign, made.recorded) == (1, SAMPLES - 1)


def test_a_seed_gives_the_same_faults_each_time() -> None:
    units = units_of(on_can=4)
    faults = schedule(7, 600.0, units)
    assert faults == schedule(7, 600.0, units)
    assert faults != schedule(8, 600.0, units)
    assert "recorder killed" in {fault.what for fault in faults}
    assert all(fault.at_s + fault.seconds <= 601.0 - QUIET_S for fault in faults)
