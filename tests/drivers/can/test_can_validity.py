"""What a unit says of its own samples: those that are not valid are dropped, and counted."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import pytest

from triaxcal_drivers.can.driver import CanDecoder, CanDriver
from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.message import Message, Signal
from triaxcal_drivers.interface import RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.profile import Bundle

MS = 1_000_000
XY = Message("XY", 0x10, {s.name: s for s in (Signal("ux", 0, 8), Signal("uy", 8, 8), Signal("v", 16, 2))})
Z = Message("Z", 0x11, {"uz": Signal("uz", 0, 8)})
CHANNELS = {"ux": (0, XY.signals["ux"]), "uy": (0, XY.signals["uy"]), "uz": (1, Z.signals["uz"])}
Record = tuple[int, int, int, bytes]


def xy(time_ns: int, x: int, valid: int = 1) -> Record:
    return time_ns, 0x10, 0, bytes([x, x, valid])


def z(time_ns: int, value: int) -> Record:
    return time_ns, 0x11, 0, bytes([value])


def decoded(layout: Layout, records: Sequence[Record], cuts: Sequence[int] = ()) -> list[SampleBlock]:
    decoder = CanDecoder(layout, rate_hz=100.0)
    return [decoder.feed(RawBatch.of(records[a:b])) for a, b in pairwise([0, *cuts, len(records)])]


def together(values: tuple[int, ...]) -> Layout:
    return Layout((XY, Z), CHANNELS, valid=((0, XY.signals["v"], values),), by_time=True)


@pytest.mark.parametrize(("values", "kept"), [((1,), [1, 4]), ((0,), [3]), ((1, 2), [1, 2, 4])])
def test_a_sample_is_valid_whose_signal_holds_one_of_the_values(values: tuple[int, ...], kept: list[int]) -> None:
    one = Message("M", 0x10, {**XY.signals, "uz": Signal("uz", 24, 8)})
    channels = {n: (0, one.signals[n]) for n in ("ux", "uy", "uz")}
    records = [(10 * MS * x, 0x10, 0, bytes([x, x, v, x])) for x, v in ((1, 1), (2, 2), (3, 0), (4, 1))]
    (block,) = decoded(Layout((one,), channels, valid=((0, one.signals["v"], values),)), records)
    assert block.readings[:, 0].tolist() == kept
    assert block.time_ns.tolist() == [10 * MS * x for x in kept]
    assert block.invalid == 4 - len(kept)


def test_with_a_counter_too_what_is_not_valid_is_not_missing(edited: Callable[..., Bundle]) -> None:
    bundle = edited(('counter = "Counter"\n', 'counter = "Counter"\nvalid = { signal = "Status", values = [13] }\n'))
    decoder = CanDriver().decoder(bundle, "readings")
    records = []
    for k in range(4):
        records.append((k, 0x185, 0, bytes(6) + k.to_bytes(2, "little")))
        records.append((k, 0x285, 0, bytes(5) + k.to_bytes(2, "little") + bytes([12 if k == 2 else 13])))
    block = decoder.feed(RawBatch.of(records))
    assert block.counter.tolist() == [0, 1, 3]
    assert (block.invalid, block.missing, block.incomplete) == (1, 0, 0)


@pytest.mark.parametrize("cuts", [(), (1,), (2,), tuple(range(1, 8))])
def test_messages_within_half_a_period_are_one_sample(cuts: Sequence[int]) -> None:
    records = [
        xy(0, 1), z(4 * MS, 101),
        z(10 * MS, 102), xy(11 * MS, 2),  # in either order
        xy(20 * MS, 3, valid=0), z(21 * MS, 103),  # not valid
        xy(30 * MS, 4),  # and its other message 6 ms later
        z(36 * MS, 104),
        xy(50 * MS, 5), z(51 * MS, 105),
    ]  # fmt: skip
    blocks = decoded(together((1,)), records, cuts)
    assert np.concatenate([b.readings for b in blocks]).tolist() == [[1, 1, 101], [2, 2, 102], [5, 5, 105]]
    assert np.concatenate([b.time_ns for b in blocks]).tolist() == [0, 10 * MS, 50 * MS]
    assert sum(b.incomplete for b in blocks) == 2
    assert sum(b.invalid for b in blocks) == 1


@pytest.mark.parametrize("cuts", [(), (3,), (5, 6), tuple(range(1, 9))])
@pytest.mark.parametrize("parts", [1, 2])
def test_samples_of_one_stamp_are_all_taken_and_repeats_of_one_are_not(parts: int, cuts: Sequence[int]) -> None:
    """As of an adapter that stamps a packet of messages, and of a log with every message twice."""
    one = Message("M", 0x10, {**XY.signals, "uz": Signal("uz", 24, 8)})
    single = Layout((one,), {n: (0, one.signals[n]) for n in ("ux", "uy", "uz")}, (), {}, ())
    x = [1, 2, 3, 3, 4, 5]
    stamps = [0, 0, 0, 0, 20 * MS, 20 * MS]
    if parts == 1:
        records = [(at, 0x10, 0, bytes([v, v, 1, v])) for at, v in zip(stamps, x, strict=True)]
        blocks = decoded(single, records, [c for c in cuts if c < len(records)])
    else:
        records = [m for at, v in zip(stamps, x, strict=True) for m in (xy(at, v), z(at, 100 + v))]
        blocks = decoded(together((1,)), records, cuts)
    assert np.concatenate([b.readings[:, 0] for b in blocks]).tolist() == x
    times = np.concatenate([b.time_ns for b in blocks])
    assert times.tolist() == [0, 1, 2, 2, 20 * MS, 20 * MS + 1]


def test_a_message_that_comes_again_begins_the_next_sample() -> None:
    (block,) = decoded(together((1,)), [xy(0, 1), xy(1 * MS, 2), z(2 * MS, 102)])
    assert block.readings.tolist() == [[2, 2, 102]]
    assert block.incomplete == 1


def test_a_fd_frame_of_an_error_passive_sender_is_no_remote_frame() -> None:
    one = Message("M", 0x10, {n: Signal(n, 8 * i, 8) for i, n in enumerate(("ux", "uy", "uz"))})
    layout = Layout((one,), {n: (0, s) for n, s in one.signals.items()}, ())
    passive = int(RawFlag.FD | RawFlag.REMOTE)
    (block,) = decoded(layout, [(0, 0x10, passive, b"\1\2\3"), (1, 0x10, int(RawFlag.REMOTE), b"\0\0\0")])
    assert block.readings.tolist() == [[1, 2, 3]]
