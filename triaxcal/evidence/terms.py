"""What a hypothesis is made of: effects, each in one form, on some axes, with
one shape; poses that are outliers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints, evenly_spread
from triaxcal.effects.contract import SINCE_START, TIME, Effect
from triaxcal.effects.odds import AXES, on_axes
from triaxcal.effects.plugins import EffectFault, is_foreign
from triaxcal.errors import Refused
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.term_columns import ScaledColumns
from triaxcal.model.directions import spiral
from triaxcal.poses.covariates import static_covariates

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
    """``columns`` (N,q) are those of coefficients of size one, so that ρ times
    them has the rms ρ; ``combination`` (q,) what they were multiplied by.
    ``kind`` is the same for terms that exclude each other; ``pose`` is the
    outlier's, or −1; ``change_point`` is the pose from which on there is
    another unit or mounting, or −1; ``kept`` are those coefficients of the
    ``effect`` that are free."""

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
    """Every form, shape and choice of axes of every effect that can act in
    these poses, every pose as an outlier, and the poses of `change_points` as
    the first of another unit or mounting. ``finer`` are divisions of shapes,
    one after the other."""
    still = static_covariates(rows.poses)
    known = rows.problem.channel_reference
    if not np.ptp(rows.t_s) > 0:  # means whose times nobody knows
        still = still | {TIME, SINCE_START}
    able = [e for e in catalogue if all(name in known and name not in still for name in e.needs)]
    share = np.log(odds.effect_odds / max(len(able), 1))
    terms = [term for effect in able for term in _of_effect(rows, effect, share, odds, finer)]
    return [*terms, *(_outlier(rows, i, odds) for i in range(rows.n)), *_another(rows, odds, near)]


def faults_of(rows: LinearisedData, catalogue: Sequence[Effect]) -> dict[str, str]:
    """Effects of other packages that cannot be used in these poses, though they
    could be loaded: name → reason."""
    found = {}
    known, covariates = rows.problem.channel_reference, rows.problem.covariates
    s = rows.state.sensor(rows.problem).along_axes(rows.problem.u, covariates)
    for effect in catalogue:
        if is_foreign(effect) and all(n in known for n in effect.needs):
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
    """The variants, and with which share of the prior."""
    out = [(shape, 1 / len(shapes)) for shape in shapes]
    for division in finer:
        each = [(division.get(variant_of(shape), (shape,)), share) for shape, share in out]
        out = [(shape, share / len(ones)) for ones, share in each for shape in ones]
    return out


def _columns(rows: LinearisedData, effect: Effect) -> tuple[Floats, Floats] | None:
    """Derivatives of the rows by the coefficients (N,p), and the size of each
    (p,): the rms of what a coefficient of one adds over the sphere and over the
    poses' covariates, about its mean over these. Of one part of a function of
    the force alone, coefficients in one unit are equally probable before the
    poses are seen, and so have the rms of their sizes: they may look the same
    in |a|. None where it cannot be determined."""
    try:
        columns = rows.by_coefficients(effect)
        covariates = rows.problem.covariates
        if is_foreign(effect):  # it may not know its slope
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
    """Its mean is off, and its slope with it."""
    own = np.array([pose, rows.n + pose] if rows.slopes else [pose])
    combination = np.full(len(own), 1 / np.sqrt(len(own)))
    columns = ScaledColumns(None, own, combination / rows.error[own], len(rows.y))
    return Term("", f"outlier {pose}", columns, combination, float(np.log(odds.outlier_odds)), pose=pose)


def change_points(n: int) -> Ints:
    """How many of n poses are before each change that is looked at."""
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
    """From a pose on all nine parameters are others: another unit, channels
    that were exchanged."""
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
