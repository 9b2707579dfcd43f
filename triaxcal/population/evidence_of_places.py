"""All hypotheses of one more effect of a place, given the others: the data that these
leave, and the evidence of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.distributions import chi2_ppf, log_sum_exp
from triaxcal.population.figures import TAILS, FigureKind, Standardised
from triaxcal.population.hypotheses import (
    COMMON_FACTOR,
    EFFICIENCY,
    SEVERAL,
    THERMOMETER,
    TINY,
    Family,
    Form,
    Posterior,
    SingleEffect,
    coefficients_of,
    in_robust_spreads,
    log_evidence,
    log_t_ratio,
    mean_of_levels,
    t_weight,
    with_spread_estimated,
)
from triaxcal.population.places import FEWEST, Sums, TimeGrid
from triaxcal.population.runs import COEFFICIENTS, UnitRun

if TYPE_CHECKING:
    from triaxcal.population.single_effects import Search

NEIGHBOURS = 4
"""Runs before and after in one place, whose median tells a shifted place from an
outlier."""


OUTLYING = 2.5
"""Spreads from which on this is asked."""


SCATTERING = 12
"""Runs that show more scatter: a standard deviation of so many is known to a
fifth."""


LARGEST_FACTOR = 30.0
"""Of scatter: beyond it units are broken."""


LISTED_RUNS = 10
"""Runs of one unit of which all pairs are listed; of more, a golden unit's say, those
of neighbours."""


class Level:
    """All hypotheses of one more effect, given others."""

    def __init__(
        self, search: Search, given: Sequence[SingleEffect], grid: TimeGrid, own: SingleEffect | None = None
    ) -> None:
        """``own`` is the effect as it was before, if it is looked at again: a run is an
        outlier by what all effects leave."""
        self.search, self.given, self.grid, self.own = search, given, grid, own
        self.sums = [Sums(places, grid) for places in search.places]
        self.share_of_kinds = -np.log(max(len(self.sums), 1))

    def _allowed(self, sums: Sums, known: Bools) -> Floats:
        """(n,w) log priors of places and windows, −∞ where too few runs are in it, or
        outside, of which the figure is ``known`` (N,)."""
        known = np.asarray(known, dtype=float)
        count = known / self.search.count
        inside = sums.by_window(sums.by_cell(np.stack([known, count], axis=1)))
        total = np.array([known.sum(), count.sum()])
        enough = (inside[..., 0] >= FEWEST) & (inside[..., 1] >= UNITS)
        enough &= (total[0] - inside[..., 0] >= FEWEST) & (total[1] - inside[..., 1] >= UNITS)
        prior = self.grid.windows.log_prior - np.log(len(sums.places.names))
        return np.where(enough, prior, -np.inf)

    def _allowed_ramps(self, sums: Sums, known: Bools, allowed: Floats) -> Floats:
        """(n,k) log priors of places and ramps, −∞ where no window of the place is
        ``allowed`` (n,w), or where too few runs carry the ramp: those after its begin,
        and their effective number (Σw)²/Σw², as the last ones count most."""
        known = np.asarray(known, dtype=float)
        cells = sums.by_cell(np.stack([known, known / self.search.count], axis=1))
        least = np.array([FEWEST, UNITS])
        carried = sums.by_ramp(cells) ** 2 / np.maximum(sums.by_ramp(cells, 2), TINY)
        enough = (sums.after_begin(cells) >= least).all(axis=-1) & (carried >= least).all(axis=-1)
        some = np.asarray(np.isfinite(allowed).any(axis=1, keepdims=True))
        return np.where(enough & some, self.grid.ramps[1] - np.log(len(sums.places.names)), -np.inf)

    # The data of one group, given the other effects.

    def residual(self, g: int) -> tuple[Floats, Floats]:
        """(N,d) of the components, and their precisions."""
        group, left = self.search.groups[g], self._left(g)
        scale = np.ones_like(left)
        for effect in self.given:
            if g in effect.scale:
                scale = scale * effect.scale[g][0]
        weight = group.weight / scale**2
        rest = left if self.own is None else left - self.own.added.get(g, 0.0)
        r = self._centred(rest, weight) * np.sqrt(weight)
        robust = self._robust(r, weight)
        if self.own is not None:
            # An effect that a few broken units make would explain these.
            robust = np.minimum(robust, self._robust(self._centred(left, weight) * np.sqrt(weight), weight))
        # The variance of the score is the information.
        used = weight > 0
        square = np.sum(np.where(used, robust**2 * np.minimum(r, 4.0).clip(-4.0) ** 2, 0.0), axis=0)
        calibrated = np.sum(np.where(used, robust, 0.0), axis=0) / np.maximum(square, 1e-12)
        weight = weight * robust * np.clip(calibrated, 0.3, 1.2)
        return self._centred(left, weight), weight

    def _robust(self, r: Floats, weight: Floats) -> Floats:
        """(N,d) weights of outliers among deviations ``r`` (N,d) in spreads; none is
        one that its neighbours in a place share."""
        robust, far = t_weight(r), (np.abs(r) > OUTLYING) & (weight > 0)
        if far.any():
            robust[far] = np.maximum(robust[far], t_weight(self._from_neighbours(r, weight > 0, far)))
        return robust

    def log_likelihood(self, g: int) -> float:
        """Of what the effects leave, with Student's t."""
        left, scale = self._left(g), np.ones((1, 1))
        weight = self.search.groups[g].weight
        for effect in self.given:
            if g in effect.scale:
                scale = scale * effect.scale[g][0]
        r = self._centred(left, weight / scale**2) * np.sqrt(weight) / scale
        each = -0.5 * (TAILS + 1) * np.log1p(r**2 / TAILS) - np.log(scale)
        return float(np.sum(np.where(weight > 0, each, 0.0)))

    def _left(self, g: int) -> Floats:
        """(N,d) of the components what the other effects leave."""
        added = (effect.added[g] for effect in self.given if g in effect.added)
        return np.asarray(self.search.groups[g].z - sum(added, np.zeros(1)))

    def _centred(self, left: Floats, weight: Floats) -> Floats:
        out = left.copy()
        for t in range(int(self.search.part.max()) + 1):
            mine = self.search.part == t
            total = weight[mine].sum(axis=0)
            out[mine] -= np.sum(weight[mine] * left[mine], axis=0) / np.where(total > 0, total, 1.0)
        return out

    def _from_neighbours(self, r: Floats, known: Bools, far: Bools) -> Floats:
        """Smallest distance of each ``far`` value from the median of its neighbours in
        time, over the kinds of places."""
        row, column = np.nonzero(far)
        smallest = np.abs(r[far])
        for places in self.search.places:
            order = np.argsort(places.label, kind="stable")
            rank = np.empty(len(order), dtype=np.int64)
            rank[order] = np.arange(len(order))
            offset = np.array([k for k in range(-NEIGHBOURS, NEIGHBOURS + 1) if k])
            beside = np.clip(rank[row][:, None] + offset, 0, len(order) - 1)
            neighbour = order[beside]
            same = (places.label[neighbour] == places.label[row][:, None]) & (places.label[row] >= 0)[:, None]
            same &= known[neighbour, column[:, None]] & (neighbour != row[:, None])
            enough = same.sum(axis=1) >= NEIGHBOURS
            if enough.any():
                values = np.where(same, r[neighbour, column[:, None]], np.nan)[enough]
                smallest[enough] = np.minimum(smallest[enough], np.abs(r[far][enough] - np.nanmedian(values, axis=1)))
        return smallest

    # All hypotheses.

    def of(self, subject: int | str) -> Iterator[Family]:
        """The hypotheses of a group of figures, or of the frequency of an effect."""
        prior = self.search.prior
        start = np.log(prior.odds) + self.share_of_kinds
        if isinstance(subject, str):
            start += np.log(prior.forms[Form.FREQUENCY]) - np.log(len(self.search.likelihood))
            yield from self._frequency(subject, start)
            return
        start -= np.log(len(self.search.groups))
        left, weight = self.residual(subject)
        families = [
            *self._means(subject, left, weight, start),
            *self._scatter(subject, self._left(subject), start + np.log(prior.forms[Form.SCATTER])),
        ]
        if subject in self.search.of_residuals:
            families = [self._without_places_taken(family) for family in families]
        known = (self.search.groups[subject].weight > 0).any(axis=1).sum()
        yield from with_spread_estimated(families, EFFICIENCY * float(known))

    def _without_places_taken(self, family: Family) -> Family:
        """A place has one pattern of residuals and one scatter of them: further ones
        would be the rest of the first."""
        log = family.log
        for effect in self.given:
            best, place, _ = effect.posterior.best()
            alike = (best.form is Form.SCATTER) == (family.form is Form.SCATTER)
            if best.group in self.search.of_residuals and alike and best.places is family.places:
                log = log.copy()
                log[place] = -np.inf
        return replace(family, log=log)

    def _means(self, g: int, left: Floats, weight: Floats, start: float) -> Iterator[Family]:
        search, group = self.search, self.search.groups[g]
        rest = left if self.own is None else left - self.own.added.get(g, 0.0)
        precise = _Precision(search.unit, search.count, _of_units(rest, search, group.repeatability), weight)
        pull, ones = precise.times(left), precise.times(np.ones_like(left))
        pull = pull - ones * self._mean_by_part(pull, ones)
        patterns = list(_patterns(group, search.runs, search.part))
        if not search.several and group.group.kind is FigureKind.COEFFICIENTS:
            patterns = [one for one in patterns if one[0] != SEVERAL]
        known = np.asarray((group.weight > 0).any(axis=1))
        pairs, between = search._same_unit, precise.between(search._same_unit)
        for sums in self.sums:
            allowed = self._allowed(sums, known)
            score = sums.by_cell(pull)
            information, taken = sums.by_cell(precise.diagonal), self._by_part(sums, ones, ones)
            scatter = _LocalScatter(sums, left, weight, rest)
            for form in (Form.SHIFT, Form.DRIFT):
                if form is Form.SHIFT:
                    s, h = sums.by_window(score), sums.by_window(information)
                    h = h + sums.pairs_by_window(pairs, between)
                    h = h - sum(sums.by_window(part) ** 2 / total for part, total in taken)
                    spread = scatter.of_windows()
                    base = allowed
                else:
                    s, h = sums.by_ramp(score), sums.by_ramp(information, 2)
                    h = h + sums.pairs_by_ramp(pairs, between)
                    h = h - sum(sums.by_ramp(part) ** 2 / total for part, total in taken)
                    spread = scatter.of_ramps()
                    base = self._allowed_ramps(sums, known, allowed)
                h = np.maximum(h, 0.0)
                s, h = s / spread, h / spread
                prior = base + start + np.log(search.prior.forms[form]) - np.log(len(patterns))
                for name, vectors, by_run, scale in patterns:
                    if by_run:
                        if form is Form.DRIFT:
                            continue
                        own_s, own_h = self._by_run(sums, precise, pull, ones, vectors)
                        overall = spread.mean(axis=2, keepdims=True)
                        own_s, own_h = own_s / overall, own_h / overall
                    elif len(vectors) == 1:
                        own_s, own_h = s @ vectors.T, h @ vectors.T**2
                    else:
                        index = np.flatnonzero(vectors.any(axis=0))
                        own_s, own_h = s[..., index], h[..., index]
                    log = log_evidence(own_s, own_h, search.prior.sizes, scale)
                    yield Family(form, g, name, sums.places, log, prior, own_s, own_h, vectors, by_run, scale)

    def _mean_by_part(self, pull: Floats, ones: Floats) -> Floats:
        out = np.zeros_like(pull)
        for t in range(int(self.search.part.max()) + 1):
            mine = self.search.part == t
            total = ones[mine].sum(axis=0)
            out[mine] = pull[mine].sum(axis=0) / np.where(total > 0, total, 1.0)
        return out

    def _by_part(self, sums: Sums, values: Floats, ones: Floats) -> list[tuple[Floats, Floats]]:
        """By part number: sums of ``values`` by cell, and the total precision of the
        mean, which is free."""
        out = []
        for t in range(int(self.search.part.max()) + 1):
            mine = (self.search.part == t)[:, None]
            total = np.sum(ones * mine, axis=0)
            out.append((sums.by_cell(values * mine), np.where(total > 0, total, 1.0)))
        return out

    def _by_run(
        self, sums: Sums, precise: _Precision, pull: Floats, ones: Floats, vectors: Floats
    ) -> tuple[Floats, Floats]:
        """Score and information (n,w,1) of a coefficient with ``vectors`` (N,d) of
        its own for each run."""
        score = sums.by_window(sums.by_cell(np.sum(pull * vectors, axis=1, keepdims=True)))
        own = np.sum(precise.diagonal * vectors**2, axis=1, keepdims=True)
        information = sums.by_window(sums.by_cell(own))
        pairs = self.search._same_unit
        product = vectors[pairs[:, 0]] * vectors[pairs[:, 1]]
        between = np.sum(precise.between(pairs) * product, axis=1, keepdims=True)
        information = information + sums.pairs_by_window(pairs, between)
        for part, total in self._by_part(sums, ones * vectors, ones):
            information = information - np.sum(sums.by_window(part) ** 2 / total, axis=-1, keepdims=True)
        return score, np.maximum(information, 0.0)

    def _scatter(self, g: int, left: Floats, start: float) -> Iterator[Family]:
        search, group = self.search, self.search.groups[g]
        if group.group.kind is FigureKind.CONVERTER:  # the same residuals scatter by direction
            return
        factors = np.array(search.prior.factors)
        alone = group.group.figures if group.group.alone else ()
        prior = start - np.log(max(len(alone) + (len(group.mix) > 1), 1))
        of = dict(self._scatter_of_each(g, left, factors))
        known = np.asarray((group.weight > 0).any(axis=1))
        for sums in self.sums:
            allowed = self._allowed(sums, known)
            runs = sums.by_window(sums.by_cell(known[:, None].astype(float)))[..., 0]
            base = np.where(runs >= SCATTERING, allowed + prior, -np.inf)
            for name, gain in of.items():
                levels = sums.by_window(sums.by_cell(gain))
                log = mean_of_levels(levels)
                yield Family(Form.SCATTER, g, name, sums.places, log, base, levels=levels)

    def _scatter_of_each(self, g: int, left: Floats, factors: Floats) -> Iterator[tuple[str, Floats]]:
        """(N,l) log density of each run with each factor against without, of each
        figure, and of all together."""
        group = self.search.groups[g]
        figures, components = self.deviations(g, left)
        if group.group.alone:
            for k, name in enumerate(group.group.figures):
                yield name, log_t_ratio(figures[:, k] ** 2, np.isfinite(figures[:, k]), factors)
        if components.shape[1] > 1:
            d = np.isfinite(components).sum(axis=1)
            square = np.nansum(components**2, axis=1)
            # Components that are not independent count as fewer.
            known = d == d.max()
            middle, spread = (
                np.median(square[known]),
                1.4826 * np.median(np.abs(square[known] - np.median(square[known]))),
            )
            independent = float(np.clip(2 * middle**2 / max(spread**2, 1e-12), 1.0, d.max()))
            share = independent / d.max()
            square = square / max(middle, 1e-12) * float(chi2_ppf(0.5, independent))
            yield SEVERAL, log_t_ratio(square, d > 0, factors, d * share)

    def deviations(self, g: int, left: Floats) -> tuple[Floats, Floats]:
        """Figures (N,f) and components (N,d) about their medians, in robust standard
        deviations, without the scatter of the other effects; NaN where a run has
        none."""
        group = self.search.groups[g]
        known = group.weight > 0
        components = np.where(known, left * np.sqrt(np.where(known, group.weight, 1.0)), np.nan)
        figures = (
            np.where(known.all(axis=1, keepdims=True), left @ group.back.T, np.nan)
            if group.group.whitened
            else components
        )
        for effect in self.given:
            if g in effect.scale:
                components, figures = components / effect.scale[g][0], figures / effect.scale[g][1]
        return in_robust_spreads(figures), in_robust_spreads(components)

    def _frequency(self, name: str, start: float) -> Iterator[Family]:
        """A share of units in the place, and a smaller one elsewhere, against one for
        all; each of the shares is as probable."""
        ratio, rates = self.search.likelihood[name][:, None], np.array(self.search.prior.rates)
        own = np.zeros((len(ratio), 1))
        for effect in self.given:
            if name in effect.rate:
                own = np.maximum(own, effect.rate[name][:, None])
        # Runs that another effect claims keep at least its share.
        within = np.log1p(np.maximum(rates, own) * (ratio - 1))
        elsewhere = np.log1p(np.where(own > 0, own, rates) * (ratio - 1))
        every = elsewhere.sum(axis=0)
        alike = log_sum_exp(every) - np.log(len(rates))
        pairs = len(rates) * (len(rates) - 1) / 2
        known = np.array([bool(run.effects) for run in self.search.runs], dtype=bool)
        for sums in self.sums:
            inside = sums.by_window(sums.by_cell(within))
            outside = every - sums.by_window(sums.by_cell(elsewhere))
            smaller = np.logaddexp.accumulate(outside, axis=2)[..., :-1]
            levels = inside[..., 1:] + smaller - np.log(pairs / (len(rates) - 1)) - alike
            prior = self._allowed(sums, known) + start
            yield Family(Form.FREQUENCY, -1, name, sums.places, prior + mean_of_levels(levels), prior, levels=levels)

    # The effect from its posterior.

    def effect(self, posterior: Posterior, finer: tuple[float, ...]) -> SingleEffect:
        search, acts = self.search, 1 - posterior.nothing
        n = len(search.runs)
        added: dict[int, Floats] = {}
        log_scale: dict[int, tuple[Floats, Floats]] = {}
        rate: dict[str, Floats] = {}
        for family, place, window, p in posterior.likely():
            share = self._in_time(family, place, window) * (p * acts)
            if family.form in (Form.SHIFT, Form.DRIFT):
                assert family.score is not None
                assert family.information is not None
                assert family.vectors is not None
                mean, _ = coefficients_of(
                    family.score[place, window], family.information[place, window], search.prior.sizes, family.scale
                )
                group = search.groups[family.group]
                to = added.setdefault(family.group, np.zeros((n, len(group.mix))))
                to += share[:, None] * (family.vectors * mean if family.by_run else mean @ family.vectors)
                continue
            assert family.levels is not None
            weight = np.exp(family.levels[place, window] - log_sum_exp(family.levels[place, window]))
            if family.form is Form.FREQUENCY:
                own = rate.setdefault(family.pattern, np.zeros(n))
                own += share * float(weight @ np.array(search.prior.rates[1:]))
                continue
            group = search.groups[family.group]
            factor = self.factor(family, place, window)
            of_components, of_figures = np.full(len(group.mix), factor), np.full(len(group.back), factor)
            if family.pattern != SEVERAL:
                k = group.group.figures.index(family.pattern)
                of_components = np.sqrt(1 + (factor**2 - 1) * group.mix[:, k] ** 2)
                of_figures = np.where(np.arange(len(group.back)) == k, factor, 1.0)
            sizes = log_scale.setdefault(family.group, (np.zeros((n, len(group.mix))), np.zeros((n, len(group.back)))))
            sizes[0][:] += share[:, None] * np.log(of_components)
            sizes[1][:] += share[:, None] * np.log(of_figures)
        self._take_all_residuals(posterior, added, acts)
        scale = {g: (np.exp(a), np.exp(b)) for g, (a, b) in log_scale.items()}
        best, place, window = posterior.best()
        if best.form is not Form.SCATTER:
            return SingleEffect(posterior, added, scale, rate, finer)
        factor = self.factor(best, place, window)
        # The median of squares is known to 1.17 / √n of it, its root to half of that.
        error = factor * 1.17 / np.sqrt(max(float(self._in_time(best, place, window).sum()), 1.0))
        return SingleEffect(posterior, added, scale, rate, finer, factor=factor, factor_error=float(error))

    def _take_all_residuals(self, posterior: Posterior, added: dict[int, Floats], acts: float) -> None:
        """A pattern of residuals at a place is one effect, whatever else it looks like:
        all that the residuals do in that place and time is taken off with it."""
        of_residuals = self.search.of_residuals
        likely = [
            (p * acts, self._in_time(family, place, window))
            for family, place, window, p in posterior.likely()
            if family.group in of_residuals and family.form in (Form.SHIFT, Form.DRIFT)
        ]
        for g in of_residuals if likely else ():
            left = self._left(g)
            shifts = [p * inside[:, None] * self._shift_of_all(g, left, inside) for p, inside in likely]
            added[g] = np.sum(shifts, axis=0)

    def _shift_of_all(self, g: int, left: Floats, inside: Floats) -> Floats:
        """(d,) least squares on a place (N,), with a free mean, without outliers."""
        weight, shift = self.search.groups[g].weight, np.zeros(left.shape[1])
        for _ in range(3):
            total = np.maximum(weight.sum(axis=0), TINY)
            about = inside[:, None] - (weight * inside[:, None]).sum(axis=0) / total
            centred = left - (weight * left).sum(axis=0) / total
            shift = (weight * about * centred).sum(axis=0) / np.maximum((weight * about**2).sum(axis=0), TINY)
            weight = self.search.groups[g].weight * t_weight(centred - about * shift)
        return np.asarray(shift)

    def factor(self, family: Family, place: int, window: int) -> float:
        """The factor of more scatter: the median of the squares inside over that
        outside."""
        figures, components = self.deviations(family.group, self._left(family.group))
        group = self.search.groups[family.group]
        if family.pattern == SEVERAL:
            square = np.nansum(components**2, axis=1)
        else:
            square = figures[:, group.group.figures.index(family.pattern)] ** 2
        inside = self._in_time(family, place, window) > 0
        known = np.isfinite(square)
        ratio = np.median(square[inside & known]) / max(np.median(square[~inside & known]), 1e-12)
        return float(np.clip(np.sqrt(ratio), 1.0, LARGEST_FACTOR))

    def _in_time(self, family: Family, place: int, window: int) -> Floats:
        """(N,) 1 in the place and window, the ramp of a drift, else 0."""
        inside = family.places.inside(place).astype(float)
        if family.form is Form.DRIFT:
            return np.asarray(inside * self.grid.ramps[0][window][self.grid.cell])
        first, end = self.grid.windows.first[window], self.grid.windows.end[window]
        return np.asarray(inside * ((self.grid.cell >= first) & (self.grid.cell < end)))


class _LocalScatter:
    """Variance of runs over that of all, from 1 on: where they scatter more, a
    difference is less certain (Welch 1947, Biometrika 34:28)."""

    def __init__(self, sums: Sums, left: Floats, weight: Floats, rest: Floats) -> None:
        """``left`` (N,d) with its ``weight`` (N,d), and the ``rest`` that all effects
        leave."""
        self.sums = sums
        known = (weight > 0).astype(float)
        moments = (known, weight, weight * left, weight * left**2)
        self.cells = [sums.by_cell(moment) for moment in moments]
        self.whole = [moment.sum(axis=0) for moment in moments]
        centre = (weight * rest).sum(axis=0) / np.maximum(weight.sum(axis=0), TINY)
        self.usual = (weight * (rest - centre) ** 2).sum(axis=0) / np.maximum(known.sum(axis=0), 1.0)

    def _variance(self, n: Floats, weight: Floats, first: Floats, second: Floats) -> Floats:
        return np.asarray((second - first**2 / np.maximum(weight, TINY)) / np.maximum(n * self.usual, TINY))

    def of_windows(self) -> Floats:
        """(n,w,d) of the difference between a place and time, and the rest."""
        inside = [self.sums.by_window(cells) for cells in self.cells]
        outside = [whole - own for whole, own in zip(self.whole, inside, strict=True)]
        share = inside[0] / np.maximum(self.whole[0], 1.0)
        both = self._variance(*inside) * (1 - share) + self._variance(*outside) * share
        return np.asarray(np.maximum(both, 1.0))

    def of_ramps(self) -> Floats:
        """(n,k,d) about a straight line after each ramp's beginning."""
        n, weight, first, second = (cells.sum(axis=1)[:, None] for cells in self.cells)
        ramp, square, product = (
            self.sums.by_ramp(self.cells[1]),
            self.sums.by_ramp(self.cells[1], 2),
            self.sums.by_ramp(self.cells[2]),
        )
        weight = np.maximum(weight, TINY)
        along = (product - first * ramp / weight) ** 2 / np.maximum(square - ramp**2 / weight, TINY)
        return np.maximum(self._variance(n, weight, first, second - along), 1.0)


UNITS = 3.0
"""Different units in a place and time, and outside; a unit that is measured m times
counts as one m-th."""


def _of_units(left: Floats, search: Search, repeatability: Floats) -> Floats:
    """(N,d) share of the variance that runs of a unit differ by: ``repeatability``
    (d,), or what they do differ by where that is far more."""
    out = np.tile(repeatability, (len(left), 1))
    if (search.count > 1).any():
        units = int(search.unit.max()) + 1
        total, square = np.zeros((2, units, left.shape[1]))
        np.add.at(total, search.unit, left)
        mean = total[search.unit] / search.count[:, None]
        np.add.at(square, search.unit, (left - mean) ** 2)
        variance = (square[search.unit]) / np.maximum(search.count - 1, 1)[:, None]
        out = np.where(variance > TAILS * out, np.clip(variance, out, 1.0), out)
    return out


@dataclass(frozen=True, eq=False)
class _Precision:
    """Runs of one unit share what is the unit's: with the share λ of ``repeatability``
    (N,d) their covariance is W^−½ ((1 − λ) 1 1ᵀ + λ I) W^−½, with ``weight`` W
    (N,d)."""

    unit: Ints
    count: Ints
    repeatability: Floats
    weight: Floats

    @cached_property
    def _common(self) -> Floats:
        """(N,d) the κ of the inverse (I − κ 1 1ᵀ) / λ."""
        m = self.count[:, None]
        return (1 - self.repeatability) / (self.repeatability + m * (1 - self.repeatability))

    def times(self, values: Floats) -> Floats:
        root = np.sqrt(self.weight)
        scaled = root * values
        if (self.count == 1).all():
            return root * scaled
        total = np.zeros((int(self.unit.max()) + 1, values.shape[1]))
        np.add.at(total, self.unit, scaled)
        return np.asarray(root * (scaled - self._common * total[self.unit]) / self.repeatability)

    @cached_property
    def diagonal(self) -> Floats:
        if (self.count == 1).all():
            return self.weight
        return np.asarray(self.weight * (1 - self._common) / self.repeatability)

    def between(self, pairs: Ints) -> Floats:
        """(p,d) twice the element of each of the ``pairs`` (p,2) of runs of one
        unit."""
        first, second = pairs.T
        m = self.count[first]
        # Of many runs only neighbours are listed: each stands for all of its pairs.
        stands_for = np.where(m <= LISTED_RUNS, 1.0, m / 2)[:, None]
        root = np.sqrt(self.weight[first] * self.weight[second])
        return np.asarray(-2 * root * self._common[first] / self.repeatability[first] * stands_for)


def _patterns(group: Standardised, runs: Sequence[UnitRun], part: Ints) -> Iterator[tuple[str, Floats, bool, float]]:
    """Name, vectors, whether these are by run, and the size of a coefficient that
    makes one spread."""
    d = len(group.mix)
    if group.group.alone:
        for k, name in enumerate(group.group.figures):
            yield name, group.mix[:, k][None], False, 1.0
    if group.group.kind is FigureKind.CONVERTER:
        for k in range(0, d, 2):  # sine and cosine of one period
            vectors = np.zeros((2, d))
            vectors[0, k] = vectors[1, k + 1] = 1.0
            yield group.group.figures[k].removesuffix(" sine"), vectors, False, 1.0
    elif d > 1:
        yield SEVERAL, np.eye(d), False, 1.0
    if group.group.kind is FigureKind.COEFFICIENTS:
        factor = np.zeros((len(runs), len(COEFFICIENTS)))
        factor[:, :3] = 1.0
        for name, shifts in ((COMMON_FACTOR, factor), (THERMOMETER, _by_temperature(runs))):
            vectors = (shifts / group.spread[part]) @ group.mix.T
            typical = float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
            if typical > 0:
                yield name, vectors, True, 1 / typical


def _by_temperature(runs: Sequence[UnitRun]) -> Floats:
    """(N,9) what a thermometer that reads 1 K too high does to the coefficients at the
    reference temperature: minus each unit's coefficients of temperature."""
    out = np.zeros((len(runs), len(COEFFICIENTS)))
    for i, run in enumerate(runs):
        for name, first in (("temperature_scale_factor", 0), ("temperature_bias", 6)):
            seen = run.effects.get(name)
            for k, axis in enumerate("xyz"):
                if seen is not None and axis in seen.coefficients:
                    out[i, first + k] = -seen.coefficients[axis][0]
    return out
