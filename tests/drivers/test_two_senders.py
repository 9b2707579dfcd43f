"""One sender or two, told from counts, times and contents, over many seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from triaxcal_drivers.two_senders import BURSTS, MEMORY, RECORDS, Records, by_arrival, by_counter, by_levels

PERIOD_NS = 10_000_000
SEEDS = range(2)


@dataclass
class Sent:
    """What one unit sends: when it arrives, its count, its numbers."""

    time_ns: np.ndarray
    counter: np.ndarray
    values: np.ndarray

    def part(self, rows: np.ndarray) -> Sent:
        return Sent(self.time_ns[rows], self.counter[rows], self.values[rows])


def unit(
    rng: np.random.Generator, n: int, *, first: int | None = None, late_s: float = 0.0, begin_s: float = 0.0
) -> Sent:
    """``n`` samples at the rate, off by some 100 ppm, of 18 bits and with noise, each as late as chance has it."""
    first = int(rng.integers(0, 1 << 16)) if first is None else first
    period_ns = PERIOD_NS * (1 + rng.normal(0, 1e-4))
    sampled_ns = begin_s * 1e9 + period_ns * (np.arange(n) + rng.random())
    values = np.rint(rng.normal(0, 1e5, 3) + rng.normal(0, 30, (n, 3)))
    arrived = sampled_ns + rng.exponential(late_s * 1e9, n) if late_s else sampled_ns
    return Sent(arrived.astype(np.int64), first + np.arange(n), values)


def together(*sent: Sent, bits: int) -> Records:
    """In the order of arrival."""
    time_ns = np.concatenate([s.time_ns for s in sent])
    order = np.argsort(time_ns, kind="stable")
    counter = np.concatenate([s.counter for s in sent])[order] % (1 << bits)
    return Records(time_ns[order], counter, np.concatenate([s.values for s in sent])[order], 1 << bits)


def ever(records: Records, judge=by_counter) -> int | None:
    """After how many records it is told, as it is looked at while they come; None where never."""
    for n in range(RECORDS, len(records.counter) + 1, RECORDS):
        begin = max(0, n - MEMORY)
        window = Records(records.time_ns[begin:n], records.counter[begin:n], records.values[begin:n], records.counts)
        if judge(window):
            return n
    return None


def lossy(rng: np.random.Generator, sent: Sent, share: float) -> Sent:
    return sent.part(rng.random(len(sent.counter)) >= share)


def in_bursts(rng: np.random.Generator, sent: Sent, share: float, longest: int) -> Sent:
    kept = np.ones(len(sent.counter), dtype=bool)
    for begin in np.flatnonzero(rng.random(len(kept)) < share):
        kept[begin : begin + int(rng.integers(1, longest))] = False
    return sent.part(kept)


def repeated(rng: np.random.Generator, sent: Sent, share: float, late_s: float) -> Sent:
    again = sent.part(rng.random(len(sent.counter)) < share)
    again = Sent(again.time_ns + round(late_s * 1e9), again.counter, again.values)
    return Sent(*(np.concatenate(pair) for pair in zip(vars(sent).values(), vars(again).values(), strict=True)))


def restarting(rng: np.random.Generator, n: int, every: int, *, pause_s: float) -> Sent:
    """Begins anew at a count near zero after some ``every`` samples."""
    parts, begin_s = [], 0.0
    while sum(len(p.counter) for p in parts) < n:
        parts.append(
            unit(rng, int(rng.integers(every // 2, 2 * every)), first=int(rng.integers(0, 3)), begin_s=begin_s)
        )
        begin_s = float(parts[-1].time_ns[-1]) * 1e-9 + pause_s
    return Sent(*(np.concatenate(column) for column in zip(*(vars(p).values() for p in parts), strict=True)))


def stalled(rng: np.random.Generator, sent: Sent, stalls: int) -> Sent:
    """The host is kept from looking: what came meanwhile bears one time."""
    time_ns = sent.time_ns.copy()
    for _ in range(stalls):
        begin = int(rng.integers(time_ns[0], time_ns[-1]))
        held = (time_ns >= begin) & (time_ns < begin + int(rng.integers(1e8, 3e9)))
        if held.any():
            time_ns[held] = time_ns[held].max()
    return Sent(time_ns, sent.counter, sent.values)


ONE = {
    "as it should be": lambda rng: unit(rng, 1500),
    "loses one in ten": lambda rng: lossy(rng, unit(rng, 1500), 0.1),
    "loses two of three": lambda rng: lossy(rng, unit(rng, 3000), 0.66),
    "loses in bursts": lambda rng: in_bursts(rng, unit(rng, 1500), 0.02, 200),
    "repeats all": lambda rng: repeated(rng, unit(rng, 1000), 1.0, 0.0),
    "repeats all a little late": lambda rng: repeated(rng, unit(rng, 1000), 1.0, float(rng.uniform(0, 0.09))),
    "repeats all late": lambda rng: repeated(rng, unit(rng, 1500), 1.0, float(rng.uniform(0.1, 4.0))),
    "repeats half late": lambda rng: repeated(rng, unit(rng, 1500), 0.5, float(rng.uniform(0.0, 4.0))),
    "repeats most and loses some": lambda rng: lossy(
        rng, repeated(rng, unit(rng, 1500), 0.9, float(rng.uniform(0, 1))), 0.2
    ),
    "comes out of order": lambda rng: unit(rng, 3000, late_s=0.03),
    "comes far out of order": lambda rng: unit(rng, 3000, late_s=float(rng.uniform(0.1, 1.0))),
    "restarts": lambda rng: restarting(rng, 2000, 400, pause_s=1.0),
    "restarts again and again": lambda rng: restarting(rng, 2000, int(rng.integers(24, 80)), pause_s=0.0),
    "is heard in stalls": lambda rng: stalled(rng, lossy(rng, unit(rng, 1500), 0.05), 6),
    "all at once": lambda rng: stalled(
        rng, lossy(rng, repeated(rng, restarting(rng, 3000, 200, pause_s=0.3), 0.2, float(rng.uniform(0, 0.5))), 0.1), 4
    ),
}  # fmt: skip


def over_two_ways(rng: np.random.Generator, late_s: float) -> Sent:
    """Each record takes one of two ways, of which one is slower."""
    sent = unit(rng, 1500)
    slower = rng.random(1500) < 0.5
    return Sent(sent.time_ns + slower * round(late_s * 1e9), sent.counter, sent.values)


ONE |= {
    "over two ways": lambda rng: over_two_ways(rng, float(rng.uniform(0, 3.0))),
    "in blocks of other order": lambda rng: blocks(rng),
}


def blocks(rng: np.random.Generator) -> Sent:
    """Blocks of records that change places with the next one."""
    sent, size = unit(rng, 1440), int(rng.integers(2, 60))
    order = np.arange(1440).reshape(-1, 2, size)[:, ::-1].ravel() if 1440 % (2 * size) == 0 else np.arange(1440)
    return Sent(sent.time_ns, sent.counter[order], sent.values[order])


@pytest.mark.parametrize("bits", [4, 8, 16, 32])
@pytest.mark.parametrize("does", ONE)
def test_one_unit_is_never_called_two(does: str, bits: int) -> None:
    never_two(does, bits, SEEDS)


@pytest.mark.slow
@pytest.mark.parametrize("bits", [4, 8, 16, 32])
@pytest.mark.parametrize("does", ONE)
def test_one_unit_is_never_called_two_whatever_the_seed(does: str, bits: int) -> None:
    never_two(does, bits, range(100, 115))


def never_two(does: str, bits: int, seeds: range) -> None:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        assert ever(together(ONE[does](rng), bits=bits)) is None, seed


@pytest.mark.parametrize("bits", [4, 8, 16, 32])
@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_two_units_are_told_within_seconds(bits: int, lost: float) -> None:
    """Two at 100 Hz bring 200 records a second."""
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        mixed = together(*(lossy(rng, unit(rng, 500), lost) for _ in range(2)), bits=bits)
        found.append(ever(mixed) or 10**6)
    assert max(found) <= 800, found
    assert np.median(found) <= (RECORDS if bits > 8 else 4 * RECORDS)


@pytest.mark.parametrize("apart", range(21))
def test_two_units_whose_counters_are_near_are_told_by_what_they_send(apart: int) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        mixed = together(unit(rng, 400, first=1000), unit(rng, 400, first=1000 + apart), bits=16)
        assert ever(mixed) is not None, seed


def test_a_second_unit_is_told_after_hours_of_one() -> None:
    rng = np.random.default_rng(1)
    alone, joining = unit(rng, 6000), unit(rng, 1000, begin_s=50.0)
    told = ever(together(alone, joining, bits=16))
    assert told is not None
    assert told <= 5000 + 2 * RECORDS


@pytest.mark.parametrize("size", [2, 10, 60])
def test_two_units_that_send_several_at_once_are_told(size: int) -> None:
    """As out of two FIFOs that are read in turn."""
    rng = np.random.default_rng(size)
    a, b = unit(rng, 1800), unit(rng, 1800)
    sampled_ns = a.time_ns.copy()
    for sent, shift in ((a, 0), (b, size // 2)):
        sent.time_ns[:] = (
            sampled_ns[(np.arange(1800) // size + 1).clip(max=1800 // size - 1) * size] + shift * PERIOD_NS
        )
    told = ever(together(a, b, bits=16))
    assert told is not None
    assert told <= 2 * BURSTS


def polled(rng: np.random.Generator, bits: int, units: int, *, restarts: int = 0, speed: float = 1.0) -> Records:
    """The newest count of one of the units, asked for each 50 ms or so."""
    n = 400
    time_ns = (np.arange(n) * 5e7 + rng.exponential(5e6, n)).astype(np.int64)
    counts = np.array([rng.integers(0, 1 << bits) + np.floor(time_ns * speed / PERIOD_NS) for _ in range(units)])
    for at in rng.integers(0, n, restarts):
        counts[0, at:] = np.floor((time_ns[at:] - time_ns[at]) * speed / PERIOD_NS)
    who = rng.integers(0, units, n)
    raw = counts[who, np.arange(n)].astype(np.int64) % (1 << bits)
    return Records(time_ns, raw, np.zeros((n, 1)), 1 << bits)


@pytest.mark.parametrize("speed", [1.0, 60.0])
@pytest.mark.parametrize("restarts", [0, 1, 5])
def test_polls_of_one_unit_are_never_called_those_of_two(restarts: int, speed: float) -> None:
    for seed in SEEDS:
        for bits in (8, 16, 32):
            rng = np.random.default_rng(seed)
            records = polled(rng, bits, 1, restarts=restarts, speed=speed)
            assert ever(records, lambda r: by_levels(r, PERIOD_NS)) is None, (seed, bits)


def test_polls_that_two_units_answer_are_told() -> None:
    told = [
        ever(polled(np.random.default_rng(seed), bits, 2), lambda r: by_levels(r, PERIOD_NS)) is not None
        for seed in range(20)
        for bits in (16, 32)
    ]
    assert np.mean(told) >= 0.95


def uncounted(sent: Sent) -> Records:
    order = np.argsort(sent.time_ns, kind="stable")
    return Records(sent.time_ns[order], np.zeros(len(order), np.int64), sent.values[order], 1)


def both(*sent: Sent) -> Sent:
    return Sent(*(np.concatenate(column) for column in zip(*(vars(s).values() for s in sent), strict=True)))


def test_without_a_counter_two_units_are_told_by_moment_and_content() -> None:
    told = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        told.append(
            ever(uncounted(both(unit(rng, 300), unit(rng, 300))), lambda r: by_arrival(r, PERIOD_NS)) is not None
        )
    assert np.mean(told) >= 0.7, "not where both send at one moment"


@pytest.mark.parametrize("moving", [0.0, 300.0, 1e5])
@pytest.mark.parametrize("pairs", [False, True])
def test_without_a_counter_a_unit_that_is_twice_as_fast_as_declared_is_one(pairs: bool, moving: float) -> None:
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        sent = unit(rng, 1000)
        sent.time_ns //= 2
        sent.values += moving * np.sin(np.arange(1000) * 0.2)[:, None]
        if pairs:
            sent.time_ns[0::2] = sent.time_ns[1::2] - PERIOD_NS // 20
        assert ever(uncounted(sent), lambda r: by_arrival(r, PERIOD_NS)) is None, seed


@pytest.mark.parametrize("does", ONE)
def test_without_a_counter_one_unit_is_one(does: str) -> None:
    for seed in SEEDS:
        sent = ONE[does](np.random.default_rng(seed))
        assert ever(uncounted(sent), lambda r: by_arrival(r, PERIOD_NS)) is None, seed
