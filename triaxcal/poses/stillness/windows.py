"""A stream cut into windows of a tenth of a second, of which mean, scatter and
times are all that is kept.

Memory grows by about a hundred bytes a window, whatever the sample rate. The
windows depend on the samples alone, not on how they were fed, so live and
replayed streams give the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from triaxcal.arrays import READING_MOST, Bools, Floats, Ints, joined
from triaxcal.errors import InvalidData

WINDOW_S = 0.1
"""Short beside a pose and a move, so that edges cost little; long beside a
sample, so that summaries are few."""
WINDOW_LEAST = 3
"""Samples in a window at low rates: fewer tell no scatter."""
GAP = 4.0
"""A silence longer than this many sample periods ends a window, and a span."""
RATE_SAMPLES = 64  # steps are taken over a quarter of them, so that bursts average out
RATE_S = 1.0
"""The sample period is learned from at least so many samples over at least so
long."""
RATE_LEAST = 12
"""Samples of a stream that ends before that; with fewer the period is not
known, and there is no window."""


def first_period_ns(time_ns: Ints) -> float:
    """The sample period of the first samples of a stream, over a quarter of
    them at a time, so that neither bursts nor a gap mislead."""
    enough = max(RATE_SAMPLES, int(np.searchsorted(time_ns, time_ns[0] + RATE_S * 1e9)) + 1)
    time_ns = time_ns[:enough]
    lag = len(time_ns) // 4
    return float(np.median(time_ns[lag:] - time_ns[:-lag])) / lag


def window_size(period_ns: float) -> int:
    """Samples in a window."""
    return max(WINDOW_LEAST, round(WINDOW_S * 1e9 / period_ns))


@dataclass(frozen=True)
class Windows:
    """Summaries of consecutive windows of ``size`` samples, (m,) or (m,3) each.

    ``start_ns`` and ``end_ns`` are the times of a window's first and last
    sample; ``variance`` of a sample by axis, ``cross`` covariance of axes xy,
    yz, zx; ``hop`` is the difference of its readings where there are two only,
    else zero; ``joined`` says that no gap lies between it and the one before.
    """

    size: int
    start_ns: Ints
    end_ns: Ints
    mean: Floats
    variance: Floats
    cross: Floats
    hop: Floats
    channels: Mapping[str, Floats]
    joined: Bools

    def __len__(self) -> int:
        return len(self.start_ns)

    @property
    def period_ns(self) -> float:
        """From the start of a window to the start of the next, where no gap
        lies between."""
        return float(np.median((self.end_ns - self.start_ns) * self.size / (self.size - 1)))


@dataclass
class WindowCutter:
    """Cuts blocks of any size into windows. ``samples`` have come in
    ``span_ns``, from the first to the last."""

    samples: int = field(default=0, init=False)
    span_ns: int = field(default=0, init=False)
    _begin_ns: int = 0
    _pending: list[tuple[Ints, Floats, dict[str, Floats]]] = field(default_factory=list)
    _held: int = 0
    _longest: int = 0
    """Samples without a gap, as long as there is no window."""
    _size: int = 0
    _period_ns: float = 0.0
    _names: tuple[str, ...] = ()
    _done: list[tuple[Any, ...]] = field(default_factory=list)
    """As `Windows` has them, the channels last."""
    _last_ns: int | None = None
    _broken: bool = False

    def feed(self, time_ns: Ints, readings: Floats, channels: Mapping[str, Floats] | None = None) -> None:
        """``time_ns`` (n,) strictly increasing across calls, ``readings``
        (n,3), ``channels`` each (n,).

        Raises InvalidData for a reading that is not a finite number: it would
        hide every pose.
        """
        if not len(time_ns):
            return
        sound = np.abs(readings) < READING_MOST  # which no NaN is
        if not sound.all():
            at = int(np.flatnonzero(~sound.all(axis=1))[0])
            raise InvalidData(f"the reading at {int(time_ns[at])} ns is not a finite number")
        if not self.samples:
            self._begin_ns = int(time_ns[0])
        self.samples += len(time_ns)
        self.span_ns = int(time_ns[-1]) - self._begin_ns
        held = {name: np.asarray(v, dtype=float) for name, v in (channels or {}).items()}
        self._pending.append((np.asarray(time_ns, dtype=np.int64), np.asarray(readings, dtype=float), held))
        self._held += len(time_ns)
        if not self._size and self._held >= RATE_SAMPLES and time_ns[-1] - self._pending[0][0][0] >= RATE_S * 1e9:
            self._learn_rate()
        if self._size and self._held >= self._size:
            self._close_windows()

    def finish(self) -> None:
        """No more samples come: what is pending is cut into windows as far as
        it goes."""
        if not self._size and self._held >= RATE_LEAST:
            self._learn_rate()
            self._close_windows()

    def _learn_rate(self) -> None:
        self._period_ns = first_period_ns(np.concatenate([p[0] for p in self._pending]))
        if self._period_ns <= 0:
            raise InvalidData("time does not increase from sample to sample")
        self._size = window_size(self._period_ns)

    def _close_windows(self) -> None:
        time_ns = np.concatenate([p[0] for p in self._pending])
        readings = np.concatenate([p[1] for p in self._pending])
        channels = {n: np.concatenate([p[2][n] for p in self._pending]) for n in self._pending[0][2]}
        before = self._last_ns if self._last_ns is not None else int(time_ns[0]) - int(self._period_ns)
        gaps = np.flatnonzero(np.diff(time_ns, prepend=before) > GAP * self._period_ns)
        start, torn = 0, set(gaps.tolist())
        for stop in (*gaps[gaps > 0], len(time_ns)):
            self._longest = max(self._longest, stop - start)
            if start in torn:
                self._broken = True
            whole = (stop - start) // self._size
            if whole:
                at = slice(start, start + whole * self._size)
                self._summarise(time_ns[at], readings[at], {n: v[at] for n, v in channels.items()}, whole)
                self._last_ns = int(time_ns[at.stop - 1])
            start = stop if stop < len(time_ns) else start + whole * self._size
        rest = slice(start, len(time_ns))
        self._pending = [(time_ns[rest], readings[rest], {n: v[rest] for n, v in channels.items()})]
        self._held = len(time_ns) - start

    def _summarise(self, time_ns: Ints, u: Floats, channels: dict[str, Floats], count: int) -> None:
        blocks = u.reshape(count, self._size, 3)
        # Sums over a contiguous last axis, so that a window's figures do not
        # depend on how many come at once.
        columns = np.ascontiguousarray(blocks.transpose(0, 2, 1))
        mean = columns.mean(axis=2)
        rest = columns - mean[:, :, None]
        variance = (rest * rest).sum(axis=2) / (self._size - 1)
        cross = (rest * rest[:, [1, 2, 0]]).sum(axis=2) / (self._size - 1)
        times = time_ns.reshape(count, self._size)
        in_one_piece = np.ones(count, dtype=bool)
        in_one_piece[0] = not self._broken and bool(self._done)
        self._broken = False
        self._names = tuple(channels)
        means = [v.reshape(count, self._size).mean(axis=1) for v in channels.values()]
        self._done.append(
            (times[:, 0].copy(), times[:, -1].copy(), mean, variance, cross, _hop(columns), in_one_piece, *means)
        )

    def windows(self) -> Windows:
        """Raises InvalidData where there is not one whole window yet."""
        if not self._done:
            raise InvalidData(f"too few samples for one window (at least {RATE_SAMPLES})")
        if len(self._done) > 1:
            self._done = [joined(self._done)]
        start, end, mean, variance, cross, hop, in_one_piece, *channels = self._done[0]
        named = dict(zip(self._names, channels, strict=True))
        return Windows(self._size, start, end, mean, variance, cross, hop, named, in_one_piece)


def _hop(columns: Floats) -> Floats:
    """(m,3) how far the two readings of a window lie apart, of ``columns``
    (m,3,size); zero where there are others."""
    high, low = columns.max(axis=2), columns.min(axis=2)
    two = ((columns == high[:, :, None]) | (columns == low[:, :, None])).all(axis=2)
    return np.asarray(np.where(two, high - low, 0.0))
