"""The columns of all terms. Terms of one effect and shape, on these axes or on
those, have columns in common; an outlier's have one entry each. So none stands
there twice, and none is longer than it has to be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from triaxcal.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class ScaledColumns:
    """Columns (N,q): those at ``index`` (q,) of a ``source`` (N,p), or of a unit
    matrix of ``rows`` where that is None, each times its ``factor`` (q,)."""

    source: Floats | None
    index: Ints
    factor: Floats
    rows: int

    @property
    def rank(self) -> int:
        return len(self.index)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Floats:
        if self.source is not None:
            return np.asarray(self.source[:, self.index] * self.factor, dtype)
        whole = np.zeros((self.rows, self.rank), dtype)
        whole[self.index, np.arange(self.rank)] = self.factor
        return whole


@dataclass(frozen=True, eq=False)
class TermColumns:
    """C columns, each one of ``base`` (N,D) or of a unit matrix, which follows
    it: at ``place`` (C,) among these D + N, times its ``factor`` (C,).
    ``blocks`` are the places (s,p) of columns of one source, or of one outlier,
    by their number p."""

    base: Floats
    place: Ints
    factor: Floats
    blocks: Sequence[Ints]

    @classmethod
    def of(cls, terms: Sequence[ScaledColumns], rows: int) -> TermColumns:
        begins: dict[int, int] = {}
        sources: list[Floats] = []
        count = 0
        for term in terms:
            if term.source is not None and id(term.source) not in begins:
                begins[id(term.source)] = count
                sources.append(term.source)
                count += term.source.shape[1]
        nothing: list[Ints] = [np.empty(0, dtype=np.int64)]
        each = [count + t.index if t.source is None else begins[id(t.source)] + t.index for t in terms]
        place, factor = np.concatenate(nothing + each), np.concatenate([np.empty(0), *(t.factor for t in terms)])
        together = [begins[id(s)] + np.arange(s.shape[1]) for s in sources]
        together += [own for own, t in zip(each, terms, strict=True) if t.source is None]
        widths = sorted({len(own) for own in together})
        blocks = [np.array([own for own in together if len(own) == width]) for width in widths]
        return cls(np.concatenate([np.empty((rows, 0)), *sources], axis=1), place, factor, blocks)

    def shared(self, terms: Sequence[ScaledColumns]) -> Iterator[ScaledColumns]:
        """The columns of the same terms, with the base as their source: their
        own need not be kept."""
        at = 0
        for term in terms:
            place = self.place[at : at + term.rank]
            at += term.rank
            yield term if term.source is None else replace(term, source=self.base, index=place)

    @property
    def count(self) -> int:
        return len(self.place)

    def with_base(self, base: Floats) -> TermColumns:
        return TermColumns(base, self.place, self.factor, self.blocks)

    def at(self, places: Ints) -> Floats:
        """(N,q) of some."""
        return self.unscaled(self.place[places]) * self.factor[places]

    def unscaled(self, place: Ints) -> Floats:
        """(N,q) of those at these places in base and unit matrix."""
        out, single = np.zeros((len(self.base), len(place))), place >= self.base.shape[1]
        out[place[single] - self.base.shape[1], np.flatnonzero(single)] = 1.0
        out[:, ~single] = self.base[:, place[~single]]
        return out

    def against(self, columns: Floats) -> Floats:
        """(D+N,…) the products of base and unit matrix with columns (N,…)."""
        return np.concatenate([self.base.T @ columns, columns])

    @cached_property
    def within_block(self) -> Ints:
        """(D+N,) where each stands in its block."""
        out = np.zeros(sum(self.base.shape), dtype=np.int64)
        for block in self.blocks:
            out[block] = np.arange(block.shape[1])
        return out

    def block_products(self, along: Floats, axes: Floats, taken: Floats) -> Floats:
        """(D+N,p) of the columns the products with those of their block, by
        these shares ``taken`` (k,) of what they have along ``axes`` (N,k):
        ``along`` (D,k) are those of the base."""
        out = np.zeros((sum(self.base.shape), max((b.shape[1] for b in self.blocks), default=0)))
        for block in self.blocks:
            own = self.along_of(block, along, axes)
            out[block, : block.shape[1]] = (own * taken) @ own.transpose(0, 2, 1)
        return out

    def along_of(self, place: Ints, along: Floats, axes: Floats) -> Floats:
        """(…,k) of the columns at these places, likewise."""
        out, single = np.empty((*place.shape, axes.shape[1])), place >= len(along)
        out[~single], out[single] = along[place[~single]], axes[place[single] - len(along)]
        return out

    def of_blocks(self, products: Floats, places: Ints) -> Floats:
        """(t,q,q) of terms with columns at ``places`` (t,q), of one block each,
        by the products in the blocks."""
        place, factor = self.place[places], self.factor[places]
        scale = factor[:, :, None] * factor[:, None]
        return np.asarray(products[place[:, :, None], self.within_block[place][:, None]] * scale)


class WeightedColumns:
    """Of columns the products by the ``weight`` (N,) of the rows. Every set of
    a diagnosis asks for the same terms, so answers are kept."""

    def __init__(self, columns: TermColumns, weight: Floats) -> None:
        self.columns, self.weight = columns, weight
        self._rows: dict[int, Floats] = {}
        self._among: dict[bytes, Floats] = {}

    @cached_property
    def block_products(self) -> Floats:
        """(D+N,p) as `TermColumns.block_products`."""
        base = self.columns.base
        out = np.zeros((sum(base.shape), max((b.shape[1] for b in self.columns.blocks), default=0)))
        for block in self.columns.blocks:
            dense, single = block[block[:, 0] < base.shape[1]], block[block[:, 0] >= base.shape[1]]
            for own in dense:
                part = base[:, own]
                out[own, : len(own)] = part.T @ (self.weight[:, None] * part)
            out[single, np.arange(single.shape[1])] = self.weight[single - base.shape[1]]
        return out

    def with_all(self, place: Ints) -> Floats:
        """(q,D+N) of those at these places with all."""
        new = np.array([p for p in dict.fromkeys(place.tolist()) if p not in self._rows], dtype=np.int64)
        if len(new):
            products = self.columns.against(self.weight[:, None] * self.columns.unscaled(new))
            self._rows.update(zip(new.tolist(), products.T.copy(), strict=True))
        return np.array([self._rows[p] for p in place.tolist()]).reshape(len(place), sum(self.columns.base.shape))

    def among(self, places: Ints) -> Floats:
        """(q,q) of some terms' columns."""
        key = places.tobytes()
        if key not in self._among:
            own = self.columns.at(places)
            self._among[key] = own.T @ (self.weight[:, None] * own)
        return self._among[key]
