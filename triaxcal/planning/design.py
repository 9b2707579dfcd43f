"""Designs for suspected effects: the information of poses in given directions and
covariates, by |a| alone, and optimal plans.

The plans are D_s-optimal (Atkinson, Donev and Tobias 2007, Optimum Experimental
Designs, ch. 10): the smallest determinant of the covariance of the effects'
coefficients with the nine parameters as a nuisance, so ``log|M| − log|M₁₁|`` is
maximised. Poses are exchanged one at a time for the best candidate (Fedorov 1972;
Cook and Nachtsheim 1980, Technometrics 22:315). The general equivalence theorem gives
an upper bound for any plan, and with it the efficiency.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, Effect
from triaxcal.effects.runs import Wrapped, of_clocks
from triaxcal.errors import Refused
from triaxcal.model.directions import FULL, Direction, cube_directions, directions, in_order, linear_design, worst_error
from triaxcal.model.sensor import LINEAR

SHOWS = 1e-6
"""Least share of a combination of coefficients, after projection off the nine
parameters, that counts as observable."""
VISIBLE = 0.02
"""Least share, after projection off all else, that is usable. Less is of the size of
direction errors of a degree."""


def channels_needed(effects: Sequence[Effect]) -> tuple[str, ...]:
    """The channels on which the effects depend, without time, each once."""
    return tuple(dict.fromkeys(n for e in effects for n in e.needs if n != TIME))


def needs_time(effects: Sequence[Effect]) -> bool:
    return any(TIME in e.needs for e in effects)


def profile_times(n: int) -> Floats:
    """(n,) time of the poses of a plan, from −1, the first, to 1, the last."""
    return np.linspace(-1, 1, n) if n > 1 else np.zeros(n)


def radial(effects: Sequence[Effect], a: Floats, held: Mapping[str, Floats]) -> Floats:
    """(n,p) derivative of |a| of an ideal triad by each coefficient, ``a`` (n,3) unit
    vectors."""
    columns = [np.einsum("ni,nip->np", a, e.basis(a, held)) for e in effects]
    return np.concatenate(columns, axis=1) if columns else np.empty((len(a), 0))


@dataclass(frozen=True)
class TargetEffects:
    """Target effects of a plan. ``seen`` (p,q): orthonormal combinations of their
    coefficients that |a| can show in addition to the nine parameters, ``hidden``
    (p,p−q) those that no plan can show, since they are equivalent to others."""

    effects: tuple[Effect, ...]
    seen: Floats
    hidden: Floats

    @property
    def rank(self) -> int:
        return int(self.seen.shape[1])

    def rows(self, a: Floats, held: Mapping[str, Floats]) -> Floats:
        """(n,9+q): derivatives of |a| by the nine parameters and by the observable
        combinations."""
        return np.concatenate([linear_design(a, a), radial(self.effects, a, held) @ self.seen], axis=1)

    def errors(self, rows: Floats, weights: Floats | None = None) -> dict[str, dict[str, float | None]]:
        """Standard error of each coefficient by effect, in standard errors of one
        pose, all fitted together.

        None where the poses (``rows`` (n,9+q), each with its weight) cannot show that
        coefficient by itself: less than `VISIBLE` of its contribution is left after
        projection off the other parameters.
        """
        loose, spread = self._spread(rows, weights)
        # Coefficients outside the hidden and the undetermined combinations.
        alone = np.linalg.norm(self.hidden, axis=1) < 1e-6
        known = alone & (np.abs(self.seen @ loose).max(axis=1, initial=0.0) < 1e-6)
        errors = np.linalg.norm(self.seen @ spread, axis=1)
        w = np.ones(len(rows)) if weights is None else weights
        # Of a coefficient alone; the columns of what is hidden are those of
        # others.
        whole = np.linalg.norm(rows[:, LINEAR:] @ self.seen.T * np.sqrt(w)[:, None], axis=0)
        # Remaining share of each coefficient: 1 / (standard error × norm of its
        # column).
        known &= errors * whole * VISIBLE <= 1
        out: dict[str, dict[str, float | None]] = {}
        at = 0
        for e in self.effects:
            out[e.name] = {
                c.name: float(errors[at + i]) if known[at + i] else None for i, c in enumerate(e.coefficients)
            }
            at += len(e.coefficients)
        return out

    def worst(self, rows: Floats, weights: Floats | None = None) -> float:
        """Largest standard error of the observable combinations; infinite where the
        poses do not determine one."""
        loose, spread = self._spread(rows, weights)
        known = np.abs(loose).max(axis=1, initial=0.0) < 1e-6
        return float(np.linalg.norm(spread, axis=1).max(initial=0.0)) if known.all() else float("inf")

    def _spread(self, rows: Floats, weights: Floats | None) -> tuple[Floats, Floats]:
        """For the observable combinations, (q,·) each: the undetermined directions,
        and a square root of the covariance of the rest."""
        w = np.ones(len(rows)) if weights is None else weights
        size = np.linalg.norm(rows, axis=0)
        size = np.where(size > 0, size, 1.0)
        # SVD with columns of length one.
        _, singular, v = np.linalg.svd(rows * np.sqrt(w)[:, None] / size, full_matrices=True)
        values = np.zeros(rows.shape[1])
        values[: len(singular)] = singular
        bad = values < SHOWS
        combined = v / size
        return combined[bad].T[LINEAR:], (combined[~bad].T / values[~bad])[LINEAR:]


def target_effects(effects: Sequence[Effect]) -> TargetEffects:
    """The observable combinations of the effects, for free directions and
    covariates."""
    # Random directions and covariates, many enough for any effect.
    rng = np.random.default_rng(0)
    a = rng.standard_normal((1500, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    held = {n: rng.uniform(-1, 1, len(a)) for n in (TIME, *channels_needed(effects))}
    seen, hidden = combinations(linear_design(a, a), radial(effects, a, held))
    return TargetEffects(tuple(effects), seen, hidden)


def combinations(nuisance: Floats, columns: Floats, least: float = SHOWS) -> tuple[Floats, Floats]:
    """Orthonormal combinations (p,q) of columns (n,p) that are observable in addition
    to the nuisance (n,k), and (p,p−q) that are not.

    A combination is observable where at least the share ``least`` of it is left after
    projection, with columns of equal length.
    """
    size = np.linalg.norm(columns, axis=0)
    there = size > 1e-9
    scale = np.where(there, size, 1.0)
    norms = np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300)
    # Project the columns off the nuisance, then split by singular values.
    rest = columns / scale - nuisance / norms @ np.linalg.lstsq(nuisance / norms, columns / scale, rcond=1e-12)[0]
    rest[:, ~there] = 0.0
    _, singular, rows = np.linalg.svd(rest, full_matrices=True)
    kept = np.zeros(columns.shape[1], dtype=bool)
    kept[: len(singular)] = singular > least
    # Null space in the coefficients, and its orthogonal complement.
    hidden = np.linalg.qr(rows[~kept].T / scale[:, None])[0] if not kept.all() else np.empty((len(size), 0))
    basis = np.linalg.svd(hidden, full_matrices=True)[0] if hidden.size else np.eye(len(size))
    return np.asarray(basis[:, hidden.shape[1] :]), np.asarray(hidden)


# Effects of the recording's clock in a plan, whose time runs from −1, the first pose,
# to 1, the last.

PLANS_CLOCK = "plans_clock"
"""`TIME` from −1 to 1, where `TIME` itself is in seconds."""
POSES = FULL + 1
"""Poses of the plan for which shapes are chosen: the one of 26, its first pose
repeated."""
HELD_SHARE = 0.01
"""Duration of a pose in a plan of length two: an eighth of the time from pose to
pose, so that a step usually falls between poses."""


@dataclass(frozen=True)
class OnPlansClock(Wrapped):
    """``inner`` with a shape for a recording two units long, by `PLANS_CLOCK`, or
    `TIME` where that is one."""

    needs: tuple[str, ...] = (TIME,)

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.inner.basis(s, _clocks(_plans(covariates)))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.inner.slope(s, _clocks(_plans(covariates)))


def in_plan(effect: Effect) -> Effect:
    """The effect in a plan; the middle variant of a time constant or a moment."""
    if not of_clocks(effect) or effect.needs == (TIME,):
        return effect
    variants = effect.variants(_clocks(np.linspace(-1, 1, POSES)))
    return OnPlansClock(variants[len(variants) // 2])


def _plans(covariates: Mapping[str, Floats]) -> Floats:
    return covariates[PLANS_CLOCK] if PLANS_CLOCK in covariates else covariates[TIME]


def _clocks(time: Floats) -> dict[str, Floats]:
    return {TIME: time, SINCE_START: time + 1, DURATION: np.full(len(time), HELD_SHARE)}


# The observability of an effect by a set of poses.


@dataclass(frozen=True)
class Observability:
    """Observability of one effect by a plan: ``visible`` of its ``of`` independent
    coefficients.

    ``hidden`` are the combinations of coefficients that do not show, name → weight,
    unit vectors.
    """

    visible: int
    of: int
    hidden: tuple[Mapping[str, float], ...]


def observability(directions: Floats, effect: Effect, held: Mapping[str, Floats] | None = None) -> Observability:
    """Observability of a single effect by poses in these directions (n,3), in this
    order and evenly in time.

    Every channel varies freely, except for those ``held`` (n,).
    """
    n, effect = len(directions), in_plan(effect)
    rng = np.random.default_rng(0)
    covariates = {TIME: profile_times(n)} | {c: rng.standard_normal(n) for c in effect.needs if c != TIME}
    covariates |= {c: v for c, v in (held or {}).items() if c in covariates}
    seen, hidden = combinations(
        linear_design(directions, directions), radial([effect], directions, covariates), VISIBLE
    )
    names = [c.name for c in effect.coefficients]
    named = tuple({k: float(w) for k, w in zip(names, v, strict=True) if abs(w) > 1e-9} for v in _plainly(hidden.T))
    return Observability(seen.shape[1], len(names), named)


def _plainly(hidden: Floats) -> Floats:
    """The same space of combinations (k,p) in reduced echelon form, rows of unit
    length."""
    rows = hidden.copy()
    pivots = 0
    # Gauss–Jordan elimination with row pivoting.
    for column in range(rows.shape[1]):
        rest = np.abs(rows[pivots:, column])
        if pivots == len(rows) or rest.max(initial=0.0) < 1e-6:
            continue
        k = pivots + int(np.argmax(rest))
        rows[[pivots, k]] = rows[[k, pivots]]
        rows[pivots] /= rows[pivots, column]
        others = np.arange(len(rows)) != pivots
        rows[others] -= np.outer(rows[others, column], rows[pivots])
        pivots += 1
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))


def unseen_effects(directions: Floats, catalogue: Sequence[Effect] = CATALOGUE) -> list[str]:
    """Names of the effects that poses in these directions (n,3) cannot show in full,
    with free channels."""
    observabilities = [observability(directions, e) for e in catalogue]
    return [e.name for e, s in zip(catalogue, observabilities, strict=True) if s.visible < s.of]


# Optimal plans for suspected effects: directions and covariates.

WORSE_MOST = 1.5
"""Limit of the worst error of the nine parameters, relative to the plain plan of
equally many poses."""
BEYOND_COSTS = 1e3
"""Penalty of the criterion for a plan beyond that limit, which is used only where
there is no other."""
CUBE_COSTS = 0.01
"""Efficiency that may be lost for faces, edges and vertices of the cube, which
fixtures have."""
APART_DEG = 10.0
"""Least angle between directions, or a station would count them once."""
STARTS, PASSES_MOST, BOUND_STEPS = 4, 12, 150
"""Exchange finds a local optimum: the best of so many starts is used. Its passes end
once nothing changes. The bound holds after any number of steps; fewer make it, and
the stated inefficiency, too high."""
EVEN = 2e-3
"""Share of a uniform design in the design of the bound."""
LEVELS = (2, 3, 4)
"""Numbers of levels of a channel; the smallest within a hundredth of the best is
used."""


@dataclass(frozen=True)
class OptimalPlan:
    """``plan`` in order, its first pose repeated at the end; ``levels`` (n,) of each
    channel from −1, its lowest, to 1. ``efficiency`` 0…1 relative to a bound on any
    plan; ``errors`` as `TargetEffects.errors`, a channel in halves of its range and
    time in halves of the plan's."""

    plan: tuple[Direction, ...]
    levels: Mapping[str, Floats]
    targets: TargetEffects
    efficiency: float
    errors: Mapping[str, Mapping[str, float | None]]

    @property
    def ups(self) -> Floats:
        return np.array([v for _, v in self.plan])


def optimal(count: int, effects: Sequence[Effect]) -> OptimalPlan:
    """The D_s-optimal plan of ``count`` distinct directions for the coefficients of
    ``effects``.

    Raises Refused where |a| shows nothing of them, or where so few poses cannot.
    """
    targets = target_effects(effects)
    if targets.rank == 0:
        raise Refused(f"|a| shows nothing of {_names(effects)} beside the nine parameters; no plan can")
    most = _distinct_rank(targets)
    if count < most or count + 1 < LINEAR + targets.rank:
        least = max(most, LINEAR + targets.rank - 1)
        raise Refused(f"a plan of {count} poses cannot show {_names(effects)}; at least {least}")
    search = _Search(count, targets)
    best = search.best(profile(channels_needed(effects), count + 1, search.levels_enough()))
    if not np.isfinite(best.value):
        raise Refused(f"a plan of {count} poses cannot show {_names(effects)}; take more")
    return _concluded(search, best)


def _names(effects: Sequence[Effect]) -> str:
    return ", ".join(e.name for e in effects)


def _distinct_rank(targets: TargetEffects) -> int:
    """Least number of distinct directions: effects of direction alone need one for
    each combination."""
    still = target_effects([e for e in targets.effects if not e.needs])
    return LINEAR + still.rank


def profile(channels: Sequence[str], n: int, levels: int) -> dict[str, Floats]:
    """Levels (n,) of each channel, equally many poses at each: up and down again,
    uncorrelated with time.

    A second channel runs through the cycle twice, and so on, so that no two are
    correlated.
    """
    out: dict[str, Floats] = {}
    # Ranks of a cosine, cut into equally many poses a level.
    for j, name in enumerate(channels):
        wave = -np.cos(2 * np.pi * (j + 1) * np.arange(n) / n)
        rank = np.argsort(np.argsort(np.round(wave, 9), kind="stable"), kind="stable")
        out[name] = np.linspace(-1, 1, levels)[rank * levels // n]
    return out


@dataclass(frozen=True)
class _Found:
    """Indices of the candidates, one for each slot, under levels by slot."""

    rows: Ints
    levels: Mapping[str, Floats]
    value: float


class _Search:
    """Exchange over slots: pose k has its time and its levels in any direction."""

    def __init__(self, count: int, targets: TargetEffects) -> None:
        self.count, self.targets = count, targets
        self.ups, self.cube = candidates(1000)
        self.linear = linear_design(self.ups, self.ups)
        plain = np.array([v for _, v in directions(count)])
        self.limit = WORSE_MOST * worst_error(linear_design(plain, plain))
        self.near = self.ups @ self.ups.T > np.cos(min(np.radians(APART_DEG), 0.6 * np.sqrt(4 * np.pi / count)))
        self.times = profile_times(count + 1)

    def held(self, levels: Mapping[str, Floats], k: int, n: int) -> dict[str, Floats]:
        """Covariates of slot ``k`` for ``n`` candidates."""
        return {TIME: np.full(n, self.times[k])} | {name: np.full(n, v[k]) for name, v in levels.items()}

    def levels_enough(self) -> int:
        """The smallest number of levels within a hundredth of the best."""
        if not channels_needed(self.targets.effects):
            return LEVELS[0]
        values = []
        for levels in LEVELS:
            tried = profile(channels_needed(self.targets.effects), self.count + 1, levels)
            values.append(self._exchanged(tried, self._blocks(tried), self._start(0)).value)
        return LEVELS[int(np.argmax(np.array(values) > max(values) - 0.01 * self.targets.rank))]

    def best(self, levels: Mapping[str, Floats]) -> _Found:
        blocks = self._blocks(levels)
        # The best of several starts; then the same with a bonus for directions of the
        # cube.
        found = [self._exchanged(levels, blocks, self._start(seed)) for seed in range(STARTS)]
        best = max(found, key=lambda f: f.value)
        for bonus in (0.1, 0.03, 0.01):
            cubic = self._exchanged(levels, blocks, best.rows, bonus)
            if cubic.value > best.value - CUBE_COSTS * self.targets.rank:
                return cubic
        return best

    def _blocks(self, levels: Mapping[str, Floats]) -> list[Floats]:
        """Rows (C,9+q) of the candidates by slot; slots with equal covariates share
        them."""
        timed = needs_time(self.targets.effects)
        known: dict[tuple[float, ...], Floats] = {}
        out = []
        for k in range(self.count + 1):
            key = (float(self.times[k]) if timed else 0.0, *(float(v[k]) for v in levels.values()))
            if key not in known:
                known[key] = self.targets.rows(self.ups, self.held(levels, k, len(self.ups)))
            out.append(known[key])
        return out

    def _start(self, seed: int) -> Ints:
        """The candidates nearest to the plain plan, or random ones, none near to
        another."""
        rng = np.random.default_rng(seed)
        wanted = np.array([v for _, v in directions(self.count)]) if seed == 0 else _random(rng, 20 * self.count)
        chosen = [0]
        for v in wanted:
            far = ~self.near[:, chosen].any(axis=1)
            if len(chosen) < self.count and far.any():
                chosen.append(int(np.argmax(np.where(far, self.ups @ v, -2.0))))
        return np.array([*chosen, 0])

    def _exchanged(self, levels: Mapping[str, Floats], blocks: list[Floats], start: Ints, bonus: float = 0.0) -> _Found:
        rows = start.copy()
        for _ in range(PASSES_MOST):
            before = rows.copy()
            for k in range(1, self.count):
                self._improve(rows, blocks, k, bonus)
            if np.array_equal(rows, before):
                break
        return _Found(rows, levels, self._value(rows, blocks))

    def _improve(self, rows: Ints, blocks: list[Floats], k: int, bonus: float) -> None:
        # Information matrix of the plan, and the gain by each exchange in slot k.
        X = np.array([blocks[i][r] for i, r in enumerate(rows)])
        M = X.T @ X + 1e-9 * np.eye(X.shape[1])
        gain = _gain(M, blocks[k], X[k]) - _gain(M[:LINEAR, :LINEAR], self.linear, X[k, :LINEAR])
        gain += bonus * self.cube
        # Exclude directions near those in use, and those that make the nine parameters
        # worse.
        taken: Bools = self.near[:, np.delete(rows, k)].any(axis=1)
        now = gain[rows[k]]
        gain[taken] = -np.inf
        rest = M[:LINEAR, :LINEAR] - np.outer(X[k, :LINEAR], X[k, :LINEAR])
        limit = max(self.limit, _worst_error(M[:LINEAR, :LINEAR]))
        for c in np.argsort(-np.round(gain, 9), kind="stable")[:200]:
            if not gain[c] > now + 1e-7:
                return
            if _worst_error(rest + np.outer(self.linear[c], self.linear[c])) <= limit * (1 + 1e-9):
                rows[k] = c
                return

    def _value(self, rows: Ints, blocks: list[Floats]) -> float:
        X = np.array([blocks[i][r] for i, r in enumerate(rows)])
        above = np.log(max(worst_error(self.linear[rows]) / self.limit, 1.0))
        return information(X.T @ X) - BEYOND_COSTS * float(above)


def _random(rng: np.random.Generator, n: int) -> Floats:
    v = rng.standard_normal((n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _gain(M: Floats, candidates: Floats, out: Floats) -> Floats:
    """(C,) log ratio of determinants after replacement of the row ``out`` of ``M`` by
    each candidate: ln((1 + x'M⁻¹x)(1 − z'M⁻¹z) + (x'M⁻¹z)²)."""
    inverse = np.linalg.inv(M)
    against = candidates @ inverse @ out
    comes = np.einsum("ci,ij,cj->c", candidates, inverse, candidates)
    goes = float(out @ inverse @ out)
    return np.asarray(np.log(np.maximum((1 + comes) * (1 - goes) + against**2, 1e-300)))


def _worst_error(linear: Floats) -> float:
    return float(1 / np.sqrt(max(float(np.linalg.eigvalsh(linear)[0]), 1e-12)))


def information(M: Floats) -> float:
    """D_s criterion log|M| − log|M₁₁|, with the nine parameters unknown; −inf where M
    is singular."""
    norms = np.sqrt(np.maximum(np.diag(M), 1e-300))
    if np.linalg.eigvalsh(M / np.outer(norms, norms))[0] < 1e-9:
        return -np.inf
    return float(np.linalg.slogdet(M)[1] - np.linalg.slogdet(M[:LINEAR, :LINEAR])[1])


@cache
def candidates(least: int) -> tuple[Floats, Bools]:
    """(C,3) unit vectors along small integer vectors, +X first, and (C,) whether they
    are directions of the cube; ``least`` or more."""
    seen: dict[tuple[int, ...], None] = {(1, 0, 0): None}
    for shell in range(1, 12):
        for v in itertools.product(range(shell, -shell - 1, -1), repeat=3):
            if max(map(abs, v)) == shell and np.gcd.reduce(v) == 1:
                seen[v] = None
        if len(seen) >= least:
            break
    vectors = np.array(list(seen), dtype=float)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.abs(vectors).max(axis=1) == 1


def _concluded(search: _Search, found: _Found) -> OptimalPlan:
    targets, n = search.targets, search.count + 1
    levels = dict(found.levels)
    rows, ups = found.rows, search.ups[found.rows]
    held = {TIME: search.times} | levels
    value = information((X := targets.rows(ups, held)).T @ X)
    # Order the poses for short moves, unless time matters.
    if not needs_time(targets.effects):
        kind = np.unique(np.stack([np.zeros(n), *levels.values()]), axis=1, return_inverse=True)[1].ravel()[:-1]
        order = in_order(ups[:-1], attached=X[:-1, LINEAR:], kind=kind)
        rows = rows[np.append(order, 0)]
        ups = search.ups[rows]
    names = {tuple(np.round(v, 9)): label for label, v in cube_directions()}
    labels = [names.get(tuple(np.round(v, 9)), f"N{k + 1}") for k, v in enumerate(ups)]
    labels[-1] = labels[0]
    most = bound(targets, n)
    return OptimalPlan(
        plan=tuple(zip(labels, ups, strict=True)),
        levels=levels,
        targets=targets,
        efficiency=float(np.exp(min(value - targets.rank * np.log(n) - most, 0.0) / targets.rank)),
        errors=targets.errors(targets.rows(ups, held)),
    )


def bound(targets: TargetEffects, n: int) -> float:
    """Upper bound of `information` a pose, over all plans of ``n`` poses in time at
    any directions and levels.

    The criterion is concave: for any design ξ, no other exceeds it by more than the
    mean over time of the largest variance function, less q (Kiefer and Wolfowitz
    1960; Atkinson, Donev and Tobias 2007, ch. 9 and 10). ξ comes from the
    multiplicative algorithm (Silvey, Titterington and Torsney 1978).
    """
    # Grid of times, levels and directions.
    times = profile_times(min(n, 41)) if needs_time(targets.effects) else np.zeros(1)
    channels = channels_needed(targets.effects)
    combined = list(itertools.product((-1.0, 0.0, 1.0) if len(channels) < 3 else (-1.0, 1.0), repeat=len(channels)))
    many = len(times) * len(combined) > 30
    coarse, fine = candidates(90 if many else 250)[0], candidates(250 if many else 1000)[0]

    def rows(ups: Floats, t: float) -> Floats:
        blocks = [
            targets.rows(
                ups, {TIME: np.full(len(ups), t)} | {c: np.full(len(ups), v) for c, v in zip(channels, at, strict=True)}
            )
            for at in combined
        ]
        return np.concatenate(blocks)

    X = np.stack([rows(coarse, t) for t in times])
    weights = np.full(X.shape[:2], 1 / (X.shape[0] * X.shape[1]))
    # A small uniform share keeps the information of the nine parameters regular.
    even = EVEN * np.einsum("tci,tc,tcj->ij", X, weights, X, optimize=True)

    def information_of(weights: Floats) -> Floats:
        return np.asarray(even + (1 - EVEN) * np.einsum("tci,tc,tcj->ij", X, weights, X, optimize=True))

    # Multiply the weights by the variance function, and normalise them at each time.
    for _ in range(BOUND_STEPS):
        kept = weights.max(axis=0) > 1e-3 / X.shape[0] / X.shape[1]
        X, weights = X[:, kept], weights[:, kept]
        weights = weights * np.maximum(_variance(information_of(weights), X), 1e-9)
        weights /= weights.sum(axis=1, keepdims=True) * X.shape[0]
    # The bound at the resulting design, with a finer grid of directions.
    M = information_of(weights)
    largest = [float(_variance(M, rows(fine, t)).max()) for t in times]
    return information(M) + max(float(np.mean(largest)) - targets.rank, 0.0)


def _variance(M: Floats, X: Floats) -> Floats:
    """The D_s variance function of rows (…,9+q): x' M⁻¹ x − x₁' M₁₁⁻¹ x₁; its mean
    over the design is q."""
    whole = np.einsum("...i,ij,...j->...", X, np.linalg.inv(M), X, optimize=True)
    linear = X[..., :LINEAR]
    part = np.einsum("...i,ij,...j->...", linear, np.linalg.inv(M[:LINEAR, :LINEAR]), linear, optimize=True)
    return np.asarray(whole - part)
