"""One stream of a unit, decoded sample by sample and counted. It needs nothing
of the metrology, so that a recorder starts without it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
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
"""As `tc.poses.READING_MOST`, whose room loads scipy: a command that decodes alone does
without."""


def only_finite(block: td.SampleBlock) -> td.SampleBlock:
    """Without the samples that hold no reading: a float register, or a message,
    may hold NaN or rubbish."""
    finite = np.asarray((np.abs(block.readings) < READING_MOST).all(axis=1))
    return block if finite.all() else replace(block.only(finite), not_finite=int((~finite).sum()))


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
        return self.counts.copy(), (self._last_ns, self._begin_ns, self._first_host_ns, self._host_span_ns)

    def roll_back(self, checkpoint: tuple[Counter[str], tuple[Any, ...]]) -> None:
        """As if nothing had come since. No more records may be fed."""
        counts, (self._last_ns, self._begin_ns, self._first_host_ns, self._host_span_ns) = checkpoint
        self.counts = counts.copy()

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
