"""Frames of the reference unit, written by hand from its register map, and what must come of them."""

import struct
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from triaxcal_drivers.can.driver import LATEST, CanDecoder, CanDriver
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.message import Message, Signal
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.profile import Bundle

T0 = 1_700_000_000_000_000_000
PERIOD = 10_000_000
Record = tuple[int, int, int, bytes]
DecodeAll = Callable[..., dict[str, Any]]
shared = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def xy(counter: int, at_ns: int = 0, *, node: int = 5) -> Record:
    """TPDO1; the reading in x tells the sample."""
    data = counter.to_bytes(4, "little")[:3] + bytes(3) + (counter % 65536).to_bytes(2, "little")
    return T0 + at_ns, 0x180 + node, 0, data


def z(counter: int, at_ns: int = 0, *, node: int = 5) -> Record:
    """TPDO2."""
    data = bytes(3) + struct.pack("<hH", 2500, counter % 65536) + bytes(1)
    return T0 + at_ns, 0x280 + node, 0, data


def whole(counters: Sequence[int], **more: int) -> list[Record]:
    return [f(c, i * PERIOD, **more) for i, c in enumerate(counters) for f in (xy, z)]


def test_the_reference_units_frames_give_volts_degrees_and_status(decoder: CanDecoder) -> None:
    block = decoder.feed(
        RawBatch.of(
            [
                (T0, 0x185, 0, bytes.fromhex("00 00 40  00 00 c0  34 12")),  # 2^22, -2^22, counter 0x1234
                (T0 + 1, 0x285, 0, bytes.fromhex("00 00 80  4b f6  34 12  0d")),  # -2^23, -24.85, status 0x0D
            ]
        )
    )
    assert block.readings.tolist() == [[5.0, -5.0, -10.0]]
    assert block.channels["temp_c"].tolist() == [pytest.approx(-24.85)]
    assert block.channels["status"].tolist() == [0x0D]
    assert block.counter.tolist() == [0x1234]
    assert block.time_ns.tolist() == [T0]
    assert (block.missing, block.duplicates, block.incomplete, block.errors) == (0, 0, 0, 0)


def test_the_corrected_stream_is_in_g(bundle: Bundle) -> None:
    decoder = CanDriver().decoder(bundle, "corrected")
    block = decoder.feed(
        RawBatch.of(
            [
                (T0, 0x385, 0, bytes.fromhex("40 42 0f  c0 bd f0  07 00")),  # 1 000 000, -1 000 000 µg
                (T0, 0x485, 0, bytes.fromhex("00 00 80  c4 09  07 00  02")),  # damaged calibration
            ]
        )
    )
    np.testing.assert_allclose(block.readings, [[1.0, -1.0, -8.388608]])
    assert block.channels["temp_c"].tolist() == [pytest.approx(25.0)]


def test_the_layout_out_of_the_eds_decodes_as_the_dbc_does(
    decoder: CanDecoder, pdo_decoder: CanDecoder, decode_all: DecodeAll
) -> None:
    random = np.random.default_rng(1)
    records = [
        (
            t,
            source,
            flags,
            random.bytes(6) + data[6:] if source == 0x185 else random.bytes(5) + data[5:7] + b"\x0d",
        )
        for t, source, flags, data in whole(range(65500, 65600))
    ]
    by_dbc, by_pdo = decode_all(decoder, records), decode_all(pdo_decoder, records)
    assert len(by_dbc["counter"]) == 100
    assert by_dbc == by_pdo


def test_a_unit_at_another_node_is_found_by_its_shifted_identifiers(bundle: Bundle, decode_all: DecodeAll) -> None:
    for node in (1, 42, 127):
        decoder = CanDriver().decoder(bundle, "readings")
        assert decode_all(decoder, whole(range(5), node=node))["counter"] == [0, 1, 2, 3, 4]


def test_frames_of_a_second_node_are_passed_over(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    mixed = [r for pair in zip(whole(range(20)), whole(range(50, 70), node=6), strict=True) for r in pair]
    assert decode_all(decoder, mixed) == decode_all(CanDecoder(decoder._layout, rate_hz=100.0), whole(range(20)))


def test_without_base_node_id_the_dbcs_identifiers_hold_as_they_are(
    edited: Callable[..., Bundle], decode_all: DecodeAll
) -> None:
    decoder = CanDriver().decoder(edited(("base_node_id = 5\n", "")), "readings")
    assert decode_all(decoder, whole(range(3), node=6))["counter"] == []
    assert decode_all(decoder, whole(range(3)))["counter"] == [0, 1, 2]


def test_the_profiles_scaling_goes_before_the_dbcs(edited: Callable[..., Bundle], decode_all: DecodeAll) -> None:
    changed = edited(('ux = "Ux"', 'ux = { signal = "Ux", scale = 2.0, offset = 1.0 }'))
    decoded = decode_all(CanDriver().decoder(changed, "readings"), whole([7]))
    assert decoded["readings"] == [[15.0, 0.0, 0.0]]


def test_the_counter_wraps_without_a_gap_and_time_goes_by_periods(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    # host time is compressed, as with an accelerated unit
    records = [(T0 + (r[0] - T0) // 50, *r[1:]) for r in whole(range(65530, 65550))]
    decoded = decode_all(decoder, records)
    assert decoded["counter"] == list(range(65530, 65550))
    assert decoded["time_ns"] == [T0 + k * PERIOD for k in range(20)]
    assert decoded["missing"] == 0


def test_the_order_of_a_samples_messages_does_not_matter(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    records = [xy(0), z(1), z(0), xy(2), xy(1), z(2)]
    decoded = decode_all(decoder, records)
    assert decoded["counter"] == [0, 1, 2]
    assert [r[0] for r in decoded["readings"]] == pytest.approx([k * 10 / 2**23 for k in range(3)])
    assert decoded["incomplete"] == decoded["missing"] == 0


def test_samples_that_never_came_are_counted_missing(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    decoded = decode_all(decoder, whole([0, 1, 5, *range(6, 20)]))
    assert decoded["counter"] == [0, 1, *range(5, 20)]
    assert decoded["missing"] == 3
    assert decoded["time_ns"][2] == T0 + 5 * PERIOD


def test_a_sample_that_lacks_a_message_is_counted_and_not_delivered(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    records = [r for r in whole(range(20)) if r[3] != z(4)[3]]
    decoded = decode_all(decoder, records)
    assert decoded["counter"] == [0, 1, 2, 3, *range(5, 20)]
    assert (decoded["incomplete"], decoded["missing"]) == (1, 0)


def test_a_message_is_waited_for_over_eight_samples_and_no_longer(bundle: Bundle, decode_all: DecodeAll) -> None:
    for late, incomplete in ((LATEST, 0), (LATEST + 1, 1)):
        records = [xy(0), *whole(range(1, late + 1)), z(0), *whole(range(late + 1, 20))]
        decoded = decode_all(CanDriver().decoder(bundle, "readings"), records)
        assert decoded["incomplete"] == incomplete
        assert decoded["counter"] == list(range(incomplete, 20))


def test_repeated_messages_are_dropped_and_counted(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    decoded = decode_all(decoder, [xy(0), xy(0), z(0), z(0), *whole([1, 1, 2])])
    assert decoded["counter"] == [0, 1, 2]
    assert decoded["duplicates"] == 4


def test_error_frames_and_frames_cut_short_are_counted_apart(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    records = [
        (T0, 0x004, int(RawFlag.ERROR), bytes(8)),
        *whole([0]),
        (T0, 0x185, 0, bytes(7)),
        (T0, 0x185, int(RawFlag.REMOTE), b""),
        (T0, 0x185, int(RawFlag.EXTENDED_ID), bytes(8)),
        *whole([1]),
    ]
    decoded = decode_all(decoder, records)
    assert decoded["counter"] == [0, 1]
    assert (decoded["errors"], decoded["malformed"]) == (1, 1)


@pytest.mark.parametrize("before", [5000, 30000, 50000])
def test_after_a_restart_time_goes_on_by_the_hosts_clock(
    decoder: CanDecoder, decode_all: DecodeAll, before: int
) -> None:
    first = [r for k in range(3) for r in (xy(before + k, k * PERIOD), z(before + k, k * PERIOD))]
    again = [r for k in range(3) for r in (xy(k, (k + 40) * PERIOD), z(k, (k + 40) * PERIOD))]
    decoded = decode_all(decoder, first + again)
    assert [(t - T0) // PERIOD for t in decoded["time_ns"]] == [0, 1, 2]
    more = decode_all(decoder, [r for k in range(3, 12) for r in (xy(k, (k + 40) * PERIOD), z(k))])
    assert [(t - T0) // PERIOD for t in more["time_ns"]] == list(range(40, 52))
    assert decoded["missing"] + more["missing"] == 37


def marked(records: Sequence[Record]) -> list[Record]:
    """The same after a gap that the receiver knows of; the mark is on a frame of another unit."""
    at_ns = records[0][0] - T0
    foreign = xy(0, at_ns - 1, node=9)
    return [(*foreign[:2], RawFlag.LOST_BEFORE, foreign[3]), *records]


@pytest.mark.parametrize("lost", [1, 904, 30_000, 40_000, 65_530, 65_536, 200_000, 8_640_000])
@pytest.mark.parametrize("rate_error", [0.0, 0.002, -0.002])
def test_over_a_gap_the_hosts_time_tells_how_often_the_counter_wrapped(
    decoder: CanDecoder, decode_all: DecodeAll, lost: int, rate_error: float
) -> None:
    back = 11 + lost
    at_ns = round(back * PERIOD * (1 + rate_error))
    after = [(t + at_ns, *rest) for t, *rest in whole(range(back, back + 20))]
    decoded = decode_all(decoder, [*whole(range(11)), *marked(after)])
    wraps = round(rate_error * lost / 65536) * 65536  # a counter tells no more than that
    assert decoded["missing"] == lost + wraps
    assert decoded["counter"] == [*range(11), *(back + wraps + k for k in range(20))]
    assert decoded["time_ns"] == [T0 + c * PERIOD for c in decoded["counter"]]


@pytest.mark.parametrize("pause_s", [0.5, 30, 3600])
@pytest.mark.parametrize("counted_s", [0.0, 0.4, 200.0])  # a counter may begin anywhere
@pytest.mark.parametrize("before", [500, 30_000, 65_000])
def test_a_restart_in_a_gap_is_bridged_by_the_hosts_time(
    decoder: CanDecoder, decode_all: DecodeAll, pause_s: float, counted_s: float, before: int
) -> None:
    counted = round(counted_s * 100)
    pause_ns = 10 * PERIOD + round(pause_s * 1e9)
    after = [(t + pause_ns, *rest) for t, *rest in whole(range(counted, counted + 20))]
    decoded = decode_all(decoder, [*whole(range(before, before + 11)), *marked(after)])
    assert len(decoded["counter"]) == 31
    assert decoded["time_ns"][11] - decoded["time_ns"][10] == pytest.approx(pause_s * 1e9, rel=0.1, abs=0.4e9)
    assert np.diff(decoded["time_ns"][11:]).tolist() == [PERIOD] * 19


def test_messages_of_one_sample_stay_together_though_a_gap_was_noticed_between_them(
    decoder: CanDecoder, decode_all: DecodeAll
) -> None:
    records = whole(range(20))
    decoded = decode_all(decoder, [*records[:9], *marked(records[9:])])
    assert decoded["counter"] == list(range(20))


@pytest.mark.parametrize(("lost", "restarts"), [(150, 0), (3, 0), (-150, 1)])
def test_a_burst_of_lost_messages_is_no_restart_of_a_counter_of_few_bits(lost: int, restarts: int) -> None:
    """150 lost of a counter of 8 bits look as if it had gone back by 106; the host's time tells."""
    signals = {n: Signal(n, 8 * i, 8) for i, n in enumerate(("ux", "uy", "uz"))}
    count = Signal("n", 24, 8)
    layout = Layout((Message("M", 0x100, signals),), {n: (0, s) for n, s in signals.items()}, (count,))
    decoder = CanDecoder(layout, rate_hz=100.0)
    begun, again = range(60), range(60 + lost, 80 + lost) if lost > 0 else range(20)
    pause = max(lost, 0)
    frames = [(T0 + i * PERIOD, 0x100, 0, bytes([1, 2, 3, n % 256])) for i, n in enumerate(begun)]
    frames += [(T0 + (60 + pause + i) * PERIOD, 0x100, 0, bytes([1, 2, 3, n % 256])) for i, n in enumerate(again)]
    assert decoder.feed(RawBatch.of(frames)).restarts == restarts


def test_time_never_goes_back_when_a_restart_takes_no_host_time(decoder: CanDecoder, decode_all: DecodeAll) -> None:
    records = [r for k in (40000, 40001, 0, 1, 2) for r in (xy(k), z(k))]  # all at the same host time
    decoded = decode_all(decoder, records)
    assert [(t - T0) // PERIOD for t in decoded["time_ns"]] == [0, 1, 2, 3, 4]
    assert decoded["missing"] == 0


def test_without_a_counter_every_message_is_a_sample_at_host_time(decode_all: DecodeAll) -> None:
    signals = {n: Signal(n, 8 * i, 8) for i, n in enumerate(("ux", "uy", "uz"))}
    layout = Layout((Message("M", 0x100, signals),), {n: (0, s) for n, s in signals.items()}, ())
    records = [(T0, 0x100, 0, b"\1\2\3"), (T0 + 7, 0x100, 0, b"\4\5\6"), (T0 + 5, 0x100, 0, b"\7\x08\x09")]
    for cuts in ([], [1], [1, 2]):
        decoded = decode_all(CanDecoder(layout, rate_hz=100.0), records, cuts)
        assert decoded["readings"] == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
        assert decoded["time_ns"] == [T0, T0 + 7, T0 + 7]
        assert decoded["counter"] == [0, 1, 2]


@st.composite
def troubled_streams(draw: st.DrawFn) -> list[Record]:
    """A stream with gaps, restarts, repeats, late and lost messages, foreign and broken frames."""
    counter, at_ns, records = draw(st.sampled_from([0, 3, 20_000, 65_530])), 0, []
    for _ in range(draw(st.integers(1, 25))):
        step = draw(st.sampled_from([1, 1, 1, 1, 1, 2, 5, 12, 3000, 0, -3, -20, None]))
        counter = 0 if step is None else (counter + step) % 65536
        at_ns += draw(st.sampled_from([0, 1_000_000, PERIOD, 30 * PERIOD]))
        parts = draw(st.sampled_from([(xy, z)] * 4 + [(z, xy), (xy,), (z,), (xy, xy, z)]))
        records += [part(counter, at_ns) for part in parts]
        if draw(st.integers(0, 9)) == 0:
            records.append(draw(st.sampled_from([
                (T0 + at_ns, 0x20, int(RawFlag.ERROR), bytes(8)), xy(7, at_ns, node=6),
                (T0 + at_ns, 0x285, 0, b"short"), (T0 + at_ns, 0x7FF, 0, b""),
                (T0 + at_ns, 0x7FF, int(RawFlag.LOST_BEFORE), b""),
            ])))  # fmt: skip
    swaps = draw(st.lists(st.integers(0, len(records) - 1), max_size=4))
    for at in swaps:
        records.insert(max(0, at - 3), records.pop(at))
    return records


@pytest.mark.slow
@shared
@given(troubled_streams(), st.data())
def test_samples_and_counts_are_the_same_however_the_records_are_cut(
    bundle: Bundle, decode_all: DecodeAll, records: list[Record], data: st.DataObject
) -> None:
    def fresh() -> CanDecoder:
        return CanDriver().decoder(bundle, "readings")

    whole_at_once = decode_all(fresh(), records)
    cuts = data.draw(st.lists(st.integers(0, len(records)), max_size=6))
    assert decode_all(fresh(), records, cuts) == whole_at_once
    assert decode_all(fresh(), records, range(len(records))) == whole_at_once
    assert all(a < b for a, b in pairwise(whole_at_once["time_ns"]))
    assert all(a < b for a, b in pairwise(whole_at_once["counter"]))


@shared
@given(st.lists(st.integers(0, 199), max_size=30, unique=True), st.integers(0, 65535))
def test_every_sample_is_delivered_incomplete_or_missing(
    bundle: Bundle, decode_all: DecodeAll, lost: list[int], start: int
) -> None:
    """Lost frames anywhere in 100 samples: the books balance."""
    sent = whole(range(start, start + 100))
    kept = [r for i, r in enumerate(sent) if i not in lost]
    tail = whole(range(start + 100, start + 100 + LATEST + 1))
    decoded = decode_all(CanDriver().decoder(bundle, "readings"), kept + tail)
    first = next((i for i in range(200) if i not in lost), 200) // 2
    parts_lost = [{2 * k, 2 * k + 1} & set(lost) for k in range(first, 100)]
    assert decoded["incomplete"] == sum(len(p) == 1 for p in parts_lost)
    assert decoded["missing"] == sum(len(p) == 2 for p in parts_lost)
    assert len(decoded["counter"]) == sum(not p for p in parts_lost) + LATEST + 1


@pytest.mark.parametrize("piece", [1, 7, 400, 5000])
def test_two_units_that_send_at_one_node_are_told_however_the_records_are_cut(decoder: CanDecoder, piece: int) -> None:
    ours, theirs = whole(range(100, 900)), [(t + PERIOD // 3, *rest) for t, *rest in whole(range(30_000, 30_800))]
    records = sorted([*ours, *theirs], key=lambda record: record[0])
    told = [decoder.feed(RawBatch.of(records[i : i + piece])).two_senders for i in range(0, len(records), piece)]
    assert any(told)


@pytest.mark.parametrize("piece", [1, 7, 400, 5000])
def test_one_unit_that_loses_and_repeats_is_not_two(decoder: CanDecoder, piece: int) -> None:
    rng = np.random.default_rng(piece)
    kept = [record for record in whole(range(60_000, 61_500)) if rng.random() > 0.2]
    records = [record for record in kept for _ in range(1 + (rng.random() < 0.3))]
    told = [decoder.feed(RawBatch.of(records[i : i + piece])).two_senders for i in range(0, len(records), piece)]
    assert not any(told)
