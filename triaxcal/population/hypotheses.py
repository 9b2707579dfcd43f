"""Hypotheses of effects of places, and their evidence against nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.distributions import log_sum_exp
from triaxcal.population.figures import TAILS
from triaxcal.population.places import PlacesOfKind, TimeGrid


class Form(StrEnum):
    """How a place differs."""

    SHIFT = "shift"
    DRIFT = "drift"
    """A shift that grows with time."""
    SCATTER = "scatter"
    """Units, or runs, scatter more."""
    FREQUENCY = "frequency"
    """An effect acts in more units."""


@dataclass(frozen=True)
class PlacePrior:
    """The settings, each with its reason."""

    odds: float = 0.1
    """Odds of one more effect of a place: a fleet of a year has one or none."""
    certain: float = 0.99
    """Probability from which on an effect, and its place, are named."""
    reported: float = 0.5
    """Probability from which on an effect is a candidate."""
    sizes: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0, 10.0)
    """Sizes in standard deviations between units: a smaller one does not matter, a
    larger one is found as well. A factor of 3 changes the evidence little."""
    factors: tuple[float, ...] = (1.3, 1.7, 2.5, 4.0, 8.0)
    """Factors of more scatter."""
    rates: tuple[float, ...] = (0.005, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9)
    """Shares of units with an effect."""
    forms: Mapping[Form, float] = field(
        default_factory=lambda: {Form.SHIFT: 0.55, Form.DRIFT: 0.15, Form.SCATTER: 0.15, Form.FREQUENCY: 0.15}
    )
    """Probability of each form: most changes are sudden."""
    most: int = 10
    """Maximum number of single effects."""


@dataclass(frozen=True, eq=False)
class Family:
    """Hypotheses of one form and pattern in the places of one kind: ``log`` (n,w) are
    log evidences against nothing, with priors, by place and window (or ramp);
    ``log_prior`` (n,w) are the latter.

    Of a shift or drift, ``score`` and ``information`` (n,w,r) are those of its r
    coefficients, ``vectors`` (r,d) or (N,d) what a unit of each adds to the components
    of the group. ``scale`` is the size of one coefficient in spreads."""

    form: Form
    group: int
    pattern: str
    places: PlacesOfKind
    log: Floats
    log_prior: Floats
    score: Floats | None = None
    information: Floats | None = None
    vectors: Floats | None = None
    by_run: bool = False
    scale: float = 1.0
    levels: Floats | None = None
    """(n,w,l) of scatter and frequency: log evidence by level."""

    @property
    def subject(self) -> int | str:
        """The group of figures, or the effect."""
        return self.pattern if self.group < 0 else self.group


@dataclass(frozen=True, eq=False)
class Posterior:
    """Of one single effect."""

    all: Sequence[Family]
    nothing: float
    log_total: float
    grid: TimeGrid

    def families(self) -> Iterator[tuple[Family, Floats]]:
        """Those that matter, with probabilities (n,w), given that it acts."""
        acting = log_sum_exp([float(f.log.max(initial=-np.inf)) for f in self.all])
        of_all = float(log_sum_exp([log_sum_exp(f.log) for f in self.all if np.isfinite(f.log).any()]))
        for family in self.all:
            if family.log.max(initial=-np.inf) > acting - NEGLIGIBLE:
                yield family, np.exp(family.log - of_all)

    def best(self) -> tuple[Family, int, int]:
        family = max(self.all, key=lambda f: float(f.log.max(initial=-np.inf)))
        place, window = np.unravel_index(int(np.argmax(family.log)), family.log.shape)
        return family, int(place), int(window)

    def likely(self) -> Iterator[tuple[Family, int, int, float]]:
        """Single hypotheses that hold most of it, with their probabilities if it
        acts."""
        for family, p in self.families():
            for place, window in zip(*np.nonzero(p > LEAST_SHARE), strict=True):
                yield family, int(place), int(window), float(p[place, window])


FOR, TINY = 1.0, 1e-9
"""Largest log evidence at which a hypothesis is not looked at; and least information
that is not rounding."""


NEGLIGIBLE = 12.0
"""Difference of log probabilities beyond which one does not matter."""


LEAST_SHARE = 2e-3
"""Share of a hypothesis that counts in the mean of an effect."""


SETTLED = 0.02
"""Change of an effect, in spreads, that is none."""


@dataclass(eq=False)
class SingleEffect:
    """What one effect adds to the groups' components (N,d), by group; the scale of
    scatter by group, of components and of figures; the rate (N,) by effect."""

    posterior: Posterior
    added: dict[int, Floats]
    scale: dict[int, tuple[Floats, Floats]]
    rate: dict[str, Floats]
    finer: tuple[float, ...] = ()
    number: int = 0
    after: tuple[tuple[int, ...], tuple[float, ...]] | None = None
    """The numbers of the effects, and the moments, that it was last found with."""
    factor: float = 1.0
    factor_error: float = 0.0
    """Of more scatter, under the likeliest hypothesis, with its standard error."""

    def is_as(self, other: SingleEffect) -> bool:
        """Whether both are the same, to a small part of a spread."""
        if (self.added.keys(), self.scale.keys(), self.rate.keys()) != (
            other.added.keys(),
            other.scale.keys(),
            other.rate.keys(),
        ):
            return False
        pairs = [(self.added[g], other.added[g]) for g in self.added]
        pairs += [(self.scale[g][0], other.scale[g][0]) for g in self.scale]
        pairs += [(self.rate[name], other.rate[name]) for name in self.rate]
        return all(float(np.abs(a - b).max()) < SETTLED for a, b in pairs)

    def acts_on(self, subject: int | str) -> bool:
        return subject in self.added or subject in self.scale or subject in self.rate


CAPPED = 3.0
"""Largest log evidence of one run for more scatter: single outliers are no scatter of
a place."""


EFFICIENCY = 0.37
"""Of a median absolute deviation: degrees of freedom of a spread by runs."""


COMMON_FACTOR, THERMOMETER = "common_factor", "temperature"


SEVERAL = "several"


UNIT_OF_RUNS = {COMMON_FACTOR: "", THERMOMETER: "K"}


def log_evidence(score: Floats, information: Floats, sizes: Sequence[float], scale: float) -> Floats:
    """(n,w) of r coefficients, normal with one size over √r, mean over the sizes. −∞
    where the evidence is against an effect: what is left out is a part of the prior
    odds."""
    chi2 = np.sum(score**2 / np.maximum(information, TINY), axis=-1)
    out = np.full(chi2.shape, -np.inf)
    some = chi2 > 2 * FOR
    out[some] = _mean_evidence(score[some], information[some], sizes, scale)
    return out


def _mean_evidence(score: Floats, information: Floats, sizes: Sequence[float], scale: float) -> Floats:
    each = []
    for size in sizes:
        variance = (size * scale) ** 2 / score.shape[-1]
        spread = 1 + variance * information
        each.append(0.5 * np.sum(variance * score**2 / spread - np.log(spread), axis=-1))
    return np.asarray(log_sum_exp(np.array(each), axis=0) - np.log(len(sizes)))


def with_spread_estimated(families: Sequence[Family], dof: float) -> Iterator[Family]:
    """Families whose evidences (without priors) suppose the spread between units
    known, with priors and for a spread that is known with ``dof`` degrees of freedom:
    Student's t of what the best hypothesis explains and another does not."""
    best = max((float(f.log.max(initial=0.0, where=np.isfinite(f.log_prior))) for f in families), default=0.0)
    nothing = -0.5 * dof * np.log1p(2 * best / dof)
    for family in families:
        short = np.maximum(best - family.log, 0.0)
        with np.errstate(invalid="ignore"):
            log = np.where(np.isfinite(family.log), -0.5 * dof * np.log1p(2 * short / dof) - nothing, -np.inf)
        yield replace(family, log=log + family.log_prior)


def mean_of_levels(levels: Floats) -> Floats:
    """(n,w) log mean over levels (n,w,l); −∞ where none is for the effect."""
    out = np.full(levels.shape[:-1], -np.inf)
    some = levels.max(axis=-1) > FOR
    out[some] = log_sum_exp(levels[some], axis=-1) - np.log(levels.shape[-1])
    return out


def coefficients_of(score: Floats, information: Floats, sizes: Sequence[float], scale: float) -> tuple[Floats, Floats]:
    """(r,) means and variances of the coefficients of one hypothesis."""
    r = len(score)
    variance = (np.array(sizes)[:, None] * scale) ** 2 / r
    spread = 1 + variance * information
    log = 0.5 * np.sum(variance * score**2 / spread - np.log(spread), axis=1)
    weight = np.exp(log - log_sum_exp(log))
    mean = variance * score / spread
    average = weight @ mean
    return average, weight @ (variance / spread + (mean - average) ** 2)


def in_robust_spreads(values: Floats) -> Floats:
    """About medians, over 1.4826 times the median absolute deviations."""
    some = np.isfinite(values).any(axis=0)
    filled = np.where(some, values, 0.0)
    left = filled - np.nanmedian(filled, axis=0)
    spread = 1.4826 * np.nanmedian(np.abs(left), axis=0)
    return np.where(some, left / np.where(spread > 0, spread, 1.0), np.nan)


def log_t_ratio(square: Floats, known: Bools, factors: Floats, d: Floats | float = 1.0) -> Floats:
    """(N,l) log of Student's t with d dimensions scaled by a factor over that without,
    at these squares (N,); a single run decides little."""
    d = np.broadcast_to(np.asarray(d, dtype=float), square.shape)[:, None]
    square = np.nan_to_num(square)[:, None]
    ratio = np.log1p(square / TAILS) - np.log1p(square / (TAILS * factors**2))
    return np.where(known[:, None], np.minimum(0.5 * (TAILS + d) * ratio - d * np.log(factors), CAPPED), 0.0)


def t_weight(r: Floats) -> Floats:
    return (TAILS + 1) / (TAILS + r**2)
