"""From the coefficients of every term to the parameters of a document, which
has one form and one shape for each effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.estimate.calibration import HoldsAt
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.unmodelled_kernels import reading_geometry
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
        there = _next_readings(posterior, at)
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
                known[id(term.effect)] = _projected(linear, to, _derivatives(posterior, term.effect, there))
            found = known[id(term.effect)][:, list(term.kept)] * term.combination
            own = [] if k is None else [*range(9 + ends[k], 9 + ends[k + 1])]
            by_term[np.ix_([*range(9), *own], evidence.places([i]))] = found
        by_term[:9] /= rows.lengths[:, None]
        columns = np.concatenate([np.empty((len(rows.y), 0)), *(c[: len(rows.y)] for c in each)], axis=1)
        return cls(tuple(likeliest), columns, by_term)


def _projected(linear: Floats, to: Floats, of: Floats) -> Floats:
    """(9+p,q): the deviation of the linear parameters, and the coefficients,
    that come nearest to a unit of each."""
    size = np.maximum(np.linalg.norm(to, axis=0), 1e-300)
    found = np.linalg.lstsq(np.concatenate([linear, to / size], axis=1), of, rcond=1e-9)[0]
    found[linear.shape[1] :] /= size[:, None]
    return np.asarray(found)


def _derivatives(posterior: Posterior, effect: Effect, there: _NextReadings) -> Floats:
    """(N+M,p) derivatives by the coefficients of an effect: of the rows, and of
    |a| in the next recording."""
    rows = posterior.evidence.rows
    try:
        basis = effect.basis(there.along, there.covariates)
        of_radius = np.einsum("ni,nip->np", there.by_bias, basis) / rows.median_standard_error
    except EffectFault:  # of another package, which does not say what it adds there
        of_radius = np.zeros((len(there.along), len(effect.coefficients)))
    return np.concatenate([rows.by_coefficients(effect), of_radius])


class _NextReadings(NamedTuple):
    """M readings all over the sphere, as of the next recording: derivatives of
    |a| by the ``linear`` parameters (M,9) over the error of a pose and by the
    biases (M,3), readings ``along`` the axes (M,3), and the covariates."""

    linear: Floats
    by_bias: Floats
    along: Floats
    covariates: Mapping[str, Floats]


def _next_readings(posterior: Posterior, at: HoldsAt) -> _NextReadings:
    rows = posterior.evidence.rows
    up = np.array([v for _, v in cube_directions()]) * rows.problem.reference
    found = reading_geometry(rows, rows.state.sensor(rows.problem).output(up, {}))
    reference = rows.problem.channel_reference
    covariates = at_moment(reference, len(up), at.clocks)
    return _NextReadings(found.linear / rows.median_standard_error, found.by_bias, found.along, covariates)
