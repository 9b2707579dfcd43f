"""log import: what others recorded becomes a recording that every command takes."""

from __future__ import annotations

import errno
import gzip
import os
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from triaxcal_drivers.interface import RawFlag
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingFile

Run = Callable[..., Any]
NODE = 5
T0_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def messages(finished_run: Any) -> list[can.Message]:
    """The frames of a finished run's poses, between those of other devices."""
    made = []
    with Recording.open(finished_run.can) as recording:
        for batch in recording.raw("calibration"):
            ends = np.cumsum(batch.length.astype(int))
            for time_ns, source, end, length in zip(batch.time_ns, batch.source, ends, batch.length, strict=True):
                data = batch.payload[end - length : end]
                made.append(_message(int(time_ns), int(source), data))
                if len(made) % 10 == 1:
                    made.append(_message(int(time_ns), 0x700, b"\x05"))
    return made


def _message(time_ns: int, identifier: int, data: bytes, channel: int = 0) -> can.Message:
    return can.Message(
        timestamp=time_ns / 1e9, arbitration_id=identifier, is_extended_id=False, data=data, channel=channel
    )


def written(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as log:
        for message in messages:
            log.on_message_received(message)
    return path


def captured(path: Path, messages: list[can.Message]) -> Path:
    """As tcpdump would, with Linux cooked headers."""
    data = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 113)
    for m in messages:
        seconds, ns = divmod(round(m.timestamp * 1e9), 10**9)
        frame = struct.pack("<IB3x8s", m.arbitration_id, len(m.data), bytes(m.data))
        cooked = b"\x00\x01\x01\x18\x00\x00" + bytes(8) + b"\x00\x0c" + frame
        data += struct.pack("<IIII", seconds, ns, len(cooked), len(cooked)) + cooked
    path.write_bytes(data)
    return path


def samples(triaxcal: Run, recording: Path) -> NDArray[np.float64]:
    done = triaxcal("log", "export", recording)
    assert done.code == 0, done
    return np.array([line.split(",") for line in done.out.splitlines()[1:]], dtype=float)


@pytest.fixture
def imported(triaxcal: Run, tmp_path: Path) -> Callable[..., Any]:
    def take(log: Path, *options: Any, profile: str | Path = "triax-ref-can", code: int = 0) -> Any:
        done = triaxcal("log", "import", log, "--profile", profile, "-o", tmp_path / "rec.mcap", *options)
        assert done.code == code, done
        return done

    return take


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [("a.blf", "BLF"), ("a.asc", "ASC"), ("a.log", "candump"), ("a.trc", "TRC"), ("a.mf4", "MF4"), ("a.pcap", "pcap")],
)
def test_a_log_of_any_kind_gives_the_samples_that_were_recorded(
    finished_run: Any, messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run, name: str, kind: str
) -> None:
    if kind == "MF4":
        pytest.importorskip("asammdf")
    path = (captured if kind == "pcap" else written)(tmp_path / name, messages)
    done = imported(path)
    others = sum(m.arbitration_id == 0x700 for m in messages)
    assert f"left out: {others} frames of other identifiers" in done.err
    assert re.fullmatch(rf"\S+rec.mcap: \d+ samples in \d+.\d\d s from {name} \({kind}\)\n", done.out)
    wanted, found = samples(triaxcal, finished_run.can), samples(triaxcal, tmp_path / "rec.mcap")
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.slow
def test_poses_fit_diagnose_and_apply_work_as_on_a_recording_of_ours(
    finished_run: Any, messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    imported(written(tmp_path / "a.blf", messages))
    rec = tmp_path / "rec.mcap"
    ours, theirs = (triaxcal("poses", r, "--json").json["poses"] for r in (finished_run.can, rec))
    assert theirs == ours
    fit = triaxcal("fit", rec, "-o", tmp_path / "cal.json", "--json")
    assert fit.code == 0
    assert fit.json["scale_factor"] == triaxcal("fit", finished_run.can, "--json").json["scale_factor"]
    assert triaxcal("apply", tmp_path / "cal.json", rec, "-o", tmp_path / "applied.csv").code == 0
    assert triaxcal("audit", rec).code == 2  # it holds no result


def test_the_recording_says_what_it_was_made_of(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    path = written(tmp_path / "a.blf", messages)
    document = imported(path, "--json").json
    assert document["format"] == "triaxcal.import/1"
    info = triaxcal("log", "info", tmp_path / "rec.mcap", "--json").json
    told = info["imported"]
    assert (told["file"], told["bytes"], told["kind"]) == ("a.blf", path.stat().st_size, "BLF")
    assert len(told["sha256"]) == 64
    assert (told["node"], told["channels"]) == (NODE, ["1"])
    assert told["frames"] == len(messages) == told["taken"] + told["other_frames"]
    assert told["samples"] == document["samples"]
    assert {k: v for k, v in document.items() if k in told} == told
    assert set(info["raw"]) == {"calibration"}
    assert info["raw"]["calibration"]["records"] == told["taken"]
    assert info["duration_s"] == pytest.approx(document["duration_s"], abs=0.1)
    assert set(info["attachments"]) == {"profile.toml", "profile/triax-ref-can.dbc"}
    assert info["metadata"]["unit"]["signs"] == "-1,-1,-1"


def test_frames_of_two_buses_are_asked_about(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    short = messages[:200]
    both = [m for one in short for m in (one, _message(round(one.timestamp * 1e9), one.arbitration_id, one.data, 1))]
    path = written(tmp_path / "a.log", both)
    done = imported(path, code=2)
    done.failed(2, f"{path}: 0x185 comes on can0 (", "can1 (", "--channel says which is the unit's")
    assert [p.name for p in tmp_path.iterdir()] == ["a.log"]
    assert "left out: " in imported(path, "--channel", "can1").err
    (tmp_path / "rec.mcap").unlink()
    imported(path, "--channel", "can7", code=2).failed(2, "--channel can7: ", "has can0 (", "can1 (")


def test_nodes_are_told_apart_or_asked_about(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    short = messages[:200]
    other = [
        _message(round(m.timestamp * 1e9), m.arbitration_id + 4, bytes(8)) for m in short if m.arbitration_id < 0x700
    ]
    path = written(tmp_path / "a.blf", [*short, *other])
    imported(path, code=2).failed(2, "frames of the nodes 5 (", "9 (", "--node says which is the unit's")
    imported(path, "--node", 7, code=2).failed(2, "--node 7: ", "has frames of 5 (")
    assert imported(path, "--node", 9, "--json").json["node"] == 9
    assert samples(triaxcal, tmp_path / "rec.mcap")[:, 1:4].any() == False  # noqa: E712


def test_a_log_without_the_units_frames_says_what_is_there(tmp_path: Path, imported: Run) -> None:
    path = written(tmp_path / "a.blf", [_message(10**18, 0x700, b"\1"), _message(10**18, 0x7FE, b"\1")])
    imported(path, code=2).failed(
        2, "(0x180 + node, 0x280 + node, 0x380 + node, 0x480 + node) is in it; found: 0x700, 0x7FE"
    )
    path = written(tmp_path / "b.blf", [_message(10**18, 0x185, bytes(8))])
    imported(path, code=2).failed(2, "no sample in its 1 frame of the profile")
    assert not (tmp_path / "rec.mcap").exists()


def test_frames_that_are_too_short_are_said_to_be_that_and_no_errors(
    tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    frames = [
        _message(T0_NS + number * 10_000_000, identifier, (head + struct.pack("<H", number) + tail)[:length])
        for number in range(100)
        for identifier, head, tail, length in (
            (0x185, bytes(6), b"", 7 if number % 20 == 3 else 8), (0x285, bytes(5), bytes(1), 8)
        )
    ]  # fmt: skip
    done = imported(written(tmp_path / "a.log", frames))
    assert "5 too short for the profile's message, or not as it is defined" in done.out
    assert "in error" not in done.out
    quality = triaxcal("poses", tmp_path / "rec.mcap", "--json").json["data_quality"]
    assert "malformed_records: 5 too short for the profile's message, or not as it is defined, left out" in quality
    assert not any(line.startswith("bus_errors") for line in quality)
    (tmp_path / "rec.mcap").unlink()
    short = written(tmp_path / "b.log", [_message(T0_NS + i * 10_000_000, 0x185, bytes(7)) for i in range(20)])
    imported(short, code=2).failed(2, "no sample in its 20 frames of the profile: 20 too short for the profile's")


def test_a_log_of_five_samples_is_too_short_and_not_of_a_unit_that_never_rests(
    tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    frames = [
        _message(T0_NS + number * 10_000_000, identifier, head + struct.pack("<H", number) + tail)
        for number in range(5)
        for identifier, head, tail in ((0x185, bytes(6), b""), (0x285, bytes(5), bytes(1)))
    ]
    imported(written(tmp_path / "a.log", frames))
    rec = tmp_path / "rec.mcap"
    for command in ("fit", "poses"):
        done = triaxcal(command, rec)
        takes = "a still pose takes at least 70 samples (0.69 s at this rate)"
        assert f"{rec}: too short: {takes}, and it has 5 in 0.04 s\n" in done.err
        assert "never rests" not in done.err


def test_times_that_go_back_or_jump_are_kept_and_said(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    late = [_message(round(m.timestamp * 1e9) + 3600 * 10**9, m.arbitration_id, m.data) for m in messages[100:200]]
    back = [_message(round(m.timestamp * 1e9), m.arbitration_id, m.data) for m in messages[200:300]]
    done = imported(written(tmp_path / "a.blf", [*messages[:100], *late, *back]))
    assert re.search(r"\d+ records came with a time before that of an earlier one, by up to 36\d\d", done.err)
    assert "1 pause, the longest of 36" in done.err
    with Recording.open(tmp_path / "rec.mcap") as recording:
        times = np.concatenate([b.time_ns for b in recording.raw("calibration")])
    assert np.diff(times).min() < -3599e9


def test_a_log_without_times_is_laid_at_the_profiles_rate(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    lines = [f"  can0  {m.arbitration_id:03X}   [{len(m.data)}]  {m.data.hex(' ').upper()}\n" for m in messages[:400]]
    path = tmp_path / "a.log"
    path.write_text("".join(lines))
    assert "the log tells no times: samples are laid at the profile's rate, from zero" in imported(path).err
    found = samples(triaxcal, tmp_path / "rec.mcap")
    np.testing.assert_allclose(np.diff(found[:, 0]), 0.01)


@pytest.mark.slow
def test_a_log_cut_short_is_imported_as_far_as_it_goes_and_a_bad_one_refused(
    messages: list[can.Message], tmp_path: Path, imported: Run
) -> None:
    path = written(tmp_path / "a.log", messages)
    path.write_bytes(gzip.compress(path.read_bytes())[:-2000])
    assert "damaged: the gzip file: " in imported(path).err
    path.write_text("what is this?\n")
    (tmp_path / "rec.mcap").unlink()
    imported(path, code=2).failed(2, f"{path}: no log of a known kind, expected BLF, ASC, candump, TRC, MF4, pcap")
    imported(tmp_path / "none.blf", code=2).failed(2, "none.blf: cannot be read: No such file")
    assert not (tmp_path / "rec.mcap").exists()


def test_what_is_there_is_not_overwritten_and_other_drivers_are_refused(
    messages: list[can.Message], tmp_path: Path, imported: Run
) -> None:
    path = written(tmp_path / "a.blf", messages[:100])
    imported(path, profile="triax-ref-modbus", code=2).failed(2, "driver 'modbus' has no logs that can be imported")
    imported(path)
    before = (tmp_path / "rec.mcap").read_bytes()
    imported(path, code=2).failed(2, "rec.mcap: exists already; a recording is never overwritten")
    assert (tmp_path / "rec.mcap").read_bytes() == before


def test_a_pause_in_which_the_counter_wrapped_is_as_long_as_the_log_says(tmp_path: Path, imported: Run) -> None:
    """700 s at 100 samples/s: more than the 655 that the counter of 16 bits can tell."""
    frames = []
    for number in (*range(200), *range(70_200, 70_400)):
        for identifier, data in ((0x185, bytes(6)), (0x285, bytes(5))):
            data += struct.pack("<H", number & 0xFFFF) + bytes(identifier == 0x285)
            frames.append(_message(T0_NS + number * 10_000_000, identifier, data))
    done = imported(written(tmp_path / "a.log", frames))
    assert "1 pause, the longest of 700.01 s" in done.err
    assert "400 samples in 703.99 s" in done.out
    assert "70000 missing by the counter" in done.out


def test_a_rate_that_the_log_contradicts_is_said(tmp_path: Path, imported: Run) -> None:
    frames = [
        _message(T0_NS + number * 20_000_000, identifier, head + struct.pack("<H", number) + tail)
        for number in range(500)
        for identifier, head, tail in ((0x185, bytes(6), b""), (0x285, bytes(5), bytes(1)))
    ]
    done = imported(written(tmp_path / "a.log", frames))
    assert "the samples last 4.99 s by their own time" in done.err
    assert "9.98 s by the log's times" in done.err


def test_an_import_that_the_disk_ends_leaves_nothing_and_says_so(
    messages: list[can.Message], tmp_path: Path, imported: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: RecordingFile, *_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(RecordingFile, "raw", full)
    done = imported(written(tmp_path / "a.blf", messages), code=5)
    done.failed(5, f"{tmp_path / 'rec.mcap'}: writing failed: No space left on device; nothing of it is left")
    assert [path.name for path in tmp_path.iterdir()] == ["a.blf"]


def test_error_frames_of_the_bus_come_along(messages: list[can.Message], tmp_path: Path, imported: Run) -> None:
    broken = can.Message(timestamp=messages[50].timestamp, is_error_frame=True, channel=0)
    document = imported(written(tmp_path / "a.blf", [*messages[:50], broken, *messages[50:100]]), "--json").json
    assert (document["error_frames"], document["samples"]["errors"]) == (1, 1)
    with Recording.open(tmp_path / "rec.mcap") as recording:
        flags = np.concatenate([b.flags for b in recording.raw("calibration")])
    assert np.count_nonzero(flags & RawFlag.ERROR) == 1


LOGS = Path(__file__).parents[4] / "shared" / "logs" / "canedge"
PROFILE = """
format = "triaxcal.profile/1"
name = "canmod-gps"
driver = "can"
identity = { vendor = "CSS Electronics", product = "CANmod.gps" }
output = { unit = "m/s²" }
sampling = { rate_hz = 100 }

[streams.readings]
layout = "dbc"
file = "FILE"
valid = "ImuValid"
channels = { ux = "IMU.AccelerationX", uy = "IMU.AccelerationY", uz = "IMU.AccelerationZ" }
"""
OTHER_TOOLS = b'\r\nBA_DEF_ "x" ENUM "true","false";\r\nBA_DEF_DEF_ "x" true;\r\n'
VEHICLES = {
    "vehicle1": ("canmod-gps.dbc", "gnss_imu", 5477, 4518, 44.59, (9.6406, 0.1521, 0.4635), 9.7186),
    "vehicle2": ("gnss.dbc", "gnss_imu@0x19", 4024, 1669, 169.96, (-0.3764, 0.3417, 10.0466), 10.0864),
}


@pytest.mark.slow
@pytest.mark.datasets
@pytest.mark.skipif(not any(LOGS.glob("*.mf4")), reason="no logs of others in ../shared/logs")
@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("suffix", [".mf4", ".blf", ".asc", ".log", ".trc"])
def test_the_logs_of_two_vehicles_give_their_known_figures(
    tmp_path: Path, triaxcal: Run, imported: Run, vehicle: str, suffix: str
) -> None:
    pytest.importorskip("asammdf")
    dbc, imu, frames, count, span, mean, magnitude = VEHICLES[vehicle]
    (tmp_path / dbc).write_bytes((LOGS / dbc).read_bytes().replace(b"BS_:", b"BS_: 1000000 : 0,0") + OTHER_TOOLS)
    profile = tmp_path / "imu.toml"
    profile.write_text(PROFILE.replace("FILE", dbc).replace("IMU.", f"{imu}."))
    log = LOGS / f"{vehicle}.mf4"
    if suffix != ".mf4":
        log = tmp_path / f"{vehicle}{suffix}"
        converted = [sys.executable, "-m", "can.logconvert", str(LOGS / f"{vehicle}.mf4"), str(log)]
        subprocess.run(converted, check=True, capture_output=True)
    told = imported(log, "--json", profile=profile).json
    assert (told["frames"], told["samples"]["samples"], told["samples"]["invalid"]) == (frames, count, 0)
    found = samples(triaxcal, tmp_path / "rec.mcap")
    assert found[-1, 0] == pytest.approx(span, abs=0.01)
    assert found[:, 1:4].mean(axis=0) == pytest.approx(mean, abs=0.001)
    assert np.linalg.norm(found[:, 1:4], axis=1).mean() == pytest.approx(magnitude, abs=0.001)
    triaxcal("fit", tmp_path / "rec.mcap", "--reference", "9.81").failed(3, "refused")


def test_a_recording_is_named_so_that_it_can_be_read(
    messages: list[can.Message], tmp_path: Path, triaxcal: Run
) -> None:
    path = written(tmp_path / "a.blf", messages[:100])
    out = tmp_path / "rec.txt"
    done = triaxcal("log", "import", path, "--profile", "triax-ref-can", "-o", out)
    done.failed(2, f"{out}: the name of a recording ends in .mcap")
    assert not out.exists()


def test_a_log_of_two_units_at_one_node_is_imported_with_a_warning(
    tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    made = []
    for i in range(600):
        for number, first, late_ns in ((100 + i, 1, 0), (40_000 + i, 9, 3_000_000)):
            at_ns, counter = T0_NS + i * 10_000_000 + late_ns, struct.pack("<H", number)
            made.append(_message(at_ns, 0x185, bytes([first, i % 7]) + bytes(4) + counter))
            made.append(_message(at_ns + 100_000, 0x285, bytes(5) + counter + bytes(1)))
    done = imported(written(tmp_path / "a.blf", made))
    assert "two units send" in done.err
    judged = triaxcal("poses", tmp_path / "rec.mcap")
    assert "two_senders" in judged.out + judged.err
