"""The likeliest sets as a mixture, and its projection onto the reported
parameters."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import log_sum_exp
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.estimate.calibration import ReferenceEpoch
from triaxcal.evidence.likelihood import SetEvidence
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.row_covariance import RowPrecision, inverse_of
from triaxcal.evidence.unmodelled_kernels import ReadingGeometry, reading_geometry
from triaxcal.model.directions import cube_directions
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.covariates import at_moment

# The posterior of all parameters as a mixture of normal distributions: one for each
# likely set, part of the evidence and choice of sizes.

NEGLIGIBLE_PROBABILITY = 1e-6
"""Sets of smaller probability do not change an average."""
CELLS = 400
"""Number of cells (one set, one part, one choice of sizes) in the mixture, the
likeliest. They represent the others."""


@dataclass(frozen=True, eq=False)
class Components:
    """A likely set with one ``part`` of the evidence, under k choices of ``sizes``
    (k,q) of its q scaled coefficients.

    ``share`` (k,) is the probability of each choice. For the d = 9 + q linear
    parameters and coefficients, ``conditional_mean`` (k,d) are the means and
    ``conditional_covariance`` (k,d,d) the covariances in units of the noise variance
    ``noise`` (k,). ``residuals`` (k,N) are those of the rows, ``design`` (N,d) the
    derivatives of the rows, ``inverse`` (N,N) the inverse of their covariance.
    """

    found: SetEvidence
    names: frozenset[str]
    places: Ints
    part: int
    share: Floats
    sizes: Floats
    conditional_mean: Floats
    conditional_covariance: Floats
    noise: Floats
    residuals: Floats
    design: Floats
    inverse: RowPrecision


def components(posterior: Posterior, share: float = 1.0) -> list[Components]:
    """The likeliest cells that hold this ``share`` of the probability, grouped by set
    and part."""
    evidence = posterior.evidence
    rows = evidence.rows
    together: dict[tuple[int, int], list[tuple[float, int]]] = defaultdict(list)
    sets: dict[int, SetEvidence] = {}
    # Group the cells of one set and part: they share design and covariance.
    for log_share, found, row, cell in _likely_cells(posterior, share):
        sets[id(found)] = found
        together[id(found), row].append((np.exp(log_share), cell))
    inverse: dict[int, RowPrecision] = {}
    out = []
    for (key, row), cells in together.items():
        found = sets[key]
        part, places = found.parts[row], evidence.places(found.members)
        if part not in inverse:
            inverse[part] = evidence.precision(part)
        # Generalised least squares with a normal prior on the coefficients: C = (Xᵀ P X
        # + diag(0, ρ⁻²))⁻¹, mean = C Xᵀ P y.
        design = np.concatenate([rows.linear, evidence.columns.at(places)], axis=1)
        weighted = design.T @ inverse[part]
        of, chosen = np.array([p for p, _ in cells]), [cell for _, cell in cells]
        sizes = np.repeat(found.sizes[chosen], [evidence.terms[i].rank for i in found.members], axis=1)
        precision = np.tile(weighted @ design, (len(cells), 1, 1))
        own = np.arange(LINEAR, design.shape[1])
        precision[:, own, own] += sizes**-2.0
        within = inverse_of(precision)
        here = within @ (weighted @ rows.y)
        # Posterior of the noise variance from chi-square at the mean.
        left = rows.y - here @ design.T
        chi2 = np.maximum(left @ (inverse[part] @ rows.y), 0.0)
        noise = np.array([rows.noise_variance_given(float(of_cell)) for of_cell in chi2])
        names = posterior.names_of(found)
        out.append(Components(found, names, places, part, of, sizes, here, within, noise, left, design, inverse[part]))
    return out


def _likely_cells(posterior: Posterior, share: float) -> list[tuple[float, SetEvidence, int, int]]:
    """The likeliest cells: log probability, set, and the indices of part and
    sizes."""
    total = float(log_sum_exp([found.total for found in posterior.sets]))
    # The best cells of every set that is not negligible, then the best of all.
    log, of_set, where = [], [], []
    for k, found in enumerate(posterior.sets):
        if found.total - total < np.log(NEGLIGIBLE_PROBABILITY):
            break
        flat = found.log.ravel()
        few = np.argpartition(-flat, CELLS // 4)[: CELLS // 4] if len(flat) > CELLS // 4 else np.arange(len(flat))
        log.append(flat[few] - total)
        of_set.append(np.full(len(few), k))
        where.append(few)
    every = np.concatenate(log)
    best = np.argsort(-every, kind="stable")[:CELLS]
    best = best[: int(np.searchsorted(np.cumsum(np.exp(every[best])), share)) + 1]
    chosen = zip(every[best], np.concatenate(of_set)[best], np.concatenate(where)[best], strict=True)
    return [(float(p), posterior.sets[k], *divmod(int(i), posterior.sets[k].log.shape[1])) for p, k, i in chosen]


# From the coefficients of all terms to the parameters of a document, which has one
# form and one shape for each effect.


@dataclass(frozen=True, eq=False)
class Projection:
    """Linear map from the scaled coefficients of all terms to deviations of the
    reported parameters: ``by_term`` (9+p,C), zero for outliers. ``effects`` are the
    listed ones, each in its representative form and shape; ``columns`` (N,p) are
    their derivatives. An effect that is not listed is projected onto the nine
    parameters."""

    effects: tuple[Effect, ...]
    columns: Floats
    by_term: Floats

    @classmethod
    def of(cls, posterior: Posterior, at: ReferenceEpoch, likeliest: Sequence[Effect]) -> Projection:
        evidence = posterior.evidence
        rows = evidence.rows
        # Compare effects in the poses, and in readings of the next recording.
        there = NextReadings.of(posterior, at, np.array([v for _, v in cube_directions()]))
        each = [_derivatives(posterior, effect, there) for effect in likeliest]
        ends = np.cumsum([0, *(columns.shape[1] for columns in each)])
        linear = np.concatenate([rows.linear, there.linear])
        by_term = np.zeros((9 + ends[-1], evidence.columns.count))
        of_name = {effect.name: k for k, effect in enumerate(likeliest)}
        nothing = np.empty((len(linear), 0))
        known: dict[int, Floats] = {}
        # Least-squares projection of each term's columns onto the nine parameters and
        # its representative.
        for i in sorted({i for found in posterior.sets for i in found.members}):
            term = evidence.terms[i]
            if term.effect is None:
                continue
            k = of_name.get(term.name)
            to = nothing if k is None else each[k]
            if id(term.effect) not in known:
                itself = k is not None and likeliest[k] is term.effect
                known[id(term.effect)] = (
                    np.eye(9 + to.shape[1], to.shape[1], -9)
                    if itself
                    else _projected(linear, to, _derivatives(posterior, term.effect, there))
                )
            found = known[id(term.effect)][:, list(term.kept)] * term.combination
            own: list[int] = [] if k is None else [*range(9 + ends[k], 9 + ends[k + 1])]
            # Scatter the result into the rows of the nine parameters and of that
            # effect.
            by_term[np.ix_(np.array([*range(9), *own]), evidence.places([i]))] = found
        # Undo the scaling of the linear columns.
        by_term[:9] /= rows.lengths[:, None]
        columns = np.concatenate([np.empty((len(rows.y), 0)), *(c[: len(rows.y)] for c in each)], axis=1)
        return cls(tuple(likeliest), columns, by_term)

    def with_effect(self, posterior: Posterior, effect: Effect) -> Projection:
        """The same projection with a further effect, onto which no term is
        projected."""
        own = posterior.evidence.rows.by_coefficients(effect)
        nothing = np.zeros((own.shape[1], self.by_term.shape[1]))
        return Projection(
            (*self.effects, effect),
            np.concatenate([self.columns, own], axis=1),
            np.concatenate([self.by_term, nothing]),
        )


def _projected(linear: Floats, to: Floats, of: Floats) -> Floats:
    """(9+p,q): linear parameters and coefficients that approximate a unit of each
    column best (least squares)."""
    size = np.maximum(np.linalg.norm(to, axis=0), 1e-300)
    found = np.linalg.lstsq(np.concatenate([linear, to / size], axis=1), of, rcond=1e-9)[0]
    found[linear.shape[1] :] /= size[:, None]
    return np.asarray(found)


def _derivatives(posterior: Posterior, effect: Effect, there: NextReadings) -> Floats:
    """(N+M,p) derivatives by the coefficients of an effect: of the rows, and of |a|
    in the next recording."""
    return np.concatenate([posterior.evidence.rows.by_coefficients(effect), there.by_coefficients(effect)])


@dataclass(frozen=True, eq=False)
class NextReadings:
    """M readings of the next recording: their ``geometry``, derivatives of |a| by the
    ``linear`` parameters (M,9), and the ``covariates``. All quantities of |a| are
    divided by the ``error`` of a pose."""

    geometry: ReadingGeometry
    linear: Floats
    covariates: Mapping[str, Floats]
    error: float

    @classmethod
    def of(cls, posterior: Posterior, at: ReferenceEpoch, directions: Floats) -> NextReadings:
        rows = posterior.evidence.rows
        up = directions * rows.problem.reference
        found = reading_geometry(rows, rows.state.sensor(rows.problem).output(up, {}))
        covariates = at_moment(rows.problem.channel_reference, len(up), at.clocks)
        error = rows.median_standard_error
        return cls(found, found.linear / error, covariates, error)

    def by_coefficients(self, effect: Effect) -> Floats:
        """(M,p) derivatives of |a| by the coefficients of an effect."""
        try:
            basis = effect.basis(self.geometry.along, self.covariates)
            return np.asarray(np.einsum("ni,nip->np", self.geometry.by_bias, basis) / self.error)
        except EffectFault:  # of another package, which does not say what it adds there
            return np.zeros((len(self.geometry.along), len(effect.coefficients)))
