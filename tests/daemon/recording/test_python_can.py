"""python-can's own tools write and read recordings."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from subprocess import DEVNULL
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triaxcald.errors import RecordingError
from triaxcald.recording.bus import bus_frames
from triaxcald.recording.info import describe
from triaxcald.recording.python_can import BATCH, RecordingMessageReader, RecordingMessageWriter
from triaxcald.recording.reader import Recording

PROJECT = Path(__file__).parents[3]
GOLDEN = PROJECT / "recordings" / "can-second-order.mcap"
BIN = Path(sys.executable).parent
T0_S = 1_700_000_000.25
EVERY_KIND = [
    can.Message(T0_S, 0x123, is_extended_id=False, data=b"\x01\x02", channel="vcan0"),
    can.Message(T0_S + 1e-6, 0x1ABCDEF0, is_extended_id=True, data=bytes(range(8)), channel="vcan0"),
    can.Message(T0_S + 2e-6, 0x7FF, is_extended_id=False, is_remote_frame=True, dlc=5, channel="vcan0"),
    can.Message(T0_S + 3e-6, 0x20, is_error_frame=True, data=bytes(8), is_extended_id=False, channel="vcan0"),
    can.Message(T0_S + 4e-6, 0x124, is_extended_id=False, is_fd=True, data=bytes(range(64)), channel=1),
    can.Message(
        T0_S + 5e-6, 0x125, is_extended_id=True, is_fd=True, bitrate_switch=True, data=bytes(12), channel=1
    ),
    can.Message(
        T0_S + 6e-6, 0x126, is_extended_id=True, is_fd=True, error_state_indicator=True, data=bytes(1), channel=1
    ),
    can.Message(T0_S + 7e-6, 0x127, is_extended_id=False, is_rx=False, channel=1),
]  # fmt: skip


def write(path: Path, messages: Sequence[can.Message]) -> None:
    with RecordingMessageWriter(path) as writer:
        for message in messages:
            writer(message)


def read(path: Path) -> list[can.Message]:
    with RecordingMessageReader(path) as reader:
        return list(reader)


def assert_same(got: Sequence[can.Message], put: Sequence[can.Message], *, delta_s: float = 1e-6) -> None:
    for one, other in zip(got, put, strict=True):
        assert one.equals(other, timestamp_delta=delta_s), f"{one!r} is not {other!r}"


def test_every_kind_of_message_reads_back(tmp_path: Path) -> None:
    write(tmp_path / "x.mcap", EVERY_KIND)
    assert_same(read(tmp_path / "x.mcap"), EVERY_KIND, delta_s=0.0)


def test_a_remote_frame_is_recorded_with_as_many_zero_bytes_as_it_asks_for(tmp_path: Path) -> None:
    write(tmp_path / "x.mcap", [EVERY_KIND[2]])
    with Recording.open(tmp_path / "x.mcap") as recording:
        [(channel, batch)] = bus_frames(recording)
    assert (channel, batch.length.tolist(), batch.payload) == ("vcan0", [5], bytes(5))
    assert batch.time_ns.tolist() == [1_700_000_000_250_001_907]  # what the float of 0.250002 s is


@st.composite
def valid_messages(draw: st.DrawFn) -> can.Message:
    extended, kind = draw(st.booleans()), draw(st.sampled_from(["data", "remote", "error", "fd"]))
    data = draw(st.binary(max_size=64 if kind == "fd" else 8))
    remote = kind == "remote"
    return can.Message(
        timestamp=draw(st.floats(0, 4e9)),
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=kind == "error",
        channel=draw(st.sampled_from([None, 0, "0", "can1"])),
        data=b"" if remote else data,
        dlc=len(data),
        is_fd=kind == "fd",
        is_rx=draw(st.booleans()),
        bitrate_switch=kind == "fd" and draw(st.booleans()),
        error_state_indicator=kind == "fd" and draw(st.booleans()),
        check=True,
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(st.lists(valid_messages(), max_size=12))
def test_whatever_messages_come_each_channel_reads_back_in_its_order(
    tmp_path_factory: pytest.TempPathFactory, messages: list[can.Message]
) -> None:
    path = tmp_path_factory.mktemp("log") / "x.mcap"
    write(path, messages)
    got = read(path)
    assert len(got) == len(messages)
    for channel in (None, 0, "0", "can1"):
        same = [
            [m for m in some if m.channel == channel and type(m.channel) is type(channel)] for some in (got, messages)
        ]
        assert_same(*same)


def test_channels_come_among_each_other_by_their_times(tmp_path: Path) -> None:
    count = 3 * BATCH
    put = [can.Message(T0_S + 1e-3 * i, i % 100, channel=("a", "b", "b")[i % 3]) for i in range(count)]
    write(tmp_path / "x.mcap", put)
    assert_same(read(tmp_path / "x.mcap"), put, delta_s=0.0)


def test_a_recording_of_an_old_log_lasts_from_its_first_message_to_its_last(tmp_path: Path) -> None:
    write(tmp_path / "x.mcap", [can.Message(1_556_000_000.0 + i / 4, 1, channel=i % 2) for i in range(3 * BATCH)])
    described = describe(tmp_path / "x.mcap")
    assert described["duration_s"] == (3 * BATCH - 1) / 4
    assert [(e["kind"], e["time_ns"]) for e in described["events"]] == [("recording_started", 1_556_000_000 * 10**9)]


def test_a_recording_of_what_comes_begins_when_the_recorder_did(tmp_path: Path) -> None:
    before_ns = time.time_ns()
    with RecordingMessageWriter(tmp_path / "x.mcap") as writer:
        after_ns = time.time_ns()
        writer(can.Message(after_ns / 1e9 + 5.0, 1))
    (started,) = describe(tmp_path / "x.mcap")["events"]
    assert before_ns <= started["time_ns"] <= after_ns


def test_a_recording_without_a_message_says_when_it_was_begun(tmp_path: Path) -> None:
    before_ns = time.time_ns()
    RecordingMessageWriter(tmp_path / "x.mcap").stop()
    (started,) = describe(tmp_path / "x.mcap")["events"]
    assert before_ns <= started["time_ns"] <= time.time_ns()


def test_a_message_that_its_sender_changes_afterwards_is_recorded_as_it_was(tmp_path: Path) -> None:
    message = can.Message(T0_S, 1, data=b"\x01")
    with RecordingMessageWriter(tmp_path / "x.mcap") as writer:
        writer(message)
        message.data[0] = 2
        message.arbitration_id = 3
    assert [(m.arbitration_id, bytes(m.data)) for m in read(tmp_path / "x.mcap")] == [(1, b"\x01")]


@pytest.mark.slow
def test_a_message_does_not_wait_for_others_to_come(
    tmp_path: Path, wait_until: Callable[[Callable[[], bool]], None]
) -> None:
    with RecordingMessageWriter(tmp_path / "x.mcap") as writer:
        writer(EVERY_KIND[0])
        wait_until(lambda: frames_in(tmp_path / "x.mcap") == 1)
        assert writer.file_size() > 0


def test_a_recording_is_neither_overwritten_nor_appended_to(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"precious")
    with pytest.raises(RecordingError, match=r"x\.mcap: exists already; a recording is never overwritten"):
        RecordingMessageWriter(tmp_path / "x.mcap")
    with pytest.raises(ValueError, match=r"x\.mcap: a recording that exists is never changed"):
        RecordingMessageWriter(tmp_path / "x.mcap", append=True)
    assert (tmp_path / "x.mcap").read_bytes() == b"precious"
    RecordingMessageWriter(tmp_path / "new.mcap", append=True).stop()


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (can.Message(float("nan"), 1), "a message without a time"),
        (can.Message(-1.0, 1), "a message without a time"),
        (can.Message(T0_S, 2**32), "an identifier beyond 32 bits"),
    ],
)
def test_a_message_that_no_recording_can_hold_is_one_clear_error(
    tmp_path: Path, message: can.Message, said: str
) -> None:
    writer = RecordingMessageWriter(tmp_path / "x.mcap")
    writer(message)
    with pytest.raises(ValueError, match=said):
        writer.stop()
    assert read(tmp_path / "x.mcap") == []


def test_the_frames_of_a_unit_s_recording_are_read_too() -> None:
    got = read(GOLDEN)
    with Recording.open(GOLDEN) as recording:
        batches = [batch for _, batch in recording.raw_batches()]
    assert len(got) == sum(map(len, batches))
    assert [m.arbitration_id for m in got] == [s for b in batches for s in b.source.tolist()]
    assert b"".join(bytes(m.data) for m in got) == b"".join(b.payload for b in batches)


def test_records_of_a_unit_on_modbus_are_no_frames() -> None:
    path = PROJECT / "recordings" / "modbus-temperature-bias.mcap"
    with pytest.raises(RecordingError, match=r"\.mcap: records of a unit on modbus, expected CAN frames"):
        read(path)


def spoiled(data: bytes) -> Iterator[tuple[str, bytes]]:
    yield "is empty", b""
    yield "not an MCAP file", b"\x00" * 100
    yield "log recover", data[:-300]
    yield "log recover", data[:-2000] + bytes(4) + data[-1996:]


@pytest.mark.parametrize("number", range(4))
def test_a_damaged_or_foreign_file_is_one_clear_error(tmp_path: Path, number: int) -> None:
    said, data = list(spoiled(GOLDEN.read_bytes()))[number]
    (tmp_path / "x.mcap").write_bytes(data)
    with pytest.raises(RecordingError, match=said) as raised:
        read(tmp_path / "x.mcap")
    assert "\n" not in str(raised.value)


# The tools themselves, as they are installed.


GROUP = "239.74.163.2"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("", 0))
        return int(s.getsockname()[1])


def multicast_or_skip(port: int) -> can.BusABC:
    try:
        bus = can.Bus(interface="udp_multicast", channel=GROUP, port=port)  # which hears itself
        bus.send(can.Message(arbitration_id=1))
        if bus.recv(2.0) is not None:
            return bus
        bus.shutdown()
    except (OSError, can.CanError):
        pass
    pytest.skip("there is no multicast on the loopback")


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """In which python-can's tools know the entry points of this project, installed or not."""
    groups = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]["entry-points"]
    known = tmp_path / "site" / "triaxcal_entry_points-0.dist-info"
    known.mkdir(parents=True)
    (known / "METADATA").write_text("Metadata-Version: 2.1\nName: triaxcal_entry_points\nVersion: 0\n")
    wanted = [g for g in groups if g.startswith("can.io.")]
    text = "".join(f"[{g}]\n" + "".join(f"{k} = {v}\n" for k, v in groups[g].items()) for g in wanted)
    (known / "entry_points.txt").write_text(text)
    paths = [str(known.parent), *(p for p in sys.path if p)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def path_of(tool: str) -> Path:
    if not (BIN / tool).exists():
        pytest.skip(f"{tool} is not installed")
    return BIN / tool


@pytest.fixture
def tool(tmp_path: Path, environment: dict[str, str]) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs one of python-can's tools to its end."""

    def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [path_of(name), *arguments],
            env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=180, check=False,
        )  # fmt: skip

    return run


@pytest.fixture
def tool_at_work(tmp_path: Path, environment: dict[str, str]) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts one of python-can's tools."""
    started: list[subprocess.Popen[str]] = []

    def start(name: str, *arguments: str) -> subprocess.Popen[str]:
        started.append(
            subprocess.Popen([path_of(name), *arguments], env=environment, cwd=tmp_path, stdout=DEVNULL, text=True)
        )
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".blf", ".asc", ".log"])
def test_can_logconvert_makes_a_recording_of_another_log_and_that_log_of_it(
    tmp_path: Path, tool: Callable[..., Any], suffix: str
) -> None:
    with can.Logger(tmp_path / f"a{suffix}") as logger:
        for message in EVERY_KIND:
            logger(message)
    for source, target in ((f"a{suffix}", "b.mcap"), ("b.mcap", f"c{suffix}")):
        done = tool("can_logconvert", source, target)
        assert done.returncode == 0, done.stderr
    first, second = (list(can.LogReader(tmp_path / f"{n}{suffix}")) for n in "ac")
    assert len(first) == len(EVERY_KIND)
    assert_same(second, first)
    assert_same(read(tmp_path / "b.mcap"), first)


@pytest.mark.slow
def test_can_player_sends_what_a_recording_holds(tmp_path: Path, tool: Callable[..., Any]) -> None:
    write(tmp_path / "x.mcap", [m for m in EVERY_KIND if not m.is_fd])
    done = tool("can_player", "-v", "-i", "virtual", "-c", "0", "x.mcap")
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("Timestamp:")]
    assert [line.split("ID:")[1].split()[0] for line in lines] == ["123", "1abcdef0", "7ff", "127"]


def frames_in(path: Path) -> int:
    """Of a file that is being written; -1 where its head is not there yet."""
    try:
        with Recording.open(path, unfinished=True) as recording:
            return sum(len(batch) for _, batch in recording.raw_batches())
    except RecordingError:
        return -1


@pytest.mark.slow
def test_can_logger_records_what_comes_over_a_bus_until_it_is_interrupted(
    tmp_path: Path,
    tool_at_work: Callable[..., subprocess.Popen[str]],
    wait_until: Callable[[Callable[[], bool]], None],
) -> None:
    port = free_port()
    with multicast_or_skip(port) as bus:
        logger = tool_at_work("can_logger", "-i", "udp_multicast", "-c", GROUP, "--bus-kwargs", f"port={port}",
                              "-f", "x.mcap")  # fmt: skip
        wait_until(lambda: frames_in(tmp_path / "x.mcap") == 0)
        for i in range(50):
            bus.send(can.Message(arbitration_id=0x100 + i, data=bytes([i]), is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x1ABCDEF0, data=bytes(20), is_fd=True, bitrate_switch=True))
        wait_until(lambda: frames_in(tmp_path / "x.mcap") == 51)
        logger.send_signal(signal.SIGINT)
        assert logger.wait(60) == 0
    got = read(tmp_path / "x.mcap")
    assert [m.arbitration_id for m in got] == [*range(0x100, 0x132), 0x1ABCDEF0]
    assert (got[-1].is_fd, got[-1].bitrate_switch, got[-1].is_extended_id, got[-1].dlc) == (True, True, True, 20)


@pytest.mark.slow
def test_no_format_takes_longer_to_open_for_ours_being_known() -> None:
    code = "import sys, can.io; import triaxcald.recording.python_can; print([m for m in {} if m in sys.modules])"
    heavy = ["pydantic", "mcap", "google.protobuf", "zstandard", "triaxcal_drivers.interface"]
    done = subprocess.run(
        [sys.executable, "-c", code.format(heavy)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "[]\n"
