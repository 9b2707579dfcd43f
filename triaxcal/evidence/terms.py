"""What a hypothesis is made of: effects, each in one form, on some axes, with
one shape; poses that are outliers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from triaxcal.arrays import Floats, Ints, evenly_spread
from triaxcal.effects.catalogue import EffectFault, is_plugin
from triaxcal.effects.contract import SINCE_START, TIME, Effect
from triaxcal.effects.odds import AXES, on_axes
from triaxcal.errors import Refused
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.model.directions import spiral
from triaxcal.poses.covariates import static_covariates

# The columns of all terms. Terms of one effect and shape, on these axes or on
# those, have columns in common; an outlier's have one entry each. So none stands
# there twice, and none is longer than it has to be.


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


FEWEST = 4
"""Poses that another unit or mounting has at least: fewer are outliers."""
CHANGE_POINTS = 100
"""At most, evenly spread over the poses. Of more poses, those about the
likeliest are looked at afterwards."""
SPHERE = 48
"""Directions over which the size of an effect is reckoned."""
SIZE_POSES = 200
"""Poses, evenly spread over all, over whose covariates it is reckoned."""
NOTHING_G = 1e-12
"""A coefficient that makes less than this makes nothing but rounding: no term
is scaled by it."""
ABSORBED = 1e-6
"""Of a term's columns: what the nine parameters leave no more of is theirs, to
rounding."""


@dataclass(frozen=True, eq=False)
class Term:
    """``columns`` (N,q) are scaled to coefficients of size one, so that ρ times them
    has the rms ρ; ``combination`` (q,) are the scale factors. ``kind`` is equal for
    terms that exclude each other; ``pose`` is the outlier's, or −1; ``change_point``
    is the first pose of another unit or mounting, or −1; ``kept`` are the free
    coefficients of the ``effect``."""

    name: str
    kind: str
    columns: ScaledColumns
    combination: Floats
    log_prior: float
    effect: Effect | None = None
    kept: tuple[int, ...] = ()
    pose: int = -1
    change_point: int = -1

    @property
    def rank(self) -> int:
        return self.columns.rank


Variant = tuple[str, tuple[str, ...], tuple[float, ...]]
"""An effect's name, coefficients and shape: foreign effects need not be equal
to themselves."""
Finer = Mapping[Variant, Sequence[Effect]]
"""Variants that share the prior of the one whose place they take, among which
it stands itself."""


def variant_of(effect: Effect) -> Variant:
    return effect.name, tuple(c.name for c in effect.coefficients), tuple(v for v, _ in effect.shape.values())


def terms_of(
    rows: LinearisedData, catalogue: Sequence[Effect], odds: Odds, finer: Sequence[Finer] = (), near: int | None = None
) -> list[Term]:
    """Every form, shape and choice of axes of every effect that can act in these
    poses, every pose as an outlier, and the poses of `change_points` as the first of
    another unit or mounting. ``finer`` are successive divisions of shapes."""
    still = static_covariates(rows.poses)
    known = rows.problem.channel_reference
    if not np.ptp(rows.t_s) > 0:  # means whose times nobody knows
        still = still | {TIME, SINCE_START}
    able = [e for e in catalogue if all(name in known and name not in still for name in e.needs)]
    share = {e.name: float(np.log(odds.of_effect(e.name, len(able)))) for e in able}
    terms = [term for effect in able for term in _of_effect(rows, effect, share[effect.name], odds, finer)]
    return [*terms, *(_outlier(rows, i, odds) for i in range(rows.n)), *_another(rows, odds, near)]


def faults_of(rows: LinearisedData, catalogue: Sequence[Effect]) -> dict[str, str]:
    """Effects of other packages that cannot be used in these poses, though they
    could be loaded: name → reason."""
    found = {}
    known, covariates = rows.problem.channel_reference, rows.problem.covariates
    s = rows.state.sensor(rows.problem).along_axes(rows.problem.u, covariates)
    for effect in catalogue:
        if is_plugin(effect) and all(n in known for n in effect.needs):
            try:
                for variant in effect.variants(covariates):
                    variant.basis(s, covariates)
                    variant.slope(s, covariates)
                    rows.by_coefficients(variant)
            except EffectFault as e:
                found[effect.name] = e.reason
    return found


def _of_effect(
    rows: LinearisedData, effect: Effect, share: float, odds: Odds, finer: Sequence[Finer]
) -> Iterator[Term]:
    try:
        variants = effect.variants(rows.problem.covariates)
    except (EffectFault, Refused):
        return
    forms: dict[tuple[str, ...], list[Effect]] = defaultdict(list)
    for variant in variants:
        forms[tuple(c.name for c in variant.coefficients)].append(variant)
    for shapes in forms.values():
        chosen = list(on_axes([c.part for c in shapes[0].coefficients], odds.on_one_axis, odds.on_two_axes))
        for shape, of_shape in _divided(shapes, finer):
            made = _columns(rows, shape)
            if made is None:
                continue
            columns, size = made
            for kept, of_axes in chosen:
                index = list(kept)
                if (size[index] < NOTHING_G).any():
                    continue
                combination = 1 / (size[index] * np.sqrt(len(index)))
                own = columns[:, index] * combination
                if np.linalg.norm(rows.beyond_linear(own)) < ABSORBED * np.linalg.norm(own):
                    continue
                prior = share + np.log(of_axes * of_shape / len(forms))
                scaled = ScaledColumns(columns, np.array(index), combination, len(columns))
                yield Term(effect.name, effect.name, scaled, combination, prior, shape, kept)


def _divided(shapes: Sequence[Effect], finer: Sequence[Finer]) -> list[tuple[Effect, float]]:
    """The variants, with their shares of the prior."""
    out = [(shape, 1 / len(shapes)) for shape in shapes]
    for division in finer:
        each = [(division.get(variant_of(shape), (shape,)), share) for shape, share in out]
        out = [(shape, share / len(ones)) for ones, share in each for shape in ones]
    return out


def _columns(rows: LinearisedData, effect: Effect) -> tuple[Floats, Floats] | None:
    """Derivatives of the rows by the coefficients (N,p), and the size of each (p,):
    rms contribution of a unit coefficient over the sphere and the poses' covariates,
    about its mean over these. Coefficients of one part and unit in a function of the
    force alone are equally probable a priori and share the rms of their sizes, as
    they may look the same in |a|. None where it cannot be determined."""
    try:
        columns = rows.by_coefficients(effect)
        covariates = rows.problem.covariates
        if is_plugin(effect):  # it may not know its slope
            effect.slope(rows.state.sensor(rows.problem).along_axes(rows.problem.u, covariates), covariates)
        up, some = spiral(SPHERE) * rows.problem.reference, evenly_spread(np.arange(rows.n), SIZE_POSES)
        every: Mapping[str, Floats] = {name: np.repeat(values[some], len(up)) for name, values in covariates.items()}
        basis = effect.basis(np.tile(up, (len(some), 1)), every).reshape(len(some), len(up), AXES, -1)
    except (EffectFault, Refused):
        return None
    if not (np.isfinite(columns).all() and np.isfinite(basis).all()):
        return None
    if effect.needs:
        basis = basis - basis.mean(axis=0, keepdims=True)
    square = np.mean(np.sum(basis**2, axis=2), axis=(0, 1))
    if not effect.needs:
        alike = [(c.part, c.unit) for c in effect.coefficients]
        square = np.array([np.mean([square[k] for k, other in enumerate(alike) if other == one]) for one in alike])
    return columns, np.sqrt(square)


def _outlier(rows: LinearisedData, pose: int, odds: Odds) -> Term:
    """A term for an outlying mean, and slope, of one pose."""
    own = np.array([pose, rows.n + pose] if rows.slopes else [pose])
    combination = np.full(len(own), 1 / np.sqrt(len(own)))
    columns = ScaledColumns(None, own, combination / rows.error[own], len(rows.y))
    return Term("", f"outlier {pose}", columns, combination, float(np.log(odds.outlier_odds)), pose=pose)


def change_points(n: int) -> Ints:
    """Numbers of poses before each change point of the grid."""
    return evenly_spread(np.arange(FEWEST, n - FEWEST + 1), CHANGE_POINTS)


def _change_points(n: int, near: int | None) -> Mapping[int, int]:
    """Change points, each with the number of those that would share the prior
    if all were like it. Those between the neighbours of the one that is
    ``near`` have its share together."""
    coarse = change_points(n).tolist()
    out = dict.fromkeys(coarse, len(coarse))
    if near is not None:
        at = coarse.index(near)
        before = coarse[at - 1] if at else near - 1
        after = coarse[at + 1] if at + 1 < len(coarse) else near + 1
        out |= dict.fromkeys(range(before + 1, after), len(coarse) * (after - before - 1))
    return out


def _another(rows: LinearisedData, odds: Odds, near: int | None) -> Iterator[Term]:
    """Terms with other values of all nine parameters from a pose on: another unit, or
    exchanged channels."""
    order = rows.order
    size = np.sqrt(np.mean((rows.linear[: rows.n] * rows.error[: rows.n, None]) ** 2, axis=0))
    combination = 1 / (np.maximum(size, NOTHING_G) * np.sqrt(len(size)))
    for cut, sharing in _change_points(rows.n, near).items():
        late = np.zeros(rows.n, dtype=bool)
        late[order[cut:]] = True
        source = rows.linear * np.resize(late, len(rows.y))[:, None]
        columns = ScaledColumns(source, np.arange(len(combination)), combination, len(source))
        prior = float(np.log(odds.change_point_odds / sharing))
        yield Term("", "another", columns, combination, prior, change_point=int(order[cut]))
