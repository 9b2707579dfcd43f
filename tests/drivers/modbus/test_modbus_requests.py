"""Samples of several requests: which requests there are, and which of their replies are one sample."""

import itertools
import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus.driver import ModbusDriver
from triaxcal_drivers.modbus.model import ModbusBus

HEAD = """
format = "triaxcal.profile/1"
name = "apart"
driver = "modbus"
identity = {{ vendor = "v", product = "p" }}
output = {{ unit = "counts" }}
sampling = {{ rate_hz = 10.0, reply_timeout_s = 1.0 }}
{more}
[streams.readings]
layout = "poll"
table = "holding"
address = 0x100
poll_period_s = 0.1
{stream}
[streams.readings.channels]
ux = {{ {ux}, type = "{type}" }}
uy = {{ {uy}, type = "{type}" }}
uz = {{ {uz}, type = "{type}" }}
{channels}
"""
MS = 1_000_000
SECOND = 1_000 * MS


def bundle(stream="", channels="", ux="word = 0", uy="word = 2", uz="word = 4", type="int16", more=""):
    text = HEAD.format(stream=stream, channels=channels, ux=ux, uy=uy, uz=uz, type=type, more=more)
    return parse_bundle(text.encode(), {}, where="apart.toml")


def decoder(made):
    return ModbusDriver().decoder(made, "readings")


def requests(made):
    reads = made.profile.reads("readings")
    return [(r.function, r.address, r.words) for r in (*reads.of_sample, *reads.lasting)]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, [(3, 0x100, 5)]),
        ({"stream": "max_gap = 1"}, [(3, 0x100, 5)]),
        ({"stream": "max_gap = 0"}, [(3, 0x100, 1), (3, 0x102, 1), (3, 0x104, 1)]),
        ({"uy": "word = 1"}, [(3, 0x100, 5)]),
        ({"stream": "max_gap = 0", "uy": "word = 1"}, [(3, 0x100, 2), (3, 0x104, 1)]),
        ({"stream": "max_gap = 1", "uy": "word = 1"}, [(3, 0x100, 2), (3, 0x104, 1)]),
        ({"stream": "max_gap = 2", "uy": "word = 1"}, [(3, 0x100, 5)]),
        ({"stream": "max_gap = 0", "type": "int32"}, [(3, 0x100, 6)]),
        ({"stream": "max_gap = 0", "type": "float64"}, [(3, 0x100, 8)]),  # which share words
        ({"ux": "word = 3"}, [(3, 0x100, 5)]),  # from the stream's address on, as ever
        ({"stream": "max_gap = 9", "ux": "word = 3", "uy": "word = 3"}, [(3, 0x103, 2)]),
        ({"stream": "max_gap = 0", "ux": "word = 4", "uz": "word = 0"}, [(3, 0x100, 1), (3, 0x102, 1), (3, 0x104, 1)]),
        ({"stream": "max_gap = 0", "uz": "word = 600"}, [(3, 0x100, 1), (3, 0x102, 1), (3, 0x358, 1)]),
        ({"stream": 'max_gap = 0\ncounter = { word = 130, type = "uint16" }\nvalid = { word = 5 }'},
         [(3, 0x100, 1), (3, 0x102, 1), (3, 0x104, 2), (3, 0x182, 1)]),
        ({"stream": "max_gap = 0", "type": "int32", "more": "max_read_words = 4"}, [(3, 0x100, 4), (3, 0x104, 2)]),
        ({"channels": 'temp_c = { table = "input", address = 0x40, type = "int16", latest_s = 5 }'},
         [(3, 0x100, 5), (4, 0x40, 1)]),
        ({"channels": 'temp_c = { address = 0x40, type = "int16" }'}, [(3, 0x40, 1), (3, 0x100, 5)]),
        ({"channels": 'temp_c = { word = 9, type = "int16", latest_s = 5.0 }'}, [(3, 0x100, 5), (3, 0x109, 1)]),
        ({"channels": 'a = { address = 0x40, type = "int16", latest_s = 5 }\n'
          'b = { address = 0x41, type = "int32", latest_s = 5 }\nc = { address = 0x43, type = "int16", latest_s = 2 }'},
         [(3, 0x100, 5), (3, 0x43, 1), (3, 0x40, 3)]),
        ({"ux": "address = 7", "uy": 'table = "input", address = 7', "uz": 'table = "input", address = 9'},
         [(3, 7, 1), (4, 7, 1), (4, 9, 1)]),
    ],
)  # fmt: skip
def test_requests_follow_from_the_profile(given, expected):
    assert requests(bundle(**given)) == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"channels": 't = { type = "int16" }'}, "readings.channels.t: give word (counted from the stream's address)"),
        ({"channels": 't = { word = 6, address = 7, type = "int16" }'}, "not both"),
        ({"channels": 't = { word = 6, table = "input", type = "int16" }'}, "give address in place of word"),
        ({"channels": 't = { address = 7, type = "int16", latest_s = 0 }'}, "latest_s: input should be greater than 0"),
        ({"channels": 't = { address = 7, type = "int16", latest = 1 }'}, "unknown key; did you mean 'latest_s'?"),
        ({"channels": 't = { address = 0xFFFF, type = "int32" }'}, "2 words from 65535 leave the table"),
        ({"channels": 't = { address = 0x100, type = "int16", latest_s = 1 }'},
         "streams.readings: two of its requests start at the same address, 256 (0x0100)"),
        ({"ux": "word = 0, latest_s = 1"}, "channels.ux: latest_s is for other channels"),
        ({"uz": "word = 200"}, "takes 201 words, more than one read gives (max_read_words 125); max_gap = 0"),
        ({"stream": "max_gap = -1"}, "max_gap: input should be greater than or equal to 0"),
        ({"stream": "max_gap = 0", "type": "int32", "more": "max_read_words = 1"}, "more than one read gives"),
        ({"stream": "valid = { word = 6, values = [] }"}, "valid"),
        ({"stream": "valid = { word = 6, values = [65536] }"}, "less than or equal to 65535"),
        ({"stream": "valid = { word = 6, mask = 0x10 }"}, "1 has bits outside the mask 0x10"),
        ({"stream": "valid = [{ word = 6 }, { word = 7, values = [4], mask = 3 }]"}, "4 has bits outside the mask 0x3"),
    ],
)  # fmt: skip
def test_a_fault_in_the_profile_is_one_line(given, message):
    with pytest.raises(ProfileError, match=re.escape(message)) as caught:
        bundle(**given)
    assert str(caught.value).startswith("apart.toml")
    assert "\n" not in str(caught.value)


def test_the_share_of_a_line_counts_each_request():
    """RTU at 9600 baud, 11 bits a character: a request of 8 bytes, a reply of 5 and two a word, two gaps of 3.5."""
    bus = ModbusBus(serial_port="/dev/ttyUSB7", baudrate=9600)
    slow = 'temp_c = { address = 0x40, type = "int16", latest_s = 5 }'
    for made, requests_a_sample in (
        (bundle(), [5]),
        (bundle("max_gap = 0"), [1, 1, 1]),
        (bundle("max_gap = 0", slow), [1, 1, 1, 1 / 25]),
    ):
        load = ModbusDriver().loads(made, bus)["readings"]
        characters = sum((8 + 5 + 2 * max(n, 1) + 2 * 3.5) * min(n, 1) for n in requests_a_sample)
        assert load.read_s == pytest.approx(characters * 11 / 9600)
        assert load.reads_per_s == 10


# Which replies are one sample: x, y, z at 0x100, 0x102, 0x104, each read by itself.

APART = bundle("max_gap = 0")
SOURCES = {"x": 0x0003_0100, "y": 0x0003_0102, "z": 0x0003_0104, "t": 0x0004_0040}


def record(what, value, time_ns, flags=0):
    """``what``: x, y, z, t; in capitals refused; with a ``!`` unanswered."""
    name = what[0].lower()
    if what[0].isupper():
        return time_ns, SOURCES[name], RawFlag.ERROR, b"\x02"
    if what.endswith("!"):
        return time_ns, SOURCES[name], RawFlag.ERROR, b""
    return time_ns, SOURCES[name], flags, struct.pack(">h", value)


def replies(text, step_ns=5 * MS):
    """Words such as ``x1 y1 z1``: a reply with that value, every 5 ms; ``Y1`` a refusal, ``y1!`` none in a second;
    ``|`` a gap, ``~`` 0.9 s without anything."""
    records, time_ns, flags = [], 0, 0
    for word in text.split():
        if word == "|":
            flags = RawFlag.LOST_BEFORE
            continue
        if word == "~":
            time_ns += 900 * MS
            continue
        time_ns += SECOND if word.endswith("!") else step_ns
        time_ns_, source, flag, data = record(word, int(word.strip("xyztXYZT!")), time_ns)
        records.append((time_ns_, source, flag | flags, data))
        flags = 0
    return RawBatch.of(records)


CYCLES = [
    # Replies, the samples that are whole, incomplete ones, errors.
    ("x1 y1 z1 x2 y2 z2", [1, 2], 0, 0),
    ("x1 Y1 x2 y2 z2", [2], 1, 1),  # an exception in the middle
    ("x1 Y1 z1 x2 y2 z2", [2], 1, 1),  # after which somebody goes on
    ("X1 x2 y2 z2", [2], 0, 1),  # nothing of it came
    ("x1 y1 Z1 x2 y2 z2", [2], 1, 1),
    ("x1 y1! x2 y2 z2", [2], 1, 1),  # a time-out
    ("x1 y1! y2 z2", [], 1, 1),  # those of the next cycle, whose first one was lost without a word
    ("x1 Y1 y1 z1 x2 y2 z2", [1, 2], 0, 1),  # repeated at once
    ("x1 Y1 y1 Z1 z1 x2 y2 z2", [1, 2], 0, 2),
    ("x1 Y1 Y1 x2 y2 z2", [2], 1, 2),  # once, and then given up
    ("x1 ~ Y1 y1 z1 x2 y2 z2", [2], 1, 1),  # a failure so late is a time-out
    ("x1 x2 y2 z2", [2], 1, 0),  # replies lost without a word
    ("x1 y1 x2 y2 z2", [2], 1, 0),
    ("x1 z1 x2 y2 z2", [2], 1, 0),
    ("y1 z1 x2 y2 z2", [2], 1, 0),  # begun in the middle
    ("z1 x2 y2 z2 x3", [2], 1, 0),  # the last one may go on
    ("x1 y1 | z2 x3 y3 z3", [3], 2, 0),  # a gap in it
    ("x1 | y1 z1 | x3 y3 z3", [3], 2, 0),
    ("x1 y1 z1 | x2 y2 z2", [1, 2], 0, 0),
    ("x1 ~ y1 ~ z1 x2 y2 z2", [1, 2], 0, 0),  # slow, within its time-outs
    ("x1 ~ ~ y1 ~ z1 x2 y2 z2", [2], 1, 0),  # slower than they allow: two cycles may be mixed
    ("x1 y1 z1 z1 x2 y2 z2", [1, 2], 1, 0),
    ("x1 z1 y1 x2 y2 z2", [2], 2, 0),
]  # fmt: skip


@pytest.mark.parametrize(("text", "whole", "incomplete", "errors"), CYCLES)
def test_two_cycles_never_mix(text, whole, incomplete, errors):
    batch = replies(text)
    block = decoder(APART).feed(batch)
    np.testing.assert_array_equal(block.readings, np.array([[n] * 3 for n in whole], dtype=float).reshape(-1, 3))
    assert (block.incomplete, block.errors) == (incomplete, errors)
    for parts in (range(len(batch) + 1), (0, 1, 3, len(batch)), (0, 2, len(batch))):
        apart = decoder(APART)
        blocks = [apart.feed(batch.part(a, b)) for a, b in itertools.pairwise(parts)]
        np.testing.assert_array_equal(np.concatenate([b.readings for b in blocks]), block.readings)
        np.testing.assert_array_equal(np.concatenate([b.time_ns for b in blocks]), block.time_ns)
        assert (sum(b.incomplete for b in blocks), sum(b.errors for b in blocks)) == (incomplete, errors)


def test_a_sample_is_midway_between_its_first_and_its_last_reply():
    batch = RawBatch.of([record("x", 1, 10 * MS), record("y", 1, 12 * MS), record("z", 1, 20 * MS)])
    assert decoder(APART).feed(batch).time_ns.tolist() == [15 * MS]
    one = RawBatch.of([(10 * MS, SOURCES["x"], 0, struct.pack(">5h", 1, 0, 1, 0, 1))])
    assert decoder(bundle()).feed(one).time_ns.tolist() == [10 * MS]  # of one request, when its reply came


def expected_of(words):
    """The whole samples by a machine that takes one reply after the other."""
    samples, had, failed_before = [], [], ""
    for name, number, failed in words:
        wanted = "xyz"[len(had)]
        if name == "x":
            had = []
        elif name != wanted or (failed_before and (failed_before != name or failed)):
            had, failed_before = [], ""
            continue
        if name == "x" or had:
            failed_before = name if failed else ""
            had += [] if failed else [number]
        if len(had) == 3:
            samples.append((had[0], had[2]))
            had = []
    return samples


@settings(max_examples=300)
@given(
    st.lists(st.tuples(st.sampled_from("xyz"), st.booleans()), max_size=60), st.lists(st.integers(0, 60), max_size=5)
)
def test_any_sequence_of_replies_gives_whole_cycles_alone_however_it_is_cut(words, cuts):
    numbered = [(name, i, failed) for i, (name, failed) in enumerate(words)]
    text = " ".join((name.upper() if failed else name) + str(i) for name, i, failed in numbered)
    batch = replies(text, step_ns=MS)
    apart = decoder(APART)
    edges = sorted({0, len(batch), *(c for c in cuts if c < len(batch))})
    blocks = [apart.feed(batch.part(a, b)) for a, b in itertools.pairwise(edges)] or [apart.feed(batch)]
    readings = np.concatenate([b.readings for b in blocks])
    assert [(x, z) for x, _, z in readings.tolist()] == expected_of(numbered)
    whole = decoder(APART).feed(batch)
    np.testing.assert_array_equal(readings, whole.readings)
    assert sum(b.incomplete for b in blocks) == whole.incomplete


# Values that last.

TEMP = 'temp_c = { table = "input", address = 0x40, type = "int16", scale = 0.5, latest_s = 1.0 }'
SLOW = bundle("max_gap = 0", TEMP)


@pytest.mark.parametrize(
    ("text", "expected", "incomplete", "errors"),
    [
        ("t20 x1 y1 z1 x2 y2 z2", [(1, 10.0), (2, 10.0)], 0, 0),
        ("x1 y1 z1 t20 x2 y2 z2", [(2, 10.0)], 1, 0),  # it has not come
        ("t20 t22 x1 y1 z1", [(1, 11.0)], 0, 0),  # the newest
        ("t20 x1 t22 y1 z1 x2 y2 z2", [(1, 10.0), (2, 11.0)], 0, 0),  # before the sample
        ("t20 x1 y1 z1 ~ x2 y2 z2 ~ x3 y3 z3 t24 x4 y4 z4", [(1, 10.0), (2, 10.0), (4, 12.0)], 1, 0),  # too old
        ("t20 x1 y1 z1 T0 x2 y2 z2", [(1, 10.0), (2, 10.0)], 0, 1),  # one that fails does no harm while the last is new
        ("t20 t0! x1 y1 z1", [], 1, 1),
        ("t20 x1 Y1 x2 y2 z2", [(2, 10.0)], 1, 1),
    ],
)  # fmt: skip
def test_a_sample_has_the_newest_value_before_it_unless_that_is_too_old(text, expected, incomplete, errors):
    batch = replies(text)
    block = decoder(SLOW).feed(batch)
    assert list(zip(block.readings[:, 0], block.channels["temp_c"], strict=True)) == expected
    assert (block.incomplete, block.errors) == (incomplete, errors)
    apart = decoder(SLOW)
    blocks = [apart.feed(batch.part(i, i + 1)) for i in range(len(batch))]
    assert np.concatenate([b.channels["temp_c"] for b in blocks]).tolist() == [t for _, t in expected]
    assert sum(b.incomplete for b in blocks) == incomplete


@pytest.mark.parametrize(("late_ns", "samples"), [(0, 1), (1, 0)])
def test_a_value_may_be_as_old_as_the_profile_says_and_no_older(late_ns, samples):
    at = SECOND + late_ns
    batch = RawBatch.of([record("t", 20, 0), *(record(axis, 1, at) for axis in "xyz")])
    block = decoder(SLOW).feed(batch)
    assert (len(block), block.incomplete) == (samples, 1 - samples)


def test_streams_may_share_a_value_that_lasts():
    temp = 'temp_c = { table = "input", address = 0x40, type = "int16", latest_s = 1.0 }'
    second = (
        '\n[streams.corrected]\nlayout = "poll"\naddress = 0x200\npoll_period_s = 0.1\n[streams.corrected.channels]\n'
        + "".join(f'u{axis} = {{ word = {i}, type = "int16" }}\n' for i, axis in enumerate("xyz"))
    )
    both = bundle(channels=temp + second + temp)
    batch = RawBatch.of([
        (0, SOURCES["t"], 0, b"\0\x15"),
        (MS, SOURCES["x"], 0, bytes(10)),
        (2 * MS, 0x0004_0200, 0, bytes(6)),
    ])  # fmt: skip
    for stream in ("readings", "corrected"):
        assert ModbusDriver().decoder(both, stream).feed(batch).channels["temp_c"].tolist() == [21.0]


# What the unit says of its samples.


def status(*words):
    """Blocks of x, y, z = their number, and further words."""
    return RawBatch.of(
        [(i * 100 * MS, SOURCES["x"], 0, struct.pack(f">3h{len(w)}H", i, i, i, *w)) for i, w in enumerate(words)]
    )


AXES = {"uy": "word = 1", "uz": "word = 2"}


@pytest.mark.parametrize(
    ("valid", "words", "expected"),
    [
        ("{ word = 3 }", [(1,), (0,), (2,), (1,)], [0, 3]),
        ("{ word = 3, values = [2, 3] }", [(1,), (2,), (3,), (0x8003,)], [1, 2]),
        ("{ word = 3, values = [1], mask = 1 }", [(1,), (2,), (3,), (0xFFFF,)], [0, 2, 3]),
        ("{ word = 3, values = [0], mask = 0x8010 }", [(0x7FEF,), (0x10,), (0x8000,)], [0]),
        ("{ word = 3, values = [0x8000], mask = 0x8001 }", [(0x8000,), (0x8001,), (0xFFFE,)], [0, 2]),
        ("[{ word = 3 }, { word = 4, values = [7] }]", [(1, 7), (1, 6), (0, 7), (0, 0)], [0]),
        ("[{ word = 3, mask = 1 }, { word = 3, values = [0], mask = 2 }]", [(1,), (3,), (5,)], [0, 2]),
    ],
)
@pytest.mark.parametrize("gap", ["", "max_gap = 0\n"])
def test_a_sample_counts_if_every_word_holds_one_of_its_values(valid, words, expected, gap):
    block = decoder(bundle(f"{gap}valid = {valid}", **AXES)).feed(status(*words))
    assert block.readings[:, 0].tolist() == expected
    assert block.invalid == len(words) - len(expected)
    assert (block.missing, block.incomplete, block.errors) == (0, 0, 0)


def test_a_sample_that_is_not_valid_is_none_that_is_missing():
    made = bundle('valid = { word = 3 }\ncounter = { word = 4, type = "uint16" }', **AXES)
    batch = status((1, 7), (0, 8), (1, 9), (1, 9), (1, 11))
    block = decoder(made).feed(batch)
    assert block.counter.tolist() == [7, 9, 11]
    assert (block.invalid, block.missing, block.duplicates) == (1, 1, 0)


def test_the_order_of_bytes_and_words_holds_in_every_request():
    made = bundle(
        'max_gap = 0\nvalid = { word = 9, values = [0x0102] }',
        'temp_c = { table = "input", address = 0x40, type = "int32", latest_s = 1.0 }',
        type="int32", uy="word = 3", uz="word = 6", more='byte_order = "little"\nword_order = "little"',
    )  # fmt: skip
    number = {name: struct.pack("<i", value) for name, value in {"x": 70_000, "y": -2, "z": 3, "t": -70_001}.items()}
    at = {"x": 0x0003_0100, "y": 0x0003_0103, "z": 0x0003_0106, "t": 0x0004_0040}
    batch = RawBatch.of([(0, at[n], 0, number[n]) for n in "txyz"] + [(0, 0x0003_0109, 0, b"\x02\x01")])
    block = decoder(made).feed(batch)
    assert block.readings.tolist() == [[70_000, -2, 3]]
    assert block.channels["temp_c"].tolist() == [-70_001]


@pytest.mark.parametrize("stream", ["", "max_gap = 0"])
@pytest.mark.parametrize("order", ["big", "little"])
def test_records_without_a_whole_reply_are_no_samples(stream, order):
    block = decoder(bundle(stream, more=f'byte_order = "{order}"')).feed(
        RawBatch.of([record("X", 0, 0), record("x!", 0, 1)])
    )
    assert (len(block), block.errors, block.incomplete) == (0, 2, 0)
    assert block.readings.shape == (0, 3)
