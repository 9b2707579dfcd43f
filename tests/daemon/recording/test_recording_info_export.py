from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcald.errors import RecordingError
from triaxcald.recording import reader
from triaxcald.recording.info import describe
from triaxcald.recording.recover import recover
from triaxcald.recording.schema import PHASE_KEY, PhaseCount
from triaxcald.recording.writer import RecordingWriter
from triaxcald.tables.native_csv import Rows, read_csv, write_csv

T0_NS = 1_700_000_000_000_000_000


def test_a_recording_is_described(recording: Path, metadata: dict[str, dict[str, str]]) -> None:
    found = json.loads(json.dumps(describe(recording)))
    assert found["format"] == "triaxcal.recording/1"
    assert (found["finished"], found["recovered"], found["chunks"]) == (True, False, 8)
    assert found["bytes"] == recording.stat().st_size
    assert found["duration_s"] == 6.0
    assert {topic: entry["messages"] for topic, entry in found["topics"].items()} == {
        "/events": 2,
        "/registers": 2,
        "/raw": 6,
        "/preview/readings": 6,
    }
    assert found["raw"]["calibration"] == {
        "records": 200,
        "bytes": 1600,
        "start_ns": T0_NS,
        "end_ns": T0_NS + 199_000_000,
        "duration_s": 0.199,
    }
    assert found["metadata"].items() >= metadata.items()
    assert found["attachments"]["result.json"] == {"media_type": "application/json", "bytes": 2}
    assert found["losses"] == []


def test_a_recording_not_finished_is_described_up_to_where_it_is(
    tmp_path: Path, new_writer: Callable[..., RecordingWriter], batch_of: Callable[..., RawBatch]
) -> None:
    writer = new_writer()
    writer.raw("calibration", batch_of(0, 30))
    writer.drain()
    found = describe(tmp_path / "rec.mcap")
    assert not found["finished"]
    assert found["raw"]["calibration"]["records"] == 30


def test_a_mended_recording_is_described_as_such(recording: Path, tmp_path: Path) -> None:
    recover(recording, tmp_path / "mended.mcap")
    assert describe(tmp_path / "mended.mcap")["recovered"]


def test_samples_are_written_as_text() -> None:
    block = SampleBlock(
        np.array([T0_NS, T0_NS + 1_500_000_001]),
        np.arange(2),
        np.array([[0.1, -2.0, 3e-7], [1.0, 2.0, 3.0]]),
        {"temp_c": np.array([21.5, 22.0])},
    )
    out = io.StringIO()
    assert write_csv(out, [Rows.of(block)]) == 2
    expected = "t_s,ux,uy,uz,temp_c\n0.000000000,0.1,-2.0,3e-07,21.5\n1.500000001,1.0,2.0,3.0,22.0\n"
    assert out.getvalue() == expected


def test_no_samples_are_a_header_alone() -> None:
    out = io.StringIO()
    assert write_csv(out, []) == 0
    assert out.getvalue() == "t_s,ux,uy,uz\n"


finite = st.floats(-1e99, 1e99)  # what a table may hold: squares and products of it are numbers too


@given(st.lists(st.tuples(st.integers(1, 10**10), finite, finite, finite, finite), min_size=1, max_size=20))
def test_what_is_exported_reads_back_to_the_last_bit(rows: list[tuple[int, float, float, float, float]]) -> None:
    table = np.array([row[1:] for row in rows])
    time_ns = T0_NS + np.cumsum([row[0] for row in rows])
    blocks = [
        SampleBlock(time_ns[i : i + 7], time_ns[i : i + 7], table[i : i + 7, :3], {"a": table[i : i + 7, 3]})
        for i in range(0, len(rows), 7)
    ]
    out = io.StringIO()
    write_csv(out, map(Rows.of, blocks))
    found = read_csv(io.BytesIO(out.getvalue().encode()))
    np.testing.assert_array_equal(found.readings, table[:, :3])
    np.testing.assert_array_equal(found.channels["a"], table[:, 3])
    np.testing.assert_array_equal(found.time_ns, time_ns - time_ns[0])


def test_blocks_of_different_channels_do_not_mix() -> None:
    one = SampleBlock(np.array([1]), np.array([0]), np.zeros((1, 3)), {"a": np.zeros(1)})
    other = SampleBlock(np.array([2]), np.array([1]), np.zeros((1, 3)), {})
    with pytest.raises(RecordingError, match=r"channels \[\] after sample 1, expected \['a'\]"):
        write_csv(io.StringIO(), map(Rows.of, [one, other]))


def _long_from(monkeypatch: pytest.MonkeyPatch, records: int) -> None:
    monkeypatch.setattr("triaxcald.recording.info.COUNTED_MOST", records)


def test_a_long_recording_is_described_by_its_index_as_by_its_records(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = describe(recording)
    _long_from(monkeypatch, 100)
    by_index, again = describe(recording), describe(recording, count=True)
    assert (counted["counted"], by_index["counted"]) == (True, False)
    assert again == counted
    assert {**by_index, "counted": True} == counted
    assert list(by_index["topics"]) == list(counted["topics"])


def test_the_index_unpacks_no_chunk_but_those_with_events(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unpacked: list[int] = []
    real = reader.chunk_data
    monkeypatch.setattr(reader, "chunk_data", lambda unparsed, name: unpacked.append(1) or real(unparsed, name))
    counted = describe(recording)
    of_all, unpacked[:] = len(unpacked), []
    _long_from(monkeypatch, 100)
    assert describe(recording)["events"] == counted["events"]
    assert 0 < len(unpacked) < of_all


def test_a_long_recording_that_was_cut_short_is_counted(
    tmp_path: Path,
    new_writer: Callable[..., RecordingWriter],
    batch_of: Callable[..., RawBatch],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _long_from(monkeypatch, 5)
    writer = new_writer()
    writer.raw("calibration", batch_of(0, 30))
    writer.drain()
    found = describe(tmp_path / "rec.mcap")
    assert (found["finished"], found["counted"], found["raw"]["calibration"]["records"]) == (False, True, 30)


@pytest.mark.parametrize("said", ["[1, 2, 3]", "[1, 2, 3, 4, 5]", "{}", "[1, 2, 3, true]", "x", '[1, 2, 3, "4"]'])
def test_what_is_no_count_of_a_phase_is_not_taken_for_one(said: str) -> None:
    with pytest.raises(ValueError):
        PhaseCount.read(said)


def test_records_that_the_metadata_do_not_count_are_counted(
    recording: Path, rewrite: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a recording of an earlier version."""
    counted = describe(recording)
    _long_from(monkeypatch, 100)

    def bare(name: str, record: dict[str, str]) -> dict[str, str]:
        return {k: v for k, v in record.items() if not k.startswith(PHASE_KEY)}

    found = describe(rewrite(recording, metadata=bare))
    assert found["counted"]
    assert found["raw"] == counted["raw"]
