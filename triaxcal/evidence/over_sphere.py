"""The posterior of |a| over the sphere in the next recording: mean, spread, and the
expected error of a reported sensor.

The selection of the correction uses the expected error. The part that the covariance
of the reported parameters does not contain is stated separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import SMOOTH, Empirical
from triaxcal.estimate.calibration import ReferenceEpoch
from triaxcal.evidence.mixture import Components, NextReadings
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.terms import Term
from triaxcal.evidence.unmodelled_kernels import PoseInputs, UnmodelledCovariance, UnmodelledKind
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import LINEAR

SPHERE = 150
"""Number of directions: more than the free values of a function of direction up to
the degree that is corrected (`effects.empirical.DEGREES`)."""
OF_DIRECTION = (UnmodelledKind.DIRECTION, UnmodelledKind.ODD, UnmodelledKind.EVEN, UnmodelledKind.LOCAL)
DRAWN_ANEW = (UnmodelledKind.EACH_POSE, UnmodelledKind.POSE_BEFORE)
ROUGHER = 4.0
"""Factor on the variance between poses. Steps and bends vary more there than the
assumed smooth covariance allows."""
NOWHERE = 1e3
"""In units of the reference: a previous pose so far from every other that no
correlation is left."""
ACROSS = 4.0
"""Ratio of the variance of a component across the measured vector to that of |a|,
both after projection off the nine parameters. For random forms of the second to the
fifth degree in the force it is 3.0, 7.4, 2.5 and 4.6."""


@dataclass(frozen=True, eq=False)
class _OfPart:
    """Prediction of one unmodelled part in M readings over the sphere, in units of
    the noise variance: ``to`` (M,N) is the linear prediction from the rows, ``error``
    (M,) its variance. ``of_smooth`` (h,h) is the remaining covariance of the smooth
    coefficients, ``prior`` (h,) their prior variance. ``smooth`` is true for a
    function of direction."""

    to: Floats
    error: Floats
    of_smooth: Floats
    prior: Floats
    smooth: bool = False


@dataclass(frozen=True, eq=False)
class _OfKind:
    """An unmodelled covariance of size one: covariance of M readings with the rows
    (M,N), variances of the readings (M,), and covariance (h,h) of the coefficients of
    a smooth term."""

    crossed: Floats
    own: Floats
    of_smooth: Floats


@dataclass(frozen=True, eq=False)
class Smooth:
    """The h coefficients of a smooth term in some cells, as a linear function of the
    cells' parameters: ``by_parameters`` (h,d) and ``constant`` (h,). ``error`` (h,h)
    is the covariance that no parameter describes, without the noise; ``prior`` (h,)
    the prior variance."""

    by_parameters: Floats
    constant: Floats
    error: Floats
    prior: Floats


@dataclass(frozen=True, eq=False)
class OverSphere:
    """M readings over the sphere, in units of the error of a pose: ``mean`` (M,) and
    mean ``square`` (M,) of |a| relative to the point of linearisation. ``across`` is
    the mean square error of a component across the measured vector that no parameter
    describes."""

    there: NextReadings
    columns: Floats
    mean: Floats
    square: Floats
    across: float
    smooth: Empirical
    harmonics: Floats
    """(h,M): least-squares coefficients of the ``smooth`` term, fitted to a function
    of the readings together with the nine parameters."""
    here: PoseInputs
    of_kind: dict[UnmodelledCovariance, _OfKind]
    of_part: dict[int, _OfPart]
    """Cached parts."""

    @classmethod
    def of(cls, posterior: Posterior, at: ReferenceEpoch, mixture: Sequence[Components]) -> OverSphere:
        there = NextReadings.of(posterior, at, spiral(SPHERE))
        columns = _columns(posterior, mixture, there)
        smooth = Empirical(SMOOTH)
        # Coefficients of the smooth term: rows of the pseudo-inverse of [linear,
        # smooth].
        basis = np.concatenate([there.linear, there.by_coefficients(smooth)], axis=1)
        size = np.linalg.norm(basis, axis=0)
        harmonics = (np.linalg.pinv(basis / size) / size[:, None])[LINEAR:]
        here, nothing = PoseInputs.of(posterior.evidence.rows), np.zeros(SPHERE)
        bare = cls(there, columns, nothing, nothing, 0.0, smooth, harmonics, here, {}, {})
        mean, square, across, total = np.zeros(SPHERE), np.zeros(SPHERE), 0.0, 0.0
        # Law of total variance over the cells: E[f] and E[f²] of |a| in each reading.
        for cells in mixture:
            part = bare._part(posterior, cells, at)
            # f = J q + T y: parameters, and the prediction of the unmodelled part from
            # residuals.
            J = bare._design(cells) - part.to @ cells.design
            of_cells = part.to @ posterior.evidence.rows.y + cells.conditional_mean @ J.T
            within = np.einsum("md,kde,me->km", J, cells.conditional_covariance, J, optimize=True)
            mean += cells.share @ of_cells
            square += cells.share @ (of_cells**2 + cells.noise[:, None] * (part.error + within))
            across += float(cells.share @ bare._across(posterior, cells, part))
            total += float(cells.share.sum())
        return replace(bare, mean=mean / total, square=square / total, across=across / total)

    def loss(self, reported: Floats) -> float:
        """Expected mean square error of |a| over the sphere, in units of the error of
        a pose, after subtraction of ``reported`` (M,)."""
        return float(np.mean(self.square - 2 * self.mean * reported + reported**2))

    def by_parameters(self, posterior: Posterior, effects: Sequence[Effect]) -> Floats:
        """(M,9+p) derivatives of |a| by the linear parameters in the scale of the
        fit, and by the coefficients of these effects."""
        own = [self.there.by_coefficients(effect) for effect in effects]
        return np.concatenate([self.there.linear * posterior.evidence.rows.lengths, *own], axis=1)

    def _part(self, posterior: Posterior, cells: Components, at: ReferenceEpoch) -> _OfPart:
        """Prediction of the part in the next recording. Contributions of single poses
        and of the previous pose are independent there."""
        if cells.part in self.of_part:
            return self.of_part[cells.part]
        (M, N), h = (len(self.there.linear), len(posterior.evidence.rows.y)), len(self.harmonics)
        part, rows = posterior.evidence.parts[cells.part], posterior.evidence.rows
        found = _OfPart(np.zeros((M, N)), np.zeros(M), np.zeros((h, h)), np.zeros(h))
        # Kriging of a function of direction: T = K(next, rows) P, error variance K − T
        # K(rows, next).
        if part.kind is not None and part.kind.what in OF_DIRECTION:
            kind, variance, P = self._kind(part.kind), part.tau**2, self.harmonics
            crossed = variance * kind.crossed
            to = crossed @ cells.inverse
            error = ROUGHER * (variance * kind.own - np.sum(to * crossed, axis=1))
            of_smooth = ROUGHER * (variance * kind.of_smooth - (P @ to) @ (P @ crossed).T)
            found = _OfPart(to, error, of_smooth, variance * np.diag(kind.of_smooth), smooth=True)
        # A bias that wanders in time: its prediction at the reference epoch.
        elif part.kind is not None and part.kind.what is UnmodelledKind.TIME:
            by_bias = self.there.geometry.by_bias / self.there.error
            crossed = part.tau**2 * by_bias @ part.kind.bias_at(rows, at.t_s)
            to = crossed @ cells.inverse
            own = part.tau**2 * part.kind.scale * np.sum(by_bias**2, axis=1)
            found = replace(found, to=to, error=own - np.sum(to * crossed, axis=1))
        elif part.kind is not None and part.kind.what in DRAWN_ANEW:
            found = replace(found, error=part.tau**2 * self._kind(part.kind).own)
        self.of_part[cells.part] = found
        return found

    def _kind(self, kind: UnmodelledCovariance) -> _OfKind:
        """Covariances for readings as poses of a new recording, far from every
        previous pose."""
        if kind not in self.of_kind:
            M, P = len(self.there.linear), self.harmonics
            zero, run, error = np.zeros(M), np.full(M, -1), np.full(M, self.there.error)
            inputs = PoseInputs(self.there.geometry, np.full((M, 3), NOWHERE), zero, zero, run, error, False)
            whole = kind.covariance_of(inputs, inputs)
            self.of_kind[kind] = _OfKind(kind.covariance_of(inputs, self.here), np.diag(whole), P @ whole @ P.T)
        return self.of_kind[kind]

    def of_cells(self, posterior: Posterior, cells: Components, listed: Floats, to: Floats) -> Smooth:
        """Posterior of the ``smooth`` term in some cells: the part of |a| that the
        ``listed`` parameters (M,9+p), which are ``to`` (9+p,d) times those of the
        cells, leave. A process in time is no function of direction and belongs to the
        bias."""
        part, P = self.of_part[cells.part], self.harmonics
        by_parameters = self._design(cells) - listed @ to
        if not part.smooth:
            return Smooth(P @ by_parameters, np.zeros(len(P)), part.of_smooth, part.prior)
        onto = P @ part.to
        constant = onto @ posterior.evidence.rows.y
        return Smooth(P @ by_parameters - onto @ cells.design, constant, part.of_smooth, part.prior)

    def _across(self, posterior: Posterior, cells: Components, part: _OfPart) -> Floats:
        """(k,) mean square of a component across the measured vector, due to
        functions of the force: all of the unmodelled part, and the share
        ``Odds.another_form`` of named effects, which may have another form."""
        evidence, out = posterior.evidence, np.zeros(len(cells.share))
        kind = evidence.parts[cells.part].kind
        # Unmodelled function of direction: residual prediction and its variance.
        if part.smooth:
            unmodelled = cells.residuals @ part.to.T
            out += ACROSS * np.mean(unmodelled**2 + cells.noise[:, None] * part.error, axis=1)
        elif kind is not None and kind.what in DRAWN_ANEW:
            out += cells.noise * float(np.mean(part.error))
        # Named effects of the force alone, after projection off the nine parameters.
        of_force = [_of_force_alone(evidence.terms[i]) for i in cells.found.members]
        if any(of_force):
            ranks = [evidence.terms[i].rank for i in cells.found.members]
            own = np.flatnonzero(np.repeat(of_force, ranks))
            X = self.columns[:, cells.places[own]]
            X = X - self.there.linear @ np.linalg.lstsq(self.there.linear, X, rcond=None)[0]
            inner, q = X.T @ X / len(X), cells.conditional_mean[:, LINEAR + own]
            C = cells.conditional_covariance[:, LINEAR + own[:, None], LINEAR + own]
            square = np.einsum("kp,pq,kq->k", q, inner, q) + cells.noise * np.einsum("kpq,pq->k", C, inner)
            out += evidence.odds.another_form * ACROSS * square
        return out

    def _design(self, cells: Components) -> Floats:
        """(M,d) of the linear parameters and the coefficients of the cells."""
        return np.concatenate([self.there.linear, self.columns[:, cells.places]], axis=1)


def _of_force_alone(term: Term) -> bool:
    return term.effect is not None and not term.effect.needs


def _columns(posterior: Posterior, mixture: Sequence[Components], there: NextReadings) -> Floats:
    """(M,C) derivatives of |a| in the readings by all terms; zero for terms of no
    likely set and for outliers."""
    evidence = posterior.evidence
    out = np.zeros((len(there.linear), evidence.columns.count))
    known: dict[int, Floats] = {}
    for i in sorted({i for cells in mixture for i in cells.found.members}):
        term = evidence.terms[i]
        if term.change_point >= 0:
            out[:, evidence.places([i])] = there.linear * term.combination
        elif term.effect is not None:
            if id(term.effect) not in known:
                known[id(term.effect)] = there.by_coefficients(term.effect)
            out[:, evidence.places([i])] = known[id(term.effect)][:, list(term.kept)] * term.combination
    return out
