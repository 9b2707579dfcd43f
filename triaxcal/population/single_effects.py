"""The search for effects of places: a sum of single effects, each with its posterior
over forms, figures, places and times."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from triaxcal.arrays import Floats, Ints, evenly_spread
from triaxcal.distributions import log_sum_exp
from triaxcal.effects.catalogue import CATALOGUE
from triaxcal.effects.odds import EFFECT_ODDS
from triaxcal.population.evidence_of_places import LISTED_RUNS, Level
from triaxcal.population.figures import FigureKind, Standardised, groups_of, standardised
from triaxcal.population.hypotheses import (
    NEGLIGIBLE,
    SEVERAL,
    UNIT_OF_RUNS,
    Family,
    Form,
    PlacePrior,
    Posterior,
    SingleEffect,
    coefficients_of,
)
from triaxcal.population.places import FEWEST, TimeGrid, places_of
from triaxcal.population.runs import UnitRun

UNKNOWN_LIKELY, UNLISTED = 0.5, 0.05
"""Probability of an effect that is likely and not calibrated; and likelihood ratio of
one that a run does not list."""


SWEEPS, MORE_SWEEPS = 1, 8
"""Passes over all single effects after a further one, and at most in the end: each
changes them less, by half where two overlap in time."""


SIMPLE = 4
"""Most effects that are looked for in place of one of several coefficients."""


FINER = 10
"""Moments between which a change point is looked for again."""


class Search:
    """Runs by time, their places, and groups of figures in spreads."""

    def __init__(self, runs: Sequence[UnitRun], prior: PlacePrior) -> None:
        self.runs, self.prior = runs, prior
        self.time = np.array([run.time_s for run in runs], dtype=float)
        self.places = places_of(runs)
        names = sorted({run.part_number or "" for run in runs})
        self.part = np.array([names.index(run.part_number or "") for run in runs])
        serials: dict[str, int] = {}
        self.unit = np.array([serials.setdefault(run.serial, len(serials)) for run in runs])
        self.count = np.bincount(self.unit)[self.unit]
        self._raw = groups_of(runs)
        self._followers, self._same_unit = _followers(runs, self.unit), _pairs(self.unit)
        self.likelihood = _likelihoods(runs)
        self.effects: list[SingleEffect] = []
        self.nothing = 1.0
        self._count = 0
        self.several = True
        """Whether several coefficients may shift together."""
        self._standardise({})

    @classmethod
    def of(cls, runs: Sequence[UnitRun], prior: PlacePrior) -> Search:
        return cls(runs, prior)

    def _standardise(self, fitted: Mapping[int, Floats]) -> None:
        every = [
            standardised(g, self.part, self._followers, self._same_unit, fitted.get(i)) for i, g in enumerate(self._raw)
        ]
        # Figures that do not vary between units have no spread to be measured by.
        self.groups: list[Standardised] = [g for g in every if len(g.mix)]
        self._raw = [g.group for g in self.groups]
        self.subjects: list[int | str] = [*range(len(self.groups)), *self.likelihood]
        self.of_residuals = {i for i, g in enumerate(self._raw) if g.kind in (FigureKind.CONVERTER, FigureKind.POSES)}
        """Groups that are two views of the same residuals."""
        self._cache: dict[int | str, tuple[tuple[int, ...], list[Family]]] = {}

    # The passes.

    def run(self) -> list[SingleEffect]:
        """The single effects that act more likely than not."""
        self._grow()
        if self.effects:
            # Once more with the spreads of what they leave.
            self._standardise(self._fitted())
            self.effects = []
            self._grow()
            self._simplify()
        return self.effects

    def _simplify(self) -> None:
        """A shift of several coefficients may be two effects of one coefficient each,
        at places that overlap: look for these, and keep what describes the runs with
        fewer coefficients (Schwarz 1978, Ann. Stat. 6:461)."""
        found, nothing = self.effects, self.nothing
        if not any(self._is_of_several(effect) for effect in found):
            return
        score = self._score()
        self.several, self.effects, self._cache = False, [], {}
        self._grow(SIMPLE)
        if len(self.effects) > SIMPLE or self._score() < score:
            self.effects, self.nothing = found, nothing
        self.several = True

    def _is_of_several(self, effect: SingleEffect) -> bool:
        family, _, _ = effect.posterior.best()
        return (
            family.group >= 0
            and family.pattern == SEVERAL
            and family.form in (Form.SHIFT, Form.DRIFT)
            and self.groups[family.group].group.kind is FigureKind.COEFFICIENTS
        )

    def _score(self) -> float:
        """Log likelihood of all components of the coefficients, less half the log of
        the number of runs for each coefficient, place and time."""
        level = Level(self, self.effects, TimeGrid.of(self.time))
        out = 0.0
        for g, group in enumerate(self.groups):
            if group.group.kind is FigureKind.COEFFICIENTS:
                out += level.log_likelihood(g)
        for effect in self.effects:
            family, _, _ = effect.posterior.best()
            count = 1 if family.score is None else family.score.shape[-1]
            out -= 0.5 * (count + 2) * np.log(len(self.runs))
        return out

    def _fitted(self) -> dict[int, Floats]:
        out = {}
        for g, group in enumerate(self.groups):
            z = sum(effect.added.get(g, 0.0) for effect in self.effects)
            if np.ndim(z):
                out[g] = (np.asarray(z) @ group.back.T) * group.spread[self.part]
        return out

    def _grow(self, most: int | None = None) -> None:
        for _ in range(self.prior.most if most is None else most + 1):
            count, found = len(self.effects), self._further()
            if found is None:
                break
            self.effects.append(found)
            for _ in range(SWEEPS):
                self._sweep()
            if len(self.effects) <= count:  # one that others explain
                break
        for _ in range(MORE_SWEEPS):
            before = list(self.effects)
            self._sweep()
            if self.effects == before:
                break

    def _sweep(self) -> None:
        """Each effect anew, given all others; with finer moments about its change."""
        for effect in list(self.effects):
            again = self._again(effect)
            at = self.effects.index(effect)
            if again is None:
                del self.effects[at]
            else:
                self.effects[at] = again

    def _finer(self, effect: SingleEffect) -> tuple[float, ...]:
        """Moments about those of the likeliest window, between runs of its place."""
        family, place, window = effect.posterior.best()
        grid = effect.posterior.grid
        if family.form is Form.DRIFT:
            return effect.finer
        times = np.unique(self.time[family.places.inside(place)])
        bounds = np.concatenate([[-np.inf], grid.edges, [np.inf]])
        out: list[float] = []
        for cut in (grid.windows.first[window], grid.windows.end[window]):
            if 0 < cut < grid.cells:
                near = times[(times >= bounds[cut - 1]) & (times <= bounds[cut + 1])]
                # The moment itself stays, with new ones about it.
                out += [float(bounds[cut]), *evenly_spread((near[1:] + near[:-1]) / 2, FINER)]
        return tuple(out)

    def _further(self) -> SingleEffect | None:
        """The posterior of one more effect; None where it is unlikely."""
        grid = TimeGrid.of(self.time)
        level = Level(self, self.effects, grid)
        families: list[Family] = []
        for subject in self.subjects:
            given = tuple(effect.number for effect in self.effects if effect.acts_on(subject))
            known = self._cache.get(subject)
            if known is None or known[0] != given:
                self._cache[subject] = known = given, list(level.of(subject))
            families += known[1]
        return self._effect(level, families, grid, ())

    def _again(self, effect: SingleEffect) -> SingleEffect | None:
        """The effect, given all others, with finer moments: among what it may be."""
        finer = self._finer(effect)
        subjects = self._subjects_of(effect)
        others = [other for other in self.effects if other is not effect]
        after = tuple(other.number for other in others if any(other.acts_on(s) for s in subjects)), finer
        if effect.after == after:  # nothing has changed for it
            return effect
        family, _, window = effect.posterior.best()
        windows = effect.posterior.grid.windows
        passing = (
            family.form is not Form.DRIFT
            and windows.first[window] > 0
            and windows.end[window] < effect.posterior.grid.cells
        )
        grid = TimeGrid.of(self.time, finer, passing=bool(passing))
        level = Level(self, others, grid, effect)
        found = self._effect(level, [family for subject in subjects for family in level.of(subject)], grid, finer)
        if found is not None and found.is_as(effect):
            found = effect
        if found is not None:
            found.after = after
        return found

    def _subjects_of(self, effect: SingleEffect) -> list[int | str]:
        """What it may be of: patterns of residuals compete with each other."""
        found = {family.subject for family, _ in effect.posterior.families()}
        if found & self.of_residuals:
            found |= self.of_residuals
        return [subject for subject in self.subjects if subject in found]

    def _effect(
        self, level: Level, families: Sequence[Family], grid: TimeGrid, finer: tuple[float, ...]
    ) -> SingleEffect | None:
        families = [family for family in families if np.isfinite(family.log).any()]
        if not families:
            return None
        log_total = float(log_sum_exp([log_sum_exp(f.log) for f in families]))
        nothing = float(np.exp(-np.logaddexp(0.0, log_total)))
        if not finer:
            self.nothing = nothing
        if 1 - nothing < self.prior.reported:
            return None
        # The others take much memory, and are of no account.
        best = max(float(f.log.max()) for f in families)
        families = [f for f in families if float(f.log.max()) > best - NEGLIGIBLE]
        effect = level.effect(Posterior(families, nothing, log_total, grid), finer)
        self._count += 1
        effect.number = self._count
        return effect

    # What is read off.

    def time_of(
        self, posterior: Posterior, best: Family, place: int
    ) -> tuple[int, float | None, tuple[float, float] | None, float | None]:
        """Runs in it, begin with its interval, and end. A window that holds all runs of
        the place is always; of a drift those after its begin count."""
        grid, inside = posterior.grid, best.places.inside(place)
        if best.form is Form.DRIFT:
            k = int(np.argmax(best.log[place]))
            since = grid.ramp_begins(k) if k else None
            acting = inside & (self.time > since) if since is not None else inside
            return int(acting.sum()), since, None, None
        p = np.exp(best.log[place] - log_sum_exp(best.log[place]))
        window = int(np.argmax(p))
        first, end = grid.windows.first[window], grid.windows.end[window]
        cell = grid.cell[inside]
        acting = (cell >= first) & (cell < end)
        times = self.time[inside]
        # Begun before all runs of the place, or ending after them, it is open.
        since = until = interval = None
        if (cell < first).any():
            since = _between(times[cell < first].max(), times[acting].min())
            begins = np.array([0.0, *grid.edges])[grid.windows.first]
            order = np.argsort(begins)
            share = np.cumsum(p[order])
            low, high = (begins[order][min(int(np.searchsorted(share, q)), len(p) - 1)] for q in (0.025, 0.975))
            # A change between two runs is no better known than these are apart.
            interval = (
                float(min(low if low else since, times[cell < first].max())),
                float(max(high if high else since, times[acting].min())),
            )
        if (cell >= end).any():
            until = _between(times[acting].max(), times[cell >= end].min())
        return int(acting.sum()), since, interval, until

    def sizes(self, effect: SingleEffect) -> dict[str, tuple[float, float, str, float]]:
        """By figure: change, standard uncertainty, unit, change in spreads; under the
        likeliest pattern and place."""
        family, place, window = effect.posterior.best()
        if family.form is Form.SCATTER:
            return {family.pattern: (effect.factor, effect.factor_error, "1", float("nan"))}
        if family.score is None or family.information is None or family.vectors is None:
            assert family.levels is not None
            rates = np.array(self.prior.rates[1:])
            log = family.levels[place, window]
            weight = np.exp(log - log_sum_exp(log))
            rate = float(weight @ rates)
            return {family.pattern: (rate, float(np.sqrt(weight @ (rates - rate) ** 2)), "1", float("nan"))}
        mean, variance = coefficients_of(
            family.score[place, window], family.information[place, window], self.prior.sizes, family.scale
        )
        group = self.groups[family.group]
        if family.by_run:
            return {family.pattern: (float(mean[0]), float(np.sqrt(variance[0])), UNIT_OF_RUNS[family.pattern],
                                     float(mean[0] / family.scale))}  # fmt: skip
        # Components to figures, of the commonest part number.
        spread = group.spread[int(np.bincount(self.part[family.places.inside(place)]).argmax())]
        in_spreads = group.back @ (family.vectors.T @ mean)
        error = np.sqrt((group.back @ family.vectors.T) ** 2 @ variance)
        out: dict[str, tuple[float, float, str, float]] = {}
        for k in np.argsort(-np.abs(in_spreads) * (error > ROUNDING * error.max())):
            if not out or (abs(in_spreads[k]) > SHOWN * error[k] and error[k] > ROUNDING * error.max()):
                value, sigma = float(in_spreads[k] * spread[k]), float(error[k] * spread[k])
                unit = group.group.units[k]
                out[group.group.figures[k]] = (value, sigma, unit, float(in_spreads[k]))
        return out


ROUNDING = 1e-6
"""Share of the largest uncertainty below which one is rounding."""


SHOWN = 3.0
"""Standard uncertainties from which on a figure of several is shown."""


def _between(before: float, after: float) -> float:
    return float((before + after) / 2)


def _followers(runs: Sequence[UnitRun], unit: Ints) -> Ints:
    """(q,2) runs of different units, one after the other, in one batch, station and
    fixture."""
    last: dict[tuple[str | None, ...], int] = {}
    out = []
    for i, run in enumerate(runs):
        key = (run.part_number, run.batch, run.station, run.fixture, run.slot, run.operator)
        if key in last and unit[last[key]] != unit[i]:
            out.append((last[key], i))
        last[key] = i
    return np.array(out, dtype=np.int64).reshape(-1, 2)


def _pairs(unit: Ints) -> Ints:
    """(r,2) pairs of runs of one unit."""
    of_unit: dict[int, list[int]] = defaultdict(list)
    for i, u in enumerate(unit.tolist()):
        of_unit[u].append(i)
    out: list[tuple[int, int]] = []
    for mine in of_unit.values():
        out += (
            [(a, b) for k, a in enumerate(mine) for b in mine[k + 1 :]]
            if len(mine) <= LISTED_RUNS
            else list(itertools.pairwise(mine))
        )
    return np.array(out, dtype=np.int64).reshape(-1, 2)


def _likelihoods(runs: Sequence[UnitRun]) -> dict[str, Floats]:
    """(N,) likelihood ratios of each effect in each run: acting against not."""
    names = sorted({name for run in runs for name in run.effects})
    out = {name: np.where([bool(run.effects) for run in runs], UNLISTED, 1.0) for name in names}
    for i, run in enumerate(runs):
        for name, seen in run.effects.items():
            odds = seen.prior_odds if seen.prior_odds > 0 else EFFECT_ODDS / len(CATALOGUE)
            p = float(np.clip(UNKNOWN_LIKELY if seen.probability is None else seen.probability, 1e-4, 1 - 1e-4))
            out[name][i] = p / (1 - p) / odds
    return {name: ratio for name, ratio in out.items() if (ratio > 1).sum() >= FEWEST}
