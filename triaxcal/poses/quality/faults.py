"""Judges of what was kept of a stream: rails, frozen outputs, repeated samples,
steps too coarse for the noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.poses.quality.extremes import COARSE, Cells
from triaxcal.poses.quality.finding import (
    AXES,
    AtRail,
    CoarseQuantization,
    DuplicateSamples,
    Finding,
    Freeze,
    Saturation,
    SlowUpdate,
    Steps,
    StillIntervals,
    StuckOutput,
)
from triaxcal.poses.quality.run_lengths import ROWS, EqualRun, RunLengths
from triaxcal.poses.stillness.quantization import noise_of

RAIL_LEAST = 10
"""Readings at a rail beyond `RAIL_TIMES` those of other poses: poses of few are
not judged."""
RAIL_TIMES = 3
"""As often as any other pose reads its own extreme: vibration too dwells at its
extremes."""
REFERENCES_LEAST = 4
"""Other poses that say how often an extreme is read; with fewer, chance says
it."""
CLIPPED_LEAST = 3
"""Readings at a known rail: one or two are the tail of the noise, or a knock."""
CLIPPED_SHARE = 0.005
"""Of a pose. Gaussian noise that is cut off there has its mean shifted by
0.0016 of its standard deviation: less than that does no harm."""
SMOOTH = 2.0
"""Scatter in steps above which no single code is much more frequent than those
beside it."""
APART = 20.0
"""Steps between the extreme and the fifth value below it from which on a
coincidence is reckoned: nearer ones are the tail of the noise."""
COINCIDENCE = 1e-4
"""Probability below which the same extreme, reached several times, is a rail
and no chance."""
FULL_SCALE_BITS = (15, 17, 19, 23, 31)
"""Largest magnitudes of two's complement numbers that no nominal scale factor
makes out of 1 g."""
SLOW_SHARE = 0.1
"""Of samples that repeat: up to this some came twice, above it the sensor
updates more slowly than it is read."""
REPEATS_LEAST = 10
"""Repeats from which on their number says more than chance."""
REPEATED_SHARE = 0.002
"""Beyond twice what chance expects, which is itself an estimate: less does no
harm."""


def saturation(
    cells: Cells, runs: RunLengths, holds: StillIntervals, step: Floats, scatter: Floats, noisy: Bools
) -> tuple[Finding | None, list[set[int]]]:
    """And the poses that lie at a rail, by axis."""
    rails: list[AtRail] = []
    affected: list[set[int]] = [set(), set(), set()]
    place = holds.within(cells.start_ns, cells.end_ns)
    for axis in np.flatnonzero(noisy).tolist() if len(cells) else ():
        long = [r for r in runs.runs(axis) if r.samples > runs.allowed(axis)]
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


def frozen_runs(cells: Cells, runs: RunLengths, noisy: Bools) -> list[list[EqualRun]]:
    """By axis, and last of all axes at once, the runs that are longer than
    noise allows. Those of one axis at its extremes are rails.
    """
    found: list[list[EqualRun]] = [[], [], [], []]
    if not (len(cells) and noisy.any()):
        return found
    most = runs.allowed(ROWS - 1)
    found[-1] = [r for r in runs.runs(ROWS - 1) if r.samples > most]
    for axis in np.flatnonzero(noisy).tolist():
        most, extremes = runs.allowed(axis), _extremes(cells, axis)
        found[axis] = [
            r
            for r in runs.runs(axis)
            if r.samples > most
            and r.value not in extremes
            and not any(r.start_ns <= a.end_ns and a.start_ns <= r.end_ns for a in found[-1])
        ]
    return found


def _side(cells: Cells, axis: int, side: int) -> tuple[Floats, Floats]:
    """Extremes of one side, turned so that they are the highest, and how often
    they were read."""
    if side > 0:
        return cells.high[:, axis], cells.at_high[:, axis].astype(float)
    return -cells.low[:, axis], cells.at_low[:, axis].astype(float)


def _piled(value: Floats, count: Floats, place: Ints, rail: float) -> list[int]:
    """Poses in which the rail was read far more often than the extremes of
    other poses."""
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
    """Poses of which a share lies at a rail that is known to be one."""
    inside = place >= 0
    if not inside.any():
        return []
    number = np.bincount(place[inside], at_rail[inside])
    samples = np.bincount(place[inside]) * size
    return [int(i) for i in np.flatnonzero((number >= CLIPPED_LEAST) & (number > CLIPPED_SHARE * samples))]


def _coincident(value: Floats, step: float, scatter: float) -> bool:
    """Whether the same extreme was reached at several times, where the next
    ones lie too far apart for chance."""
    number = int(np.count_nonzero(np.diff(np.flatnonzero(value == value.max())) > 1)) + 1
    if number < 2 or scatter < SMOOTH * step:
        return False
    step = max(step, scatter / 100)  # without steps no reading comes twice
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
) -> Finding | None:
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
    """Samples that repeat the one before on all axes: of a sensor that is read
    faster than it updates, or single ones that came twice. Neither where noise
    explains them.
    """
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


def coarse_quantization(holds: StillIntervals, affected: Sequence[set[int]], step: Floats) -> Finding | None:
    """Where steps are wider than twice the scatter in the poses, so that a mean
    keeps part of its rounding error; ``affected`` are poses, by axis, that lack
    their scatter for another reason.
    """
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
    """The largest error of a mean of rounded readings over all places between
    two steps, in steps, where rounded readings have ``variance`` on average
    over the places (Widrow and Kollár 2008, Quantization Noise: the harmonics
    of the rounding error under Gaussian noise).
    """
    noise = float(noise_of(np.array([variance]))[0])
    k, place = np.arange(1, 50)[:, None], np.linspace(0, 0.5, 101)
    waves = (-1.0) ** k / (np.pi * k) * np.sin(2 * np.pi * k * place) * np.exp(-2 * np.pi**2 * k**2 * noise**2)
    return min(float(np.abs(waves.sum(axis=0)).max()), 0.5)
