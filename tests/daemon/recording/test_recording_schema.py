from __future__ import annotations

import hashlib
import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcald.recording import schema

TWO = RawBatch.of([(256, 0x181, 0, b"\x01\x02"), (512, 0x281, 16, b"\xff")])


def test_the_raw_digest_is_sha256_of_columns_and_payloads_by_phase() -> None:
    digest = schema.RawDigest()
    digest.update("calibration", TWO)
    columns = struct.pack("<qIBH", 256, 0x181, 0, 2) + struct.pack("<qIBH", 512, 0x281, 16, 1)
    parts = [hashlib.sha256(part).digest() for part in (b"calibration", columns, b"\x01\x02\xff")]
    assert digest.hexdigest() == hashlib.sha256(b"".join(parts)).hexdigest()
    assert digest.records == 2


records = st.lists(
    st.tuples(st.integers(0, 2**62), st.integers(0, 2**32 - 1), st.integers(0, 255), st.binary(max_size=9)),
    max_size=30,
)


@given(records, records, st.integers(1, 7))
def test_the_raw_digest_does_not_see_how_records_are_cut_and_phases_interleaved(
    calibration: list[tuple[int, int, int, bytes]], verification: list[tuple[int, int, int, bytes]], size: int
) -> None:
    whole, pieces = schema.RawDigest(), schema.RawDigest()
    whole.update("calibration", RawBatch.of(calibration))
    whole.update("verification", RawBatch.of(verification))
    for phase, rows in (("verification", verification), ("calibration", calibration)):
        for piece in schema.cut(RawBatch.of(rows), size):
            assert len(piece) <= size
            pieces.update(phase, piece)
    assert pieces.hexdigest() == whole.hexdigest()


def test_the_raw_digest_sees_a_byte_that_moves_from_one_record_to_the_next() -> None:
    def hexdigest(*payloads: bytes) -> str:
        digest = schema.RawDigest()
        digest.update("calibration", RawBatch.of([(1, 2, 0, data) for data in payloads]))
        return digest.hexdigest()

    assert hexdigest(b"ab", b"c") != hexdigest(b"a", b"bc")


def test_recordings_declare_the_columns_of_a_raw_batch_as_numbers() -> None:
    fields = (
        b"\x12\x0d\x0a\x05first\x18\x01\x20\x01\x28\x06"  # field 1, optional, fixed64
        b"\x12\x0d\x0a\x05phase\x18\x02\x20\x01\x28\x09"  # string
        b"\x12\x0f\x0a\x07time_ns\x18\x03\x20\x03\x28\x06"  # repeated fixed64
        b"\x12\x0e\x0a\x06source\x18\x04\x20\x03\x28\x07"  # repeated fixed32
        b"\x12\x0d\x0a\x05flags\x18\x05\x20\x01\x28\x0c"  # bytes
        b"\x12\x0e\x0a\x06length\x18\x06\x20\x03\x28\x07"
        b"\x12\x0f\x0a\x07payload\x18\x07\x20\x01\x28\x0c"
        b"\x12\x10\x0a\x08start_ns\x18\x08\x20\x01\x28\x06"
        b"\x12\x0f\x0a\x07step_ns\x18\x09\x20\x03\x28\x0f"  # repeated sfixed32
    )
    file = (
        b"\x0a\x24triaxcal/recording/v1/rawbatch.proto\x12\x15triaxcal.recording.v1"
        b"\x22\x9c\x01\x0a\x08RawBatch" + fields + b"\x62\x06proto3"
    )
    assert schema.SCHEMAS["RawBatch"].data == b"\x0a\xe4\x01" + file


def test_each_auxiliary_channel_is_a_plain_field_of_the_preview() -> None:
    names = ["temp_c", "supply.v", "supply v", "x", "3rd", "größe"]
    assert schema.preview_fields(names) == ["temp_c", "supply_v", "supply_v_", "x_", "_3rd", "gr__e"]
    message = schema.preview_schema(["temp_c"]).message(time_ns=1, x=1.0, y=2.0, z=3.0, temp_c=21.5)
    doubles = b"".join(
        bytes([number << 3 | 1]) + struct.pack("<d", v) for number, v in ((2, 1), (3, 2), (4, 3), (5, 21.5))
    )
    assert message.SerializeToString() == b"\x09" + (1).to_bytes(8, "little") + doubles


@given(st.lists(st.integers(0, 40), min_size=1, max_size=60), st.lists(st.integers(1, 9), min_size=1))
def test_the_preview_is_the_same_however_samples_are_cut_into_blocks(steps: list[int], sizes: list[int]) -> None:
    time_ns = 10**18 + np.cumsum(steps) * 1_000_000

    def picked(bounds: list[int]) -> list[int]:
        decimator = schema.Decimator(100.0)
        found = []
        for start, stop in zip([0, *bounds], [*bounds, len(time_ns)], strict=True):
            piece = time_ns[start:stop]
            block = SampleBlock(piece, piece, np.zeros((len(piece), 3)), {})
            found += [start + i for i in decimator.pick(block)]
        return found

    bounds = [int(b) for b in np.cumsum(sizes) if b < len(time_ns)]
    whole = picked([])
    assert picked(bounds) == whole
    slots = time_ns[whole] // 10_000_000
    assert len(set(slots.tolist())) == len(whole)  # never two in one period
