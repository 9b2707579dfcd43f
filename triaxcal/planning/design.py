"""Information of poses in given directions and covariates on effects: the columns of
a design, by |a| alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import DURATION, SINCE_START, TIME, Effect
from triaxcal.effects.runs import Wrapped, of_clocks
from triaxcal.model.directions import FULL, linear_design
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
    """``whole`` with a shape for a recording two units long, by `PLANS_CLOCK`, or
    `TIME` where that is one."""

    needs: tuple[str, ...] = (TIME,)

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.basis(s, _clocks(_plans(covariates)))

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.whole.slope(s, _clocks(_plans(covariates)))


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
