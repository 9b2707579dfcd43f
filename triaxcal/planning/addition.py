"""The next best poses: what to add to poses that are there, and what each
addition would do."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME
from triaxcal.model.directions import (
    FULL,
    Direction,
    cube_directions,
    dilution,
    directions,
    in_range,
    linear_design,
    worst_error,
)
from triaxcal.model.sensor import LINEAR
from triaxcal.planning.clock import PLANS_CLOCK
from triaxcal.planning.design import Asked, channels_needed, profile_times
from triaxcal.planning.optimal import profile

ENOUGH = 1.25
"""A set is good whose worst parameter is no more uncertain than this many
poses' standard errors (the 14 have 1.06 where all are alike), and whose effects
come out no more than so many times worse than from the plan of 26."""
MOST = FULL
"""No more are added than a whole plan has: that would be the better one to
take."""


@dataclass(frozen=True)
class Had:
    """The poses that are there. ``up`` (n,3); ``weights`` (n,) 1/variance, of a
    typical pose 1; ``held`` by channel and time (n,), each from −1 to 1 over
    what it went through, of which ``half`` is the half in the channel's unit;
    ``axes`` (3,3) the sensitive axes, in rows."""

    up: Floats
    weights: Floats
    held: Mapping[str, Floats]
    half: Mapping[str, float]
    axes: Floats = field(default_factory=lambda: np.eye(3))

    @property
    def worst_error(self) -> float:
        """Of the nine parameters, in standard errors of a typical pose
        (`worst_error`)."""
        return worst_error(linear_design(self.up, self.up) * np.sqrt(self.weights)[:, None])


@dataclass(frozen=True)
class Addition:
    """One pose more. ``levels`` of the channels, −1 lowest to 1 highest;
    ``dilution``, ``worst_error`` of the nine parameters and ``errors``
    (`Asked.errors`, per unit of the channels) are those of the poses there with
    this one and all before it."""

    label: str
    up: Floats
    levels: Mapping[str, float]
    dilution: float
    worst_error: float
    errors: Mapping[str, Mapping[str, float | None]]


def additions(had: Had, asked: Asked, first: Sequence[Direction] = ()) -> list[Addition]:
    """Poses of the 26 worth adding, best first: ``first`` those that the nine
    parameters want, then those that the effects asked for want, until these
    come out nearly as well as from a whole plan, or ``MOST`` are added.

    Each is the one that adds most to the information on what is still wanting.
    """
    return _Adding(had, asked).run(first)


class _Adding:
    def __init__(self, had: Had, asked: Asked) -> None:
        self.had, self.asked = had, asked
        self.channels = channels_needed(asked.effects)
        self.step = 2 / max(len(had.up) - 1, 1)
        self.rows = asked.rows(had.up, had.held)
        self.scaled = asked.rows(had.up, self._in_units(had.held))
        self.weights = had.weights
        self.out: list[Addition] = []

    def run(self, first: Sequence[Direction]) -> list[Addition]:
        for direction in first:
            self._add([direction])
        limit = _as_a_whole_plan(self.asked)
        while self.asked.rank and len(self.out) < MOST and not self._enough(limit):
            self._add(cube_directions())
        return self.out

    def _enough(self, limit: float) -> bool:
        _, singular, _ = np.linalg.svd(self.rows * np.sqrt(self.weights)[:, None])
        whole = len(self.rows) >= self.rows.shape[1] and singular[-1] > 1e-6 * singular[0]
        return bool(whole and self.asked.worst(self.rows, self.weights) <= limit)

    def _add(self, choice: Sequence[Direction]) -> None:
        """The best of these directions, at the best levels."""
        combined = list(itertools.product((-1.0, 0.0, 1.0), repeat=len(self.channels)))
        options = [(d, dict(zip(self.channels, at, strict=True))) for at in combined for d in choice]
        ups = np.array([v for (_, v), _ in options])
        time = 1 + self.step * (len(self.out) + 1)
        held = {clock: np.full(len(options), time) for clock in (TIME, PLANS_CLOCK)} | {
            c: np.array([levels[c] for _, levels in options]) for c in self.channels
        }
        rows = self.asked.rows(ups, held)
        gain = self._gain(rows)
        at = int(np.argmax(gain >= gain.max() - 1e-6))
        (label, up), levels = options[at]
        self.rows = np.concatenate([self.rows, rows[at : at + 1]])
        self.weights = np.append(self.weights, 1.0)
        linear = self.rows[:, :LINEAR] * np.sqrt(self.weights)[:, None]
        scaled = self.asked.rows(ups[at : at + 1], {n: v[at : at + 1] for n, v in self._in_units(held).items()})
        self.scaled = np.concatenate([self.scaled, scaled])
        errors = self.asked.errors(self.scaled, self.weights)
        ups = np.concatenate([self.had.up, *(a.up[None] for a in self.out), up[None]])
        spread = dilution(ups, linear_design(ups, in_range(ups @ self.had.axes.T)))
        self.out.append(Addition(label, up, levels, spread, worst_error(linear), errors))

    def _in_units(self, held: Mapping[str, Floats]) -> dict[str, Floats]:
        return {name: v * self.had.half.get(name, 1.0) for name, v in held.items()}

    def _gain(self, rows: Floats) -> Floats:
        """(C,) log of what each row multiplies the determinant of the effects'
        information by."""
        M = (self.rows * self.weights[:, None]).T @ self.rows + 1e-9 * np.eye(rows.shape[1])
        whole = np.einsum("ci,ij,cj->c", rows, np.linalg.inv(M), rows)
        linear = rows[:, :LINEAR]
        part = np.einsum("ci,ij,cj->c", linear, np.linalg.inv(M[:LINEAR, :LINEAR]), linear)
        return np.asarray(np.log1p(whole) - (np.log1p(part) if self.asked.rank else 0.0))


def _as_a_whole_plan(asked: Asked) -> float:
    """The worst standard error that the combinations of the effects'
    coefficients may have."""
    ups = np.array([v for _, v in directions(FULL)])
    ups = np.concatenate([ups, ups[:1]])
    held = {TIME: profile_times(len(ups))} | profile(channels_needed(asked.effects), len(ups), 3)
    return ENOUGH * asked.worst(asked.rows(ups, held))
