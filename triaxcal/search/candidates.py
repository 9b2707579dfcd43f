"""What the search tries: every visible effect in every variant, on all axes, on two of them and on each alone.

A candidate stands in the search by the part of its columns that the model cannot absorb (Frisch–Waugh–Lovell).
"""

from __future__ import annotations

import itertools
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SCATTER, Effect, condition_of, rate_of
from triaxcal.effects.part import Part
from triaxcal.effects.plugins import EffectFault, is_foreign
from triaxcal.poses.pose import Pose
from triaxcal.problem import Problem, State, linearise
from triaxcal.visibility import VISIBLE

NOTHING = 1e-9
"""The size of a column that shows nothing, beside the largest of its effect."""
AXES = 3
"""Of effects with so many parts two may act as well as one or all."""
MOVES = 3.0
"""A channel stands still unless its means, or its rates, differ by so many of their standard errors (rms)."""
SCATTER_MOVES = 0.1
"""Scatter stands still unless it differs from pose to pose by this share, and by `MOVES` times what chance makes."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect, or part of one, and an orthonormal basis (n,q) of what shows of it beside the model, in poses weighted
    by their standard errors. ``tries`` is how many candidates bear its name.
    """

    effect: Effect
    basis: Floats
    tries: int

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def rank(self) -> int:
        return int(self.basis.shape[1])


@dataclass(frozen=True)
class Ground:
    """The model linearised at a state: residuals ``y`` (n,) and an orthonormal basis ``model`` (n,k) of its columns,
    both weighted, with what it takes to make the columns of any effect.
    """

    problem: Problem
    state: State
    y: Floats
    model: Floats
    by_v: Floats
    s: Floats
    error: Floats

    @classmethod
    def at(cls, problem: Problem, state: State) -> Ground:
        r, J, error = linearise(problem, state)
        weighted = J / error[:, None]
        norms = np.linalg.norm(weighted, axis=0)
        left, singular, _ = np.linalg.svd(weighted / np.where(norms > 0, norms, 1.0), full_matrices=False)
        model = left[:, singular > 1e-10]
        radius = state.sensor(problem).radius(problem.u, problem.conditions)
        y = r / error
        return cls(problem, state, y - model @ (model.T @ y), model, radius.by_v, radius.s, error)

    def columns(self, effect: Effect) -> Floats:
        """(n,p) derivatives of the weighted residuals by the coefficients of an effect."""
        by_q = np.einsum("ni,nip->np", self.by_v, effect.basis(self.s, self.problem.conditions))
        return np.asarray(-by_q / self.error[:, None])

    def shown(self, columns: Floats, least: float = VISIBLE) -> tuple[Floats, Floats]:
        """Orthonormal basis (n,q) of what shows of columns (n,p), and the combinations (p,q) of them that show."""
        size = np.linalg.norm(columns, axis=0)
        there = size > NOTHING * size.max(initial=0.0)
        scaled = columns[:, there] / size[there]
        rest = scaled - self.model @ (self.model.T @ scaled)
        left, singular, right = np.linalg.svd(rest, full_matrices=False)
        kept = singular > least
        mix = np.zeros((len(size), int(kept.sum())))
        if there.any():
            mix[there] = right[kept].T / size[there][:, None] * statistics.median(size[there].tolist())
        return left[:, kept], mix


def faults_of(ground: Ground, catalogue: Sequence[Effect]) -> dict[str, str]:
    """Effects of other packages that cannot be used on these poses, though they could be loaded: name → reason."""
    found = {}
    for effect in catalogue:
        if is_foreign(effect) and all(n in ground.problem.channel_reference for n in effect.needs):
            try:
                for variant in effect.variants(ground.problem.conditions):
                    ground.columns(variant)
                    variant.slope(ground.s, ground.problem.conditions)
            except EffectFault as e:
                found[effect.name] = e.reason
    return found


def candidates_of(ground: Ground, catalogue: Sequence[Effect], still: set[str]) -> tuple[list[Candidate], set[str]]:
    """All that show, and the names of the effects that show in full. ``still`` are conditions that do not move."""
    found: list[tuple[Effect, Floats]] = []
    full: set[str] = set()
    faulty = faults_of(ground, catalogue)
    for effect in catalogue:
        if effect.name in faulty:
            continue
        if any(n not in ground.problem.channel_reference or n in still for n in effect.needs):
            continue
        for variant in effect.variants(ground.problem.conditions):
            for part, basis, whole in _parts(ground, variant):
                found.append((part, basis))
                if whole:
                    full.add(effect.name)
    tries = Counter(e.name for e, _ in found)
    return [Candidate(e, basis, tries[e.name]) for e, basis in found], full


def _parts(ground: Ground, effect: Effect) -> list[tuple[Effect, Floats, bool]]:
    """Of one variant: all that shows of it, then each part that shows alone; whether it is the whole."""
    columns = ground.columns(effect)
    if not np.isfinite(columns).all():
        return []
    basis, mix = ground.shown(columns)
    rank, p = basis.shape[1], columns.shape[1]
    if not rank:
        return []
    out: list[tuple[Effect, Floats, bool]] = [(effect if rank == p else Part(effect, mix), basis, rank == p)]
    labels = list(dict.fromkeys(c.part for c in effect.coefficients))
    some = [(label,) for label in labels] if len(labels) > 1 else []
    for kept in [*some, *itertools.combinations(labels, 2)] if len(labels) == AXES else some:
        part = Part.of(effect, *kept)
        own, _ = ground.shown(columns @ part.mix)
        # What shows as one number of all axes together must not be given to one of them.
        if own.shape[1] == part.mix.shape[1] < rank:
            out.append((part, own, False))
    return out


def still_conditions(poses: Sequence[Pose]) -> set[str]:
    """Conditions that do not move from pose to pose by more than their own noise.

    A coefficient of such a condition would be one of chance.
    """
    still = set()
    for name in sorted(set.intersection(*(set(p.channels) for p in poses))):
        if not _moves([p.channels[name] for p in poses], [p.channel_errors.get(name, 0.0) for p in poses]):
            still.add(condition_of(name))
        if not _moves([p.rates.get(name, 0.0) for p in poses], [p.rate_errors.get(name, 0.0) for p in poses]):
            still.add(rate_of(condition_of(name)))
    scatter = np.array([p.scatter for p in poses])
    chance = np.sqrt(2 / np.array([max(p.samples, 2) for p in poses]))
    share = scatter.std(axis=0) / np.maximum(scatter.mean(axis=0), 1e-300)
    if not np.any(share > max(SCATTER_MOVES, MOVES * float(np.sqrt(np.mean(chance**2))))):
        still |= set(SCATTER)
    return still


def _moves(values: list[float], errors: list[float]) -> bool:
    return float(np.std(values)) > MOVES * float(np.sqrt(np.mean(np.square(errors))))
