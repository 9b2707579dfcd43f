"""The figures of many calibrations, in standard deviations between units: what a place
shifts, or scatters more.

Figures that units have in common, as scale factors of one wafer, are correlated. So the
nine coefficients are whitened together; a figure with a standard error counts by it.
Spreads come from differences of runs that follow each other in the same places:
a shift of a place, or a slow drift, does not widen them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import chi2_ppf
from triaxcal.model.directions import spiral
from triaxcal.population.runs import COEFFICIENTS, SeenPoses, UnitRun

LEAST_RUNS = 60
"""Runs that have a figure: a spread of fewer is not known to a fifth."""
LEAST_PAIRS = 30
"""Pairs of runs that show the spread between units."""
OCTAVES = 12
"""Bits of a converter that are looked at, from the one of the whole range down."""
FINEST = 4.0
"""Steps of a converter in the shortest period: the mean of a pose averages shorter
ones."""
ONE_KIND = 1e-3
"""Relative difference of steps of one kind of converter, which rounding of outputs
leaves."""
REWEIGHTED = 50
"""Rounds of reweighted least squares: the sum of distances has settled long before."""
SMALLEST_RAD = 1e-5
"""Distances below count alike: no fixture is as good."""
TAILS = 6.0
"""Degrees of freedom of Student's t for the spread between units, which has heavier
tails than a normal one."""
ROUNDS = 12
"""Of the fit of a covariance: each halves the error at least."""
CLIP = 4.0
"""Spreads beyond which a difference does not decide in which directions figures
vary."""
RANK = 1e-6
"""Share of the largest variance below which figures do not vary, but for rounding."""
CHI2_MEDIAN = 0.4549
"""Median of chi-square with one degree of freedom: the square of a normal quartile."""
SMALLEST_SPREAD = 1e-9
"""Of a figure over its size: less is rounding."""
DEGREES, HARMONICS = (3, 4), 7 + 9
"""Degrees of the harmonics of the direction that the nine parameters leave: the
lowest. And their number."""
SPHERE = 400
"""Directions over which they are made: more than ten a harmonic."""


class FigureKind(StrEnum):
    """What a group of figures is of."""

    COEFFICIENTS = "coefficients"
    """The nine of the linear model; scale factors relative."""
    DIRECTIONS = "directions"
    """The rotation of the measured directions against the planned ones."""
    CONVERTER = "converter"
    """Residuals of |a| that go with the reading in periods of a power of two."""
    POSES = "poses"
    """Residuals of |a| as a function of the direction."""
    EFFECT = "effect"
    """The coefficients of an effect, in runs where it acts."""
    OTHER = "other"


@dataclass(frozen=True, eq=False)
class Group:
    """Figures (N,d) of N runs with their standard errors (N,d), NaN where a run has
    none. ``whitened``: they are whitened together. ``alone``: each may shift by
    itself."""

    kind: FigureKind
    name: str
    figures: tuple[str, ...]
    units: tuple[str, ...]
    values: Floats
    errors: Floats
    whitened: bool = False
    alone: bool = True


def groups_of(runs: Sequence[UnitRun]) -> list[Group]:
    """All figures of the runs that at least `LEAST_RUNS` of them have."""
    found = [_coefficients(runs), *_directions(runs), *_residuals(runs), *_effects(runs), *_others(runs)]
    return [g for g in found if np.isfinite(g.values).sum(axis=0).max(initial=0) >= LEAST_RUNS]


def _coefficients(runs: Sequence[UnitRun]) -> Group:
    values = np.array([run.coefficients for run in runs], dtype=float).reshape(-1, len(COEFFICIENTS))
    errors = np.array([run.standard_errors for run in runs], dtype=float).reshape(values.shape)
    # A common factor is one shift of the logarithms.
    scale = np.abs(values[:, :3])
    known = np.where(scale > 0, scale, np.nan)
    values = np.concatenate([np.log(known), values[:, 3:]], axis=1)
    errors = np.concatenate([errors[:, :3] / known, errors[:, 3:]], axis=1)
    units = ("",) * 3 + ("rad",) * 3 + ("g",) * 3
    return Group(FigureKind.COEFFICIENTS, "coefficients", COEFFICIENTS, units, values, errors, whitened=True)


def _directions(runs: Sequence[UnitRun]) -> Iterator[Group]:
    """Rotation vectors r that make m = p + r × p of planned directions p the measured
    ones m: least squares, with the error from the rest."""
    values, errors = np.full((2, len(runs), 3), np.nan)
    for i, run in enumerate(runs):
        if run.poses is not None and run.poses.measured is not None and run.poses.planned is not None:
            p, m = run.poses.planned, run.poses.measured
            normal = len(p) * np.eye(3) - p.T @ p
            if len(p) < 3 or np.linalg.cond(normal) > 1e6:
                continue
            inverse = np.linalg.inv(normal)
            values[i] = inverse @ np.cross(p, m).sum(axis=0)
            rest = m - p - np.cross(values[i], p)
            errors[i] = np.sqrt(np.diag(inverse) * np.sum(rest**2) / max(2 * len(p) - 3, 1))
    values = _of_places(values, runs)
    if np.isfinite(values).any():
        names = ("rotation.x", "rotation.y", "rotation.z")
        yield Group(FigureKind.DIRECTIONS, "directions", names, ("rad",) * 3, values, errors)


def _of_places(rotations: Floats, runs: Sequence[UnitRun]) -> Floats:
    """Rotations (N,3) along the axes of the fixture without the tilt that units of the
    type share in their housings, which turns with the mounting. NaN where the mounting
    is not known while units stand differently."""
    aligned = np.eye(3)
    mountings = [None if run.poses is None else run.poses.mounting for run in runs]
    if all(m is None or np.array_equal(m, aligned) for m in mountings):
        return rotations
    known = np.array([m is not None for m in mountings]) & np.isfinite(rotations).all(axis=1)
    turns = np.array([aligned if m is None else m for m in mountings], dtype=float)
    found = np.where(known[:, None], rotations, np.nan)
    if not known.any():
        return found
    # r = f + M t with the least sum of |r - f - M t|: a bent place of a minority counts
    # little. Where all stand alike, f and t are one, and what t has is constant.
    both = np.concatenate([np.broadcast_to(aligned, turns.shape), turns], axis=2)[known]
    target = rotations[known]
    weight = np.ones(len(target))
    solution = np.zeros(6)
    for _ in range(REWEIGHTED):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq((both * root[:, :, None]).reshape(-1, 6), (target * root).ravel(), rcond=None)[0]
        left = np.linalg.norm(target - both @ solution, axis=1)
        weight = 1 / np.maximum(left, SMALLEST_RAD)
    return np.asarray(found - turns @ solution[3:])


def _residuals(runs: Sequence[UnitRun]) -> Iterator[Group]:
    """What residuals have in common as a function of the reading, and of the
    direction."""
    posed = [i for i, run in enumerate(runs) if run.poses is not None and len(run.poses.residual) > len(COEFFICIENTS)]
    if not posed:
        return
    periods = _periods([runs[i] for i in posed])
    waves, wave_errors = np.full((2, len(runs), 6 * len(periods)), np.nan)
    harmonics, harmonic_errors = np.full((2, len(runs), HARMONICS), np.nan)
    for i in posed:
        run, poses = runs[i], runs[i].poses
        assert poses is not None
        direction = _direction(run, poses)
        linear = np.linalg.qr(_quadratic(direction) / poses.standard_error[:, None])[0]
        left = _beyond(poses.residual / poses.standard_error, linear)
        columns = _waves(poses, direction, periods) / poses.standard_error[:, None]
        waves[i], wave_errors[i] = _each(columns, left, linear)
        columns = _harmonics(direction) / poses.standard_error[:, None]
        harmonics[i], harmonic_errors[i] = _each(columns, left, linear)
    if periods:
        names = tuple(
            f"{axis} period {period:.6g} {phase}"
            for axis in "xyz" for period in periods for phase in ("sine", "cosine")
        )  # fmt: skip
        yield Group(FigureKind.CONVERTER, "converter", names, ("g",) * len(names), waves, wave_errors, alone=False)
    names = tuple(f"harmonic {k}" for k in range(HARMONICS))
    yield Group(
        FigureKind.POSES, "residuals by direction", names, ("g",) * HARMONICS, harmonics, harmonic_errors,
        whitened=True, alone=False,
    )  # fmt: skip


def _direction(run: UnitRun, poses: SeenPoses) -> Floats:
    """(n,3) unit vectors of the readings under the run's own coefficients."""
    k, (ax, ay, az), b = np.split(np.asarray(run.coefficients, dtype=float), 3)
    skew = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])
    a = np.linalg.solve(skew, (poses.readings / k - b).T).T
    return np.asarray(a / np.linalg.norm(a, axis=1, keepdims=True))


def _quadratic(a: Floats) -> Floats:
    """(n,9) what the nine parameters do to |a|: all of degrees one and two."""
    x, y, z = a.T
    return np.stack([x, y, z, x * x, y * y, z * z, x * y, y * z, x * z], axis=1)


@cache
def _harmonic_combinations() -> Floats:
    """(25,16) combinations of the monomials that are functions of degrees three and
    four alone, of rms one over the sphere."""
    a = spiral(SPHERE)
    left = _beyond(_monomials(a), np.linalg.qr(_quadratic(a))[0])
    combinations = np.linalg.svd(left, full_matrices=False)[2][:HARMONICS].T
    return np.asarray(combinations / np.sqrt(np.mean((left @ combinations) ** 2, axis=0)))


def _monomials(a: Floats) -> Floats:
    x, y, z = a.T
    return np.stack(
        [x**i * y**j * z ** (d - i - j) for d in DEGREES for i in range(d + 1) for j in range(d + 1 - i)], axis=1
    )


def _harmonics(a: Floats) -> Floats:
    """(n,16) functions of the direction of degrees three and four."""
    return np.asarray(_monomials(a) @ _harmonic_combinations())


def _periods(runs: Sequence[UnitRun]) -> tuple[float, ...]:
    """Periods of the bits of the commonest converter, the longest first."""
    known = np.sort([run.resolution for run in runs if run.resolution is not None and run.resolution > 0])
    if not len(known):
        return ()
    kinds = np.split(known, np.flatnonzero(known[1:] > known[:-1] * (1 + ONE_KIND)) + 1)
    step = float(np.median(max(kinds, key=len)))
    span = float(np.median([np.ptp(run.poses.readings) for run in runs if run.poses is not None]))
    largest = int(np.ceil(np.log2(max(span / step, 1.0))))
    exponents = range(largest, max(largest - OCTAVES, 0), -1)
    return tuple(float(step * 2.0**e) for e in exponents if 2.0**e >= FINEST)


def _waves(poses: SeenPoses, direction: Floats, periods: tuple[float, ...]) -> Floats:
    """(n,6P) change of |a| by a wave of the reading of each axis, a sine and a cosine
    of each period: a square wave of a bit is its fundamental to a tenth."""
    phase = 2 * np.pi * poses.readings[:, :, None] / np.array(periods)
    both = np.stack([np.sin(phase), np.cos(phase)], axis=3) * direction[:, :, None, None]
    return both.reshape(len(direction), -1)


def _beyond(columns: Floats, linear: Floats) -> Floats:
    return np.asarray(columns - linear @ (linear.T @ columns))


def _each(columns: Floats, left: Floats, linear: Floats) -> tuple[Floats, Floats]:
    """The coefficient of each column by itself, and its standard error; NaN where the
    nine parameters leave too little of it."""
    own = _beyond(columns, linear)
    information = np.sum(own**2, axis=0)
    shown = information > 1e-3 * np.sum(columns**2, axis=0)
    information = np.where(shown, information, np.nan)
    return (own.T @ left) / information, 1 / np.sqrt(information)


LIKELY = 0.5
"""Probability from which the coefficients of an effect are its own."""


def _effects(runs: Sequence[UnitRun]) -> Iterator[Group]:
    units: dict[str, dict[str, dict[int, tuple[float, float]]]] = defaultdict(lambda: defaultdict(dict))
    for i, run in enumerate(runs):
        for name, seen in run.effects.items():
            if seen.probability is None or seen.probability >= LIKELY:
                for coefficient, value in seen.coefficients.items():
                    units[name][coefficient][i] = value
    for name, of_effect in sorted(units.items()):
        values, errors = _spread_out(of_effect, len(runs))
        yield Group(FigureKind.EFFECT, name, tuple(of_effect), ("",) * len(of_effect), values, errors)


def _others(runs: Sequence[UnitRun]) -> Iterator[Group]:
    found: dict[str, dict[int, tuple[float, float]]] = defaultdict(dict)
    for i, run in enumerate(runs):
        for name, value in run.figures.items():
            found[name][i] = value
    for name, of_figure in sorted(found.items()):
        values, errors = _spread_out({name: of_figure}, len(runs))
        yield Group(FigureKind.OTHER, name, (name,), ("",), values, errors)


def _spread_out(found: dict[str, dict[int, tuple[float, float]]], n: int) -> tuple[Floats, Floats]:
    values, errors = np.full((2, n, len(found)), np.nan)
    for k, of_figure in enumerate(found.values()):
        for i, (value, error) in of_figure.items():
            values[i, k], errors[i, k] = value, error
    return values, errors


# In standard deviations between units.


@dataclass(frozen=True, eq=False)
class Standardised:
    """A group's components (N,d) z, of variance one between units, with their weights
    (N,d), 0 where a run has none.

    ``spread`` (T,f) are those of the f figures by part number. ``mix`` (d,f): column k
    is what one spread of figure k adds to the components; ``back`` (f,d) makes figures
    in spreads of them. ``repeatability`` (d,) is the share of the variance that differs
    from run to run of one unit."""

    group: Group
    z: Floats
    weight: Floats
    spread: Floats
    mix: Floats
    back: Floats
    repeatability: Floats


def standardised(group: Group, part: Ints, followers: Ints, same_unit: Ints, fitted: Floats | None) -> Standardised:
    """``part`` (N,) is the number of the part number of each run; ``followers`` (q,2)
    and ``same_unit`` (r,2) are pairs of runs: of different units one after the other in
    the same places, and of one unit. ``fitted`` (N,f) are figures that known effects
    make, in the group's units: spreads then come from what they leave."""
    parts, d = int(part.max()) + 1, group.values.shape[1]
    left = group.values if fitted is None else group.values - fitted
    centre, spread = np.zeros((parts, d)), np.ones((parts, d))
    for t in range(parts):
        mine = part == t
        centre[t] = _median(left[mine])
        pairs = followers[mine[followers[:, 0]]]
        spread[t] = _spread(left, pairs, mine, fitted is None)
    scaled, rest = ((values - centre[part]) / spread[part] for values in (group.values, left))
    error = group.errors / spread[part]
    if group.whitened:
        whole = np.asarray(np.isfinite(scaled).all(axis=1))
        mix, back = _whitening(rest, followers, whole, fitted is None)
        z = np.where(whole[:, None], scaled, 0.0) @ mix.T
        excess = np.nansum(error**2, axis=1) - np.nanmedian(np.nansum(error**2, axis=1)[whole])
        weight = np.where(whole, 1 / (1 + np.maximum(excess, 0.0) / d), 0.0)[:, None] * np.ones(len(mix))
        noise = np.clip(np.diag(mix @ np.diag(_median(error[whole] ** 2)) @ mix.T), 0.0, 1.0)
    else:
        known = np.isfinite(scaled)
        z, mix, back = np.where(known, scaled, 0.0), np.eye(d), np.eye(d)
        own = np.where(np.isfinite(error), error, 0.0) ** 2
        noise = np.clip(np.nan_to_num(_median(np.where(known, error, np.nan) ** 2)), 0.0, 0.95)
        weight = np.where(known, 1 / (1 - noise + own), 0.0)
    return Standardised(group, z, weight, spread, mix, back, _repeatability(z, weight, same_unit, noise))


def _median(values: Floats) -> Floats:
    """(d,) medians without NaN; 0 where there is nothing."""
    found = np.zeros(values.shape[1])
    some = np.isfinite(values).any(axis=0)
    found[some] = np.nanmedian(values[:, some], axis=0)
    return found


def _spread(values: Floats, pairs: Ints, mine: Bools, by_pairs: bool) -> Floats:
    """(d,) standard deviations between units: 1.4826 times the median absolute
    difference."""
    differences = (values[pairs[:, 0]] - values[pairs[:, 1]]) / np.sqrt(2)
    own = values[mine]
    some = np.isfinite(differences).sum(axis=0) >= LEAST_PAIRS
    from_pairs = 1.4826 * _median(np.abs(differences))
    found = np.where(some & by_pairs, from_pairs, 1.4826 * _median(np.abs(own - _median(own))))
    size = _median(np.abs(own))
    return np.where(found > SMALLEST_SPREAD * size, found, np.where(size > 0, size, 1.0))


def _whitening(scaled: Floats, pairs: Ints, whole: Bools, by_pairs: bool) -> tuple[Floats, Floats]:
    """The matrix (c,d) that makes scaled figures components of variance one, and the
    one (d,c) that leads back. The covariance is the maximum of likelihood of Student's
    t (Lange, Little and Taylor 1989, J. Am. Stat. Assoc. 84:881), in the directions in
    which the figures vary at all."""
    used = pairs[whole[pairs].all(axis=1)]
    differences = (scaled[used[:, 0]] - scaled[used[:, 1]]) / np.sqrt(2)
    if not by_pairs or len(used) < 5 * scaled.shape[1]:
        differences = scaled[whole] - _median(scaled[whole])
    clipped = np.clip(differences, -CLIP, CLIP)
    size, axes = np.linalg.eigh(clipped.T @ clipped / len(clipped))
    axes = axes[:, size > RANK * size[-1]]
    if not axes.shape[1]:
        return axes.T, axes
    differences, d = differences @ axes, axes.shape[1]
    covariance = np.diag(_median(differences**2) / CHI2_MEDIAN)
    for _ in range(ROUNDS):
        distance = np.sum(differences @ np.linalg.inv(covariance) * differences, axis=1)
        weight = (TAILS + d) / (TAILS + distance)
        covariance = (weight[:, None] * differences).T @ differences / weight.sum()
    # At the median distance it is that of a normal distribution.
    distance = np.sum(differences @ np.linalg.inv(covariance) * differences, axis=1)
    covariance = covariance * np.median(distance) / float(chi2_ppf(0.5, d))
    share = d / (d + len(differences))
    root = np.linalg.cholesky((1 - share) * covariance + share * np.diag(np.diag(covariance)))
    return np.linalg.inv(root) @ axes.T, axes @ root


REPEATS = 8
"""Pairs of runs of one unit that show how it repeats."""
BEST = 0.02
"""Smallest share of the variance between units that a repeated unit has."""


def _repeatability(z: Floats, weight: Floats, same_unit: Ints, noise: Floats) -> Floats:
    """(d,) share of the variance that runs of one unit differ by, with two standard
    errors of its estimate, and at least that of the ``noise``; all of it where too few
    units repeat."""
    out = np.ones(z.shape[1])
    known = (weight[same_unit] > 0).all(axis=1)
    count = known.sum(axis=0)
    differences = np.where(known, (z[same_unit[:, 0]] - z[same_unit[:, 1]]) ** 2 / 2, np.nan)
    found = _median(differences) / CHI2_MEDIAN * (1 + 2 / np.sqrt(np.maximum(count, 1)))
    shown = count >= REPEATS
    out[shown] = np.clip(np.maximum(found, noise)[shown], BEST, 1.0)
    return out
