"""The likeliest sets as a mixture: its projection onto the reported parameters, and the
posterior of |a| over the sphere in the next recording.

The selection of the correction uses the expected error over the sphere. The part that
the covariance of the reported parameters does not contain is stated separately.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.distributions import log_sum_exp
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import SMOOTH, Empirical
from triaxcal.estimate.calibration import ReferenceEpoch
from triaxcal.evidence.covariances import (
    PoseInputs,
    ReadingGeometry,
    RowPrecision,
    UnmodelledCovariance,
    UnmodelledKind,
    inverse_of,
    reading_geometry,
)
from triaxcal.evidence.likelihood import SetEvidence
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.terms import Term
from triaxcal.model.directions import cube_directions, spiral
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.covariates import at_moment

# The likeliest sets as a mixture, and its projection onto the reported parameters.

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


# The posterior of |a| over the sphere in the next recording: mean, spread, and the
# expected error of a reported sensor.

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
