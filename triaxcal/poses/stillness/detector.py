"""Detection of still spans, with the noise learned from the stream itself.

The detector works on the windows of `triaxcal.poses.stillness.windows`, in three
steps. Calm windows have the scatter of the quietest ones. Among calm windows a move
shows in the difference of neighbouring averages over one or more windows, compared
with the scatter of such differences in this stream, whatever the colour of its noise.
The remaining runs are trimmed where a move begins or settles, and joined where only a
bump separates them. Where a machine shakes the stand,
`triaxcal.poses.stillness.vibration` finds the remaining poses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import chi2_cdf, chi2_isf, chi2_ppf
from triaxcal.errors import TooShort
from triaxcal.poses.arrivals import RATE_LEAST
from triaxcal.poses.stillness.vibration import (
    ALONE_S,
    MOVE_SIGMA,
    disturbances,
    parted,
    runs,
    vibrating_runs,
    vibration_noise,
    worth_keeping,
)
from triaxcal.poses.stillness.windows import (
    GUARD,
    SCALES,
    SPAN_LEAST_WINDOWS,
    NoiseScales,
    Rounding,
    WindowCutter,
    Windows,
    contrast,
    contrasts,
    resolution,
    trimmed,
    unbroken,
    window_size,
)

# In-place rotation: a turn about the vertical between poses of the same mean.

TURN_S = 1.0
"""In-place rotation of a fixture by half a turn takes as long, and so do some knocks
that ring. The longest averages extend noise over 0.8 s; longer is rare."""
IN_PLACE = 0.01
"""In the range of the outputs. With poses over the sphere this is 20 mrad: two
orientations on a table tilted by 10 mrad, or the mean acceleration 8 cm off the axis
of half a turn in 2 s."""
PAUSE = 1 / 2
"""A pause within a rotation is shorter than this share of the poses before and after
it. A lost pose costs its data; a pause that is taken for a pose puts the acceleration
of the turn into it."""


def without_rotations(w: Windows, quiet: list[Ints], vibrating: list[Ints]) -> list[Ints]:
    """Still pieces in order of time, without those between quiet pieces that belong
    to an in-place rotation."""
    # Group the pieces by place; within a place, drop pieces between quiet ones.
    known = {int(piece[0]) for piece in quiet}
    pieces = sorted([*quiet, *vibrating], key=lambda p: int(p[0]))
    kept: list[Ints] = []
    for place in _places(w, pieces):
        at = [k for k, piece in enumerate(place) if int(piece[0]) in known]
        hand = set(range(at[0], at[-1])).difference(at) if at else ()
        kept += _without_pauses([piece for k, piece in enumerate(place) if k not in hand])
    return kept


def _places(w: Windows, pieces: list[Ints]) -> Iterator[list[Ints]]:
    """Groups of consecutive pieces with the same mean."""
    if not pieces:
        return
    # A new place begins where the mean changes by more than IN_PLACE of the range.
    level: Floats = np.array([w.mean[piece].mean(axis=0) for piece in pieces])
    apart = np.abs(np.diff(level, axis=0)).max(axis=1)
    moved = np.flatnonzero(apart > IN_PLACE * np.ptp(level, axis=0).max()) + 1
    for begin, end in itertools.pairwise([0, *moved.tolist(), len(pieces)]):
        yield pieces[begin:end]


def _without_pauses(place: list[Ints]) -> list[Ints]:
    """The pieces of a place without those that have much longer pieces before and
    after."""
    length = np.array([len(piece) for piece in place])
    before = np.maximum.accumulate(length)
    after = np.maximum.accumulate(length[::-1])[::-1]
    stays = length >= PAUSE * np.minimum(before, after)
    return [piece for piece, kept in zip(place, stays, strict=True) if kept]


__all__ = ["Span", "StillnessDetector", "Windows", "find_spans"]

SPAN_LEAST_S = 0.4
"""Four windows: a shorter span has hardly a middle between its
ends."""
REJOIN_S = 1.5
"""A shorter disturbance with the same mean before and after is a bump inside one
pose."""
FALSE_ALARM = 1e-6
"""Probability that the noise of an axis makes a still window look moving: once in 28
hours."""
STEP_SIGMA = 7.0
"""Limit for a single step, where the noise need not be Gaussian."""
BESIDE = 6
"""Windows next to a run that show whether it is part of a move."""
MOTION = 2.0
"""For a random walk, the strongest colour of noise, a quarter of the squared steps is
below 0.4 of the scatter."""
SLIGHT = 0.01
"""Slow vibration changes the outputs from window to window by a smaller share of
their range."""
FROZEN_WINDOWS = 3
"""Number of windows with one reading after which an output is frozen, if its noise is
wider than its steps."""


@dataclass(frozen=True)
class Span:
    """A still span as indices of windows. ``used`` (k,) are its undisturbed windows.

    ``since_s`` is the duration of the disturbance before it, where this left the mean
    unchanged; else infinite. ``vibrating`` (j,) are the windows of its disturbances,
    none of them in ``used``. ``parted``: a move hidden by vibration lies between this
    span and the previous one.
    """

    used: Ints
    since_s: float = math.inf
    vibrating: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
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
        if not len(self._done):
            period_ns = self._period_ns or (self.span_ns / (self.samples - 1) if self.samples > 1 else math.inf)
            if self._period_ns and self.samples >= least_samples(period_ns):
                raise _too_short(self._longest, (self._longest - 1) * period_ns, period_ns, in_pieces=True)
            raise _too_short(self.samples, self.span_ns, period_ns, in_pieces=False)
        return super().windows()

    def too_short(self) -> TooShort | None:
        """The reason why no pose can be found in so short a stream; None where one
        can."""
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
    """Samples of the shortest stream with a detectable pose (windows and guards), at
    a sample period that may be infinite."""
    size = window_size(period_ns)
    windows = max(SPAN_LEAST_WINDOWS, math.ceil((SPAN_LEAST_S * 1e9 / period_ns + 1) / size))
    return max(RATE_LEAST, (windows + 2 * GUARD) * size)


def _too_short(samples: int, span_ns: float, period_ns: float, *, in_pieces: bool) -> TooShort:
    least = least_samples(period_ns)
    least_s = (least - 1) * period_ns * 1e-9 if math.isfinite(period_ns) else 0.0
    return TooShort(samples, span_ns * 1e-9, least, least_s, in_pieces=in_pieces)


def find_spans(w: Windows, turn_s: float | None = None) -> list[Span]:
    """The still spans of a stream of windows, at least 0.4 s long.

    A unit that turns about the vertical on a level table comes to rest with the same
    mean: no reading distinguishes the rotation from a bump. Where such rotations
    occur, ``turn_s`` is their shortest duration: a disturbance of that length
    separates spans, whatever the means, and a pause within it is no span
    (`without_rotations`).
    """
    # Constant windows of a digital output have the variance of half a step.
    raw, step = w.variance, resolution(w)
    frozen = _frozen(w, step)
    live, stuck = np.asarray(~frozen.any(axis=1)), np.asarray(frozen.all(axis=1))
    w = replace(w, variance=np.maximum(raw, step**2 / 4))
    # Calm windows, by a limit from the quietest ones.
    calm = np.asarray((w.variance <= quiet_limit(w.variance[live], w.size - 1)).all(axis=1)) & ~stuck
    if _only_moves(w, calm):
        return []
    # First still runs; then twice the limits from the windows inside them.
    found, noise, steady = _still_runs(w, calm, live, _rounding(step, raw[calm & live]))
    for _ in range(2):
        inside = _inside(w, found) & live
        if inside.sum() < 2 * SPAN_LEAST_WINDOWS:
            break
        calm = np.asarray((w.variance <= _limit_within(w.variance[inside], w.size - 1)).all(axis=1)) & ~stuck
        found, noise, steady = _still_runs(w, calm, live, _rounding(step, raw[inside & calm]))
    # Quiet pieces, then vibrating pieces in the rest of the stream.
    taken, pieces = _quiet_pieces(w, found, noise)
    vibrating = vibrating_runs(w, [*taken, *runs(stuck, w.joined)], noise)
    disturbed = ~steady
    # Separate in-place rotations, or keep all pieces.
    if turn_s is None:
        kept, longest = sorted([*pieces, *vibrating], key=lambda p: int(p[0])), REJOIN_S
    else:
        kept, longest = without_rotations(w, pieces, vibrating), turn_s
    quiet = np.zeros(len(w), dtype=bool)
    quiet[np.concatenate([*pieces, np.zeros(0, dtype=np.int64)])] = True
    # Join pieces of one pose, then split poses that hide a move.
    poses = _rejoined(w, kept, noise, disturbed, longest)
    return [span for pose, since_s in poses for span in _spans_of(w, pose, quiet, noise, since_s)]


def _spans_of(w: Windows, pose: list[Ints], quiet: Bools, noise: NoiseScales, since_s: float) -> list[Span]:
    """The sufficiently long spans of one pose: several where vibration hid a move."""
    spans: list[Span] = []
    for part in parted(w, pose, [bool(quiet[p[0]]) for p in pose], noise):
        used, vibrating = _without_vibration(w, part, quiet, noise)
        if _long_enough(w, used, SPAN_LEAST_S if quiet[used].any() else ALONE_S):
            disturbed = disturbances(w, used, vibrating)
            spans.append(Span(used, math.inf if spans else since_s, disturbed, parted=bool(spans)))
    return spans


def _without_vibration(w: Windows, part: list[Ints], quiet: Bools, noise: NoiseScales) -> tuple[Ints, Ints]:
    """The windows that enter the mean of a pose, and the vibrating ones that would
    make it worse."""
    still = [p for p in part if quiet[p[0]]]
    if not still or not _long_enough(w, np.concatenate(still), SPAN_LEAST_S):
        return np.concatenate(part), np.zeros(0, dtype=np.int64)
    known = np.concatenate(still)
    kept = [bool(quiet[p[0]]) or worth_keeping(w, p, known, noise) for p in part]
    vibrating = [p for p, k in zip(part, kept, strict=True) if not k]
    used = [p for p, k in zip(part, kept, strict=True) if k]
    return np.concatenate(used), np.concatenate([np.zeros(0, dtype=np.int64), *vibrating])


def _rounding(step: Floats, quiet: Floats) -> Rounding:
    """Rounding by the ``step``, from the mean variance of quiet windows (k,3): their
    median is unreliable where windows hold one or two readings."""
    return Rounding.of(step, quiet.mean(axis=0) if len(quiet) else np.zeros(3))


def _quiet_pieces(w: Windows, found: list[Ints], noise: NoiseScales) -> tuple[list[Ints], list[Ints]]:
    """Runs that are decided, and the still pieces among them."""
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
    """(m,3) windows in which an axis is frozen. They show no noise and teach none,
    and a window with all axes frozen is no part of a pose: the motion of the unit is
    unknown there.

    An output with a ``step`` as wide as its noise repeats readings too, but often, or
    with changes of a step or two.
    """
    frozen = np.zeros((len(w), 3), dtype=bool)
    for axis in range(3):
        # A single reading that differs by a step would exceed either limit.
        repeats = w.variance[:, axis] < step[axis] ** 2 / (2 * w.size)
        same = np.abs(np.diff(w.mean[:, axis], prepend=w.mean[0, axis])) < step[axis] / (2 * w.size)
        # Runs of equal windows; other repeats must be rarer than live windows.
        found = runs(repeats, w.joined & same)
        live = w.variance[~repeats, axis]
        again = sum(map(len, found)) - max(map(len, found), default=0)
        if again < len(live) and np.quantile(live, 0.01) > step[axis] ** 2:
            for run in found:
                frozen[run, axis] = len(run) >= FROZEN_WINDOWS
    return frozen


def _still_runs(w: Windows, calm: Bools, live: Bools, rounding: Rounding) -> tuple[list[Ints], NoiseScales, Bools]:
    """Runs of calm windows without moves, the noise of their detection (learned from
    the ``live`` ones), and the steady windows."""
    # Iterate: noise of the steady windows, then steadiness under that noise.
    noise = NoiseScales.learned(w, calm & live, rounding, first=True)
    for _ in range(2):
        noise = NoiseScales.learned(w, _steady(w, calm, noise) & live, rounding)
    still = _steady(w, calm, noise)
    return [run for run in runs(still, w.joined) if len(run) >= SPAN_LEAST_WINDOWS], noise, still


def _under_way(w: Windows, run: Ints, noise: NoiseScales) -> bool:
    """Whether a steadily climbing run is the middle of a move. A creeping pose lies
    between faster moves."""
    # Least-squares slope, in standard deviations of a step between windows.
    x = run - run.mean()
    pace = x @ w.mean[run] / max(float(x @ x), 1.0) / noise.step[1]
    if np.abs(pace).max() < 1:
        return False
    # Speed on either side of the run.
    for beside in (run[0] - np.arange(BESIDE), run[-1] + 1 + np.arange(BESIDE)):
        if beside.min() < 1 or beside.max() >= len(w) or not w.joined[beside].all():
            continue
        speed = np.abs(w.mean[beside] - w.mean[beside - 1]).max(axis=0) / noise.step[1]
        if speed.max() < 2 * np.abs(pace).max():
            return True
    return False


def quiet_limit(variance: Floats, dof: int) -> Floats:
    """(3,) largest scatter of a window by noise alone, learned from the quietest
    windows.

    The logarithms of the variances of still windows cluster, while moving ones spread
    over decades above. The mode is the noise; the spread of the windows below it
    gives the effective degrees of freedom, fewer than the samples for coloured noise.
    """
    limit = np.zeros(3)
    # Distance from mode to lower median, for each number of degrees of freedom.
    tried = np.unique(np.r_[np.geomspace(1, max(dof, 2), 40), dof])
    reaches = -np.log(chi2_ppf(chi2_cdf(tried, tried) / 2, tried) / tried)
    for axis in range(3):
        # Mode, distance below it, and the matching degrees of freedom.
        log = np.sort(np.log(np.maximum(variance[:, axis], 1e-300)))
        mode = _half_sample_mode(log)
        below = log[log < mode]
        reach = float(mode - np.median(below)) if len(below) else 0.0
        effective = tried[int(np.argmin(np.abs(reaches - reach)))]
        # Upper chi-square quantile at the false-alarm rate.
        limit[axis] = np.exp(mode) * chi2_isf(FALSE_ALARM, effective) / effective
    return limit


def _half_sample_mode(ordered: Floats) -> float:
    """Mode of sorted values by the half-sample method: the densest half, repeatedly
    (Robertson and Cryer 1974)."""
    while len(ordered) > 8:
        half = (len(ordered) + 1) // 2
        widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
        at = int(np.argmin(widths))
        ordered = ordered[at : at + half]
    return float(np.mean(ordered))


def _limit_within(variance: Floats, most: int) -> Floats:
    """(3,) the same limit from windows nearly all of which are still: chi-square with
    the degrees of freedom (``most`` at most) that match the interquartile range of
    the logarithm."""
    logs = (np.log(np.maximum(variance[:, axis], 1e-300)) for axis in range(3))
    low, middle, high = np.array([np.quantile(log, [0.25, 0.5, 0.75]) for log in logs]).T
    tried = np.geomspace(0.5, most, 80)
    spreads = np.log(chi2_ppf(0.75, tried) / chi2_ppf(0.25, tried))
    dof = np.interp(-(high - low), -spreads, tried)
    return np.asarray(np.exp(middle) * chi2_isf(FALSE_ALARM, dof) / chi2_ppf(0.5, dof))


def _inside(w: Windows, pieces: list[Ints]) -> Bools:
    """Windows from the first to the last of each span, with the excluded ones."""
    inside = np.zeros(len(w), dtype=bool)
    for piece in pieces:
        inside[piece] = True
    for here, there in itertools.pairwise(pieces):
        if there[0] - here[-1] <= 4:
            inside[here[-1] : there[0]] = True
    return inside


def _only_moves(w: Windows, calm: Bools) -> bool:
    """Whether the quietest windows belong to a motion and nothing in the stream is
    static.

    For outputs that move steadily, the squared step from window to window is 12 times
    the variance inside one. Slow vibration shows the same, but is small compared with
    the differences of poses and returns.
    """
    # Axis by axis, since a recording may last for days: squared steps over the
    # variance inside the windows, and their size.
    at = unbroken(calm, w.joined, 1, 1)
    if not len(at):
        return False
    moves, pace = False, np.zeros(3)
    for axis in range(3):
        step, inside = contrast(w.mean[:, axis : axis + 1], at, 1, 1)[:, 0], w.variance[:, axis]
        share = step**2 / np.maximum((inside[at] + inside[at - 1]) / 2, 1e-300)
        moves |= bool(np.quantile(share, 0.25) > MOTION)
        pace[axis] = np.median(np.abs(step))
    if not moves:
        return False
    # Motion goes on in one direction, or is large against the range.
    _, far = contrasts(w.mean, calm, w.joined, SCALES[-1], SCALES[-1])
    leads = len(far) > 0 and (np.median(np.abs(far), axis=0) > 3 * pace).any()
    return bool(leads or pace.max() > SLIGHT * np.ptp(w.mean, axis=0).max())


def _steady(w: Windows, calm: Bools, noise: NoiseScales) -> Bools:
    """The calm windows without significant differences of neighbouring averages at
    any scale."""
    steady = calm.copy()
    for scale in SCALES:
        moved = _moved(w, steady, noise, scale)
        half = max(scale // 2, 1)
        for shift in range(-half, half):
            steady[moved + shift] = False
        steady[_bumped(w, steady, noise, scale)] = False
    return steady


def _moved(w: Windows, steady: Bools, noise: NoiseScales, scale: int) -> Ints:
    """Windows that begin a significant change between averages over ``scale``
    windows."""
    at, sigma = unbroken(steady, w.joined, scale, scale), noise.step[scale]
    if not len(at):
        return at
    # Axis by axis: a recording may last for days.
    out = np.zeros(len(at), dtype=bool)
    if scale == 1:
        for axis in range(3):
            difference = contrast(w.mean[:, axis : axis + 1], at, 1, 1)[:, 0]
            out |= np.abs(difference) > STEP_SIGMA * sigma[axis]
        return np.asarray(at[out])
    # Subtract the common climb of the run: steady creep is no move.
    size = np.zeros(len(at))
    for axis in range(3):
        np.maximum(size, np.abs(contrast(w.mean[:, axis : axis + 1], at, scale, scale)[:, 0] / sigma[axis]), out=size)
    quiet = _Quietest.of(at, size)
    for axis in range(3):  # once more, which takes less than to keep three
        differences = contrast(w.mean[:, axis : axis + 1], at, scale, scale)[:, 0]
        climb = quiet.common_climb(differences / sigma[axis])
        out |= np.abs(differences - climb * sigma[axis]) > MOVE_SIGMA * sigma[axis]
    return np.asarray(at[out])


@dataclass(frozen=True)
class _Quietest:
    """The smallest quarter of the differences in each run: the ``places`` (q,) of
    these, run by run, ``count`` (r,) of each run, and the ``run`` (len,) of all."""

    places: Ints
    count: Ints
    run: Ints

    @classmethod
    def of(cls, at: Ints, size: Floats) -> _Quietest:
        begins = np.diff(at, prepend=at[0] - 2) > 1
        run, first = np.cumsum(begins) - 1, np.flatnonzero(begins)
        length = np.diff(first, append=len(at))
        # Run by run the quietest first: in that order they are added up.
        ordered = np.lexsort((size, run))
        count = np.maximum(length // 4, 1)
        return cls(ordered[np.arange(len(at)) - first[run] < count[run]], count, run)

    def common_climb(self, z: Floats) -> Floats:
        """(len,) mean of these differences in each run, from ``z`` (len,): the rate of
        a steady creep."""
        climb = np.zeros(len(self.count))
        np.add.at(climb, self.run[self.places], z[self.places])
        climb /= self.count
        return np.asarray(np.where(np.abs(climb) > 1, climb, 0.0)[self.run])


def _bumped(w: Windows, steady: Bools, noise: NoiseScales, scale: int) -> Ints:
    """Windows of short bumps: averages that differ in the same direction from those
    before and after."""
    if scale not in noise.edge:
        return np.zeros(0, dtype=np.int64)
    limit = MOVE_SIGMA * noise.edge[scale]
    behind, ahead = unbroken(steady, w.joined, 4 * scale, scale), unbroken(steady, w.joined, scale, 4 * scale)
    # Places with four times as many still windows on either side.
    among = np.zeros(len(w), dtype=bool)
    among[behind] = True
    at = ahead[among[ahead - scale]] - scale
    out = np.zeros(len(at), dtype=bool)
    for axis in range(3):  # one by one: a recording may last for days
        mean = w.mean[:, axis : axis + 1]
        before, after = contrast(mean, at, 4 * scale, scale), contrast(mean, at + scale, scale, 4 * scale)
        out |= ((np.abs(before) > limit[axis]) & (np.abs(after) > limit[axis]) & (before * after < 0))[:, 0]
    return np.asarray(np.unique(at[out][:, None] + np.arange(scale)), dtype=np.int64)


def _rejoined(
    w: Windows, pieces: list[Ints], noise: NoiseScales, disturbed: Bools, longest_s: float
) -> list[tuple[list[Ints], float]]:
    """Pieces of one pose joined over bumps shorter than ``longest_s``, and the
    duration of the disturbance before each pose, as in `Span`."""
    period_s = w.period_ns * 1e-9
    poses: list[tuple[list[Ints], float]] = []
    for piece in pieces:
        # Duration of the disturbance: disturbed windows and silence between the pieces.
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
    """Whether the means on either side of a disturbance agree within noise."""
    scale = max(s for s in SCALES if s <= min(len(before), len(after)))
    here, there = before[-scale:], after[:scale]
    apart = np.abs(w.mean[here].mean(axis=0) - w.mean[there].mean(axis=0))
    level = w.variance[np.concatenate([here, there])].mean(axis=0)
    return bool((apart <= MOVE_SIGMA * vibration_noise(noise, level, w.size).step[scale]).all())


def _long_enough(w: Windows, used: Ints, least_s: float) -> bool:
    if len(used) < SPAN_LEAST_WINDOWS:
        return False
    return bool((w.end_ns[used[-1]] - w.start_ns[used[0]]) * 1e-9 >= least_s)
