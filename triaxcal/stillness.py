"""Where the unit stood still: a streaming detector that learns the noise.

The stream is cut into windows of a tenth of a second (at least six samples), whose times, mean and scatter are
all that is kept: memory grows by about a hundred bytes a window, whatever the sample rate. The windows depend on
the samples alone, not on how they were fed, so live and replayed streams give the same spans.

A window is still when its scatter, and the step of its mean from the window before, are what the unit's own
noise makes; the scale of both is learned from the quietest windows by iterated clipping. A slight or slow move
that no window shows alone is found afterwards, on the windows' means, at every scale up to the span itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.errors import InvalidData

WINDOW_S = 0.1
WINDOW_LEAST = 6
GAP = 4.0
"""A silence longer than this many sample periods ends a window, and a span."""
SPAN_LEAST_S = 0.6
SPAN_LEAST_WINDOWS = 3
REJOIN_S = 1.5
"""A disturbance shorter than this, with the same mean before and after, is a bump inside one pose."""
REJOIN_SIGMA = 5.0
FALSE_ALARM = 1e-6
STEP_SIGMA = 7.0
"""Steps of window means are tested many times a pose, on noise that need not be white; hence not 3."""
MOTION = 6.0
"""Steadily moving outputs step 12 times as far from window to window, squared, as they scatter inside one; a random
walk, the strongest colour that noise has, 4 times."""
RATE_SAMPLES = 64


@dataclass(frozen=True)
class Windows:
    """Summaries of consecutive windows of ``size`` samples, (m,) or (m,3) each.

    ``start_ns`` and ``end_ns`` are the times of a window's first and last sample; ``variance`` of a sample by axis,
    ``cross`` covariance of axes xy, yz, zx; ``joined`` says that no gap lies between it and the one before.
    """

    size: int
    start_ns: Ints
    end_ns: Ints
    mean: Floats
    variance: Floats
    cross: Floats
    channels: Mapping[str, Floats]
    joined: Bools

    def __len__(self) -> int:
        return len(self.start_ns)


@dataclass(frozen=True)
class Span:
    """A still span as indices of windows. ``used`` (k,) are the windows in it that no bump disturbs."""

    used: Ints

    @property
    def first(self) -> int:
        return int(self.used[0])

    @property
    def last(self) -> int:
        return int(self.used[-1])


@dataclass
class StillnessDetector:
    """Feed it blocks of any size; ask for `windows` and `spans` at any time."""

    _pending: list[tuple[Ints, Floats, dict[str, Floats]]] = field(default_factory=list)
    _size: int = 0
    _period_ns: float = 0.0
    _done: list[tuple[Ints, Ints, Floats, Floats, Floats, dict[str, Floats], Bools]] = field(default_factory=list)
    _last_ns: int | None = None
    _broken: bool = False

    def feed(self, time_ns: Ints, readings: Floats, channels: Mapping[str, Floats] | None = None) -> None:
        """``time_ns`` (n,) strictly increasing across calls, ``readings`` (n,3), ``channels`` each (n,).

        Raises InvalidData for a reading that is not a finite number: it would hide every pose.
        """
        if not len(time_ns):
            return
        if not np.isfinite(readings).all():
            at = int(np.flatnonzero(~np.isfinite(readings).all(axis=1))[0])
            raise InvalidData(f"the reading at {int(time_ns[at])} ns is not a finite number")
        held = {name: np.asarray(v, dtype=float) for name, v in (channels or {}).items()}
        self._pending.append((np.asarray(time_ns, dtype=np.int64), np.asarray(readings, dtype=float), held))
        if not self._size and sum(len(p[0]) for p in self._pending) >= RATE_SAMPLES:
            self._learn_rate()
        if self._size:
            self._close_windows()

    def finish(self) -> None:
        """No more samples come: what is pending is cut into windows as far as it goes."""
        if not self._size and sum(len(p[0]) for p in self._pending) >= 2 * WINDOW_LEAST:
            self._learn_rate()
            self._close_windows()

    def _learn_rate(self) -> None:
        time_ns = np.concatenate([p[0] for p in self._pending])[:RATE_SAMPLES]
        self._period_ns = float(np.median(np.diff(time_ns)))
        if self._period_ns <= 0:
            raise InvalidData("time does not increase from sample to sample")
        self._size = max(WINDOW_LEAST, round(WINDOW_S * 1e9 / self._period_ns))

    def _close_windows(self) -> None:
        time_ns = np.concatenate([p[0] for p in self._pending])
        readings = np.concatenate([p[1] for p in self._pending])
        channels = {n: np.concatenate([p[2][n] for p in self._pending]) for n in self._pending[0][2]}
        before = self._last_ns if self._last_ns is not None else int(time_ns[0]) - int(self._period_ns)
        gaps = np.flatnonzero(np.diff(time_ns, prepend=before) > GAP * self._period_ns)
        start = 0
        for stop in (*gaps[gaps > 0], len(time_ns)):
            if start in gaps:
                self._broken = True
            whole = (stop - start) // self._size
            if whole:
                at = slice(start, start + whole * self._size)
                self._summarise(time_ns[at], readings[at], {n: v[at] for n, v in channels.items()}, whole)
                self._last_ns = int(time_ns[at.stop - 1])
            start = stop if stop < len(time_ns) else start + whole * self._size
        rest = slice(start, len(time_ns))
        self._pending = [(time_ns[rest], readings[rest], {n: v[rest] for n, v in channels.items()})]

    def _summarise(self, time_ns: Ints, u: Floats, channels: dict[str, Floats], count: int) -> None:
        blocks = u.reshape(count, self._size, 3)
        # Sums over a contiguous last axis, so that a window's figures do not depend on how many come at once.
        columns = np.ascontiguousarray(blocks.transpose(0, 2, 1))
        mean = columns.mean(axis=2)
        rest = columns - mean[:, :, None]
        variance = (rest * rest).sum(axis=2) / (self._size - 1)
        cross = (rest * rest[:, [1, 2, 0]]).sum(axis=2) / (self._size - 1)
        times = time_ns.reshape(count, self._size)
        joined = np.ones(count, dtype=bool)
        joined[0] = not self._broken and bool(self._done)
        self._broken = False
        means = {n: v.reshape(count, self._size).mean(axis=1) for n, v in channels.items()}
        self._done.append((times[:, 0], times[:, -1], mean, variance, cross, means, joined))

    def windows(self) -> Windows:
        """Raises InvalidData where there is not one whole window yet."""
        if not self._done:
            raise InvalidData(f"too few samples for one window (at least {RATE_SAMPLES})")
        if len(self._done) > 1:
            names = self._done[0][5]
            self._done = [
                (
                    *(np.concatenate([d[i] for d in self._done]) for i in range(5)),
                    {n: np.concatenate([d[5][n] for d in self._done]) for n in names},
                    np.concatenate([d[6] for d in self._done]),
                )  # type: ignore[list-item]
            ]
        start, end, mean, variance, cross, channels, joined = self._done[0]
        return Windows(self._size, start, end, mean, variance, cross, channels, joined)

    def spans(self) -> list[Span]:
        """The still spans so far, in order."""
        return find_spans(self.windows())


def find_spans(w: Windows) -> list[Span]:
    """The still spans of a stream of windows, at least 0.6 s long."""
    # Rounding of a digital output leaves windows without any scatter; a step of it is noise all the same.
    w = replace(w, variance=np.maximum(w.variance, resolution(w) ** 2 / 4))
    still = _still(w)
    if _only_moves(w, still):
        return []
    runs = _runs(still, w.joined)
    noise = _step_scale(w, still)
    pieces = [p for run in runs for p in _cut_at_steps(w, _trim(w, run, noise), noise) if len(p)]
    return [s for s in _rejoin(w, pieces) if _long_enough(w, s)]


def _still(w: Windows) -> Bools:
    """Which windows scatter, and step from their neighbours, as the quietest ones do."""
    limit = np.array([_quiet_limit(w.variance[:, axis], w.size - 1) for axis in range(3)])
    still = np.asarray((w.variance <= limit).all(axis=1))
    both = _neighbours(w, still)
    if both.sum() < SPAN_LEAST_WINDOWS:
        return still
    step = np.diff(w.mean, axis=0, prepend=w.mean[:1]) ** 2
    least = np.median(w.variance[still], axis=0) / w.size
    scale = np.maximum(np.median(step[both], axis=0) / stats.chi2.median(1), least)
    jump: Bools = both & (step > scale * STEP_SIGMA**2).any(axis=1)
    # A jump lies between two windows: neither can be trusted to its edge.
    still &= ~jump & ~np.append(jump[1:], False)
    return still


def _neighbours(w: Windows, still: Bools) -> Bools:
    """Which windows follow without a gap on a still one, and are still too."""
    both: Bools = still & np.roll(still, 1) & w.joined
    both[0] = False
    return both


def _only_moves(w: Windows, still: Bools) -> bool:
    """Whether the quietest windows are those of a motion, and nothing in the stream stands still."""
    both = _neighbours(w, still)
    if not both.any():
        return False
    step = np.median(np.diff(w.mean, axis=0, prepend=w.mean[:1])[both] ** 2, axis=0) / stats.chi2.median(1)
    return bool((step > MOTION * np.median(w.variance[both], axis=0)).any())


def _quiet_limit(variance: Floats, dof: int) -> float:
    """The largest scatter that noise alone makes in a window, learned from the quietest windows.

    Still windows crowd around one scatter while moving ones spread over decades above it: the mode of the logarithm
    is the noise, and how far the windows below it reach tells its effective degrees of freedom, which are fewer than
    the samples where the noise is coloured.
    """
    log = np.sort(np.log(np.maximum(variance, 1e-300)))
    mode = _half_sample_mode(log)
    below = log[log < mode]
    reach = float(mode - np.median(below)) if len(below) else 0.0
    tried = np.unique(np.r_[np.geomspace(2, max(dof, 2), 40), dof])
    reaches = -np.log(stats.chi2.ppf(stats.chi2.cdf(tried, tried) / 2, tried) / tried)
    effective = tried[int(np.argmin(np.abs(reaches - reach)))]
    return float(np.exp(mode) * stats.chi2.isf(FALSE_ALARM, effective) / effective)


def _half_sample_mode(ordered: Floats) -> float:
    """The densest place of sorted values: the densest half, again and again (Robertson and Cryer 1974)."""
    while len(ordered) > 8:
        half = (len(ordered) + 1) // 2
        widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
        at = int(np.argmin(widths))
        ordered = ordered[at : at + half]
    return float(np.mean(ordered))


def resolution(w: Windows) -> Floats:
    """(3,) the smallest difference that any two readings show, judged by the sums of windows; never quite zero."""
    sums = w.mean * w.size
    least: Floats = 1e-12 * np.max(np.abs(sums), axis=0, initial=1e-100)
    out = least.copy()
    for i in range(3):
        gaps = np.diff(np.unique(sums[:, i]))
        gaps = gaps[gaps > least[i]]
        out[i] = gaps.min() if len(gaps) else least[i]
    return out


def _runs(still: Bools, joined: Bools) -> list[Ints]:
    """Indices of unbroken runs of still windows."""
    index = np.flatnonzero(still)
    if not len(index):
        return []
    breaks = np.flatnonzero((np.diff(index) > 1) | ~joined[index[1:]]) + 1
    return [np.asarray(run, dtype=np.int64) for run in np.split(index, breaks)]


def _step_scale(w: Windows, still: Bools) -> Floats:
    """(3,) standard deviation of a still window's mean about its neighbours'."""
    steps = np.diff(w.mean, axis=0, prepend=w.mean[:1])[_neighbours(w, still)]
    if not len(steps):
        return np.asarray(np.sqrt(np.median(w.variance, axis=0) / w.size))
    floor = np.sqrt(np.median(w.variance[still], axis=0) / w.size)
    return np.asarray(np.maximum(stats.median_abs_deviation(steps, axis=0, scale="normal") / np.sqrt(2), floor))


def _trim(w: Windows, run: Ints, noise: Floats) -> Ints:
    """Without one guard window at either end, nor those that still settle."""
    run = run[1:-1]
    while len(run) > 2 * SPAN_LEAST_WINDOWS:
        inner = np.median(w.mean[run[len(run) // 4 : -(len(run) // 4)]], axis=0)
        off = np.any(np.abs(w.mean[run[[0, -1]]] - inner) > 3.5 * noise, axis=1)
        if not off.any():
            break
        run = run[int(off[0]) : len(run) - int(off[1])]
    return run


def _cut_at_steps(w: Windows, run: Ints, noise: Floats) -> list[Ints]:
    """Parts of a run between steps of its mean that no window alone shows (a slow or slight move)."""
    n = len(run)
    if n < 4 * SPAN_LEAST_WINDOWS:
        return [run]
    means = w.mean[run]
    total = np.cumsum(means - means.mean(axis=0), axis=0)[:-1]
    left = np.arange(1, n)[:, None]
    score = np.max(np.abs(total) / (noise * np.sqrt(left * (n - left) / n)), axis=1)
    at = int(np.argmax(score))
    cut = at + 1
    # A move is many times as high as what is left on either side of it; drift and coloured noise are not.
    height = np.abs(means[:cut].mean(axis=0) - means[cut:].mean(axis=0))
    left_over = np.sqrt((means[:cut].var(axis=0) * cut + means[cut:].var(axis=0) * (n - cut)) / n)
    if score[at] < 2 * STEP_SIGMA or (height < STEP_SIGMA * np.maximum(noise, left_over)).all():
        return [run]
    return _cut_at_steps(w, _trim(w, run[:cut], noise), noise) + _cut_at_steps(w, _trim(w, run[cut:], noise), noise)


def _rejoin(w: Windows, pieces: list[Ints]) -> list[Span]:
    """Pieces of one pose on either side of a bump, put together."""
    if not pieces:
        return []
    within = np.concatenate([w.mean[p] - w.mean[p].mean(axis=0) for p in pieces])
    scatter = np.sqrt((within**2).sum(axis=0) / max(len(within) - len(pieces), 1))
    spans: list[Span] = []
    for piece in pieces:
        if spans:
            before = spans[-1].used
            gap_s = (w.start_ns[piece[0]] - w.end_ns[before[-1]]) * 1e-9
            apart = np.abs(w.mean[before[-20:]].mean(axis=0) - w.mean[piece[:20]].mean(axis=0))
            if gap_s < REJOIN_S and (apart <= REJOIN_SIGMA * scatter).all():
                spans[-1] = Span(np.concatenate([before, piece]))
                continue
        spans.append(Span(piece))
    return spans


def _long_enough(w: Windows, span: Span) -> bool:
    seconds = (w.end_ns[span.last] - w.start_ns[span.first]) * 1e-9
    return len(span.used) >= SPAN_LEAST_WINDOWS and seconds >= SPAN_LEAST_S
