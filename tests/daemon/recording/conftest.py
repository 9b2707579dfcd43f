"""Recordings to write, read and damage; all times are the test's own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcald.recording.writer import RecordingWriter

T0_NS = 1_700_000_000_000_000_000
METADATA = {"run": {"id": "r1"}, "station": {"name": "bench"}, "unit": {"serial": "42"}, "software": {"triaxcal": "0"}}


class Clock:
    def __init__(self) -> None:
        self.now_ns = T0_NS

    def __call__(self) -> int:
        return self.now_ns


def _batch_of(first: int, n: int, payload_bytes: int = 8) -> RawBatch:
    """Records ``first`` … of a CAN unit, 1 ms apart, each unlike any other."""
    index = np.arange(first, first + n)
    payload = b"".join((int(i) * 0x9E3779B97F4A7C15 % 2**64).to_bytes(8, "little")[:payload_bytes] for i in index)
    return RawBatch(
        T0_NS + index * 1_000_000,
        (0x181 + index % 4 * 0x100).astype(np.uint32),
        np.zeros(n, dtype=np.uint8),
        np.full(n, payload_bytes, dtype=np.uint16),
        payload,
    )


def _block_of(n: int, start_ns: int = T0_NS, period_ns: int = 10_000_000) -> SampleBlock:
    index = np.arange(n)
    n_float: NDArray[np.float64] = index.astype(np.float64)
    return SampleBlock(
        start_ns + index * period_ns,
        index,
        np.column_stack([index * 1.0, index * 2.0, index * 3.0]),
        {"temp_c": n_float / 10, "supply.v": n_float / 2},
    )


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 180
    while not condition():
        assert time.monotonic() < deadline, "the condition has not come about"
        time.sleep(0.001)


@pytest.fixture
def batch_of() -> Callable[..., RawBatch]:
    return _batch_of


@pytest.fixture
def block_of() -> Callable[..., SampleBlock]:
    return _block_of


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    return _wait_until


@pytest.fixture
def metadata() -> dict[str, dict[str, str]]:
    return METADATA


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def new_writer(tmp_path: Path, clock: Clock) -> Iterator[Callable[..., RecordingWriter]]:
    writers: list[RecordingWriter] = []

    def new(name: str = "rec.mcap", **options: object) -> RecordingWriter:
        settings = {"metadata": METADATA, "preview_channels": ["temp_c", "supply.v"], "preview_unit": "V"}
        writer = RecordingWriter(tmp_path / name, **{**settings, "clock_ns": clock, **options})  # type: ignore[arg-type]
        writers.append(writer)
        return writer

    yield new
    for writer in writers:
        if not writer._closed:  # a test that failed must not leave a thread behind
            writer.close()


@pytest.fixture
def write_recording(tmp_path: Path, new_writer: Callable[..., RecordingWriter], clock: Clock) -> Callable[[str], Path]:
    """Writes six chunks of 50 raw records in two phases, with everything else a recording holds."""

    def write(name: str) -> Path:
        clock.now_ns = T0_NS
        with new_writer(name) as writer:
            writer.attach("station.toml", "text/plain", b"name = 'bench'\n")
            writer.register("scale_factor_x", "read", bytes.fromhex("c019999a"))
            for i in range(6):
                writer.raw("calibration" if i < 4 else "verification", _batch_of(50 * i, 50))
                writer.preview("/preview/readings", _block_of(5, clock.now_ns))
                writer.drain()
                clock.now_ns += 1_000_000_000
            writer.event("pose_done", {"pose": 3})
            writer.register("store", "write", bytes.fromhex("65766173"), "refused")
            writer.attach("result.json", "application/json", b"{}")
        return tmp_path / name

    return write


@pytest.fixture
def recording(write_recording: Callable[[str], Path]) -> Path:
    return write_recording("rec.mcap")
