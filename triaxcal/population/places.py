"""The places and times that runs share, and sums over all of them at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from triaxcal.arrays import Bools, Floats, Ints, evenly_spread
from triaxcal.population.runs import PlaceKind, UnitRun

HOURS = (1, 2, 3, 4, 6, 8, 12)
"""Lengths of spans of hours of the day: an hour, up to a shift and half a day."""
CHANGE_POINTS = 40
"""Moments of a change, with the same number of runs between each two; those about the
likeliest come later."""
FROM_TO = 12
"""Of them, those that a passing change begins and ends with."""
FEW_PAIRS = 300
"""Pairs of runs that are summed one by one, not by a table of cells."""
FEWEST = 5
"""Runs inside a place and time, and outside: fewer are single units."""


@dataclass(frozen=True, eq=False)
class PlacesOfKind:
    """``label`` (N,) of each run, −1 where its place is not known. ``member`` (n,L):
    which labels are in each of the n places; ``names`` (n,) are theirs."""

    kind: PlaceKind
    label: Ints
    names: tuple[str, ...]
    member: Bools

    def inside(self, place: int) -> Bools:
        """(N,) whether each run is in this place."""
        return np.asarray((self.label >= 0) & self.member[place][self.label])

    def over_places(self, by_label: Floats) -> Floats:
        """(n,…) sums over places from those over labels (L,…)."""
        if len(self.names) == self.member.shape[1]:
            return by_label
        return np.asarray(np.tensordot(self.member.astype(float), by_label, axes=1))


def places_of(runs: Sequence[UnitRun]) -> list[PlacesOfKind]:
    """All kinds of places that the runs differ in, and everywhere."""
    found: list[PlacesOfKind] = []
    for kind in PlaceKind:
        if kind is PlaceKind.HOUR:
            found += _hours(runs)
            continue
        label_of = [run.place(kind) for run in runs]
        names = sorted({name for name in label_of if name is not None})
        number = {name: i for i, name in enumerate(names)}
        label = np.array([-1 if name is None else number[name] for name in label_of])
        if names and (len(names) > 1 or kind is PlaceKind.EVERYWHERE or (label < 0).any()):
            found.append(PlacesOfKind(kind, label, tuple(names), np.eye(len(names), dtype=bool)))
    return found


def _hours(runs: Sequence[UnitRun]) -> Iterator[PlacesOfKind]:
    label = np.array([-1 if run.hour is None else int(run.hour) % 24 for run in runs])
    if len(set(label[label >= 0].tolist())) < 2:
        return
    spans = [(first, length) for length in HOURS for first in range(24)]
    hours = np.arange(24)
    member = np.array([(hours - first) % 24 < length for first, length in spans])
    # Spans with the same runs are one place, the shortest.
    used = np.isin(hours, label)
    _, first_of = np.unique(member & used, axis=0, return_index=True)
    kept = [i for i in sorted(first_of) if (member[i] & used).any()]
    names = tuple(f"{spans[i][0]}-{(spans[i][0] + spans[i][1] - 1) % 24 + 1}" for i in kept)
    yield PlacesOfKind(PlaceKind.HOUR, label, names, member[kept])


@dataclass(frozen=True, eq=False)
class Windows:
    """Cells of time ``first`` (w,) up to before ``end`` (w,), each with its prior."""

    first: Ints
    end: Ints
    log_prior: Floats


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """Runs at ``time`` (N,) s in the cells between ``edges`` (G−1,) s."""

    time: Floats
    edges: Floats
    coarse: Bools
    """(G−1,) edges that passing changes begin and end with."""

    @classmethod
    def of(cls, time: Floats, finer: Sequence[float] = (), *, passing: bool = False) -> TimeGrid:
        """``finer`` are further edges, about likely changes, also ``passing`` ones."""
        every = np.unique(time)
        between = (every[1:] + every[:-1]) / 2
        base = evenly_spread(np.sort(time), CHANGE_POINTS + 2)[1:-1]
        base = (
            np.unique(between[np.clip(np.searchsorted(between, base), 0, len(between) - 1)]) if len(between) else base
        )
        edges = np.unique(np.concatenate([base, np.asarray(finer, dtype=float)]))
        coarse = np.isin(edges, np.concatenate([evenly_spread(base, FROM_TO), np.asarray(finer if passing else ())]))
        return cls(time, edges, coarse)

    @property
    def cells(self) -> int:
        return len(self.edges) + 1

    @cached_property
    def cell(self) -> Ints:
        """(N,) of each run."""
        return np.searchsorted(self.edges, self.time, side="right")

    @cached_property
    def middle(self) -> Floats:
        """(G,) mean time of the cells."""
        count = np.bincount(self.cell, minlength=self.cells)
        total = np.bincount(self.cell, self.time - self.time[0], minlength=self.cells)
        bounds = np.concatenate([[self.time.min()], self.edges, [self.time.max()]])
        middle = self.time[0] + total / np.maximum(count, 1)
        return np.asarray(np.where(count > 0, middle, (bounds[1:] + bounds[:-1]) / 2))

    @cached_property
    def windows(self) -> Windows:
        """Always; since; until; from, to: with these probabilities, each shared by its
        moments."""
        cuts = np.arange(1, self.cells)
        passing = np.flatnonzero(self.coarse) + 1
        i, j = np.triu_indices(len(passing), 1)
        kinds = [
            (0.4, np.array([0]), np.array([self.cells])),
            (0.35, cuts, np.full(len(cuts), self.cells)),
            (0.1, np.zeros(len(cuts), dtype=np.int64), cuts),
            (0.15, passing[i], passing[j]),
        ]
        kinds = [(share, first, end) for share, first, end in kinds if len(first)]
        return Windows(
            np.concatenate([first for _, first, _ in kinds]),
            np.concatenate([end for _, _, end in kinds]),
            np.concatenate([np.full(len(first), np.log(share / len(first))) for share, first, _ in kinds]),
        )

    @cached_property
    def ramps(self) -> tuple[Floats, Floats]:
        """Drifts (k,G) from 0 at a moment to 1 at the end, and their log priors: from
        the beginning, or from a coarse edge."""
        last = self.middle[-1]
        begin = np.concatenate([[self.middle[0]], self.edges[self.coarse]])
        begin = begin[begin < last]
        ramps = np.clip((self.middle - begin[:, None]) / (last - begin[:, None]), 0.0, None)
        prior = np.full(len(begin), np.log(0.5 / max(len(begin) - 1, 1)))
        prior[0] = np.log(0.5)
        return ramps, prior

    def ramp_begins(self, k: int) -> float:
        begin = np.concatenate([[self.middle[0]], self.edges[self.coarse]])
        return float(begin[begin < self.middle[-1]][k])


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the places of a kind and the cells of a grid."""

    places: PlacesOfKind
    grid: TimeGrid

    @cached_property
    def _gather(self) -> sparse.csr_matrix:
        known = np.flatnonzero(self.places.label >= 0)
        labels, cells = self.places.member.shape[1], self.grid.cells
        row = self.places.label[known] * cells + self.grid.cell[known]
        return sparse.csr_matrix((np.ones(len(known)), (row, known)), shape=(labels * cells, len(self.grid.time)))

    def by_cell(self, values: Floats) -> Floats:
        """(n,G,d) of ``values`` (N,d)."""
        out = (self._gather @ values).reshape(-1, self.grid.cells, values.shape[1])
        return self.places.over_places(out)

    def by_window(self, by_cell: Floats) -> Floats:
        """(n,w,d) from sums by cell (n,G,d)."""
        cumulative = np.concatenate([np.zeros_like(by_cell[:, :1]), np.cumsum(by_cell, axis=1)], axis=1)
        windows = self.grid.windows
        return np.asarray(cumulative[:, windows.end] - cumulative[:, windows.first])

    def by_ramp(self, by_cell: Floats, power: int = 1) -> Floats:
        """(n,k,d) sums times the ramps."""
        return np.asarray(np.einsum("kg,ngd->nkd", self.grid.ramps[0] ** power, by_cell, optimize=True))

    def after_begin(self, by_cell: Floats) -> Floats:
        """(n,k,d) sums over the cells in which each ramp is above 0."""
        return np.asarray(np.einsum("kg,ngd->nkd", self.grid.ramps[0] > 0, by_cell, optimize=True))

    def pairs_by_window(self, pairs: Ints, value: Floats) -> Floats:
        """(n,w,d) sums of ``value`` (p,d) over ``pairs`` (p,2) of runs that are both in
        the place and the window."""
        cells, windows = self.grid.cells, self.grid.windows
        low, high = np.sort(self.grid.cell[pairs], axis=1).T
        both = np.array([self.places.inside(k)[pairs].all(axis=1) for k in range(len(self.places.names))])
        if len(pairs) <= FEW_PAIRS:
            during = (low[:, None] >= windows.first) & (high[:, None] < windows.end)
            product = during[:, :, None] * value[:, None]
            return np.asarray(np.tensordot(both.astype(float), product, axes=1))
        out = np.zeros((len(self.places.names), len(windows.first), value.shape[1]))
        for place in np.flatnonzero(both.any(axis=1)):
            mine = both[place]
            table = np.zeros((cells * cells, value.shape[1]))
            np.add.at(table, low[mine] * cells + high[mine], value[mine])
            # Of all pairs those that begin at a cell or later, and end before one.
            later = np.cumsum(table.reshape(cells, cells, -1)[::-1], axis=0)[::-1]
            before = np.concatenate([np.zeros((cells, 1, value.shape[1])), np.cumsum(later, axis=1)], axis=1)
            out[place] = before[windows.first, windows.end]
        return out

    def pairs_by_ramp(self, pairs: Ints, value: Floats) -> Floats:
        """(n,k,d) sums of ``value`` (p,d) times the ramps at both runs, over ``pairs``
        (p,2) that are both in the place."""
        ramps, cell = self.grid.ramps[0], self.grid.cell
        product = ramps[:, cell[pairs[:, 0]]] * ramps[:, cell[pairs[:, 1]]]
        both = np.array([self.places.inside(k)[pairs].all(axis=1) for k in range(len(self.places.names))])
        return np.asarray(np.einsum("np,kp,pd->nkd", both.astype(float), product, value, optimize=True))
