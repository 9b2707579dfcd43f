"""All frames of a bus, recorded for later: a unit's recording is made of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcald.recording.bus import bus_record, phase_of
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import BUS_RECORD
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.writer import RecordingWriter

BEGUN_NS = 1_700_000_000_000_000_000
GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
HEAD: dict[str, Any] = {"metadata": {BUS_RECORD: bus_record("socketcan", "can0")}, "preview_channels": None}


def recorded(writer: RecordingWriter) -> None:
    with writer, Recording.open(GOLDEN) as recording:
        for phase, batch in recording.raw_batches():
            if phase == "calibration":
                writer.raw(phase_of("can0"), batch)
                writer.drain()


def bus_in_one(folder: Path) -> Path:
    recorded(RecordingWriter(folder / "bus.mcap", **HEAD))
    return folder / "bus.mcap"


def bus_in_segments(folder: Path) -> Path:
    recorded(SegmentedWriter(folder / "bus.mcap", size_bytes=100_000, **HEAD))
    assert len(list(folder.glob("bus-*.mcap"))) > 1
    return folder / "bus.segments.json"


@pytest.mark.slow
@pytest.mark.parametrize("make", [bus_in_one, bus_in_segments])
def test_the_poses_are_those_of_the_unit_s_own_recording(
    tmp_path: Path, triaxcal: Callable[..., Any], make: Callable[[Path], Path]
) -> None:
    bus, unit = make(tmp_path), tmp_path / "unit.mcap"
    done = triaxcal("log", "import", bus, "--profile", "triax-ref-can", "-o", unit, "--json")
    assert done.code == 0, done.err
    assert (done.json["kind"], done.json["channels"], done.json["damaged"]) == ("triaxcal", ["can0"], 0)
    imported, own = (triaxcal("poses", path, "--json").json["poses"] for path in (unit, GOLDEN))
    assert imported == own


def test_a_loss_before_a_frame_of_somebody_else_is_before_the_unit_s_next(
    tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    """Frames of the unit may have been among those that were lost."""
    bus, unit = tmp_path / "bus.mcap", tmp_path / "unit.mcap"
    rows: list[tuple[int, int, int, bytes]] = []
    for counter in range(40):
        lost = RawFlag.LOST_BEFORE if counter == 20 else 0
        time_ns, number = BEGUN_NS + counter * 10_000_000, counter.to_bytes(2, "little")
        rows += [
            (time_ns, 0x7FF, lost, b""),
            (time_ns + 1, 0x185, 0, bytes(6) + number),
            (time_ns + 2, 0x285, 0, bytes(5) + number + bytes(1)),
        ]
    with RecordingWriter(bus, **HEAD) as writer:
        writer.raw(phase_of("can0"), RawBatch.of(rows))
    assert triaxcal("log", "import", bus, "--profile", "triax-ref-can", "-o", unit).code == 0
    with Recording.open(unit) as recording:
        (batch,) = recording.raw("calibration")
    lost_before = [i for i, flags in enumerate(batch.flags.tolist()) if flags & RawFlag.LOST_BEFORE]
    assert lost_before == [40]
    assert batch.source.tolist() == [0x185, 0x285] * 40


def test_a_unit_s_recording_is_not_imported_again(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    done = triaxcal("log", "import", GOLDEN, "--profile", "triax-ref-can", "-o", tmp_path / "unit.mcap")
    assert (done.code, done.out) == (2, "")
    assert f"{GOLDEN}: a recording of one unit already, expected one of all frames of a bus" in done.err
    assert not (tmp_path / "unit.mcap").exists()
