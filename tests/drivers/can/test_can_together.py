"""Samples of several messages: joined from one begin to the next, counted and timed by one of them, multiplexed, and
with slow channels beside them. cantools says what the frames hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cantools
import numpy as np
import pytest

from triaxcal_drivers.can.driver import CanDecoder
from triaxcal_drivers.can.layout import Layout, stream_layout
from triaxcal_drivers.can.model import DbcStream
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.interface import RawBatch, RawFlag, SampleBlock

MS = 1_000_000
DBC = """VERSION ""
BU_: S
BO_ 5 Time: 4 S
 SG_ Us : 7|32@0+ (1,0) [0|0] "us" S
BO_ 6 Count: 2 S
 SG_ N : 7|16@0+ (1,0) [0|0] "" S
BO_ 52 Acc: 6 S
 SG_ ax : 7|16@0- (0.00390625,0) [0|0] "" S
 SG_ ay : 23|16@0- (0.00390625,0) [0|0] "" S
 SG_ az : 39|16@0- (0.00390625,0) [0|0] "" S
BO_ 81 Temp: 2 S
 SG_ temp : 7|16@0- (0.00390625,0) [0|0] "" S
BO_ 96 Wit: 8 S
 SG_ Kind M : 8|8@1+ (1,0) [0|0] "" S
 SG_ Good : 0|2@1+ (1,0) [0|0] "" S
 SG_ AX m81 : 16|16@1- (0.5,0) [0|0] "" S
 SG_ AY m81 : 32|16@1- (0.5,0) [0|0] "" S
 SG_ AZ m81 : 48|16@1- (0.5,0) [0|0] "" S
 SG_ GX m82 : 16|16@1- (0.5,0) [0|0] "" S
 SG_ T m86 : 16|16@1- (0.01,0) [0|0] "" S
"""
FILE = cantools.database.load_string(DBC, "dbc")
OURS = DBC.replace("SG_ N :", 'SG_ Short : 15|8@0+ (1,0) [0|0] "" S\n SG_ N :').replace(
    "SG_ Good :", 'SG_ Cycle : 0|8@1+ (1,0) [0|0] "" S\n SG_ Good :'
)
"""With shorter counters in the same places."""
BEGIN: dict[str, Any] = {
    "together": {"begins": "Time"},
    "channels": {"ux": "ax", "uy": "ay", "uz": "az"},
}
STAMP = {"signal": "Us", "unit_s": 1e-6}
WIT: dict[str, Any] = {"channels": {"ux": "AX", "uy": "AY", "uz": "AZ"}}
Record = tuple[int, int, int, bytes]


def layout(**keys: Any) -> Layout:
    stream = DbcStream.model_validate({"layout": "dbc", "file": "f.dbc", **keys})
    return stream_layout(stream, {"f.dbc": OURS.encode()}, where="test")


def frame(time_ns: int, message: str, **signals: float) -> Record:
    found = FILE.get_message_by_name(message)
    return time_ns, found.frame_id, 0, found.encode(signals, strict=False)


def acc(time_ns: int, x: float) -> Record:
    return frame(time_ns, "Acc", ax=x, ay=-x, az=x / 2)


def wit(time_ns: int, kind: int, good: int = 1, **signals: float) -> Record:
    held = {81: {"AX": 0, "AY": 0, "AZ": 0}, 82: {"GX": 0}, 86: {"T": 0}}.get(kind)
    if held is None:
        return time_ns, 96, 0, bytes([good, kind, 9, 9, 9, 9, 9, 9])
    return frame(time_ns, "Wit", Kind=kind, Good=good, **{**held, **signals})


def cycle(k: int, *, us: int | None = None, lost: Sequence[str] = (), jitter_ns: int = 0) -> list[Record]:
    """Sample ``k`` of a device at 100 Hz: its time stamp, its counter, its accelerations."""
    at = 10 * MS * k + jitter_ns
    frames = {
        "Time": frame(at, "Time", Us=(10_000 * k if us is None else us) % 2**32),
        "Count": frame(at + MS, "Count", N=k % 2**16),
        "Acc": acc(at + 2 * MS, k % 100),
    }
    return [record for name, record in frames.items() if name not in lost]


def decoded(of: Layout, records: Sequence[Record], cuts: Sequence[int] = (), lost_before: int = -1) -> SampleBlock:
    """All blocks as one, with the sums of their counts."""
    decoder = CanDecoder(of, rate_hz=100.0)
    flagged = [
        (t, s, f | (RawFlag.LOST_BEFORE if i == lost_before else 0), d) for i, (t, s, f, d) in enumerate(records)
    ]
    blocks = [decoder.feed(RawBatch.of(flagged[a:b])) for a, b in pairwise([0, *cuts, len(flagged)])]
    sums = {
        name: sum(getattr(b, name) for b in blocks)
        for name in ("missing", "duplicates", "incomplete", "invalid", "malformed", "restarts", "errors")
    }
    return replace(
        blocks[-1],
        time_ns=np.concatenate([b.time_ns for b in blocks]),
        counter=np.concatenate([b.counter for b in blocks]),
        readings=np.concatenate([b.readings for b in blocks]),
        channels={n: np.concatenate([b.channels[n] for b in blocks]) for n in blocks[-1].channels},
        **sums,
    )


CUTS = [(), (1,), (4, 5), tuple(range(1, 40))]


@pytest.mark.parametrize("cuts", CUTS)
def test_a_sample_goes_from_one_begin_to_the_next(cuts: Sequence[int]) -> None:
    records = [acc(0, 77), *(record for k in range(1, 20) for record in cycle(k))]
    block = decoded(layout(**BEGIN), records, cuts)
    assert block.readings[:, 0].tolist() == list(range(1, 20))
    assert block.time_ns.tolist() == [10 * MS * k for k in range(1, 20)]
    assert (block.incomplete, block.missing, block.duplicates) == (0, 0, 0)


@pytest.mark.parametrize("rate_hz", [100, 500, 1000])
@pytest.mark.parametrize("seed", range(3))
def test_no_jitter_below_a_period_costs_a_sample(rate_hz: int, seed: int) -> None:
    """Frames of one device keep their order, however late the host sees them."""
    rng = np.random.default_rng(seed)
    period = 1_000_000_000 // rate_hz
    true_ns = [period * k // 1 + part * period // 10 for k in range(300) for part in range(3)]
    seen = np.maximum.accumulate(np.array(true_ns) + rng.uniform(0, 0.6 * period, len(true_ns)).astype(int))
    frames = [record for k in range(300) for record in cycle(k)]
    records = [(int(at), *record[1:]) for at, record in zip(seen, frames, strict=True)]
    decoder = CanDecoder(layout(**BEGIN, counter="N"), rate_hz=float(rate_hz))
    block = decoder.feed(RawBatch.of(records))
    assert (len(block), block.incomplete, block.missing) == (300, 0, 0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("cuts", [(), tuple(range(1, 800))])
def test_no_pause_of_the_host_costs_a_sample(seed: int, cuts: Sequence[int]) -> None:
    """Frames that wait are stamped together, in mid cycle too."""
    rng = np.random.default_rng(seed)
    frames = [record for k in range(300) for record in cycle(k)]
    seen = np.array([record[0] for record in frames])
    for begun in rng.uniform(0, 3e9, 12).astype(int):
        late = (seen >= begun) & (seen < begun + int(rng.uniform(5 * MS, 30 * MS)))
        seen[late] = seen[late].max(initial=0)
    records = [(int(at), *record[1:]) for at, record in zip(np.maximum.accumulate(seen), frames, strict=True)]
    block = decoded(layout(**BEGIN, counter="N"), records, cuts)
    assert (len(block), block.incomplete, block.missing) == (300, 0, 0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("cuts", [(), tuple(range(1, 800))])
@pytest.mark.parametrize(("jitter_ms", "rate"), [(0, 1.0), (1, 0.97), (3, 1.0), (0.5, 1.03), (0, 1.09)])
def test_frames_lost_in_a_row_never_mix_two_cycles(
    seed: int, cuts: Sequence[int], jitter_ms: float, rate: float
) -> None:
    """Whatever the jitter of the host, and where the device is faster or slower than it says."""
    rng = np.random.default_rng(seed)
    frames = [record for k in range(200) for record in cycle(k)]
    lost: set[int] = set()
    for begun in rng.integers(0, len(frames), 12):
        lost |= set(range(begun, begun + rng.integers(1, 8)))
    # The three frames of a cycle follow each other at once.
    at = np.array([10 * MS * (i // 3) / rate + 0.25 * MS * (i % 3) for i in range(len(frames))])
    at = np.maximum.accumulate(at + rng.uniform(0, jitter_ms * MS, len(at)))
    records = [(int(t), *frame[1:]) for i, (t, frame) in enumerate(zip(at, frames, strict=True)) if i not in lost]
    whole = [k for k in range(200) if not lost & {3 * k, 3 * k + 1, 3 * k + 2}]
    block = decoded(layout(**BEGIN, counter="N", time_stamp=STAMP), records, cuts)
    assert set(block.counter.tolist()) <= set(whole)
    assert block.readings[:, 0].tolist() == [k % 100 for k in block.counter.tolist()]
    assert block.time_ns.tolist() == [block.time_ns[0] + 10 * MS * (k - block.counter[0]) for k in block.counter]
    assert len(block) >= len(whole) - 2  # those at the end wait for begins that never come


@pytest.mark.parametrize("cuts", CUTS)
@pytest.mark.parametrize("first", [0, 1, 2])
def test_a_known_gap_is_not_forgotten_where_it_leaves_a_sample_incomplete(first: int, cuts: Sequence[int]) -> None:
    """A counter of 8 bits turns within the gap, and the host's clock tells by how much."""
    keys = {**BEGIN, "counter": "Short"}
    before = [record for k in range(20) for record in cycle(k)]
    after = [record for k in range(420, 440) for record in cycle(k)][first:]
    block = decoded(layout(**keys), [*before, *after], cuts, lost_before=len(before))
    steps = np.diff(block.time_ns)
    assert steps.max() == pytest.approx(4.01e9, abs=0.03e9)
    assert np.count_nonzero(steps != 10 * MS) == 1


def test_a_slow_channel_goes_with_a_counter_in_every_message() -> None:
    records = [(t, s, f, bytes([k]) + d[1:]) for k in range(20) for t, s, f, d in [wit(10 * MS * k + 5, 81, AX=k)]]
    records = [frame(0, "Temp", temp=20.0), *records]
    keys = {"channels": {**WIT["channels"], "temp_c": {"signal": "temp", "latest_s": 5}}, "counter": "Cycle"}
    block = decoded(layout(**keys), records)
    assert block.channels["temp_c"].tolist() == [20.0] * len(block)
    assert block.readings[:, 0].tolist() == list(range(20))
    assert (block.missing, block.incomplete) == (0, 0)


@pytest.mark.parametrize("order", [("AX", "GX"), ("GX", "AX")])
def test_a_begin_that_comes_in_several_kinds_of_frame_is_refused(order: tuple[str, str]) -> None:
    channels = {"ux": order[0], "uy": order[1], "uz": "ax"}
    with pytest.raises(ProfileError, match="begins a sample cannot be told"):
        layout(channels=channels, together={"begins": "Wit"})


def test_valid_counts_in_every_kind_of_frame() -> None:
    keys = {"channels": {"ux": "AX", "uy": "AY", "uz": "GX"}, "together": "time", "valid": "Good"}
    records = []
    for k in range(4):
        at = 10 * MS * k
        records += [wit(at, 81, AX=k), wit(at + 1, 82, good=int(k != 2))]
    block = decoded(layout(**keys), records)
    assert block.readings[:, 0].tolist() == [0, 1, 3]
    assert block.invalid == 1


@pytest.mark.parametrize("cuts", CUTS)
@pytest.mark.parametrize(
    ("lost", "incomplete"), [(["Time"], 1), (["Count"], 1), (["Acc"], 1), (["Time", "Count"], 1), (["Count", "Acc"], 1)]
)
def test_a_lost_frame_costs_its_sample_and_two_cycles_never_mix(
    lost: list[str], incomplete: int, cuts: Sequence[int]
) -> None:
    records = [record for k in range(20) for record in cycle(k, lost=lost if k == 7 else ())]
    block = decoded(layout(**BEGIN, counter="N"), records, cuts)
    assert block.readings[:, 0].tolist() == [k for k in range(20) if k != 7]
    assert block.counter.tolist() == [k for k in range(20) if k != 7]
    assert block.incomplete == incomplete


def test_what_is_lost_over_several_cycles_is_not_made_up_of_their_rest() -> None:
    """The begins of three cycles and other frames of theirs are lost."""
    lost = {7: ["Acc"], 8: ["Time", "Count"], 9: ["Time"], 10: ["Time", "Acc"]}
    records = [record for k in range(20) for record in cycle(k, lost=lost.get(k, ()))]
    block = decoded(layout(**BEGIN, counter="N"), records)
    assert block.readings[:, 0].tolist() == [k for k in range(20) if k not in lost]
    assert block.missing + block.incomplete >= 4


@pytest.mark.parametrize("cuts", CUTS)
def test_a_time_stamp_of_one_message_is_the_time_of_the_sample(cuts: Sequence[int]) -> None:
    begun = 2**32 - 55_000  # wraps after six samples
    rng = np.random.default_rng(1)
    records = [
        record
        for k in range(20)
        for record in cycle(k, us=begun + 10_020 * k, jitter_ns=int(rng.uniform(0, 4 * MS)) if k else 0)
    ]
    block = decoded(layout(**BEGIN, time_stamp=STAMP), records, cuts)
    assert block.time_ns.tolist() == [10_020_000 * k for k in range(20)]
    assert (block.missing, block.incomplete, block.restarts, block.duplicates) == (0, 0, 0, 0)


@pytest.mark.parametrize("keys", [{"counter": "N"}, {"time_stamp": STAMP}, {"counter": "N", "time_stamp": STAMP}])
@pytest.mark.parametrize("cuts", CUTS)
def test_a_device_that_restarts_goes_on_after_the_pause(keys: dict[str, Any], cuts: Sequence[int]) -> None:
    before = [record for k in range(5000, 5020) for record in cycle(k, us=3_000_000_000 + 10_000 * k)]
    after = [(t + 60 * 10**9, *rest) for k in range(20) for t, *rest in cycle(k)]
    block = decoded(layout(**BEGIN, **keys), [*before, *after], cuts)  # type: ignore[list-item]
    assert len(block) == 40
    assert np.all(np.diff(block.time_ns) > 0)
    pause_s = (block.time_ns[20] - block.time_ns[19]) / 1e9
    assert pause_s == pytest.approx(60 - 50.19, abs=0.1)
    assert block.restarts == 1


def test_a_counter_of_one_message_says_what_is_missing() -> None:
    records = [record for k in range(30) if not 10 <= k < 15 for record in cycle(k)]
    block = decoded(layout(**BEGIN, counter="N"), records)
    assert (len(block), block.missing, block.restarts) == (25, 5, 0)
    assert block.time_ns.tolist() == [10 * MS * k for k in range(30) if not 10 <= k < 15]


@pytest.mark.parametrize("keys", [{"counter": "N"}, {"time_stamp": STAMP}])
def test_after_a_gap_that_the_receiver_knows_of_samples_keep_their_distance(keys: dict[str, Any]) -> None:
    records = [record for k in range(30) if not 10 <= k < 15 for record in cycle(k)]
    block = decoded(layout(**BEGIN, **keys), records, lost_before=30)
    assert len(block) == 25
    assert np.diff(block.time_ns).max() == 60 * MS
    assert block.restarts == 0


@pytest.mark.parametrize("cuts", CUTS)
def test_a_slow_channel_has_its_newest_value_that_is_not_too_old(cuts: Sequence[int]) -> None:
    records = [record for k in range(30) for record in cycle(k)]
    temperatures = [(35 * MS, 20.0), (151 * MS, 21.0), (152 * MS, 22.0)]
    records = sorted([*records, *(frame(at, "Temp", temp=t) for at, t in temperatures)], key=lambda r: r[0])
    keys = {**BEGIN, "channels": {**BEGIN["channels"], "temp_c": {"signal": "temp", "latest_s": 0.1}}}
    block = decoded(layout(**keys), records, cuts)
    fresh = [*range(4, 14), *range(16, 26)]  # until 0.1 s after it came
    assert block.readings[:, 0].tolist() == fresh
    assert block.channels["temp_c"].tolist() == [20.0 if k < 16 else 22.0 for k in fresh]
    assert block.incomplete == 10
    assert block.missing == 0


@pytest.mark.parametrize("cuts", CUTS)
def test_frames_with_another_selector_are_passed_over(cuts: Sequence[int]) -> None:
    records = []
    for k in range(20):
        records += [wit(10 * MS * k, 81, AX=k, AY=-k, AZ=1), wit(10 * MS * k + MS, 82, GX=1000), wit(10 * MS * k, 99)]
    block = decoded(layout(**WIT), records, cuts)
    assert block.readings.tolist() == [[k, -k, 1] for k in range(20)]
    assert (block.incomplete, block.malformed, block.invalid) == (0, 0, 0)


@pytest.mark.parametrize("cuts", CUTS)
def test_a_slow_channel_may_be_in_the_same_message_under_another_selector(cuts: Sequence[int]) -> None:
    records = [wit(0, 86, T=25.0)]
    records += [wit(10 * MS * k + 1, 81, AX=k) for k in range(20)]
    keys = {"channels": {**WIT["channels"], "temp_c": {"signal": "T", "latest_s": 0.105}}}
    block = decoded(layout(**keys), records, cuts)
    assert block.channels["temp_c"].tolist() == [25.0] * 11
    assert block.incomplete == 9


def test_a_selector_that_never_comes_brings_no_sample() -> None:
    block = decoded(layout(**WIT), [wit(10 * MS * k, 82, GX=1) for k in range(20)])
    assert (len(block), block.incomplete, block.malformed) == (0, 0, 0)


def test_a_frame_without_its_selector_is_malformed() -> None:
    block = decoded(layout(**WIT), [(0, 96, 0, b"\1"), (1, 96, 0, b"\1\x51\0\0"), wit(2, 81, AX=1)])
    assert (len(block), block.malformed) == (1, 2)


@pytest.mark.parametrize(
    ("valid", "kept"),
    [
        ("Good", [1]),
        ({"signal": "Good", "values": [0, 1]}, [0, 1]),
        ([{"signal": "Good", "values": [0, 1, 2]}, {"signal": "Kind", "values": [81]}], [0, 1, 2]),
        ([{"signal": "Good", "values": [1, 2]}, {"signal": "AX", "values": [2, 4]}], [1, 2]),
        (["Good", {"signal": "AX", "values": [4]}], []),
    ],
)
def test_a_sample_counts_where_all_signals_say_so(valid: Any, kept: list[int]) -> None:
    records = [wit(10 * MS * k, 81, good=k, AX=k) for k in range(4)]
    block = decoded(layout(**WIT, valid=valid), records)
    assert block.readings[:, 0].tolist() == kept
    assert block.invalid == 4 - len(kept)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"channels": {"ux": "AX", "uy": "AY", "uz": "GX"}}, "(Wit (Kind = 81), Wit (Kind = 82)) needs a counter"),
        ({**BEGIN, "together": {"begins": "Tim"}}, "no message 'Tim'; did you mean 'Time'?"),
        ({**BEGIN, "time_stamp": {"signal": "ax", "unit_s": 1e-3}, "counter": "Nn"}, "no signal 'Nn'"),
        (
            {**BEGIN, "counter": "Good"},
            "counter 'Good' is a whole number of 2 bits, expected an integer of 4 to 32 bits",
        ),
        ({**WIT, "counter": "GX"}, "no signal 'GX' (the counter) in message 'Wit (Kind = 81)'"),
        ({**WIT, "valid": "GX"}, "valid: 'GX' is in no message of the sample (Wit (Kind = 81))"),
    ],
)
def test_what_a_stream_cannot_be_is_named(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ProfileError) as caught:
        layout(**keys)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
