"""All frames of a bus, of no unit."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcald.recording import schema
from triaxcald.recording.bus import Channel, bus_frames, bus_record, channel_of, frame_rows, phase_of
from triaxcald.recording.info import describe
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import recover
from triaxcald.recording.writer import RecordingWriter

T0_NS = 1_700_000_000_000_000_000
REMOTE, ERROR, FD = RawFlag.REMOTE, RawFlag.ERROR, RawFlag.FD
CHASSIS = RawBatch.of(
    [
        (T0_NS, 0x123, 0, b"\x01\x02"),
        (T0_NS + 1_000, 0x123, RawFlag.EXTENDED_ID, b"\x03"),
        (T0_NS + 2_000, 0x124, REMOTE, bytes(4)),
        (T0_NS + 3_000, 0x20, ERROR, bytes(8)),
        (T0_NS + 4_000, 0x125, FD | REMOTE | RawFlag.BIT_RATE_SWITCH | RawFlag.SENT, bytes(64)),
    ]
)
ENGINE = RawBatch.of([(T0_NS + 2_500_000_000, 0x7FF, RawFlag.LOST_BEFORE, b"")])


@pytest.fixture
def bus_recording(tmp_path: Path) -> Path:
    path = tmp_path / "bus.mcap"
    metadata = {"station": {"name": "bench"}, schema.BUS_RECORD: bus_record("socketcan", bitrate="500000")}
    with RecordingWriter(path, metadata=metadata, preview_channels=None, clock_ns=lambda: T0_NS) as writer:
        writer.raw(phase_of("chassis"), CHASSIS)
        writer.raw(phase_of(1), ENGINE)
        writer.raw(phase_of("chassis"), CHASSIS)
    return path


def test_a_bus_recording_has_a_phase_for_each_channel_and_neither_unit_nor_previews(bus_recording: Path) -> None:
    with open(bus_recording, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {c.topic for c in summary.channels.values()} == {"/raw", "/registers", "/events", "/loss"}
    with Recording.open(bus_recording) as recording:
        assert recording.metadata["bus"] == {"interface": "socketcan", "bitrate": "500000"}
        assert "unit" not in recording.metadata
        assert recording.phases() == ["bus/chassis", "bus/1"]


def test_its_frames_come_by_channel_in_the_order_of_the_file(bus_recording: Path) -> None:
    with Recording.open(bus_recording) as recording:
        found = list(bus_frames(recording))
    assert [channel for channel, _ in found] == ["chassis", 1, "chassis"]
    batch = found[0][1]
    assert batch.time_ns.tolist() == CHASSIS.time_ns.tolist()
    assert batch.flags.tolist() == CHASSIS.flags.tolist()
    assert batch.payload == CHASSIS.payload


def test_its_frames_come_one_by_one_for_whoever_imports_them(bus_recording: Path) -> None:
    with Recording.open(bus_recording) as recording:
        rows = list(frame_rows(recording))
    assert rows[:3] == [
        (T0_NS, 0x123, 0, b"\x01\x02", "chassis"),
        (T0_NS + 1_000, 0x123, RawFlag.EXTENDED_ID, b"\x03", "chassis"),
        (T0_NS + 2_000, 0x124, REMOTE, bytes(4), "chassis"),
    ]
    assert rows[5] == (T0_NS + 2_500_000_000, 0x7FF, RawFlag.LOST_BEFORE, b"", "1")


@pytest.mark.parametrize(
    ("channel", "phase"),
    [(None, "bus/"), (0, "bus/0"), (-1, "bus/-1"), ("vcan0", "bus/vcan0"), ("0", 'bus/"0"'), ("", 'bus/""'),
     ('"0"', 'bus/"\\"0\\""'), ("a b", "bus/a b")],
)  # fmt: skip
def test_a_channel_is_told_apart_by_its_phase(channel: Channel, phase: str) -> None:
    assert phase_of(channel) == phase
    assert channel_of(phase) == channel


def test_info_of_a_long_bus_recording_reads_no_frame(bus_recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted = describe(bus_recording)
    monkeypatch.setattr("triaxcald.recording.info.COUNTED_MOST", 5)
    monkeypatch.setattr(Recording, "joined_batches", lambda _: pytest.fail("it reads frames"))
    found = describe(bus_recording)
    assert (found["counted"], found["raw"], found["bus"]["lost"]) == (False, counted["raw"], counted["bus"]["lost"])
    for name, channel in found["bus"]["channels"].items():
        of = counted["bus"]["channels"][name]
        assert channel == {
            "records": of["frames"] + of["errors"], **{key: of[key] for key in ("start_ns", "end_ns", "duration_s")}
        }  # fmt: skip
    assert set(found["bus"]["channels"]) == {"chassis", "1"}


def test_info_says_what_came_on_which_channel(bus_recording: Path, triaxcal: Callable[..., Any]) -> None:
    done = triaxcal("log", "info", bus_recording, "--json")
    assert done.code == 0
    assert done.json["bus"] == {
        "interface": "socketcan",
        "bitrate": "500000",
        "channels": {
            "chassis": {
                "frames": 8, "remote": 2, "errors": 2, "sent": 2, "gaps": 0, "identifiers": 4,
                "start_ns": T0_NS, "end_ns": T0_NS + 4_000, "duration_s": 4e-6,
            },
            "1": {
                "frames": 1, "remote": 0, "errors": 0, "sent": 0, "gaps": 1, "identifiers": 1,
                "start_ns": T0_NS + 2_500_000_000, "end_ns": T0_NS + 2_500_000_000, "duration_s": 0.0,
            },
        },
        "lost": 0,
    }  # fmt: skip
    assert "    identifiers: 4\n" in triaxcal("log", "info", bus_recording).out


@pytest.mark.parametrize(
    "command", [("poses",), ("fit",), ("diagnose",), ("plan",), ("audit",), ("log", "export")], ids=" ".join
)
def test_what_needs_a_unit_names_the_command_that_makes_one_of_it(
    bus_recording: Path, triaxcal: Callable[..., Any], command: tuple[str, ...]
) -> None:
    done = triaxcal(*command, bus_recording)
    assert (done.code, done.out) == (2, "")
    said = f"{bus_recording}: all frames of a bus, of no unit; 'triaxcal log import {bus_recording} --profile P -o "
    assert said in done.err
    assert done.err.count("\n") == 1


def test_a_bus_recording_is_mended_like_any_other(bus_recording: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(bus_recording.read_bytes()[:-200])
    recovery = recover(tmp_path / "cut.mcap", tmp_path / "mended.mcap")
    assert (recovery.raw_records, recovery.raw_missing) == (11, 0)
    with Recording.open(tmp_path / "mended.mcap") as recording:
        assert recording.metadata["bus"]["interface"] == "socketcan"
        assert recording.phases() == ["bus/chassis", "bus/1"]


def test_one_that_is_packed_is_to_be_unpacked_for_an_import(bus_recording: Path, triaxcal: Callable[..., Any]) -> None:
    packed = bus_recording.with_suffix(".mcap.gz")
    packed.write_bytes(gzip.compress(bus_recording.read_bytes()))
    done = triaxcal("log", "import", packed, "--profile", "triax-ref-can", "-o", bus_recording.with_name("unit.mcap"))
    done.failed(2, f"{packed}: a recording of triaxcal, packed with gzip; unpack it first")
