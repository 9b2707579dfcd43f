from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.interface import RawBatch
from triaxcald.recording import schema
from triaxcald.recording.schema import Fields, batch_of, decode_raw, encode_raw, fields_of

TWO = RawBatch.of([(256, 0x181, 0, b"\x01\x02"), (512, 0x281, 16, b"\xff")])


def by_protobuf(**fields: object) -> bytes:
    return bytes(schema.SCHEMAS["RawBatch"].message(**fields).SerializeToString())


def test_records_of_a_unit_are_packed_fixed_width_columns_on_the_wire() -> None:
    expected = (
        "09 0700000000000000"  # 1: first = 7, fixed64
        "12 0b 63616c6962726174696f6e"  # 2: phase = "calibration"
        "1a 10 0001000000000000 0002000000000000"  # 3: time_ns, packed fixed64
        "22 08 81010000 81020000"  # 4: source, packed fixed32
        "2a 02 00 10"  # 5: flags
        "32 08 02000000 01000000"  # 6: length, packed fixed32
        "3a 03 01 02 ff"  # 7: payload
    )
    assert encode_raw(7, "calibration", TWO) == bytes.fromhex(expected)


def test_frames_of_a_bus_have_the_first_time_and_the_steps() -> None:
    three = RawBatch.of([(256, 0x181, 0, b"\x01"), (512, 0x181, 0, b"\x02"), (511, 0x181, 0, b"\x03")])
    expected = (
        "12 05 6275732f30"  # 2: phase = "bus/0"; first = 0 is not written
        "22 0c 81010000 81010000 81010000"
        "2a 03 00 00 00"
        "32 0c 01000000 01000000 01000000"
        "3a 03 01 02 03"
        "41 0001000000000000"  # 8: start_ns, fixed64
        "4a 08 00010000 ffffffff"  # 9: step_ns, packed sfixed32
    )
    assert encode_raw(0, "bus/0", three) == bytes.fromhex(expected)
    assert decode_raw(bytes.fromhex(expected))[2].time_ns.tolist() == [256, 512, 511]


@pytest.mark.parametrize("step_ns", [2**31, -(2**31)])
def test_frames_of_a_bus_that_lie_far_apart_have_their_times_as_they_are(step_ns: int) -> None:
    far = RawBatch.of([(2**32, 1, 0, b""), (2**32 + step_ns, 1, 0, b"")])
    data = encode_raw(0, "bus/0", far)
    assert schema.SCHEMAS["RawBatch"].message.FromString(data).time_ns == [2**32, 2**32 + step_ns]
    assert decode_raw(data)[2].time_ns.tolist() == far.time_ns.tolist()


rows = st.lists(
    st.tuples(st.integers(0, 2**62), st.integers(0, 2**32 - 1), st.integers(0, 255), st.binary(max_size=64)),
    max_size=40,
)


@given(st.integers(0, 2**63), st.sampled_from(["calibration", "bus/vcan0", "bus/Fahrgestell ä"]), rows)
def test_a_raw_batch_reads_back_as_it_was_and_is_what_protobuf_would_write(
    first: int, phase: str, records: list[tuple[int, int, int, bytes]]
) -> None:
    put = RawBatch.of(records)
    data = encode_raw(first, phase, put)
    assert schema.SCHEMAS["RawBatch"].message.FromString(data).SerializeToString() == data
    got_first, got_phase, got = decode_raw(data)
    assert (got_first, got_phase, got.payload) == (first, phase, put.payload)
    for column in ("time_ns", "source", "flags", "length"):
        assert getattr(got, column).dtype == getattr(put, column).dtype
        np.testing.assert_array_equal(getattr(got, column), getattr(put, column))


def test_a_message_in_another_order_or_with_a_field_of_a_later_version_is_read_too() -> None:
    data = encode_raw(7, "calibration", TWO)
    for other in (data[9:] + data[:9], data + b"\x52\x01x"):
        first, phase, batch = decode_raw(other)
        assert (first, phase, batch.payload) == (7, "calibration", TWO.payload)
        assert batch.time_ns.tolist() == [256, 512]


def by_declaration(data: bytes) -> Fields | None:
    """As the message says that recordings declare; None where ``data`` is none."""
    try:
        message = schema.parse("RawBatch", data)
    except ValueError:
        return None
    kinds = {"time_ns": "<u8", "source": "<u4", "length": "<u4", "step_ns": "<i4"}
    columns = {name: np.array(getattr(message, name), dtype=kind).tobytes() for name, kind in kinds.items()}
    return Fields(message.first, message.phase.encode(), flags=message.flags, payload=message.payload,
                  start_ns=message.start_ns, **columns)  # fmt: skip


def as_read(data: bytes) -> Fields | None:
    try:
        fields = fields_of(data)
        fields.phase.decode()
    except ValueError:
        return None
    return fields


@pytest.mark.parametrize("phase", ["calibration", "bus/0"])
@pytest.mark.parametrize(
    "other",
    [
        b"\x09" + bytes(8),  # a number that is 0
        b"\x12\0",  # an empty phase
        b"\x12\x01\xff",  # a phase that is no text
        b"\x19" + bytes(8),  # a time, not packed
        b"\x1a\x08" + bytes(8),  # times once more
        b"\x25" + bytes(4),  # a source, not packed
        b"\x4a\x03abc",  # three bytes of steps
        b"\x4a\x84\x00abcd",  # a length in more bytes than it takes
        b"\x52\x01x",  # a field of a later version
        b"\x53\x54",  # a group, which is none of ours either
        encode_raw(9, "calibration", TWO),
    ],
)
def test_what_another_writer_may_put_into_a_message_is_read_as_it_is_declared(phase: str, other: bytes) -> None:
    data = encode_raw(7, phase, TWO)
    for changed in (data, data + other, other + data, data[:9] + other + data[9:], other):
        assert as_read(changed) == by_declaration(changed)


@given(st.sampled_from(["calibration", "bus/0"]), rows, st.integers(0, 80), st.binary(max_size=4), st.booleans())
def test_a_damaged_message_is_read_as_it_is_declared(
    phase: str, records: list[tuple[int, int, int, bytes]], at: int, put: bytes, instead: bool
) -> None:
    data = encode_raw(7, phase, RawBatch.of(records))
    for changed in (data[:at] + put + data[at + instead * len(put) :], data[:at]):
        assert as_read(changed) == by_declaration(changed)


@pytest.mark.parametrize(
    "data",
    [
        b"\x09\x01",
        b"\xff\xff\xff",
        bytes.fromhex("3a03ffffff"),  # a payload without its records
        bytes.fromhex("1a07 00000000000000"),  # seven bytes of times
        bytes.fromhex("1a08 0100000000000000 4101000000000000"),  # times in two ways
        bytes.fromhex("3affffffffffffffffff01"),
    ],
)
def test_bytes_that_are_no_raw_batch_are_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError):
        decode_raw(data)


def test_more_records_than_one_message_may_have_are_a_value_error() -> None:
    n = schema.MAX_RECORDS + 1
    with pytest.raises(ValueError, match=f"{n} records in one message, expected at most {schema.MAX_RECORDS}"):
        decode_raw(by_protobuf(time_ns=[1] * n, source=[0] * n, flags=bytes(n), length=[0] * n))


def test_a_record_longer_than_any_is_a_value_error() -> None:
    with pytest.raises(ValueError, match="a record of 65536 bytes, expected at most 65535"):
        decode_raw(by_protobuf(time_ns=[1], source=[0], flags=b"\0", length=[65536], payload=bytes(65536)))


def test_messages_that_are_read_together_are_their_batches_one_after_the_other() -> None:
    unit, bus = encode_raw(7, "calibration", TWO), encode_raw(9, "bus/0", TWO)
    for messages in ([unit, unit], [bus, unit, bus], [encode_raw(0, "calibration", RawBatch.of([])), unit]):
        together = batch_of([fields_of(data) for data in messages])
        apart = RawBatch.joined([decode_raw(data)[2] for data in messages])
        for name in ("time_ns", "source", "flags", "length", "payload"):
            assert np.array_equal(getattr(together, name), getattr(apart, name)), name
            assert getattr(together, name).dtype == getattr(apart, name).dtype if name != "payload" else True


@pytest.mark.parametrize("column", ["time_ns", "source", "length", "payload"])
def test_a_message_that_lacks_what_the_next_has_too_much_is_a_value_error(column: str) -> None:
    columns = {"time_ns": [1, 2], "source": [1, 1], "flags": bytes(2), "length": [1, 1], "payload": b"ab"}
    less, more = ({**columns, column: columns[column][:n] + columns[column][:m]} for n, m in ((1, 0), (2, 1)))  # type: ignore[index]
    with pytest.raises(ValueError, match="differ in length"):
        batch_of([fields_of(by_protobuf(**less)), fields_of(by_protobuf(**more))])
