"""Replies, as bytes, to samples."""

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus.driver import ModbusDriver

FIFO_SOURCE, POLL_SOURCE = 0x0004_0020, 0x0003_006B
FULL = """
[streams.full]
layout = "fifo"
address = 0x40
poll_period_s = 0.05
header = { count = 0, remaining = 1, lost = 2 }
record_start = 3
record_words = 10
record_capacity = 12
counter = { word = 0, type = "uint16" }
time_stamp = { word = 1, type = "uint32", unit_s = 1e-6 }

[streams.full.channels]
ux = { word = 3, type = "int32", scale = 0.5 }
uy = { word = 5, type = "int32", scale = 0.5 }
uz = { word = 7, type = "int32", scale = 0.5, offset = 1.0 }
temp_c = { word = 9, type = "int16", scale = 0.01 }

[registers]
"""
FULL_SOURCE = 0x0004_0040


def decoder(bundle, stream, *replaced):
    return ModbusDriver().decoder(bundle(("\n[registers]\n", FULL), *replaced), stream)


def window(*counters, remaining=0, lost=0, stamp_us=None):
    """A reply of stream "full" with samples x = 2·counter, y = −2, z = 4."""
    body = b"".join(
        struct.pack(">HIiiih", c % 2**16, (c * 10_000 if stamp_us is None else stamp_us) % 2**32, 2 * c, -2, 4, 2150)
        for c in counters
    )
    return (struct.pack(">HHH", len(counters), remaining, lost) + body).ljust(246, b"\0")


def full(*replies, step_ns=50_000_000):
    return RawBatch.of([(i * step_ns, FULL_SOURCE, flags, data) for i, (flags, data) in enumerate(replies)])


def test_a_fifo_window_is_decoded(bundle):
    """Bytes by hand: two records; x −20927, y 22098, z 17216 in the first, counter 0xFFFF then 0."""
    reply = bytes.fromhex("0002 0000 AE41 5652 4340 FFFF 0001 0002 0003 0000")
    block = decoder(bundle, "queue").feed(RawBatch.of([(10**9, FIFO_SOURCE, 0, reply)]))
    np.testing.assert_array_equal(block.readings, [[-20927, 22098, 17216], [1, 2, 3]])
    assert block.counter.tolist() == [65535, 65536]
    assert block.time_ns.tolist() == [10**9 - 10_000_000, 10**9]  # the newest one was taken just now
    assert (block.missing, block.duplicates, block.errors) == (0, 0, 0)


def test_the_newest_sample_read_twice_is_one_sample_and_no_fault(bundle):
    """Read oftener than it changes, as a block with a counter should be."""
    readings = 'layout = "poll"\n'
    counted = (readings, readings + 'counter = { word = 3, type = "uint16" }\n')
    replies = [(10**7 * i, POLL_SOURCE, 0, bytes.fromhex(f"AE41 5652 4340 {7 + i // 2:04X}")) for i in range(6)]
    block = ModbusDriver().decoder(bundle(counted), "readings").feed(RawBatch.of(replies))
    assert len(block) == 3
    assert (block.missing, block.duplicates) == (0, 0)


def test_a_polled_block_is_a_sample(bundle):
    replies = [(100 * i, POLL_SOURCE, 0, bytes.fromhex("AE41 5652 4340")) for i in range(3)]
    block = decoder(bundle, "readings").feed(RawBatch.of(replies))
    assert block.readings.tolist() == [[-20927, 22098, 17216]] * 3
    assert block.time_ns.tolist() == [0, 100, 200]
    assert block.counter.tolist() == [0, 1, 2]


def test_values_are_scaled_and_further_channels_go_by_name(bundle):
    block = decoder(bundle, "full").feed(full((0, window(0, 1, 2))))
    np.testing.assert_array_equal(block.readings, [[0, -1, 3], [1, -1, 3], [2, -1, 3]])
    np.testing.assert_allclose(block.channels["temp_c"], 21.5)


def test_records_still_in_the_device_put_the_first_sample_back_in_time(bundle):
    block = decoder(bundle, "full").feed(full((0, window(0, 1, remaining=100)), step_ns=0))
    assert block.time_ns.tolist() == [-1_010_000_000, -1_000_000_000]


def test_unused_records_of_a_window_are_no_samples(bundle):
    assert len(decoder(bundle, "full").feed(full((0, window()), (0, window(5)), (0, window())))) == 1


def test_other_streams_in_the_batch_are_passed_over(bundle):
    block = decoder(bundle, "full").feed(
        RawBatch.of([(0, POLL_SOURCE, 0, b"\0" * 6), (1, FULL_SOURCE, 0, window(1)), (2, POLL_SOURCE, 4, b"\2")])
    )
    assert (len(block), block.errors) == (1, 0)


def test_failed_requests_are_errors_and_no_samples(bundle):
    block = decoder(
        bundle, "full"
    ).feed(
        full(
            (0, window(0, 1)),
            (RawFlag.ERROR, b"\x04"),
            (RawFlag.ERROR, b""),
            (RawFlag.INVALID, window(8)),
            (0, window(2)[:-2]),  # short
            (0, b"\x00\x0d" + window(2)[2:]),  # 13 records in a window of 12
            (0, window(2, 3)),
        )
    )
    assert block.counter.tolist() == [0, 1, 2, 3]
    assert block.errors == 5


def test_an_empty_batch_gives_no_samples(bundle):
    block = decoder(bundle, "full").feed(RawBatch.of([]))
    assert len(block) == 0
    assert block.readings.shape == (0, 3)
    assert set(block.channels) == {"temp_c"}


def test_overflow_in_the_device_is_missing_by_the_counter(bundle):
    block = decoder(bundle, "full").feed(full((0, window(0, 1)), (0, window(10, 11, lost=8))))
    assert block.missing == 8


def test_without_a_counter_overflow_is_missing_by_the_devices_own_count(bundle):
    no_clock = [
        ('counter = { word = 0, type = "uint16" }\ntime_stamp = { word = 1, type = "uint32", unit_s = 1e-6 }', "")
    ]
    decode = decoder(bundle, "full", *no_clock)
    before = decode.feed(full((0, window(0, 1, lost=65_530))))
    after = decode.feed(full((0, window(lost=65_534)), (0, window(10, 11, lost=2))))
    assert before.missing == 0  # lost before anybody listened
    assert after.missing == 8
    assert np.concatenate([before.counter, after.counter]).tolist() == [0, 1, 10, 11]


def test_the_devices_count_of_lost_samples_starts_afresh_with_it(bundle):
    no_clock = [
        ('counter = { word = 0, type = "uint16" }\ntime_stamp = { word = 1, type = "uint32", unit_s = 1e-6 }', "")
    ]
    decode = decoder(bundle, "full", *no_clock)
    blocks = [decode.feed(full((0, window(0, lost=lost)))) for lost in (10, 15, 15, 0, 0, 2)]
    assert [b.missing for b in blocks] == [0, 5, 0, 0, 0, 2]


def test_a_failed_request_counts_for_the_sample_after_it_and_no_later_one(bundle):
    """Without a time stamp a counter near zero is a restart after a failed request, and else a gap."""
    no_stamp = ('time_stamp = { word = 1, type = "uint32", unit_s = 1e-6 }', "")
    decode = decoder(bundle, "full", no_stamp)
    decode.feed(full((RawFlag.ERROR, b""), (0, window(40_000))))
    later_ns = (65_536 + 3 - 40_000) * 10_000_000
    assert decode.feed(RawBatch.of([(later_ns, FULL_SOURCE, 0, window(3))])).missing == 65_536 + 3 - 40_000 - 1
    decode.feed(full((0, window(40_000))))
    decode.feed(full((RawFlag.ERROR, b"")))
    assert decode.feed(full((0, window(3)))).missing == 0


def test_a_restart_seen_only_in_the_time_stamp_is_bridged_by_the_host_time(bundle):
    block = decoder(bundle, "full").feed(full((0, window(7000, 7001)), (0, window(0, 1)), step_ns=250_000_000))
    assert np.diff(block.time_ns).tolist() == [10_000_000, 240_000_000, 10_000_000]
    assert block.missing == 0


WORD_TYPES = {
    "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip


@pytest.mark.parametrize("type_", WORD_TYPES)
@pytest.mark.parametrize("word_order", ["big", "little"])
@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_every_type_is_decoded_in_every_order(bundle, type_, word_order, byte_order):
    number = 1.5 if type_.startswith("float") else 0x1234
    raw = struct.pack(">" + WORD_TYPES[type_], number)
    words = [raw[i : i + 2] for i in range(0, len(raw), 2)]
    if word_order == "little":
        words.reverse()
    if byte_order == "little":
        words = [w[::-1] for w in words]
    at = [i * len(words) for i in range(3)]
    channels = ", ".join(f'u{a} = {{ word = {w}, type = "{type_}" }}' for a, w in zip("xyz", at, strict=True))
    text = (
        'channels = { ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" }, '
        'uz = { word = 2, type = "int16" } }\n\n[streams.queue]'
    )
    decode = decoder(
        bundle,
        "readings",
        (text, f"channels = {{ {channels} }}\n\n[streams.queue]"),
        ('name = "by-hand"', f'name = "by-hand"\nword_order = "{word_order}"\nbyte_order = "{byte_order}"'),
    )
    block = decode.feed(RawBatch.of([(0, POLL_SOURCE, 0, b"".join(words) * 3)]))
    assert block.readings.tolist() == [[number] * 3]


events = st.lists(
    st.one_of(
        st.tuples(st.just("window"), st.integers(0, 12)),
        st.tuples(st.just("gap"), st.integers(1, 70_000)),
        st.tuples(st.just("error"), st.integers(0, 1)),
        st.tuples(st.just("restart"), st.just(0)),
        st.tuples(st.just("repeat"), st.just(0)),
        st.tuples(st.just("lost"), st.integers(1, 70_000)),
    ),
    max_size=25,
)


@given(events, st.lists(st.integers(0, 25), max_size=6))
def test_samples_do_not_depend_on_how_records_are_cut_into_batches(make_full, history, cuts):
    at, last, replies = 64_000, window(), []
    for kind, number in history:
        if kind == "window":
            last = window(*range(at, at + number), remaining=number)
            at += number
            replies.append((0, last))
        elif kind == "gap":
            at += number
        elif kind == "error":
            replies.append((RawFlag.ERROR, b"\x04" * number))
        elif kind == "restart":
            at = 0
        elif kind == "lost":
            at += number
            last = window(*range(at, at + 3), remaining=3)
            at += 3
            replies.append((RawFlag.LOST_BEFORE, last))
        else:
            replies.append((0, last))
    records = [(i * 50_000_000, FULL_SOURCE, flags, data) for i, (flags, data) in enumerate(replies)]
    whole = make_full().feed(RawBatch.of(records))
    decode = make_full()
    edges = [0, *sorted(min(c, len(records)) for c in cuts), len(records)]
    parts = [decode.feed(RawBatch.of(records[lo:hi])) for lo, hi in itertools.pairwise(edges)]
    for column in ("time_ns", "counter", "readings"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, column) for p in parts]), getattr(whole, column))
    for count in ("missing", "duplicates", "errors"):
        assert sum(getattr(p, count) for p in parts) == getattr(whole, count)
    assert (np.diff(whole.time_ns) > 0).all()


@pytest.fixture(scope="module")
def make_full(request):
    from triaxcal_drivers.catalogue import parse_bundle

    parsed = parse_bundle(
        request.getfixturevalue("profile_text").replace("\n[registers]\n", FULL).encode(), {}, where="t"
    )
    return lambda: ModbusDriver().decoder(parsed, "full")


def test_a_stream_that_is_not_there_is_refused_with_the_nearest_name(bundle):
    with pytest.raises(ProfileError, match="no stream named 'reading'; did you mean 'readings'"):
        decoder(bundle, "reading")


def fifo_of(units, windows, size=8):
    """Windows that the units answer in turn, each with samples of its own."""
    at, begun = [1000, 40_000, 9_000], itertools.count()
    replies = []
    for _ in range(windows):
        unit = next(begun) % units
        replies.append(window(*range(at[unit], at[unit] + size)))
        at[unit] += size
    return RawBatch.of([(1_000_000_000 * i // 12, FULL_SOURCE, 0, reply) for i, reply in enumerate(replies)])


@pytest.mark.parametrize(("units", "two"), [(1, False), (2, True)])
def test_two_units_that_answer_in_turn_out_of_their_fifos_are_told(bundle, units, two):
    block = decoder(bundle, "full").feed(fifo_of(units, 200))
    assert block.two_senders is two
