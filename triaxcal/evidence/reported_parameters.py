"""From the coefficients of every term to the parameters of a document, which
has one form and one shape for each effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.estimate.calibration import HoldsAt
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.unmodelled_kernels import ReadingGeometry, reading_geometry
from triaxcal.model.directions import cube_directions
from triaxcal.poses.covariates import at_moment


@dataclass(frozen=True, eq=False)
class Projection:
    """Maps the scaled coefficients of every term to deviations of the reported
    parameters: ``by_term`` (9+p,C), zero for outliers. ``effects`` are those
    listed, each in the form and the shape that stands for its name, and
    ``columns`` (N,p) theirs. An effect that is not listed is projected onto the
    nine parameters."""

    effects: tuple[Effect, ...]
    columns: Floats
    by_term: Floats

    @classmethod
    def of(cls, posterior: Posterior, at: HoldsAt, likeliest: Sequence[Effect]) -> Projection:
        evidence = posterior.evidence
        rows = evidence.rows
        there = NextReadings.of(posterior, at, np.array([v for _, v in cube_directions()]))
        each = [_derivatives(posterior, effect, there) for effect in likeliest]
        ends = np.cumsum([0, *(columns.shape[1] for columns in each)])
        linear = np.concatenate([rows.linear, there.linear])
        by_term = np.zeros((9 + ends[-1], evidence.columns.count))
        of_name = {effect.name: k for k, effect in enumerate(likeliest)}
        nothing = np.empty((len(linear), 0))
        known: dict[int, Floats] = {}
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
            by_term[np.ix_(np.array([*range(9), *own]), evidence.places([i]))] = found
        by_term[:9] /= rows.lengths[:, None]
        columns = np.concatenate([np.empty((len(rows.y), 0)), *(c[: len(rows.y)] for c in each)], axis=1)
        return cls(tuple(likeliest), columns, by_term)

    def beside(self, posterior: Posterior, effect: Effect) -> Projection:
        """With a further effect, which no term projects onto."""
        own = posterior.evidence.rows.by_coefficients(effect)
        nothing = np.zeros((own.shape[1], self.by_term.shape[1]))
        return Projection(
            (*self.effects, effect),
            np.concatenate([self.columns, own], axis=1),
            np.concatenate([self.by_term, nothing]),
        )


def _projected(linear: Floats, to: Floats, of: Floats) -> Floats:
    """(9+p,q): the deviation of the linear parameters, and the coefficients,
    that come nearest to a unit of each."""
    size = np.maximum(np.linalg.norm(to, axis=0), 1e-300)
    found = np.linalg.lstsq(np.concatenate([linear, to / size], axis=1), of, rcond=1e-9)[0]
    found[linear.shape[1] :] /= size[:, None]
    return np.asarray(found)


def _derivatives(posterior: Posterior, effect: Effect, there: NextReadings) -> Floats:
    """(N+M,p) derivatives by the coefficients of an effect: of the rows, and of
    |a| in the next recording."""
    return np.concatenate([posterior.evidence.rows.by_coefficients(effect), there.by_coefficients(effect)])


@dataclass(frozen=True, eq=False)
class NextReadings:
    """M readings, as of the next recording: their ``geometry``, derivatives of
    |a| by the ``linear`` parameters (M,9), and the ``covariates``. All of |a| is
    over the ``error`` of a pose."""

    geometry: ReadingGeometry
    linear: Floats
    covariates: Mapping[str, Floats]
    error: float

    @classmethod
    def of(cls, posterior: Posterior, at: HoldsAt, directions: Floats) -> NextReadings:
        rows = posterior.evidence.rows
        up = directions * rows.problem.reference
        found = reading_geometry(rows, rows.state.sensor(rows.problem).output(up, {}))
        covariates = at_moment(rows.problem.channel_reference, len(up), at.clocks)
        error = rows.median_standard_error
        return cls(found, found.linear / error, covariates, error)

    def by_coefficients(self, effect: Effect) -> Floats:
        """(M,p)"""
        try:
            basis = effect.basis(self.geometry.along, self.covariates)
            return np.asarray(np.einsum("ni,nip->np", self.geometry.by_bias, basis) / self.error)
        except EffectFault:  # of another package, which does not say what it adds there
            return np.zeros((len(self.geometry.along), len(effect.coefficients)))
