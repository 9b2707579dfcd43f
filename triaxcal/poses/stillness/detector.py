"""Where the unit stood still: a detector that learns the noise from the stream
itself.

It works on the windows of `triaxcal.poses.stillness.windows`, in three steps.
What scatters inside a window as the quietest windows do is calm. Among calm
windows a move shows in the difference of neighbouring averages over one window
and more, judged by how such differences scatter in this very stream, whatever
the colour of its noise. What is left are runs, trimmed where a move sets out or
settles, and put together where only a bump parts them. Where a machine shakes
the stand, `triaxcal.poses.stillness.shaken` looks for the poses that are left."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import chi2_cdf, chi2_isf, chi2_ppf
from triaxcal.errors import TooShort
from triaxcal.poses.stillness.noise_scales import (
    GUARD,
    SCALES,
    SPAN_LEAST_WINDOWS,
    NoiseScales,
    contrast,
    contrasts,
    trimmed,
    unbroken,
)
from triaxcal.poses.stillness.shaken import (
    ALONE_S,
    MOVE_SIGMA,
    disturbances,
    parted,
    runs,
    shaken_noise,
    shaken_runs,
    worth_keeping,
)
from triaxcal.poses.stillness.windows import RATE_LEAST, Rounding, WindowCutter, Windows, resolution, window_size

# A unit that turns in place: what a turn about the vertical shows between the poses
# about it.

TURN_S = 1.0
"""Turning a fixture by half a circle and putting it down takes as long; some
knocks that ring do. What noise makes of the longest averages, which are over
0.8 s, is shorter, but for rare chance."""
IN_PLACE = 0.01
"""Of the range of the outputs. Where poses cover the sphere this is 20 mrad:
two orientations on a table that tilts by 10 mrad, or the pull 8 cm off the axis
of half a turn in 2 s, on average."""
PAUSE = 1 / 2
"""What stands still on the way is shorter than this share of poses before and
after it. A pose that is lost so costs its data; a piece of a turn that is taken
for one puts its pull into the face."""


def without_turns(w: Windows, quiet: list[Ints], shaken: list[Ints]) -> list[Ints]:
    """Still pieces in order of time, but those that turns in place show between
    quiet ones."""
    known = {int(piece[0]) for piece in quiet}
    pieces = sorted([*quiet, *shaken], key=lambda p: int(p[0]))
    kept: list[Ints] = []
    for place in _places(w, pieces):
        at = [k for k, piece in enumerate(place) if int(piece[0]) in known]
        hand = set(range(at[0], at[-1])).difference(at) if at else ()
        kept += _without_pauses([piece for k, piece in enumerate(place) if k not in hand])
    return kept


def _places(w: Windows, pieces: list[Ints]) -> Iterator[list[Ints]]:
    """Pieces that follow one another in place."""
    if not pieces:
        return
    level: Floats = np.array([w.mean[piece].mean(axis=0) for piece in pieces])
    apart = np.abs(np.diff(level, axis=0)).max(axis=1)
    moved = np.flatnonzero(apart > IN_PLACE * np.ptp(level, axis=0).max()) + 1
    for begin, end in itertools.pairwise([0, *moved.tolist(), len(pieces)]):
        yield pieces[begin:end]


def _without_pauses(place: list[Ints]) -> list[Ints]:
    """Without those that have far longer ones before them and after them."""
    length = np.array([len(piece) for piece in place])
    before = np.maximum.accumulate(length)
    after = np.maximum.accumulate(length[::-1])[::-1]
    stays = length >= PAUSE * np.minimum(before, after)
    return [piece for piece, kept in zip(place, stays, strict=True) if kept]


__all__ = ["Span", "StillnessDetector", "Windows", "find_spans"]

SPAN_LEAST_S = 0.4
"""Four windows: in less there is hardly a middle beside the
ends."""
REJOIN_S = 1.5
"""A disturbance shorter than this, with the same mean before and after, is a
bump inside one pose."""
FALSE_ALARM = 1e-6
"""Probability that the noise of an axis takes a still window for motion: once
in 28 hours."""
STEP_SIGMA = 7.0
"""Of a single step, tested on noise that need not be Gaussian."""
BESIDE = 6
"""Windows beside a run in which a move shows."""
MOTION = 2.0
"""Of a random walk, the strongest colour that noise has, a quarter of the
squared steps is below 0.4 of the scatter."""
SLIGHT = 0.01
"""Slow vibration moves the outputs from window to window by no more than this
share of their range."""
FROZEN_WINDOWS = 3
"""An output is frozen that repeats one reading over so many windows, though
noise is wider than its steps."""


@dataclass(frozen=True)
class Span:
    """A still span as indices of windows. ``used`` (k,) are the windows in it
    that no bump disturbs.

    ``since_s`` is how long the disturbance before it lasted, where that left
    the mean as it was; else infinite. ``shaken`` (j,) are the windows of its
    disturbances, of which ``used`` has none. ``parted``: a move that shaking
    hid lies between this span and the one before.
    """

    used: Ints
    since_s: float = math.inf
    shaken: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    parted: bool = False

    @property
    def first(self) -> int:
        return int(self.used[0])

    @property
    def last(self) -> int:
        return int(self.used[-1])


@dataclass
class StillnessDetector(WindowCutter):
    """Feed it blocks of any size; ask for `windows` and `spans` at any time."""

    def windows(self) -> Windows:
        """Raises TooShort where there is not one whole window yet."""
        if not self._done:
            period_ns = self._period_ns or (self.span_ns / (self.samples - 1) if self.samples > 1 else math.inf)
            if self._period_ns and self.samples >= least_samples(period_ns):
                raise _too_short(self._longest, (self._longest - 1) * period_ns, period_ns, in_pieces=True)
            raise _too_short(self.samples, self.span_ns, period_ns, in_pieces=False)
        return super().windows()

    def too_short(self) -> TooShort | None:
        """Why no pose could be found, whatever the unit did; None where one
        could."""
        try:
            w = self.windows()
        except TooShort as e:
            return e
        begins = np.flatnonzero(~w.joined)
        longest = w.size * int(np.diff(begins, append=len(w)).max())
        least = least_samples(self._period_ns)
        if longest >= least:
            return None
        if self.samples < least:
            return _too_short(self.samples, self.span_ns, self._period_ns, in_pieces=False)
        return _too_short(longest, (longest - 1) * self._period_ns, self._period_ns, in_pieces=True)

    def spans(self, turn_s: float | None = None) -> list[Span]:
        """The still spans so far, in order; ``turn_s`` as for `find_spans`."""
        return find_spans(self.windows(), turn_s)


def least_samples(period_ns: float) -> int:
    """Of a stream in which a pose can be found, at a sample period that may be
    infinite: its windows and their guards."""
    size = window_size(period_ns)
    windows = max(SPAN_LEAST_WINDOWS, math.ceil((SPAN_LEAST_S * 1e9 / period_ns + 1) / size))
    return max(RATE_LEAST, (windows + 2 * GUARD) * size)


def _too_short(samples: int, span_ns: float, period_ns: float, *, in_pieces: bool) -> TooShort:
    least = least_samples(period_ns)
    least_s = (least - 1) * period_ns * 1e-9 if math.isfinite(period_ns) else 0.0
    return TooShort(samples, span_ns * 1e-9, least, least_s, in_pieces=in_pieces)


def find_spans(w: Windows, turn_s: float | None = None) -> list[Span]:
    """The still spans of a stream of windows, at least 0.4 s long.

    A unit that turns about the vertical on a level table comes to rest with the
    mean that it had: no reading tells the turn from a bump. Where the unit may
    have turned so, ``turn_s`` says how long a turn takes at least; a
    disturbance of that length parts spans then, whatever the means, and what
    stands out of it for a while is no span of its own
    (`triaxcal.poses.stillness.detector`).
    """
    # Rounding of a digital output leaves windows without any scatter; a step of
    # it is noise all the same.
    raw, step = w.variance, resolution(w)
    frozen = _frozen(w, step)
    live, stuck = np.asarray(~frozen.any(axis=1)), np.asarray(frozen.all(axis=1))
    w = replace(w, variance=np.maximum(raw, step**2 / 4))
    calm = np.asarray((w.variance <= quiet_limit(w.variance[live], w.size - 1)).all(axis=1)) & ~stuck
    if _only_moves(w, calm):
        return []
    found, noise, steady = _still_runs(w, calm, live, _rounding(step, raw[calm & live]))
    for _ in range(2):
        inside = _inside(w, found) & live
        if inside.sum() < 2 * SPAN_LEAST_WINDOWS:
            break
        calm = np.asarray((w.variance <= _limit_within(w.variance[inside], w.size - 1)).all(axis=1)) & ~stuck
        found, noise, steady = _still_runs(w, calm, live, _rounding(step, raw[inside & calm]))
    taken, pieces = _quiet_pieces(w, found, noise)
    shaken = shaken_runs(w, [*taken, *runs(stuck, w.joined)], noise)
    disturbed = ~steady
    if turn_s is None:
        kept, longest = sorted([*pieces, *shaken], key=lambda p: int(p[0])), REJOIN_S
    else:
        kept, longest = without_turns(w, pieces, shaken), turn_s
    quiet = np.zeros(len(w), dtype=bool)
    quiet[np.concatenate([*pieces, np.zeros(0, dtype=np.int64)])] = True
    poses = _rejoined(w, kept, noise, disturbed, longest)
    return [span for pose, since_s in poses for span in _spans_of(w, pose, quiet, noise, since_s)]


def _spans_of(w: Windows, pose: list[Ints], quiet: Bools, noise: NoiseScales, since_s: float) -> list[Span]:
    """The spans, long enough, of what was taken for one pose: more than one
    where shaking hid a move."""
    spans: list[Span] = []
    for part in parted(w, pose, [bool(quiet[p[0]]) for p in pose], noise):
        used, shaken = _without_shaken(w, part, quiet, noise)
        if _long_enough(w, used, SPAN_LEAST_S if quiet[used].any() else ALONE_S):
            disturbed = disturbances(w, used, shaken)
            spans.append(Span(used, math.inf if spans else since_s, disturbed, parted=bool(spans)))
    return spans


def _without_shaken(w: Windows, part: list[Ints], quiet: Bools, noise: NoiseScales) -> tuple[Ints, Ints]:
    """The windows of a pose that its mean is taken over, and the shaken ones
    that would make it worse."""
    still = [p for p in part if quiet[p[0]]]
    if not still or not _long_enough(w, np.concatenate(still), SPAN_LEAST_S):
        return np.concatenate(part), np.zeros(0, dtype=np.int64)
    known = np.concatenate(still)
    kept = [bool(quiet[p[0]]) or worth_keeping(w, p, known, noise) for p in part]
    shaken = [p for p, k in zip(part, kept, strict=True) if not k]
    used = [p for p, k in zip(part, kept, strict=True) if k]
    return np.concatenate(used), np.concatenate([np.zeros(0, dtype=np.int64), *shaken])


def _rounding(step: Floats, quiet: Floats) -> Rounding:
    """What the step adds, by the variances (k,3) of quiet windows: of their
    mean, since a median of windows with one reading or two says little."""
    return Rounding.of(step, quiet.mean(axis=0) if len(quiet) else np.zeros(3))


def _quiet_pieces(w: Windows, found: list[Ints], noise: NoiseScales) -> tuple[list[Ints], list[Ints]]:
    """Runs that are settled, one way or the other, and the still pieces of
    them."""
    taken, pieces = [], []
    for run in found:
        if _under_way(w, run, noise):
            taken.append(run)
            continue
        piece = trimmed(w, run, noise)
        if len(piece) >= SPAN_LEAST_WINDOWS:
            taken.append(run)
            pieces.append(piece)
    return taken, pieces


def _frozen(w: Windows, step: Floats) -> Bools:
    """(m,3) windows in which an axis is frozen: they show no noise, and nothing
    is learned from them. Nor is it a pose where all axes are: what the unit
    does meanwhile, nobody knows.

    An output whose ``step`` is as wide as its noise repeats readings too, but
    it does so again and again, or else changes by a step or two.
    """
    frozen = np.zeros((len(w), 3), dtype=bool)
    # One reading that differs by a step makes more of either.
    repeats = w.variance < step**2 / (2 * w.size)
    same = np.abs(np.diff(w.mean, axis=0, prepend=w.mean[:1])) < step / (2 * w.size)
    for axis in range(3):
        found = runs(repeats[:, axis], w.joined & same[:, axis])
        live = w.variance[~repeats[:, axis], axis]
        again = sum(map(len, found)) - max(map(len, found), default=0)
        if again < len(live) and np.quantile(live, 0.01) > step[axis] ** 2:
            for run in found:
                frozen[run, axis] = len(run) >= FROZEN_WINDOWS
    return frozen


def _still_runs(w: Windows, calm: Bools, live: Bools, rounding: Rounding) -> tuple[list[Ints], NoiseScales, Bools]:
    """Runs of windows that are calm and do not move, the noise they were judged
    by, learned from the ``live``, and which windows are steady by it."""
    noise = NoiseScales.learned(w, calm & live, rounding, first=True)
    for _ in range(2):
        noise = NoiseScales.learned(w, _steady(w, calm, noise) & live, rounding)
    still = _steady(w, calm, noise)
    return [run for run in runs(still, w.joined) if len(run) >= SPAN_LEAST_WINDOWS], noise, still


def _under_way(w: Windows, run: Ints, noise: NoiseScales) -> bool:
    """Whether a run that climbs steadily is the middle of a move: a pose that
    creeps lies between faster moves."""
    x = run - run.mean()
    pace = x @ w.mean[run] / max(float(x @ x), 1.0) / noise.step[1]
    if np.abs(pace).max() < 1:
        return False
    for beside in (run[0] - np.arange(BESIDE), run[-1] + 1 + np.arange(BESIDE)):
        if beside.min() < 1 or beside.max() >= len(w) or not w.joined[beside].all():
            continue
        speed = np.abs(w.mean[beside] - w.mean[beside - 1]).max(axis=0) / noise.step[1]
        if speed.max() < 2 * np.abs(pace).max():
            return True
    return False


def quiet_limit(variance: Floats, dof: int) -> Floats:
    """(3,) the largest scatter that noise alone makes in a window, learned from
    the quietest windows.

    Still windows crowd around one scatter while moving ones spread over decades
    above it: the mode of the logarithm is the noise, and how far the windows
    below it reach tells its effective degrees of freedom, which are fewer than
    the samples where the noise is coloured.
    """
    limit = np.zeros(3)
    tried = np.unique(np.r_[np.geomspace(1, max(dof, 2), 40), dof])
    reaches = -np.log(chi2_ppf(chi2_cdf(tried, tried) / 2, tried) / tried)
    for axis in range(3):
        log = np.sort(np.log(np.maximum(variance[:, axis], 1e-300)))
        mode = _half_sample_mode(log)
        below = log[log < mode]
        reach = float(mode - np.median(below)) if len(below) else 0.0
        effective = tried[int(np.argmin(np.abs(reaches - reach)))]
        limit[axis] = np.exp(mode) * chi2_isf(FALSE_ALARM, effective) / effective
    return limit


def _half_sample_mode(ordered: Floats) -> float:
    """The densest place of sorted values: the densest half, again and again
    (Robertson and Cryer 1974)."""
    while len(ordered) > 8:
        half = (len(ordered) + 1) // 2
        widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
        at = int(np.argmin(widths))
        ordered = ordered[at : at + half]
    return float(np.mean(ordered))


def _limit_within(variance: Floats, most: int) -> Floats:
    """(3,) the same limit from windows of which all but a few are known to be
    still: chi-square with the degrees of freedom, ``most`` at most, that the
    spread between the quartiles of the logarithm shows.
    """
    log = np.log(np.maximum(variance, 1e-300))
    low, middle, high = np.quantile(log, [0.25, 0.5, 0.75], axis=0)
    tried = np.geomspace(0.5, most, 80)
    spreads = np.log(chi2_ppf(0.75, tried) / chi2_ppf(0.25, tried))
    dof = np.interp(-(high - low), -spreads, tried)
    return np.asarray(np.exp(middle) * chi2_isf(FALSE_ALARM, dof) / chi2_ppf(0.5, dof))


def _inside(w: Windows, pieces: list[Ints]) -> Bools:
    """Windows from the first to the last of each span, those that were excluded
    as well."""
    inside = np.zeros(len(w), dtype=bool)
    for piece in pieces:
        inside[piece] = True
    for here, there in itertools.pairwise(pieces):
        if there[0] - here[-1] <= 4:
            inside[here[-1] : there[0]] = True
    return inside


def _only_moves(w: Windows, calm: Bools) -> bool:
    """Whether the quietest windows are those of a motion, and nothing in the
    stream stands still.

    Steadily moving outputs step 12 times as far from window to window, squared,
    as they scatter inside one. Slow vibration does so too, but it is small
    beside the differences of poses, and leads nowhere.
    """
    at, step = contrasts(w.mean, calm, w.joined, 1, 1)
    if not len(at):
        return False
    share = step**2 / np.maximum((w.variance[at] + w.variance[at - 1]) / 2, 1e-300)
    if not (np.quantile(share, 0.25, axis=0) > MOTION).any():
        return False
    _, far = contrasts(w.mean, calm, w.joined, SCALES[-1], SCALES[-1])
    pace = np.median(np.abs(step), axis=0)
    leads = len(far) > 0 and (np.median(np.abs(far), axis=0) > 3 * pace).any()
    return bool(leads or pace.max() > SLIGHT * np.ptp(w.mean, axis=0).max())


def _steady(w: Windows, calm: Bools, noise: NoiseScales) -> Bools:
    """The calm windows at which no difference of neighbouring averages, short
    or long, is more than noise."""
    steady = calm.copy()
    for scale in SCALES:
        moved = _moved(w, steady, noise, scale)
        half = max(scale // 2, 1)
        for shift in range(-half, half):
            steady[moved + shift] = False
        steady[_bumped(w, steady, noise, scale)] = False
    return steady


def _moved(w: Windows, steady: Bools, noise: NoiseScales, scale: int) -> Ints:
    """Windows before which and from which on averages over ``scale`` windows
    differ by more than noise."""
    at, difference = contrasts(w.mean, steady, w.joined, scale, scale)
    if not len(at):
        return at
    sigma = noise.step[scale]
    if scale == 1:
        return np.asarray(at[(np.abs(difference) > STEP_SIGMA * sigma).any(axis=1)])
    difference -= _common_climb(at, difference / sigma) * sigma
    return np.asarray(at[(np.abs(difference) > MOVE_SIGMA * sigma).any(axis=1)])


def _common_climb(at: Ints, z: Floats) -> Floats:
    """(len, 3) what the quietest quarter of the differences of each run have in
    common: the pace of a steady creep."""
    begins = np.diff(at, prepend=at[0] - 2) > 1
    run, first = np.cumsum(begins) - 1, np.flatnonzero(begins)
    length = np.diff(first, append=len(at))
    # Run by run the quietest first: in that order they are added up.
    ordered = np.lexsort((np.abs(z).max(axis=1), run))
    count = np.maximum(length // 4, 1)
    quiet = ordered[np.arange(len(at)) - first[run] < count[run]]
    climb = np.zeros((len(count), 3))
    np.add.at(climb, run[quiet], z[quiet])
    climb /= count[:, None]
    return np.asarray(np.where(np.abs(climb) > 1, climb, 0.0)[run])


def _bumped(w: Windows, steady: Bools, noise: NoiseScales, scale: int) -> Ints:
    """Windows of short bumps: averages that differ from those before and from
    those after alike."""
    if scale not in noise.edge:
        return np.zeros(0, dtype=np.int64)
    limit = MOVE_SIGMA * noise.edge[scale]
    behind, ahead = unbroken(steady, w.joined, 4 * scale, scale), unbroken(steady, w.joined, scale, 4 * scale)
    at = np.intersect1d(behind, ahead - scale, assume_unique=True)
    out = np.zeros(len(at), dtype=bool)
    for axis in range(3):  # one by one: a recording may last for days
        mean = w.mean[:, axis : axis + 1]
        before, after = contrast(mean, at, 4 * scale, scale), contrast(mean, at + scale, scale, 4 * scale)
        out |= ((np.abs(before) > limit[axis]) & (np.abs(after) > limit[axis]) & (before * after < 0))[:, 0]
    return np.asarray(np.unique(at[out][:, None] + np.arange(scale)), dtype=np.int64)


def _rejoined(
    w: Windows, pieces: list[Ints], noise: NoiseScales, disturbed: Bools, longest_s: float
) -> list[tuple[list[Ints], float]]:
    """Pieces of one pose on either side of a bump, which is shorter than
    ``longest_s``, put together; and how long the disturbance before lasted, as
    `Span` has it."""
    period_s = w.period_ns * 1e-9
    poses: list[tuple[list[Ints], float]] = []
    for piece in pieces:
        here = int(poses[-1][0][-1][-1]) if poses else 0
        silent_s = (w.start_ns[piece[0]] - w.start_ns[here]) * 1e-9 - (piece[0] - here) * period_s
        between = np.flatnonzero(disturbed[here : piece[0]])
        bump_s = float(np.ptp(between) + 1 if len(between) else 0) * period_s + max(silent_s, 0.0)
        if not poses or not _same_pose(w, np.concatenate(poses[-1][0]), piece, noise):
            poses.append(([piece], math.inf))
        elif bump_s < longest_s:
            poses[-1][0].append(piece)
        else:
            poses.append(([piece], bump_s))
    return poses


def _same_pose(w: Windows, before: Ints, after: Ints, noise: NoiseScales) -> bool:
    """Whether the means on either side of a disturbance agree."""
    scale = max(s for s in SCALES if s <= min(len(before), len(after)))
    here, there = before[-scale:], after[:scale]
    apart = np.abs(w.mean[here].mean(axis=0) - w.mean[there].mean(axis=0))
    level = w.variance[np.concatenate([here, there])].mean(axis=0)
    return bool((apart <= MOVE_SIGMA * shaken_noise(noise, level, w.size).step[scale]).all())


def _long_enough(w: Windows, used: Ints, least_s: float) -> bool:
    if len(used) < SPAN_LEAST_WINDOWS:
        return False
    return bool((w.end_ns[used[-1]] - w.start_ns[used[0]]) * 1e-9 >= least_s)
