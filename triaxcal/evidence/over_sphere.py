"""What all likely sets say of |a| over the sphere in the next recording: its
mean, its spread, and how far a reported sensor is expected to be off.

The posterior decides by this what is corrected. What the covariance of the
reported parameters does not hold is stated beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import SMOOTH, Empirical
from triaxcal.estimate.calibration import HoldsAt
from triaxcal.evidence.mixture import Components, NextReadings
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.terms import Term
from triaxcal.evidence.unmodelled_kernels import PoseInputs, UnmodelledCovariance, UnmodelledKind
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import LINEAR

SPHERE = 150
"""Directions: more than a function of direction has free values up to the
degree that is corrected (`effects.empirical.DEGREES`)."""
OF_DIRECTION = (UnmodelledKind.DIRECTION, UnmodelledKind.ODD, UnmodelledKind.EVEN, UnmodelledKind.LOCAL)
DRAWN_ANEW = (UnmodelledKind.EACH_POSE, UnmodelledKind.POSE_BEFORE)
ROUGHER = 4.0
"""Factor on the variance between poses. Steps and bends vary more there than the
assumed smooth covariance allows."""
NOWHERE = 1e3
"""References: so far from every pose that none is near, though it is a number."""
ACROSS = 4.0
"""Variance of a component across the measured vector over that of |a|, less
what the nine parameters take of both. Of forms of the second to the fifth
degree in the force, drawn at random, it is 3.0, 7.4, 2.5 and 4.6."""


@dataclass(frozen=True, eq=False)
class _OfPart:
    """One unmodelled part, seen from M readings over the sphere: ``to`` (M,N)
    predicts it linearly from the rows, and ``error`` (M,) is the variance of
    that prediction. ``of_smooth`` (h,h) is the covariance that remains in the
    smooth coefficients, ``prior`` (h,) their variance before the poses were
    seen. All are in units of the noise variance. ``smooth`` is true for a
    function of direction."""

    to: Floats
    error: Floats
    of_smooth: Floats
    prior: Floats
    smooth: bool = False


@dataclass(frozen=True, eq=False)
class _OfKind:
    """Of an unmodelled covariance of size one: of M readings with the rows
    (M,N), their variances (M,), and the covariance (h,h) of the coefficients of
    a smooth term."""

    crossed: Floats
    own: Floats
    of_smooth: Floats


@dataclass(frozen=True, eq=False)
class Smooth:
    """The h coefficients of a smooth term, of some cells: ``by_parameters``
    (h,d) of theirs, ``constant`` (h,), the covariance ``error`` (h,h) of what
    no parameter describes, but for the noise; and the variance (h,) ``prior``
    to the poses."""

    by_parameters: Floats
    constant: Floats
    error: Floats
    prior: Floats


@dataclass(frozen=True, eq=False)
class OverSphere:
    """Of M readings all over the sphere, over the error of a pose: the ``mean``
    (M,) of |a| and the mean of its ``square`` (M,), counted from the point of
    linearisation. ``across`` is the mean square of what a component across the
    measured vector may be off, beside all parameters."""

    there: NextReadings
    columns: Floats
    mean: Floats
    square: Floats
    across: float
    smooth: Empirical
    harmonics: Floats
    """(h,M): the coefficients of the ``smooth`` term that come, beside the nine
    parameters, nearest to a function of the readings."""
    here: PoseInputs
    of_kind: dict[UnmodelledCovariance, _OfKind]
    of_part: dict[int, _OfPart]
    """Those that were asked for."""

    @classmethod
    def of(cls, posterior: Posterior, at: HoldsAt, mixture: Sequence[Components]) -> OverSphere:
        there = NextReadings.of(posterior, at, spiral(SPHERE))
        columns = _columns(posterior, mixture, there)
        smooth = Empirical(SMOOTH)
        basis = np.concatenate([there.linear, there.by_coefficients(smooth)], axis=1)
        size = np.linalg.norm(basis, axis=0)
        harmonics = (np.linalg.pinv(basis / size) / size[:, None])[LINEAR:]
        here, nothing = PoseInputs.of(posterior.evidence.rows), np.zeros(SPHERE)
        bare = cls(there, columns, nothing, nothing, 0.0, smooth, harmonics, here, {}, {})
        mean, square, across, total = np.zeros(SPHERE), np.zeros(SPHERE), 0.0, 0.0
        for cells in mixture:
            part = bare._part(posterior, cells, at)
            J = bare._design(cells) - part.to @ cells.design
            of_cells = part.to @ posterior.evidence.rows.y + cells.conditional_mean @ J.T
            within = np.einsum("md,kde,me->km", J, cells.conditional_covariance, J, optimize=True)
            mean += cells.share @ of_cells
            square += cells.share @ (of_cells**2 + cells.noise[:, None] * (part.error + within))
            across += float(cells.share @ bare._across(posterior, cells, part))
            total += float(cells.share.sum())
        return replace(bare, mean=mean / total, square=square / total, across=across / total)

    def loss(self, reported: Floats) -> float:
        """The expected mean square of |a| over the sphere, over the error of a
        pose, where ``reported`` (M,) is taken off."""
        return float(np.mean(self.square - 2 * self.mean * reported + reported**2))

    def by_parameters(self, posterior: Posterior, effects: Sequence[Effect]) -> Floats:
        """(M,9+p) of the linear parameters as the fit has them, and of the
        coefficients of these effects."""
        own = [self.there.by_coefficients(effect) for effect in effects]
        return np.concatenate([self.there.linear * posterior.evidence.rows.lengths, *own], axis=1)

    def _part(self, posterior: Posterior, cells: Components, at: HoldsAt) -> _OfPart:
        """The next recording draws anew what each pose had of its own, and what
        came from the pose before."""
        if cells.part in self.of_part:
            return self.of_part[cells.part]
        (M, N), h = (len(self.there.linear), len(posterior.evidence.rows.y)), len(self.harmonics)
        part, rows = posterior.evidence.parts[cells.part], posterior.evidence.rows
        found = _OfPart(np.zeros((M, N)), np.zeros(M), np.zeros((h, h)), np.zeros(h))
        if part.kind is not None and part.kind.what in OF_DIRECTION:
            kind, variance, P = self._kind(part.kind), part.tau**2, self.harmonics
            crossed = variance * kind.crossed
            to = crossed @ cells.inverse
            error = ROUGHER * (variance * kind.own - np.sum(to * crossed, axis=1))
            of_smooth = ROUGHER * (variance * kind.of_smooth - (P @ to) @ (P @ crossed).T)
            found = _OfPart(to, error, of_smooth, variance * np.diag(kind.of_smooth), smooth=True)
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
        """The readings as poses that follow no known one."""
        if kind not in self.of_kind:
            M, P = len(self.there.linear), self.harmonics
            zero, run, error = np.zeros(M), np.full(M, -1), np.full(M, self.there.error)
            inputs = PoseInputs(self.there.geometry, np.full((M, 3), NOWHERE), zero, zero, run, error, False)
            whole = kind.covariance_of(inputs, inputs)
            self.of_kind[kind] = _OfKind(kind.covariance_of(inputs, self.here), np.diag(whole), P @ whole @ P.T)
        return self.of_kind[kind]

    def of_cells(self, posterior: Posterior, cells: Components, listed: Floats, to: Floats) -> Smooth:
        """The ``smooth`` term of some cells: what |a| is off beside the
        ``listed`` parameters (M,9+p), which are ``to`` (9+p,d) of those of the
        cells. A process in time is no function of direction: the bias has it."""
        part, P = self.of_part[cells.part], self.harmonics
        by_parameters = self._design(cells) - listed @ to
        if not part.smooth:
            return Smooth(P @ by_parameters, np.zeros(len(P)), part.of_smooth, part.prior)
        onto = P @ part.to
        constant = onto @ posterior.evidence.rows.y
        return Smooth(P @ by_parameters - onto @ cells.design, constant, part.of_smooth, part.prior)

    def _across(self, posterior: Posterior, cells: Components, part: _OfPart) -> Floats:
        """(k,) mean square of a component across the measured vector, of what
        acts along it as a function of the force: all of it where no name
        describes it, some where a name may be another's."""
        evidence, out = posterior.evidence, np.zeros(len(cells.share))
        kind = evidence.parts[cells.part].kind
        if part.smooth:
            unmodelled = cells.residuals @ part.to.T
            out += ACROSS * np.mean(unmodelled**2 + cells.noise[:, None] * part.error, axis=1)
        elif kind is not None and kind.what in DRAWN_ANEW:
            out += cells.noise * float(np.mean(part.error))
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
    """(M,C) of all terms; zero of those that are in no likely set, and of
    outliers."""
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
