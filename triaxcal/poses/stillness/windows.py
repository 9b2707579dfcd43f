"""A stream as windows of a tenth of a second, of which mean, scatter and times are
kept, and the noise of the stream at each time scale.

Memory grows by about a hundred bytes a window at any sample rate. The windows depend
on the samples alone, not on the size of the blocks, so live and replayed streams give
the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.special import ndtr

from triaxcal.arrays import READING_MOST, Bools, Columns, Floats, Ints
from triaxcal.errors import InvalidData
from triaxcal.poses.arrivals import GAP, RATE_LEAST, RATE_S, RATE_SAMPLES, first_period_ns

WINDOW_S = 0.1
"""Short beside a pose and a move, so that edges cost little; long beside a
sample, so that summaries are few."""
WINDOW_LEAST = 3
"""Samples in a window at low rates: fewer do not determine a scatter."""


def window_size(period_ns: float) -> int:
    """Samples in a window."""
    return max(WINDOW_LEAST, round(WINDOW_S * 1e9 / period_ns))


def require_finite(time_ns: Ints, readings: Floats) -> None:
    """Raises InvalidData for a reading that is not a finite number."""
    sound = np.abs(readings) < READING_MOST  # which no NaN is
    if not sound.all():
        at = int(np.flatnonzero(~sound.all(axis=1))[0])
        raise InvalidData(f"the reading at {int(time_ns[at])} ns is not a finite number")


@dataclass(frozen=True)
class Windows:
    """Summaries of consecutive windows of ``size`` samples, (m,) or (m,3) each.

    ``start_ns`` and ``end_ns`` are the times of a window's first and last sample;
    ``variance`` of a sample by axis, ``cross`` covariance of axes xy, yz, zx; ``hop``
    is the difference of the readings in a window that has only two, else zero;
    ``joined``: no gap before the window.
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
        """Time from the start of a window to that of the next without a gap."""
        return float(np.median((self.end_ns - self.start_ns) * self.size / (self.size - 1)))


@dataclass
class WindowCutter:
    """Cuts blocks of any size into windows. ``samples`` were fed over ``span_ns``,
    from the first to the last."""

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
    _done: Columns = field(default_factory=Columns)
    """As `Windows` has them, without the hops, the channels last."""
    _hops: Columns = field(default_factory=Columns)
    """Windows with a hop, by number, and their hops."""
    _last_ns: int | None = None
    _broken: bool = False

    def feed(self, time_ns: Ints, readings: Floats, channels: Mapping[str, Floats] | None = None) -> None:
        """``time_ns`` (n,) strictly increasing across calls, ``readings`` (n,3) in
        output units, ``channels`` each (n,).

        Raises InvalidData for a reading that is not a finite number.
        """
        if not len(time_ns):
            return
        require_finite(time_ns, readings)
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
        """End of the stream: the remaining samples are cut into windows as far as
        possible."""
        if not self._size and self._held >= RATE_LEAST:
            self._learn_rate()
            self._close_windows()

    def _learn_rate(self) -> None:
        self._period_ns = first_period_ns(np.concatenate([p[0] for p in self._pending]))
        if self._period_ns <= 0:
            raise InvalidData("time does not increase from sample to sample")
        self._size = window_size(self._period_ns)

    def _close_windows(self) -> None:
        # Samples since the last window, and the gaps among them.
        time_ns = np.concatenate([p[0] for p in self._pending])
        readings = np.concatenate([p[1] for p in self._pending])
        channels = {n: np.concatenate([p[2][n] for p in self._pending]) for n in self._pending[0][2]}
        before = self._last_ns if self._last_ns is not None else int(time_ns[0]) - int(self._period_ns)
        gaps = np.flatnonzero(np.diff(time_ns, prepend=before) > GAP * self._period_ns)
        # Cut each stretch without a gap into whole windows; the rest stays pending.
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
        in_one_piece[0] = not self._broken and len(self._done) > 0
        self._broken = False
        self._names = tuple(channels)
        means = [v.reshape(count, self._size).mean(axis=1) for v in channels.values()]
        # A hop is mostly zero: it is kept where it is not.
        hop = _hop(columns)
        at = np.flatnonzero(hop.any(axis=1))
        if len(at):
            self._hops.add((len(self._done) + at, hop[at]))
        self._done.add((times[:, 0], times[:, -1], mean, variance, cross, in_one_piece, *means))

    def windows(self) -> Windows:
        """Raises InvalidData where there is not one whole window yet."""
        if not len(self._done):
            raise InvalidData(f"too few samples for one window (at least {RATE_SAMPLES})")
        start, end, mean, variance, cross, in_one_piece, *channels = self._done.arrays()
        hop = np.zeros(mean.shape)  # takes no memory where nothing is written
        if len(self._hops):
            at, values = self._hops.arrays()
            hop[at] = values
        named = dict(zip(self._names, channels, strict=True))
        return Windows(self._size, start, end, mean, variance, cross, hop, named, in_one_piece)


def _hop(columns: Floats) -> Floats:
    """(m,3) difference of the two readings of a window, from ``columns`` (m,3,size);
    zero where there are others."""
    high, low = columns.max(axis=2), columns.min(axis=2)
    two = ((columns == high[:, :, None]) | (columns == low[:, :, None])).all(axis=2)
    return np.asarray(np.where(two, high - low, 0.0))


# Rounding to the steps of a digital output: its effect on means and variances.

COARSEST = 50
"""Least number of steps in the range of the outputs."""
TWO_READINGS_LEAST = 8
"""Number of windows with two readings from which a step is estimated."""
ALIKE = 0.25
"""Largest effect of printed decimals, as a share of a step."""
MOSTLY, SINGLE = 0.9, 0.6
"""Share of these windows that differ by one, two or three steps, and share by one."""
MOSTLY_COARSE = 0.5
"""Share of such windows with which the noise is narrower than the steps."""
OTHERWISE = 1.5
"""Ratio of a step to the smallest difference that chance does not explain."""
FINE = 1.0
"""Noise in steps above which rounding has no effect: exp(−2π²) is 3e-9."""
HARMONICS = np.arange(1, 50)[:, None]
"""Terms of the Fourier series over the place between two steps. Without noise they
decrease as 1/k² and the truncation is 1.2 %; with noise they vanish exponentially."""
SIGMAS = np.linspace(0.0, FINE, 201)
"""Grid of the noise in steps, for the inverse function."""
BLUR = 0.01
"""In steps squared: variances at neighbouring places of the grid differ by no more on
average."""


@dataclass(frozen=True)
class Rounding:
    """Effect of rounding on an output by axis (3,), in output units squared:
    ``residue``, the variance of an infinitely long mean over all places between two
    steps; ``widest``, the variance of a reading half-way between two steps, where it
    is largest; zero where the noise is wider than a step."""

    residue: Floats
    widest: Floats

    @classmethod
    def of(cls, step: Floats, scatter: Floats) -> Rounding:
        """``scatter`` (3,) is the variance of a reading without motion, averaged over
        the places."""
        sigma = noise_of(scatter / step**2)
        widest = np.where(sigma < FINE, widest_variance(sigma), 0.0)
        return cls(rounding_variance(step, scatter), np.asarray(step**2 * widest))


def resolution(w: Windows) -> Floats:
    """(3,) smallest difference of any two readings; never exactly zero.

    A step that is a large part of the range is no resolution: outputs without noise
    differ by their poses alone. Where readings are printed with decimals that are no
    multiples of the step, sums show the decimals; windows with two readings still
    show the step.
    """
    return _steps(w)[0]


def _steps(w: Windows) -> tuple[Floats, Floats]:
    """(3,) step of the output, and (3,) step of the printed decimals, zero where both
    are the same."""
    least, shown = _least_difference(w), shown_step(w)
    hidden = shown > OTHERWISE * least
    return np.where(hidden, shown, least), np.where(hidden, least, 0.0)


def _least_difference(w: Windows) -> Floats:
    """(3,) smallest difference of the sums of windows."""
    out = np.zeros(3)
    for i in range(3):  # one by one: a recording may last for days
        sums = w.mean[:, i] * w.size
        least = 1e-12 * np.max(np.abs(sums), initial=1e-100)
        gaps = np.diff(np.unique(sums))
        gaps = gaps[gaps > least]
        fine = len(gaps) > 0 and gaps.min() * COARSEST < np.ptp(w.mean[:, i])
        out[i] = gaps.min() if fine else least
    return out


def shown_step(w: Windows) -> Floats:
    """(3,) step between the readings of windows with only two, zero where these do
    not agree on one. Such windows are frequent where the noise is narrower than the
    step, and never occur by chance."""
    out = np.zeros(3)
    for i in range(3):
        hops = w.hop[w.hop[:, i] > 0, i]
        if len(hops) < TWO_READINGS_LEAST:
            continue
        # Most differences are one step; nearly all are one to three.
        step = float(np.median(hops))
        times = np.clip(np.rint(hops / step), 1, 3)
        alike = np.abs(hops / step - times) <= ALIKE
        agree = np.mean(alike) >= MOSTLY and np.mean(alike & (times == 1)) >= SINGLE
        if agree and step * COARSEST < np.ptp(w.mean[:, i]):
            out[i] = step
    return out


def widest_steps(w: Windows) -> Floats:
    """(3,) differences of readings in windows with two readings, where most windows
    have no more: steps of the output, or the dead band of a logger. Elsewhere the
    resolution."""
    out = resolution(w)
    for i in range(3):
        hops = w.hop[w.hop[:, i] > 0, i]
        if len(hops) and np.mean((w.hop[:, i] > 0) | (w.variance[:, i] == 0)) > MOSTLY_COARSE:
            out[i] = max(out[i], float(np.median(hops)))
    return out


def rounding_variance(step: Floats, scatter: Floats) -> Floats:
    """(3,) variance of the rounding error to ``step`` in an infinitely long mean;
    ``scatter`` is the variance of a reading. Sufficient noise averages the error
    out."""
    return np.asarray(step**2 * mean_rounding_variance(noise_of(scatter / step**2)))


def left_in_means(w: Windows, scatter: Floats, count: Ints) -> Floats:
    """(3,) variance of the rounding error in means of poses whose readings have the
    variance ``scatter`` (k,3) over ``count`` (k,) windows, together with that of
    printing: equal readings have equal printing errors, so that averages over the
    different readings alone."""
    step, printed = _steps(w)
    level = scatter.mean(axis=0) / step**2
    sigma = noise_of(level)
    left = mean_rounding_variance(sigma)
    for i in np.flatnonzero(sigma < FINE):
        left[i] = _left_by_poses(scatter[:, i] / step[i] ** 2, count)
    # The sum of the squared shares of the readings: of a density of σ steps,
    # 1/(2√π σ).
    again = np.minimum(1 / (2 * np.sqrt(np.pi) * np.maximum(sigma, 1e-3)), 1.0)
    return np.asarray(step**2 * left + printed**2 / 12 * again)


def _left_by_poses(variance: Floats, count: Ints) -> float:
    """`mean_rounding_variance`, averaged over the noise that is consistent with the
    ``variance`` (k,) of the poses, in steps squared, from ``count`` (k,) windows. The
    place of a pose between two steps is random, so the mean of few variances is
    unreliable, and the residue depends exponentially on the squared noise."""
    # Likelihood of each noise level: Gaussian about the variance at every place,
    # averaged over the places.
    sigma, seen, spread = _by_place()
    off = variance[:, None, None] - seen
    width = BLUR**2 + spread / count[:, None, None]
    chance = (np.exp(-(off**2) / (2 * width)) / np.sqrt(width)).mean(axis=2)
    likelihood = np.log(np.maximum(chance, 1e-300)).sum(axis=0)
    weight = np.exp(likelihood - likelihood.max())
    return float(weight @ mean_rounding_variance(sigma) / weight.sum())


@cache
def _by_place() -> tuple[Floats, Floats, Floats]:
    """Noise (s,) in steps; variance of a reading (s,p) at that noise and place
    between two steps, and the variance of its squared deviation, by exact sums."""
    sigma, place = SIGMAS[4::2], (np.arange(50) + 0.5) / 100
    codes = np.arange(-6, 8)
    # Probability of every output code under Gaussian noise.
    edges = (np.append(codes, codes[-1] + 1) - 0.5 - place[:, None]) / sigma[:, None, None]
    share = np.diff(ndtr(edges), axis=2)
    off = codes - (share @ codes)[:, :, None]
    variance = (share * off**2).sum(axis=2)
    return sigma, variance, (share * off**4).sum(axis=2) - variance**2


def mean_rounding_variance(sigma: Floats) -> Floats:
    """(n,) mean square error of an infinite mean over all places between two steps,
    in steps squared, for noise of ``sigma`` (n,) steps: Σ exp(−4π²k²σ²) / (2π²k²)."""
    k = HARMONICS
    return np.asarray((np.exp(-4 * np.pi**2 * k**2 * sigma**2) / (2 * np.pi**2 * k**2)).sum(axis=0))


def widest_variance(sigma: Floats) -> Floats:
    """(n,) variance of a reading half-way between two steps, in steps squared; a
    quarter without noise."""
    k = HARMONICS
    swing = np.exp(-2 * np.pi**2 * k**2 * sigma**2) * (1 / (np.pi**2 * k**2) + 4 * sigma**2)
    return np.asarray(sigma**2 + 1 / 12 + swing.sum(axis=0))


def noise_of(variance: Floats) -> Floats:
    """(n,) noise in steps for rounded readings of this ``variance`` (n,), in steps
    squared, averaged over the places. The part of the rounding error that stays in
    the mean is missing in the variance."""
    # Variance of a rounded reading: σ² + 1/12 less the residue of the mean; invert it.
    seen = SIGMAS**2 + 1 / 12 - mean_rounding_variance(SIGMAS)
    beyond = np.sqrt(np.maximum(variance - 1 / 12, 0.0))
    return np.asarray(np.where(variance < seen[-1], np.interp(variance, seen, SIGMAS), beyond))


# The noise of a stream at each time scale, and spans without their disturbed ends.

# Standard deviations of differences of neighbouring averages, learned from the
# static parts at every scale.

SCALES = (1, 2, 4, 8)
"""Numbers of windows in an average."""
ENOUGH = 12
"""Number of differences from which a standard deviation is estimated."""


@dataclass(frozen=True)
class NoiseScales:
    """Standard deviations (3,) of differences of averages: ``step`` of two over
    equally many windows, ``edge`` of one over a number of windows and its neighbour
    over four times as many. ``scatter`` is that inside a window."""

    step: dict[int, Floats]
    edge: dict[int, Floats]
    scatter: Floats

    @classmethod
    def learned(cls, w: Windows, still: Bools, rounding: Rounding, *, first: bool = False) -> NoiseScales:
        """Noise at every scale. ``rounding`` is the contribution of the output's
        steps. ``first``: most windows may still be moving.

        With wide steps most differences are zero, and a median does not show the
        variance half-way between two steps.
        """
        base = still if still.any() else slice(None)
        scatter = np.sqrt([np.median(w.variance[base, axis]) for axis in range(3)])
        quantile = 0.25 if first else 0.5
        step: dict[int, Floats] = {}
        edge: dict[int, Floats] = {}
        # Per scale: quantile of the absolute differences, at least the rounding
        # variance.
        for s in SCALES:
            share = 2 / (w.size * s)
            least = np.maximum(2 * rounding.residue, rounding.widest * share)
            found = _quantile(w, unbroken(still, w.joined, s, s), (s, s), quantile)
            step[s] = _scale(found, least, scatter**2 * share, step.get(s // 2))
            share = 1.25 / (w.size * s)
            least = np.maximum(2 * rounding.residue, rounding.widest * share)
            found = _quantile(w, unbroken(still, w.joined, 4 * s, s), (4 * s, s), quantile)
            edge[s] = _scale(found, least, scatter**2 * share, edge.get(s // 2))
        return cls(step, edge, scatter)

    def of_edge(self, scale: int, before: int) -> Floats:
        """(3,) ``edge`` for an average over ``before`` windows, fewer than four times
        ``scale``, next to one over ``scale``."""
        return np.asarray(self.edge[scale] * np.sqrt((1 / scale + 1 / before) / (1.25 / scale)))


def _quantile(w: Windows, at: Ints, lengths: tuple[int, int], quantile: float) -> Floats | None:
    """(3,) standard deviation from a quantile of the absolute differences of averages
    over windows before and after ``at``; None with too few of them."""
    if len(at) < ENOUGH:
        return None
    # Axis by axis: a recording may last for days.
    each = (contrast(w.mean[:, axis : axis + 1], at, *lengths)[:, 0] for axis in range(3))
    # A normal variable is within 0.3186 and 0.6745 standard deviations in a
    # quarter and in half of all cases.
    return np.array([np.quantile(np.abs(found), quantile) for found in each]) / {0.25: 0.31864, 0.5: 0.67449}[quantile]


def _scale(found: Floats | None, least: Floats, white: Floats, half: Floats | None) -> Floats:
    """(3,) the standard deviation that was ``found``; without one, from half the scale
    as for white noise. At least the variance ``least`` (3,)."""
    if found is not None:
        sigma = found
    elif half is not None:
        sigma = half / np.sqrt(2)
    else:
        sigma = np.sqrt(white)
    sigma = np.maximum(sigma, np.sqrt(least))
    # An axis that hardly ever changes from window to window may still scatter
    # inside them.
    return np.asarray(np.where(sigma > 0, sigma, np.sqrt(white)))


def contrasts(values: Floats, still: Bools, joined: Bools, before: int, after: int) -> tuple[Ints, Floats]:
    """`unbroken` and the `contrast` there."""
    at = unbroken(still, joined, before, after)
    return at, contrast(values, at, before, after)


def unbroken(still: Bools, joined: Bools, before: int, after: int) -> Ints:
    """(k,) indices at which ``before`` windows before and ``after`` windows from
    there on are still and without a gap."""
    n = len(still)
    broken = np.ones(n + 1, dtype=bool)
    broken[1:n] = ~(still[:-1] & still[1:] & joined[1:])
    breaks = np.cumsum(broken, dtype=np.int32)
    # Between the first and the last of them no boundary is broken; a single
    # window must be still itself.
    reach = before + after - 1
    at = before + np.flatnonzero(breaks[reach:n] == breaks[: max(n - reach, 0)])
    return np.asarray(at[still[at - before]] if len(at) else at, dtype=np.int64)


def contrast(values: Floats, at: Ints, before: int, after: int) -> Floats:
    """(k,c) mean of ``values`` (n,c) over ``after`` windows from ``at`` (k,) on, less
    that of the ``before`` windows before."""
    offset = values[0] * ((after > 0) - int(before > 0))
    out = np.empty((len(at), values.shape[1]))
    for axis in range(values.shape[1]):  # one by one: a recording may last for days
        # Differences of cumulative sums.
        sums = np.zeros(len(values) + 1)
        np.cumsum(values[:, axis] - values[0, axis], out=sums[1:])
        middle, there = sums[at], sums[at + after]
        there -= middle
        there /= max(after, 1)
        middle -= sums[at - before]
        middle /= max(before, 1)
        there -= middle
        out[:, axis] = there + offset[axis]
    return out


# The ends of a still run: what of it belongs to the moves on either side.

SPAN_LEAST_WINDOWS = 3
"""Windows in a span: fewer have no middle that ends could differ from."""
GUARD = 1
"""Windows at either end of a run that are never used: a move may begin or end
inside one."""
EDGE_SIGMA = 3.5
"""At the ends of a run, where a false alarm costs a few windows and nothing
else."""
EVENLY = 0.1
"""The scatter of a steady tone repeats itself to less than that: a little more
of it at an end is no sign of a move."""
ONSET_SIGMA = 6.0  # standard deviations of the mean of a window, which no noise reaches
ONSET_WINDOWS = 30
"""Where the onset of a move is judged by what follows: well above the noise,
and within this reach."""


def trimmed(w: Windows, run: Ints, noise: NoiseScales) -> Ints:
    """The run without a guard window at either end, and without windows in which a
    move begins or settles."""
    # Cut the guards, or the onset of a move, at both ends.
    late, early = _onset(w, run, noise), _onset(w, run[::-1], noise)
    run = run[max(early, GUARD) : len(run) - max(late, GUARD)]
    # Then cut as long as an end differs from the middle, keeping at least half.
    for direction in (1, -1):
        least = max(len(run) // 2, 2 * SPAN_LEAST_WINDOWS)
        while len(run) > least:
            cut = _unsettled(w, run[::direction], noise)
            if not cut:
                break
            # As many again: what comes before the part that shows is smaller,
            # but the same.
            run = run[: -2 * cut] if direction == 1 else run[2 * cut :]
    return run


def _onset(w: Windows, run: Ints, noise: NoiseScales) -> int:
    """Number of windows at the end of a run that belong to the move after it, though
    noise hides it there.

    A move begins smoothly: its displacement grows as the cube of time or slower (a
    minimum-jerk path: as the cube). Two moments at which it is well above the noise
    determine when it began.
    """
    # Windows after the run, up to the next gap.
    n, way = len(run), int(run[-1] - run[-2]) if len(run) > 1 else 1
    behind = run[-1] + way * np.arange(1, ONSET_WINDOWS)
    behind = behind[(behind >= 0) & (behind < len(w))]
    broken = np.flatnonzero(~w.joined[np.maximum(behind, behind - way)])
    behind = behind[: broken[0]] if len(broken) else behind
    if n < 2 * SPAN_LEAST_WINDOWS or not len(behind):
        return 0
    # Displacement from the middle of the run, in standard deviations of a step.
    away = (w.mean[behind] - w.mean[run[n // 4 : n - n // 4]].mean(axis=0)) / noise.step[1]
    z = np.maximum.accumulate(np.abs(away).max(axis=1))
    if z[-1] < ONSET_SIGMA:
        return 0
    # The first window well above the noise, and one at four times that displacement.
    first = int(np.argmax(z >= ONSET_SIGMA))
    # A move that is there at once has no onset; what noise adds to its end is
    # none of it.
    second = int(np.argmax(z >= min(4 * z[first], 0.9 * z[-1])))
    if second <= first:
        return 0
    # The sum of displacements up to the end of a window grows as the fourth
    # power of the time since the onset.
    area = np.abs(np.cumsum(away, axis=0))[:, int(np.argmax(np.abs(away[second])))]
    ratio = min(float(area[first] / area[second]), 1.0) ** 0.25
    # Extrapolate the fourth root of the area to zero.
    began = first + 1 - (second - first) * ratio / max(1 - ratio, 1e-3)
    return int(min(max(np.ceil(-1.25 * began), 0), n // 4, SCALES[-1]))


def _unsettled(w: Windows, run: Ints, noise: NoiseScales) -> int:
    """Number of windows at the end of a run that differ from those before, in mean or
    in scatter."""
    # Slope of the middle, and the log variance relative to it.
    n = len(run)
    inner = run[n // 4 : n - n // 4]
    climb = np.zeros(3)
    if len(inner) >= 8:
        x = inner - inner.mean()
        climb = x @ w.mean[inner] / (x @ x) * np.sign(run[1] - run[0])
    # Of the logarithm, which is nearly normal also where coloured noise leaves
    # few degrees of freedom to a window.
    share = np.log((w.variance[run] / np.median(w.variance[inner], axis=0)).mean(axis=1))
    middle = share[n // 4 : n - n // 4]
    spread = max(1.4826 * float(np.median(np.abs(middle - np.median(middle)))), EVENLY)
    # A part without the usual vibration does not make the rest exceptional.
    usual = np.maximum(share[: n // 2], np.median(middle) - 5 * spread).mean()
    # Compare the last windows with four times as many before, at every scale.
    for scale in SCALES:
        before = min(4 * scale, n - scale)
        if before < 2 * scale or n < 5 * scale:
            break
        change = w.mean[run[-scale:]].mean(axis=0) - w.mean[run[-scale - before : -scale]].mean(axis=0)
        # What the middle climbs explains any part of it: whether that is a
        # creep, or the noise, one need not know.
        crept = climb * (scale + before) / 2
        change -= np.clip(change, np.minimum(crept, 0), np.maximum(crept, 0))
        if (np.abs(change) > EDGE_SIGMA * noise.of_edge(scale, before)).any():
            return scale
        excess = float(share[-scale:].mean() - usual)
        if n >= 12 and excess > EDGE_SIGMA * spread * np.sqrt(1 / scale + 2 / n):
            return scale
    return 0
