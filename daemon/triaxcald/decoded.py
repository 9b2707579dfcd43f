"""One stream of a unit, decoded sample by sample and counted. It needs nothing
of the metrology, so that a recorder starts without it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
import triaxcal_drivers as td

COUNTS = ("samples", "missing", "duplicates", "incomplete", "errors", "out_of_order", "receiver_overflows")
_PASSED_ON = ("missing", "duplicates", "incomplete", "errors")
_SELDOM = ("malformed", "invalid", "not_finite")
"""Counted where there are any: older certificates have no such keys, and are
compared byte for byte."""

_COUNTED = {"duplicates": "duplicate", "errors": "error", "receiver_overflows": "interruption"}
_CALLED = {
    "malformed": "malformed (too short for the profile's message, or not as it is defined)",
    "not_finite": "not finite",
    "out_of_order": "out of order",
}


READING_MOST = 1e100
"""As `tc.poses.READING_MOST`."""


def only_finite(block: td.SampleBlock) -> td.SampleBlock:
    """Without the samples that hold no reading: a float register, or a message,
    may hold NaN or rubbish."""
    finite = np.asarray((np.abs(block.readings) < READING_MOST).all(axis=1))
    return block if finite.all() else replace(block.only(finite), not_finite=int((~finite).sum()))


# The rate at which a unit samples, against the declared one.

OFF = 0.1
"""A rate that differs by a larger share is not the declared one: oscillators are off by
a hundredth at most."""
FASTER = 4.0
"""A unit that is so many times as fast as declared is simulated, faster than life."""
SILENCE_S, SILENCE_PERIODS = 1.0, 10
"""Longer steps in time, and in declared periods, are interruptions and no part of the
rate."""
RATE_LEAST, RATE_LEAST_S = 50, 2.0
"""Samples, and seconds, from which a rate is judged."""
BINS = 100
"""Bins of steps in a factor e: a median to a percent."""


@dataclass
class SampleRate:
    """The real rate of a stream of ``declared_hz``, whatever its times are of.

    Times by a counter go on at the declared rate; then the host's clock tells the real
    one. Times by stamps, or of arrival, tell it themselves: by all samples over all
    time and by the median step, of which lost samples change the first alone.
    """

    declared_hz: float
    _samples: int = 0
    """Counter steps in ``_own_ns`` of the stream's own time."""
    _own_ns: int = 0
    _host_ns: int = 0
    _longest_ns: int = 0
    """Longest step of the host's time that is no silence."""
    _last: tuple[int, int] | None = None
    """Counter and time of the last sample."""
    _last_host_ns: int | None = None
    _last_laid_ns: int | None = None
    _times: tc.poses.SampleTimes = field(default_factory=lambda: tc.poses.SampleTimes())
    _steps: Counter[int] = field(default_factory=Counter)

    @property
    def _silence_ns(self) -> float:
        return max(SILENCE_S, SILENCE_PERIODS / self.declared_hz) * 1e9

    def received(self, host_ns: NDArray[np.int64]) -> None:
        """Host times (n,) at which samples came, or their raw records."""
        if not len(host_ns):
            return
        step = np.diff(host_ns, prepend=host_ns[0] if self._last_host_ns is None else self._last_host_ns)
        step = step[np.abs(step) <= self._silence_ns]
        self._host_ns += int(step.sum())
        self._longest_ns = max(self._longest_ns, int(step.max(initial=0)))
        self._last_host_ns = int(host_ns[-1])

    def decoded(self, counter: NDArray[np.int64], time_ns: NDArray[np.int64]) -> None:
        """Samples (n,) whose times rise."""
        if not len(time_ns):
            return
        counter_before, before_ns = self._last or (int(counter[0]), int(time_ns[0]))
        step = np.diff(time_ns, prepend=before_ns)
        near = step <= self._silence_ns
        self._own_ns += int(step[near].sum())
        self._samples += int(np.diff(counter, prepend=counter_before)[near].sum())
        self._last = int(counter[-1]), int(time_ns[-1])
        self._laid(self._times.feed(time_ns))

    def _laid(self, time_ns: NDArray[np.int64]) -> None:
        if not len(time_ns):
            return
        step = np.diff(time_ns, prepend=time_ns[0] if self._last_laid_ns is None else self._last_laid_ns)
        self._last_laid_ns = int(time_ns[-1])
        bins, count = np.unique(np.rint(np.log(step[step > 0]) * BINS).astype(int), return_counts=True)
        self._steps.update(dict(zip(bins.tolist(), count.tolist(), strict=True)))

    @property
    def bursts(self) -> tuple[int, float] | None:
        """As of `tc.poses.SampleTimes.bursts`, with those that it holds back."""
        times = deepcopy(self._times)
        times.finish()
        return times.bursts()

    def wrong_hz(self) -> float | None:
        """The real rate, where it is not the declared one."""
        if self._samples < RATE_LEAST or min(self._own_ns, self._host_ns) < RATE_LEAST_S * 1e9:
            return None
        if abs(self._own_ns / self._host_ns - 1) > OFF:  # the host's clock tells
            rate_hz = self._samples / self._host_ns * 1e9
        elif not self._steps:  # all are held back, since they come in bursts
            return None
        else:
            both = (self._samples / self._own_ns * 1e9, 1e9 / self._median_step_ns())
            rate_hz = min(both, key=lambda hz: abs(np.log(hz / self.declared_hz)))
        # The first and the last burst may have more samples than time, or fewer.
        allowed = 1 + OFF + self._longest_ns / self._host_ns
        off = rate_hz / self.declared_hz
        return None if 1 / allowed <= off <= allowed or off > FASTER else rate_hz

    def _median_step_ns(self) -> float:
        bins = sorted(self._steps)
        passed = np.cumsum([self._steps[b] for b in bins])
        return float(np.exp(bins[int(np.searchsorted(passed, passed[-1] / 2))] / BINS))


@dataclass
class DecodedStream:
    """One stream of one unit, decoded; counts whatever does not come through.
    It keeps no samples, however many come."""

    bundle: td.Bundle
    stream: str
    counts: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(COUNTS, 0)))

    def __post_init__(self) -> None:
        self._decoder = td.driver_named(self.bundle.profile.driver).decoder(self.bundle, self.stream)
        self._last_ns: int | None = None
        self._begin_ns: int | None = None
        self._first_host_ns: int | None = None
        self._host_span_ns: tuple[int, int] | None = None
        self._rate = SampleRate(self.bundle.profile.sampling.rate_hz)
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self.two_senders = False
        """Whether records of two units were among those that came."""

    @property
    def first_host_ns(self) -> int | None:
        """Host time of the first raw record."""
        return self._first_host_ns

    @property
    def host_seconds(self) -> float:
        """From the first batch of raw records that completed a sample to the
        latest, by the host's clock."""
        first_ns, last_ns = self._host_span_ns or (0, 0)
        return max(0.0, (last_ns - first_ns) * 1e-9)

    @property
    def seconds(self) -> float:
        """From the first sample to the latest."""
        return 0.0 if self._last_ns is None or self._begin_ns is None else (self._last_ns - self._begin_ns) * 1e-9

    def checkpoint(self) -> tuple[Counter[str], tuple[Any, ...]]:
        """What it has come to so far, for `roll_back`."""
        kept = deepcopy((self._rate, self._low, self._high))
        return self.counts.copy(), (self._last_ns, self._begin_ns, self._first_host_ns, self._host_span_ns, kept)

    def roll_back(self, checkpoint: tuple[Counter[str], tuple[Any, ...]]) -> None:
        """As if nothing had come since. No more records may be fed."""
        counts, (self._last_ns, self._begin_ns, self._first_host_ns, self._host_span_ns, kept) = checkpoint
        self.counts = counts.copy()
        self._rate, self._low, self._high = deepcopy(kept)

    def wrong_rate(self) -> str:
        """The real rate beside the declared one, in words; empty where they are the
        same."""
        if (rate_hz := self._rate.wrong_hz()) is None:
            return ""
        declared = tc.number_format.plain(self._rate.declared_hz, 6)
        return f"{rate_hz:.3g} Hz, and sampling.rate_hz of the profile is {declared}"

    def faults(self) -> list[str]:
        """What shows in the samples of a mere recording, one line of data quality
        each. The metrology is loaded only where there is anything to say of them."""
        found = [f"rate: {rate}"] if (rate := self.wrong_rate()) else []
        if (bursts := self._rate.bursts) is not None:
            found.append(tc.text.quality_line(tc.poses.Bursts(*bursts)))
        if self.counts["samples"] >= RATE_LEAST and (dead := np.flatnonzero(self._low == self._high)).size:
            found.append(tc.text.quality_line(tc.poses.StuckOutput(tuple("xyz"[i] for i in dead), None, ())))
        return found

    def feed(self, batch: td.RawBatch) -> td.SampleBlock:
        """Takes raw records; gives the samples that they complete."""
        return self._decoded(batch)[0]

    def rising(self, batch: td.RawBatch) -> td.SampleBlock:
        """The same without those that are out of order."""
        block, fresh = self._decoded(batch)
        return block if fresh.all() else block.only(fresh)

    def _decoded(self, batch: td.RawBatch) -> tuple[td.SampleBlock, NDArray[np.bool_]]:
        """The samples, and which of them go on in time."""
        if self._first_host_ns is None and len(batch):
            self._first_host_ns = int(batch.time_ns[0])
        self.counts["receiver_overflows"] += int(np.count_nonzero(batch.flags & td.RawFlag.LOST_BEFORE))
        block = only_finite(self._decoder.feed(batch))
        self._rate.received(batch.time_ns if block.arrival_ns is None else block.arrival_ns)
        self.two_senders = self.two_senders or block.two_senders
        for name in _PASSED_ON:
            self.counts[name] += getattr(block, name)
        for name in _SELDOM:
            if count := getattr(block, name):
                self.counts[name] += count
        fresh = np.ones(len(block), dtype=bool)
        if len(block):
            if self._begin_ns is None:
                self._begin_ns = int(block.time_ns[0])
            first_ns = self._host_span_ns[0] if self._host_span_ns else int(batch.time_ns[0])
            self._host_span_ns = first_ns, int(batch.time_ns[-1])
            latest = np.maximum.accumulate(np.r_[self._last_ns or -(2**62), block.time_ns[:-1]])
            fresh = block.time_ns > latest
            self.counts["out_of_order"] += int((~fresh).sum())
            self.counts["samples"] += int(fresh.sum())
            self._last_ns = max(int(block.time_ns.max()), self._last_ns or -(2**62))
            self._rate.decoded(block.counter[fresh], block.time_ns[fresh])
            self._low = np.minimum(self._low, block.readings[fresh].min(axis=0, initial=np.inf))
            self._high = np.maximum(self._high, block.readings[fresh].max(axis=0, initial=-np.inf))
            self._take(block, fresh)
        return block, fresh

    def _take(self, block: td.SampleBlock, fresh: NDArray[np.bool_]) -> None:
        """The block's samples, of which those that are ``fresh`` go on in
        time."""


def beside_samples(counts: Mapping[str, int]) -> list[str]:
    """What else was counted of a stream, by kind."""
    return [
        tc.number_format.number_of(n, _COUNTED[kind]) if kind in _COUNTED else f"{n} {_CALLED.get(kind, kind)}"
        for kind, n in counts.items()
        if n and kind != "samples"
    ]
