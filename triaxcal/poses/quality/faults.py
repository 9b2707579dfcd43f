"""Detection of faults in the summaries of a stream: rails, frozen outputs, repeated
samples, steps too coarse for the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal.arrays import Bools, Columns, Floats, Ints
from triaxcal.poses.quality.finding import (
    AXES,
    AtRail,
    CoarseQuantization,
    DuplicateSamples,
    Freeze,
    QualityFinding,
    Saturation,
    SlowUpdate,
    Steps,
    StillIntervals,
    StuckOutput,
)
from triaxcal.poses.stillness.windows import noise_of

# Extremes of every tenth of a second with their counts, and the step of the output.

LATTICE = 20.5
"""Differences up to so many steps decide whether there are steps."""
OFF_LATTICE = 0.05
"""Steps by which a difference may deviate from a multiple; one in ten is as near by
chance."""
LATTICE_LEAST = 8
"""Differences that have to lie on the lattice: by chance as many do once in ten
million."""
COARSE = 0.5
"""Noise of a sample in steps: with less, readings stay on one value for long."""
HUSHED = 0.35
"""The same for the quietest tenth of the blocks, which are quieter by chance."""
BLOCK = 16
"""Samples in a block. Longer ones mix noise and motion; in shorter ones chance
decides which it is."""
BLOCKS_LEAST = 4
"""Blocks of noise in a chunk below which their quantiles are unreliable."""
NOISE_LIKE = 0.4
"""Ratio of the variances by fourth and by second differences: 1 for white noise, near
0 for smooth motion. A higher limit loses sound noise by chance."""
NOISY_SHARE = 0.2
"""Least share of noisy blocks: moves and stretches without noise may fill the
others."""
NOISELESS = 1e-13
"""Scatter due to rounding of the arithmetic, as a share of the readings."""
FINEST = 1e-10
"""Smallest step as a share of the readings: less is rounding of the arithmetic."""


@dataclass(frozen=True)
class Cells:
    """Stretches of equal length: ``start_ns``, ``end_ns`` (m,); ``high``, ``low``
    (m,3) extremes of the readings, ``at_high``, ``at_low`` (m,3) numbers of samples
    at exactly that value. ``size`` samples in each."""

    size: int
    start_ns: Ints
    end_ns: Ints
    high: Floats
    low: Floats
    at_high: NDArray[np.integer[Any]]
    at_low: NDArray[np.integer[Any]]

    def __len__(self) -> int:
        return len(self.start_ns)

    def without(self, runs: Sequence[EqualRun]) -> Cells:
        """The cells that overlap none of the ``runs``."""
        kept = np.ones(len(self), dtype=bool)
        for r in runs:
            kept &= (self.end_ns < r.start_ns) | (self.start_ns > r.end_ns)
        if kept.all():
            return self
        return Cells(
            self.size,
            self.start_ns[kept],
            self.end_ns[kept],
            self.high[kept],
            self.low[kept],
            self.at_high[kept],
            self.at_low[kept],
        )


@dataclass
class CellKeeper:
    """Collects cells from whole cells of samples, in order."""

    size: int
    _done: Columns = field(default_factory=Columns)  # as Cells has them, behind its size

    def feed(self, time_ns: Ints, u: Floats) -> None:
        """``u`` (3,n), n a multiple of ``size``."""
        blocks = u.reshape(3, -1, self.size)
        times = time_ns.reshape(-1, self.size)
        high, low = blocks.max(axis=2), blocks.min(axis=2)
        small = np.min_scalar_type(self.size)  # there is one for each tenth of a second, however long
        at_high = np.count_nonzero(blocks == high[:, :, None], axis=2).astype(small)
        at_low = np.count_nonzero(blocks == low[:, :, None], axis=2).astype(small)
        self._done.add((times[:, 0], times[:, -1], _short(high.T), _short(low.T), at_high.T, at_low.T))

    def cells(self) -> Cells:
        if not len(self._done):
            none = np.zeros(0, dtype=np.int64)
            empty = np.zeros((0, 3))
            return Cells(self.size, none, none, empty, empty, empty.astype(np.int64), empty.astype(np.int64))
        return Cells(self.size, *self._done.arrays())


def _short(values: Floats) -> Floats:
    """With half the digits, where these are all: readings of up to 24 bits."""
    short = values.astype(np.float32)
    return short if (short == values).all() else values


@dataclass
class StepEstimator:
    """Estimates the smallest step of each axis, and its noise from sample to sample,
    from chunks of the stream."""

    _least: list[Floats] = field(default_factory=list)
    _rough: list[list[float]] = field(default_factory=lambda: [[], [], []])
    _least_rough: Floats = field(default_factory=lambda: np.full(3, np.inf))
    _blocks: int = 0
    _noisy: Ints = field(default_factory=lambda: np.zeros(3, dtype=np.int64))

    def feed(self, u: Floats) -> None:
        """``u`` (3,n) consecutive samples."""
        if u.shape[1] < BLOCK + 4:
            return
        difference = np.diff(u, axis=1)
        size = np.abs(difference)
        largest = np.abs(u).max(axis=1)
        # The smallest difference of each axis, if all lie on its lattice.
        self._least.append(np.array([_step(size[axis], FINEST * largest[axis]) for axis in range(3)]))
        # Noise variance by second differences, whose gain is 6, in blocks.
        second, count = np.diff(difference, axis=1), (u.shape[1] - 4) // BLOCK
        rough = _mean_square(second, count) / 6
        # Noise is as large in fourth differences as in second ones; what moves
        # smoothly all but vanishes there.
        like_noise = (_mean_square(np.diff(second, n=2, axis=1), count) / 70 > NOISE_LIKE * rough) & (
            rough > (NOISELESS * largest[:, None]) ** 2
        )
        self._blocks += rough.shape[1]
        self._noisy += like_noise.sum(axis=1)
        for axis in range(3):
            noisy = rough[axis, like_noise[axis]]
            if len(noisy) >= BLOCKS_LEAST:
                low, middle = np.quantile(noisy, [0.1, 0.5])
                self._rough[axis].append(float(middle))
                self._least_rough[axis] = min(self._least_rough[axis], float(low))

    def step(self) -> Floats:
        """(3,) smallest difference between readings, zero where they do not lie on a
        lattice."""
        if not self._least:
            return np.zeros(3)
        least = np.array(self._least)
        found = np.where(least > 0, least, np.inf).min(axis=0)
        return np.where(np.isfinite(found), found, 0.0)

    def roughness(self, constant: Ints) -> Floats:
        """(3,) standard deviation of the noise from sample to sample; zero where most
        of the stream has none. ``constant`` (3,) are samples in which the axis repeats
        one value for so long that they say nothing about its noise."""
        out = np.zeros(3)
        blocks = self._blocks - constant // BLOCK
        for axis in np.flatnonzero(self._noisy > NOISY_SHARE * blocks).tolist():
            out[axis] = np.sqrt(np.median(self._rough[axis])) if self._rough[axis] else 0.0
        return out

    def scatters(self, roughness: Floats, step: Floats) -> Bools:
        """(3,) whether the noise exceeds half a ``step`` (3,), so that readings do
        not stay on one value: in the median (``roughness``), and nearly so in every
        part of the stream, such as after a vibrating machine is switched off."""
        return np.asarray((roughness > COARSE * step) & (np.sqrt(self._least_rough) > HUSHED * step))


def _mean_square(differences: Floats, count: int) -> Floats:
    """(3,count) mean squares in blocks."""
    blocks = differences[:, : count * BLOCK].reshape(3, count, BLOCK)
    return np.asarray(np.einsum("ijk,ijk->ij", blocks, blocks) / BLOCK)


def _step(size: Floats, floor: float) -> float:
    changes = size[size > floor]
    if not len(changes):
        return 0.0
    least = float(changes.min())
    near = changes[changes < LATTICE * least] / least
    if len(near) < LATTICE_LEAST or np.mean(np.abs(near - np.rint(near)) < OFF_LATTICE) < 0.999:
        return 0.0
    return least


# Lengths of runs of equal readings, and the longest runs.

ROWS = 4
"""The three axes, and all of them together."""
LONGEST_COUNTED = 4096
"""Lengths that are counted individually; longer runs count as this long, and are kept
as well."""
KEPT_LEAST = 8
"""Least samples of a run that is kept: shorter ones are common in sound noise. A
shorter freeze of the output is not detected."""
KEPT_MOST = 256
"""Largest number of runs that are kept of each row, which bounds the memory; all
others are counted."""
FROZEN_LEAST = 256
"""Equal readings in a row that say nothing about chance: an output with as few changes
has no noise to judge repeats by."""
RUNS_LEAST = 200
"""Number of runs from which their length is estimated."""
FALSE_ALARM = 1e-4
"""Probability of a false alarm in a stream."""
MARGIN = 1.5
"""Factor on the decay length of the tail beyond one run in a thousand."""
SCALE_LEAST = 0.3
"""Least decay length of the tail in samples: as though one sample in 28 repeated,
where fewer do. A conservative limit."""


@dataclass(frozen=True)
class EqualRun:
    """``samples`` equal readings in a row, from ``start_ns`` to ``end_ns``."""

    start_ns: int
    end_ns: int
    samples: int
    value: float


@dataclass
class RunLengths:
    """Fed chunks of the stream in order; a run may continue from chunk to chunk."""

    by_chance: float = 0.0
    """Expected number of simultaneous repeats of all axes."""
    counts: Ints = field(default_factory=lambda: np.zeros((ROWS, LONGEST_COUNTED + 1), dtype=np.int64))
    _long: list[list[EqualRun]] = field(default_factory=lambda: [[] for _ in range(ROWS)])
    _fed: int = 0
    _start: list[int] = field(default_factory=lambda: [0] * ROWS)
    _start_ns: list[int] = field(default_factory=lambda: [0] * ROWS)
    _last: Floats = field(default_factory=lambda: np.zeros(3))
    _last_ns: int = 0

    def feed(self, time_ns: Ints, u: Floats) -> None:
        """``u`` (3,n)."""
        n = len(time_ns)
        # Whether each axis, and any axis, changes at each sample.
        changed = np.empty((ROWS, n), dtype=bool)
        changed[:3, 0] = u[:, 0] != self._last if self._fed else False
        np.not_equal(u[:, 1:], u[:, :-1], out=changed[:3, 1:])
        changed[3] = changed[0] | changed[1] | changed[2]
        if not self._fed:
            self._start_ns = [int(time_ns[0])] * ROWS
        for row in range(ROWS):
            at = np.flatnonzero(changed[row])
            if len(at):
                self._close(row, at, time_ns, u)
        self.by_chance += _by_chance(changed[:3])
        self._fed += n
        self._last, self._last_ns = u[:, -1].copy(), int(time_ns[-1])

    def _close(self, row: int, at: Ints, time_ns: Ints, u: Floats) -> None:
        """Count the runs that end before the changes at ``at``, and keep the long
        ones."""
        length = np.diff(at, prepend=self._start[row] - self._fed)
        self.counts[row] += np.bincount(np.minimum(length, LONGEST_COUNTED), minlength=LONGEST_COUNTED + 1)
        for i in np.flatnonzero(length >= KEPT_LEAST):
            before = int(at[i]) - 1
            start_ns = self._start_ns[row] if i == 0 else int(time_ns[at[i - 1]])
            end_ns = int(time_ns[before]) if before >= 0 else self._last_ns
            value = float(u[row % 3, before] if before >= 0 else self._last[row % 3])
            self._long[row].append(EqualRun(start_ns, end_ns, int(length[i]), value))
        self._long[row] = _longest(self._long[row], 2 * KEPT_MOST)
        self._start[row], self._start_ns[row] = self._fed + int(at[-1]), int(time_ns[at[-1]])

    def runs(self, row: int) -> list[EqualRun]:
        """The longest runs by time, with the unfinished one."""
        last = self._fed - self._start[row]
        open_run = [EqualRun(self._start_ns[row], self._last_ns, last, float(self._last[row % 3]))] if last else []
        return sorted(_longest(self._long[row], 0) + open_run, key=lambda r: r.start_ns)

    def constant(self) -> Ints:
        """(3,) samples in the longest run of each axis."""
        return np.array([max((r.samples for r in self.runs(axis)), default=0) for axis in range(3)])

    def allowed(self, row: int) -> float:
        """Longest run that noise explains, from the decay of the run lengths;
        infinite where unknown.

        Runs of a noisy output end at any sample with some probability, so their tail
        is at most exponential. Its decay follows from the share of repeated samples
        and from the quantiles at one run in a hundred and in a thousand, which a
        frozen output does not shift.
        """
        counts = self.counts[row]
        total = int(counts.sum())
        if total < RUNS_LEAST:
            return float("inf")
        # Quantiles 0.99 and 0.999 of the length, and the share of repeated samples.
        above = np.cumsum(counts)
        high, higher = (int(np.searchsorted(above, q * total)) for q in (0.99, 0.999))
        length = np.arange(1, higher + 1)
        usual = counts[1 : higher + 1]
        repeating = float(((length - 1) * usual).sum() / max((length * usual).sum(), 1))
        # The largest decay length, then the extreme quantile for the false-alarm rate.
        scale = max(SCALE_LEAST, (higher - high) / np.log(10.0), -1 / np.log(max(repeating, 1e-300)))
        return float(higher + MARGIN * scale * np.log(max(total / 1000, 1.0) / FALSE_ALARM))

    def repeated(self, row: int, most: float) -> tuple[int, int]:
        """Samples that repeat the previous one, in runs of up to ``most``, and all
        samples in such runs."""
        upto = min(int(most), LONGEST_COUNTED - 1) + 1
        length = np.arange(upto)
        counts = self.counts[row, :upto]
        return int(((length - 1) * counts)[1:].sum()), int((length * counts).sum())


def _by_chance(changed: Bools) -> float:
    """Expected number of simultaneous repeats from ``changed`` (3,n), given the other
    combinations of repeating axes (log-linear model without the interaction of all
    three; Bishop, Fienberg and Holland 1975). Where one output is frozen, the repeats
    of the two others are independent; where two are, those of the third count."""
    frozen = np.array([_within_long_runs(row) for row in changed])
    which = np.array([1, 2, 4], dtype=np.int8)
    pattern = frozen.astype(np.int8).T @ which if frozen.any() else np.zeros(changed.shape[1], dtype=np.int8)
    expected = 0.0
    for frozen_axes in np.unique(pattern).tolist():
        part = ~changed[:, pattern == frozen_axes]
        live = part[(which & frozen_axes) == 0]
        if len(live) == len(which):
            n = np.bincount(part.astype(np.int8).T @ which, minlength=8).astype(float)
            expected += float(n[0] * n[3] * n[5] * n[6] / np.maximum(n[[1, 2, 4]], 1.0).prod())
        elif len(live):
            expected += float(live.mean(axis=1).prod() * part.shape[1])
    return expected


def _within_long_runs(changed: Bools) -> Bools:
    """(n,) samples inside runs of `FROZEN_LEAST` equal readings."""
    edges = np.concatenate([[0], np.flatnonzero(changed), [len(changed)]])
    length = np.diff(edges)
    return np.repeat(length >= FROZEN_LEAST, length) if len(changed) else changed


def _longest(found: list[EqualRun], unless: int) -> list[EqualRun]:
    if len(found) <= max(unless, KEPT_MOST):
        return found
    return sorted(found, key=lambda r: (-r.samples, r.start_ns))[:KEPT_MOST]


RAIL_LEAST = 10
"""Readings at a rail beyond `RAIL_TIMES` those of other poses: poses with fewer are
not judged."""
RAIL_TIMES = 3
"""Ratio to the count at the extreme of any other pose: vibration too dwells at its
extremes."""
REFERENCES_LEAST = 4
"""Number of other poses with extremes for the comparison; with fewer, chance
decides."""
CLIPPED_LEAST = 3
"""Readings at a known rail: one or two are the tail of the noise, or a knock."""
CLIPPED_SHARE = 0.005
"""Share of a pose at the rail. Gaussian noise that is clipped there shifts its mean
by 0.0016 of its standard deviation: less is harmless."""
SMOOTH = 2.0
"""Scatter in steps above which no single code is much more frequent than its
neighbours."""
APART = 20.0
"""Steps between the extreme and the fifth value below it, from which on a coincidence
is tested: nearer ones are the tail of the noise."""
COINCIDENCE = 1e-4
"""Probability of a coincidence below which the same extreme, reached several times,
is a rail."""
FULL_SCALE_BITS = (15, 17, 19, 23, 31)
"""Exponents of the largest two's complement numbers, which no nominal scale factor
gives for 1 g."""
SLOW_SHARE = 0.1
"""Share of repeated samples: below it some came twice, above it the sensor updates
more slowly than it is read."""
POSES_FROZEN = 3
"""Poses through which an output is frozen at an extreme: a rail may be kept from one
pose to the next where both are beyond it."""
REPEATS_LEAST = 10
"""Least number of significant repeats."""
REPEATED_SHARE = 0.002
"""Share of repeats beyond twice the expectation, itself an estimate; less is
harmless."""


def saturation(
    whole: Cells,
    runs: RunLengths,
    frozen: Sequence[Sequence[EqualRun]],
    holds: StillIntervals,
    step: Floats,
    scatter: Floats,
    noisy: Bools,
) -> tuple[QualityFinding | None, list[set[int]]]:
    """A fault of saturation, and the poses at a rail, by axis. The ``frozen`` runs
    (`frozen_runs`) reach no rail, whatever their value."""
    rails: list[AtRail] = []
    affected: list[set[int]] = [set(), set(), set()]
    for axis in np.flatnonzero(noisy).tolist():
        cells = whole.without([*frozen[axis], *frozen[-1]])
        if not len(cells):
            continue
        place = holds.within(cells.start_ns, cells.end_ns)
        # Test the extremes of every noisy axis, upper and lower.
        long = [r for r in runs.runs(axis) if r.samples > runs.allowed(axis) and r not in frozen[axis]]
        for side, rail in zip((1, -1), _extremes(cells, axis), strict=True):
            value, count = _side(cells, axis, side)
            at_rail = value == side * rail
            number = int(count[at_rail].sum())
            piled = _piled(value, count, place, side * rail)
            known = any(r.value == rail for r in long) or _full_scale(rail, step[axis], side)
            if not (known or piled or _coincident(value, step[axis], scatter[axis])):
                continue
            touched = sorted({*piled, *_clipped(count * at_rail, place, cells.size)})
            affected[axis].update(touched)
            first = holds.seconds(int(cells.start_ns[at_rail][0]))
            rails.append(AtRail(AXES[axis], rail, number, first, holds.touching(touched)))
    return Saturation(tuple(rails)) if rails else None, affected


def _extremes(cells: Cells, axis: int) -> tuple[float, float]:
    return float(cells.high[:, axis].max()), float(cells.low[:, axis].min())


def frozen_runs(whole: Cells, runs: RunLengths, holds: StillIntervals, noisy: Bools) -> list[list[EqualRun]]:
    """Runs longer than noise explains, by axis, and last those of all axes at once.
    Runs of one axis at its extremes are rails, unless one of them goes on through
    several poses to the end of the stream, or from its beginning."""
    found: list[list[EqualRun]] = [[], [], [], []]
    if not (len(whole) and noisy.any()):
        return found
    most = runs.allowed(ROWS - 1)
    found[-1] = [r for r in runs.runs(ROWS - 1) if r.samples > most]
    for axis in np.flatnonzero(noisy).tolist():
        most, ends = runs.allowed(axis), (whole.start_ns[0], whole.end_ns[-1])
        long = [
            r
            for r in runs.runs(axis)
            if r.samples > most and not any(r.start_ns <= a.end_ns and a.start_ns <= r.end_ns for a in found[-1])
        ]
        # A unit that moves leaves its rail between two poses.
        dead = [
            r
            for r in long
            if (r.start_ns <= ends[0] or r.end_ns >= ends[1])
            and len(holds.touched(r.start_ns, r.end_ns)) >= POSES_FROZEN
        ]
        cells = whole.without([*dead, *found[-1]])
        extremes = _extremes(cells, axis) if len(cells) else ()
        found[axis] = [r for r in long if r in dead or r.value not in extremes]
    return found


def _side(cells: Cells, axis: int, side: int) -> tuple[Floats, Floats]:
    """Extremes of one side, with the sign that makes them maxima, and their
    counts."""
    if side > 0:
        return cells.high[:, axis].astype(float), cells.at_high[:, axis].astype(float)
    return -cells.low[:, axis].astype(float), cells.at_low[:, axis].astype(float)


def _piled(value: Floats, count: Floats, place: Ints, rail: float) -> list[int]:
    """Poses in which the rail was read far more often than other poses read their
    extremes."""
    # Top reading of every pose, its count, and the number of cells.
    tops: dict[int, tuple[float, float, int]] = {}
    for pose in np.unique(place[place >= 0]):
        inside = place == pose
        top = float(value[inside].max())
        tops[int(pose)] = (top, float(count[inside & (value == top)].sum()), int(inside.sum()))
    share = [n / cells for top, n, cells in tops.values() if top < rail]
    if len(share) < REFERENCES_LEAST:
        return []
    most = max(share)
    return [
        pose
        for pose, (top, n, cells) in tops.items()
        if top == rail and n > RAIL_TIMES * max(most * cells, 1.0) + RAIL_LEAST
    ]


def _clipped(at_rail: Floats, place: Ints, size: int) -> list[int]:
    """Poses with a share of readings at a known rail."""
    inside = place >= 0
    if not inside.any():
        return []
    number = np.bincount(place[inside], at_rail[inside])
    samples = np.bincount(place[inside]) * size
    return [int(i) for i in np.flatnonzero((number >= CLIPPED_LEAST) & (number > CLIPPED_SHARE * samples))]


def _coincident(value: Floats, step: float, scatter: float) -> bool:
    """Whether the same extreme was reached at several times, with the next values too
    far away for chance."""
    number = int(np.count_nonzero(np.diff(np.flatnonzero(value == value.max())) > 1)) + 1
    if number < 2 or scatter < SMOOTH * step:
        return False
    step = max(step, scatter / 100)  # without steps no reading comes twice
    # Probability that several extremes coincide within one step: (5/apart)^(n−1).
    below = np.sort(value[value < value.max()])[::-1]
    if len(below) < 5:
        return False
    apart = float(value.max() - below[4]) / step
    return apart > APART and (5 / apart) ** (number - 1) < COINCIDENCE


def _full_scale(rail: float, step: float, side: int) -> bool:
    """Whether counts reach the end of an integer's range."""
    return step == 1.0 and any(rail == (2.0**k - 1 if side > 0 else -(2.0**k)) for k in FULL_SCALE_BITS)


def stuck_output(
    frozen: Sequence[Sequence[EqualRun]], slow: SlowUpdate | None, holds: StillIntervals, dead: Sequence[str]
) -> QualityFinding | None:
    """``dead`` are axes that never change."""
    freezes = []
    for axis, runs in enumerate(frozen):
        if not runs:
            continue
        longest = max(runs, key=lambda r: (r.samples, -r.start_ns))
        touched = sorted({i for r in runs for i in holds.touched(r.start_ns, r.end_ns)})
        which, first = AXES[axis] if axis < len(AXES) else None, holds.seconds(runs[0].start_ns)
        freezes.append(Freeze(which, longest.value, len(runs), longest.samples, first, holds.touching(touched)))
    return StuckOutput(tuple(dead), slow, tuple(freezes)) if dead or slow or freezes else None


def repeated_samples(
    runs: RunLengths, noisy: Bools, rate_hz: float
) -> tuple[SlowUpdate | None, DuplicateSamples | None]:
    """Samples that repeat the previous one on all axes: of a sensor that is read
    faster than it updates, or single ones that came twice. Neither where noise
    explains them."""
    most = runs.allowed(3)
    if noisy.sum() < 2 or not np.isfinite(most):
        return None, None
    triple, samples = runs.repeated(3, most)
    if triple < REPEATS_LEAST:
        return None, None
    share = triple / samples
    if triple < 2 * runs.by_chance + REPEATED_SHARE * samples:
        return None, None
    if share > SLOW_SHARE:
        chance = runs.by_chance / samples
        every = (1 - chance) / (1 - share)
        return SlowUpdate(every, rate_hz), None
    return None, DuplicateSamples(triple, samples)


def coarse_quantization(holds: StillIntervals, affected: Sequence[set[int]], step: Floats) -> QualityFinding | None:
    """Axes with steps wider than twice the scatter in the poses, so that a mean keeps
    part of its rounding error; ``affected`` are poses, by axis, that lack their
    scatter for another reason."""
    axes = []
    for axis in np.flatnonzero(step > 0).tolist():
        sound = [i for i in range(len(holds)) if i not in affected[axis]]
        if not sound:
            continue
        q, variance = float(step[axis]), float(holds.variance[sound, axis].mean())
        if np.sqrt(variance) >= COARSE * q:
            continue
        off = q * _rounding_error(variance / q**2)
        axes.append(Steps(AXES[axis], q, float(np.sqrt(variance)), off))
    return CoarseQuantization(tuple(axes)) if axes else None


def _rounding_error(variance: float) -> float:
    """Largest error of a mean of rounded readings over all places between two steps,
    in steps, for rounded readings of mean ``variance`` (Widrow and Kollár 2008,
    Quantization Noise: harmonics of the rounding error under Gaussian noise)."""
    # Σ (−1)ᵏ/(πk) sin(2πkx) exp(−2π²k²σ²).
    noise = float(noise_of(np.array([variance]))[0])
    k, place = np.arange(1, 50)[:, None], np.linspace(0, 0.5, 101)
    waves = (-1.0) ** k / (np.pi * k) * np.sin(2 * np.pi * k * place) * np.exp(-2 * np.pi**2 * k**2 * noise**2)
    return min(float(np.abs(waves.sum(axis=0)).max()), 0.5)


# Missing samples, from the time stamps alone.

OFF_CLOCK = 0.2
"""For time stamps of an even clock: steps within this many periods of a multiple."""
EVEN_SHARE = 0.95
"""Share of steps that are whole periods in an even clock; a few may be late."""
EVEN_LEAST = 0.4
"""Median step over the average period below which samples come in bursts: half of the
steps then lie within a burst and do not show the period."""
BESIDE = 64
"""Samples on each side of a gap whose earliest stamps are compared: more find a less
delayed one, but two gaps within them count as one."""
SHIFT_LEAST = 0.75
"""For uneven time stamps: a gap shifts all that follow by so many periods."""
LONG = 3.5
"""In periods: for uneven stamps only steps above three are examined, since late
stamps cause others."""


@dataclass
class Gaps:
    """Counts the samples missing between others. Fed chunks of the stream; judges a
    step once its sequel is known."""

    missing: int = 0
    gaps: int = 0
    longest: int = 0
    first_ns: int = 0
    _held: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    _judged: int = 0

    def feed(self, time_ns: Ints, *, last: bool = False) -> None:
        """``time_ns`` (n,) of the samples that follow; ``last``: no more come."""
        held = np.concatenate([self._held, time_ns])
        until = len(held) if last else len(held) - BESIDE
        if len(held) >= 3 and until > self._judged:
            self._judge(held, until)
        keep = max(0, len(held) - 2 * BESIDE)
        self._held, self._judged = held[keep:].copy(), max(until, self._judged) - keep

    def _judge(self, time_ns: Ints, until: int) -> None:
        # Period of the samples, over many bursts if there are any.
        step = np.diff(time_ns).astype(float)
        lag = max(len(step) // 2, 1)  # over many bursts, if there are any
        average, period = float(np.median(time_ns[lag:] - time_ns[:-lag])) / lag, float(np.median(step))
        if period < EVEN_LEAST * average:  # they come in bursts
            period = average
        ratio = step / period
        # An even clock gives whole steps; else gaps shift the clock permanently.
        even = np.mean((np.abs(ratio - np.rint(ratio)) < OFF_CLOCK) & (ratio > 0.5)) >= EVEN_SHARE
        lost = np.rint(ratio) - 1 if even else _shifts((time_ns - time_ns[0]) / average, ratio)
        for i in range(self._judged, min(until, len(step))) if (lost >= 1).any() else ():
            if lost[i] >= 1:
                self._add(int(lost[i]), int(time_ns[i]))

    def _add(self, lost: int, at_ns: int) -> None:
        if not self.gaps:
            self.first_ns = at_ns
        self.gaps += 1
        self.missing += lost
        self.longest = max(self.longest, lost)


def _shifts(periods: Floats, ratio: Floats) -> Floats:
    """(n-1,) whole periods by which each long step shifts the clock permanently:
    samples that are only late catch up. ``periods`` (n,) are the times in average
    periods."""
    # Delay of every sample against an even clock; the longest steps first.
    late = periods - np.arange(len(periods))
    lost = np.zeros(len(ratio))
    # The average period is off by a burst in half of all samples.
    least = SHIFT_LEAST + BESIDE * float(np.quantile(ratio, 0.99)) / max(len(ratio) // 2, 1)
    clear = np.ones(len(ratio), dtype=bool)
    long = np.flatnonzero(ratio > LONG)
    for i in long[np.argsort(-ratio[long], kind="stable")]:
        if not clear[i]:
            continue
        before, after = late[max(0, i - BESIDE) : i + 1], late[i + 1 : i + 1 + BESIDE]
        if min(len(before), len(after)) >= BESIDE // 4:
            # Delays only add: the earliest of each side is nearest to the
            # truth.
            shift = float(after.min() - before.min())
            lost[i] = np.rint(shift) if shift > least else 0.0
        if lost[i]:  # seen from the steps beside it too
            clear[max(0, i - 2 * BESIDE) : i + 2 * BESIDE] = False
    return lost
