"""Optimal plans for suspected effects: directions and covariates.

D_s-optimality (Atkinson, Donev and Tobias 2007, Optimum Experimental Designs, ch.
10): the smallest determinant of the covariance of the effects' coefficients with the
nine parameters as a nuisance, so ``log|M| − log|M₁₁|`` is maximised. Poses are
exchanged one at a time for the best candidate (Fedorov 1972; Cook and Nachtsheim
1980, Technometrics 22:315). The general equivalence theorem gives an upper bound for
any plan, and with it the efficiency.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.effects.contract import TIME, Effect
from triaxcal.errors import Refused
from triaxcal.model.directions import Direction, cube_directions, directions, in_order, linear_design, worst_error
from triaxcal.model.sensor import LINEAR
from triaxcal.planning.design import TargetEffects, channels_needed, needs_time, profile_times, target_effects

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
