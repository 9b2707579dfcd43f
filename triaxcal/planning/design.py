"""What poses in given directions and covariates tell of effects: the columns of
a plan's design, by |a| alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Effect
from triaxcal.model.directions import linear_design
from triaxcal.model.sensor import LINEAR

SHOWS = 1e-6
"""A combination of coefficients shows at all where this share of it is left
beside the nine parameters."""
VISIBLE = 0.02
"""What shows of an effect, or of a coefficient, can be used where at least this
share of it is left beside all else. What is less comes of directions that are a
degree off."""


def channels_needed(effects: Sequence[Effect]) -> tuple[str, ...]:
    """The channels that the effects depend on, time left out, each once."""
    return tuple(dict.fromkeys(n for e in effects for n in e.needs if n != TIME))


def needs_time(effects: Sequence[Effect]) -> bool:
    return any(TIME in e.needs for e in effects)


def profile_times(n: int) -> Floats:
    """(n,) time of the poses of a plan, from −1, the first, to 1, the last."""
    return np.linspace(-1, 1, n) if n > 1 else np.zeros(n)


def radial(effects: Sequence[Effect], a: Floats, held: Mapping[str, Floats]) -> Floats:
    """(n,p): what a unit of each coefficient adds to |a| of an ideal triad,
    ``a`` (n,3) unit vectors."""
    columns = [np.einsum("ni,nip->np", a, e.basis(a, held)) for e in effects]
    return np.concatenate(columns, axis=1) if columns else np.empty((len(a), 0))


@dataclass(frozen=True)
class Asked:
    """Effects that a plan is for. ``seen`` (p,q): orthonormal combinations of
    their coefficients that |a| can show beside the nine parameters, ``hidden``
    (p,p−q) those that no plan can, since they look like others of them."""

    effects: tuple[Effect, ...]
    seen: Floats
    hidden: Floats

    @property
    def rank(self) -> int:
        return int(self.seen.shape[1])

    def rows(self, a: Floats, held: Mapping[str, Floats]) -> Floats:
        """(n,9+q): derivatives of |a| by the nine parameters and by the
        combinations that show."""
        return np.concatenate([linear_design(a, a), radial(self.effects, a, held) @ self.seen], axis=1)

    def errors(self, rows: Floats, weights: Floats | None = None) -> dict[str, dict[str, float | None]]:
        """Standard error of each coefficient by effect, in standard errors of
        one pose, fitted all together.

        None where the poses (``rows`` (n,9+q), each with its weight) cannot
        show that coefficient by itself: less than `VISIBLE` of what it makes is
        left beside the other parameters.
        """
        loose, spread = self._spread(rows, weights)
        alone = np.linalg.norm(self.hidden, axis=1) < 1e-6
        known = alone & (np.abs(self.seen @ loose).max(axis=1, initial=0.0) < 1e-6)
        errors = np.linalg.norm(self.seen @ spread, axis=1)
        w = np.ones(len(rows)) if weights is None else weights
        # Of a coefficient alone; the columns of what is hidden are those of
        # others.
        whole = np.linalg.norm(rows[:, LINEAR:] @ self.seen.T * np.sqrt(w)[:, None], axis=0)
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
        """The largest standard error of the combinations that can show;
        infinite where the poses do not show one."""
        loose, spread = self._spread(rows, weights)
        known = np.abs(loose).max(axis=1, initial=0.0) < 1e-6
        return float(np.linalg.norm(spread, axis=1).max(initial=0.0)) if known.all() else float("inf")

    def _spread(self, rows: Floats, weights: Floats | None) -> tuple[Floats, Floats]:
        """Of the combinations that can show, (q,·) each: what of them the poses
        do not determine, and the spread of what they do."""
        w = np.ones(len(rows)) if weights is None else weights
        size = np.linalg.norm(rows, axis=0)
        size = np.where(size > 0, size, 1.0)
        _, singular, v = np.linalg.svd(rows * np.sqrt(w)[:, None] / size, full_matrices=True)
        values = np.zeros(rows.shape[1])
        values[: len(singular)] = singular
        bad = values < SHOWS
        combined = v / size
        return combined[bad].T[LINEAR:], (combined[~bad].T / values[~bad])[LINEAR:]


def ask(effects: Sequence[Effect]) -> Asked:
    """What of the effects, taken together, |a| can show, were directions and
    covariates free."""
    rng = np.random.default_rng(0)
    a = rng.standard_normal((1500, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    held = {n: rng.uniform(-1, 1, len(a)) for n in (TIME, *channels_needed(effects))}
    seen, hidden = combinations(linear_design(a, a), radial(effects, a, held))
    return Asked(tuple(effects), seen, hidden)


def combinations(nuisance: Floats, columns: Floats, least: float = SHOWS) -> tuple[Floats, Floats]:
    """Orthonormal combinations (p,q) of columns (n,p) that show beside the
    nuisance (n,k), and (p,p−q) that do not.

    A combination shows where at least the share ``least`` of it is left after
    projection, the columns scaled alike.
    """
    size = np.linalg.norm(columns, axis=0)
    there = size > 1e-9
    scale = np.where(there, size, 1.0)
    norms = np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300)
    rest = columns / scale - nuisance / norms @ np.linalg.lstsq(nuisance / norms, columns / scale, rcond=1e-12)[0]
    rest[:, ~there] = 0.0
    _, singular, rows = np.linalg.svd(rest, full_matrices=True)
    kept = np.zeros(columns.shape[1], dtype=bool)
    kept[: len(singular)] = singular > least
    # Coefficients of what does not show; what shows is whatever is at right
    # angles to it.
    hidden = np.linalg.qr(rows[~kept].T / scale[:, None])[0] if not kept.all() else np.empty((len(size), 0))
    basis = np.linalg.svd(hidden, full_matrices=True)[0] if hidden.size else np.eye(len(size))
    return np.asarray(basis[:, hidden.shape[1] :]), np.asarray(hidden)
