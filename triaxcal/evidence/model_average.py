"""What is corrected: the linear parameters and the effects' coefficients,
averaged over all likely sets.

A document has one form and one shape for each effect. So every shape of a name
is carried over to the likeliest one: the coefficients are those that come
nearest, in the poses and in the next recording, to what all shapes together do."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.effects import CATALOGUE, TEMPERATURE
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import Empirical
from triaxcal.estimate.calibration import HoldsAt, Unmodelled
from triaxcal.estimate.likelihood import State, linearise_all, parameters_by_theta
from triaxcal.evidence.mixture import NEGLIGIBLE_PROBABILITY, Components, Projection, components
from triaxcal.evidence.over_sphere import OverSphere, Smooth
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.row_covariance import inverse_of
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.model.sensor import LINEAR, Sensor
from triaxcal.rounding import reaches

# The covariance of a model average: within each set, part and choice of sizes, and
# between them.

BIAS = slice(3, 6)
"""Of the nine parameters as the fit has them: those to which a bias adds
unscaled."""
THERMAL = frozenset(effect.name for effect in CATALOGUE if TEMPERATURE in effect.needs)


@dataclass(frozen=True, eq=False)
class Spread:
    """Of the parameters as deviations: the ``whole`` covariance (9+p,9+p), of
    which ``thermal`` is the part of sets with a thermal effect that is not
    listed; ``prior`` (p,) are the variances of the coefficients before the
    poses were seen."""

    whole: Floats
    thermal: Floats
    prior: Floats

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        mixture: Sequence[Components],
        mean: Floats,
        projection: Projection,
        process_bias: Floats,
        t_s: float,
        sphere: OverSphere | None = None,
    ) -> Spread:
        """Within each set, part and choice of sizes, and between them. The
        biases are those of the moment, with what a process in time adds. With a
        ``sphere``, the last effect of the ``projection`` is its smooth term."""
        listed = {effect.name for effect in projection.effects}
        whole, thermal = np.zeros((2, len(mean), len(mean)))
        prior, total = np.zeros(len(mean) - LINEAR), 0.0
        for cells in mixture:
            size, here = _moments(cells, posterior, mean, projection, process_bias, t_s, sphere)
            total += float(cells.share.sum())
            whole += here
            prior += size
            if cells.names & (THERMAL - listed):
                thermal += here
        return cls(_sound(whole / total), _sound(thermal / total), prior / total)


def _sound(covariance: Floats) -> Floats:
    """Where combinations are hardly known, rounding may leave less than nothing
    of the others."""
    if (np.diag(covariance) >= 0).all():
        return covariance
    size, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)


def smooth_mean(
    posterior: Posterior, mixture: Sequence[Components], projection: Projection, sphere: OverSphere
) -> Floats:
    """(h,) mean coefficients of the smooth term beside the parameters of a
    ``projection``, which has no such term."""
    total, out = 0.0, np.zeros(len(sphere.harmonics))
    for cells in mixture:
        smooth = _smooth_of(cells, posterior, projection, projection.effects, sphere)
        total += float(cells.share.sum())
        out += cells.share @ (smooth.constant + cells.conditional_mean @ smooth.by_parameters.T)
    return out / total


def _smooth_of(
    cells: Components, posterior: Posterior, projection: Projection, listed: Sequence[Effect], sphere: OverSphere
) -> Smooth:
    by_listed = sphere.by_parameters(posterior, listed)
    return sphere.of_cells(posterior, cells, by_listed, _by_cells(cells, posterior, projection)[: by_listed.shape[1]])


def _by_cells(cells: Components, posterior: Posterior, projection: Projection) -> Floats:
    """(9+p,d) reported parameters by those of the cells."""
    by_term = projection.by_term[:, cells.places]
    to = np.concatenate([np.zeros((len(by_term), LINEAR)), by_term], axis=1)
    to[:LINEAR, :LINEAR] += np.diag(1 / posterior.evidence.rows.lengths)
    return to


def _moments(
    cells: Components,
    posterior: Posterior,
    mean: Floats,
    projection: Projection,
    process_bias: Floats,
    t_s: float,
    sphere: OverSphere | None,
) -> tuple[Floats, Floats]:
    """Sums over the choices, by their share: the variances (p,) that the sizes
    give the coefficients of an average, and the second moments (9+p,9+p) about
    its mean."""
    rows, assumed = posterior.evidence.rows, posterior.evidence.parts[cells.part]
    to = _by_cells(cells, posterior, projection)
    size = cells.share @ (cells.sizes**2 @ (to[LINEAR:, LINEAR:] ** 2).T)
    added, wandering = np.zeros(len(mean)), np.zeros((len(mean), len(mean)))
    if sphere is not None:
        smooth = _smooth_of(cells, posterior, projection, projection.effects[:-1], sphere)
        own = slice(len(mean) - len(smooth.constant), len(mean))
        to[own], added[own], wandering[own, own] = smooth.by_parameters, smooth.constant, smooth.error
        size[own.start - LINEAR :] += cells.share.sum() * smooth.prior
    off = cells.conditional_mean @ to.T + added - mean
    off[:, BIAS] -= process_bias
    if assumed.kind is not None and assumed.kind.what is UnmodelledKind.TIME:
        there = assumed.tau**2 * assumed.kind.bias_at(rows, t_s) @ cells.inverse
        off[:, BIAS] += cells.residuals @ there.T
        wandering[BIAS, BIAS] = assumed.tau**2 * (
            assumed.kind.scale * np.eye(3) - there @ assumed.kind.bias_at(rows, t_s).T
        )
        to[BIAS] -= there @ cells.design
    shared = cells.share * cells.noise
    spread = to @ np.tensordot(shared, cells.conditional_covariance, axes=1) @ to.T + shared.sum() * wandering
    return size, spread + (cells.share[:, None] * off).T @ off


NOTICEABLE = 0.1
"""Of the standard error of a pose: a name that is unlikely and corrects less is
not listed."""
SELECTED_LEAST = 0.03
"""An unlikely name is dropped if its mean correction holds less than this share
of its expected square: its coefficients would add uncertainty and hardly any
correction."""
STEPS = 3
"""Of Newton's method, for nine parameters a few parts in a thousand from where
they go."""


class Refusal(StrEnum):
    """Why no effect is corrected."""

    UNMODELLED = "unmodelled"
    """Something that no name describes probably acts: an average over names
    would go with it where it must not."""
    CHANGE_POINT = "another"
    """One calibration does not hold in all poses: a unit was exchanged on the
    way, or its channels."""
    ONE_POSE = "one_pose"
    """A name is certain, and without some single pose unlikelier than not."""
    GAIN = "gain"
    """No name is certain, and the expected error would fall too little."""


@dataclass(frozen=True, eq=False)
class Average:
    """``sensor`` has one entry for each likely name, by the mean of its
    coefficients: sets without the effect count, with zero. Its biases hold what
    a process in time adds to them at the moment for which all this holds.
    ``covariance`` (9+p,9+p) is that of its scale factors, misalignments, biases
    and coefficients, within the sets and between them, of which ``thermal`` is
    the part of sets with a thermal effect that is not listed; ``prior_sd`` (p,)
    are the coefficients' standard deviations before the poses were seen, as the
    probabilities and sizes after have them. ``weights`` has the probability of
    each name. ``loss`` is the expected mean square of |a| over the sphere in
    the next recording, over the error of a pose, NaN where nobody asked."""

    sensor: Sensor
    covariance: Floats
    thermal: Floats
    prior_sd: Floats
    weights: Mapping[str, float]
    unmodelled: Unmodelled | None
    loss: float


def refusal(posterior: Posterior) -> Refusal | None:
    odds = posterior.evidence.odds
    if reaches(posterior.change_point_probabilities.sum(), odds.refused):
        return Refusal.CHANGE_POINT
    if reaches(posterior.unmodelled_probability, odds.refused):
        return Refusal.UNMODELLED
    certain = [name for name, p in posterior.effect_probabilities.items() if reaches(p, odds.certain)]
    if not all(reaches(posterior.least_leave_one_out(name), odds.refused) for name in certain):
        return Refusal.ONE_POSE
    return None


def average(posterior: Posterior, at: HoldsAt, mixture: Sequence[Components] | None = None) -> Average:
    """Over all sets, sizes and parts, of what has a name; it holds for another
    recording as at a moment of this one. ``mixture`` are the likeliest sets
    (`components`), where they are known."""
    mixture = components(posterior) if mixture is None else mixture
    return _of_likely(posterior, None, at, mixture)


def least_loss(
    posterior: Posterior, at: HoldsAt, linear: Sensor, mixture: Sequence[Components]
) -> tuple[Average, Refusal | None]:
    """What is handed on, and why no name is corrected in it. Of the ``linear``
    sensor and the averages that the posterior allows (`refusal`), it is the one
    with the least expected error. Names none of which is certain are corrected
    only where the expected mean square falls far enough (`Odds.gain_by_names`)."""
    odds = posterior.evidence.odds
    sphere = OverSphere.of(posterior, at, mixture)
    alone = _linear_alone(posterior, at, linear, mixture, sphere)
    why = refusal(posterior)
    if why is None:
        made = _of_likely(posterior, sphere, at, mixture)
        pays = bool(posterior.certain) or made.loss <= odds.gain_by_names * alone.loss
        if made.sensor.effects and pays:
            return made, None
        likely = any(reaches(p, odds.reported) for p in posterior.effect_probabilities.values())
        return alone, Refusal.GAIN if likely else None
    if why is not Refusal.UNMODELLED:
        return alone, why
    whole = _smooth(posterior, sphere, at, mixture)
    return (whole if whole.loss <= odds.gain * alone.loss else alone), why


def _of_likely(posterior: Posterior, sphere: OverSphere | None, at: HoldsAt, mixture: Sequence[Components]) -> Average:
    listed = _likeliest(posterior)
    made = _of_listed(posterior, sphere, at, listed, mixture)
    kept = [effect for effect in listed if _selected(posterior, made, effect)]
    return made if len(kept) == len(listed) else _of_listed(posterior, sphere, at, kept, mixture)


def _of_listed(
    posterior: Posterior,
    sphere: OverSphere | None,
    at: HoldsAt,
    listed: Sequence[Effect],
    mixture: Sequence[Components],
) -> Average:
    projection = Projection.of(posterior, at, listed)
    mean, left = _mean(posterior, projection)
    state = _where_linearised(posterior, mean, projection)
    sensor = state.sensor(posterior.evidence.rows.problem)
    process_bias = _process_bias(posterior, left, at.t_s)
    moved = Sensor(sensor.scale_factor, sensor.misalignment, sensor.bias + process_bias, sensor.effects)
    return _with_errors(posterior, sphere, at, projection, moved, state, mean, process_bias, mixture)


def _smooth(posterior: Posterior, sphere: OverSphere, at: HoldsAt, mixture: Sequence[Components]) -> Average:
    """The sensor with the mean of all functions of the direction, and the nine
    parameters that fit the poses best beside it. Between the poses a function
    of the direction is interpolated. Effects of temperature, time or memory are
    left out: if none of the hypotheses is true, nothing says that they hold
    under other conditions."""
    rows = posterior.evidence.rows
    projection = Projection.of(posterior, at, [e for e in _likeliest(posterior) if not e.needs])
    coefficients = _mean(posterior, projection)[0][LINEAR:]
    further = smooth_mean(posterior, mixture, projection, sphere)
    projection, coefficients = projection.beside(posterior, sphere.smooth), np.concatenate([coefficients, further])
    used = np.flatnonzero(posterior.outlier_probabilities < posterior.evidence.odds.reported)
    left = (rows.y - projection.columns @ coefficients)[used]
    nine = np.linalg.lstsq(rows.linear[used], left, rcond=None)[0] / rows.lengths
    mean = np.concatenate([nine, coefficients])
    state = _where_linearised(posterior, mean, projection)
    sensor = state.sensor(rows.problem)
    return _with_errors(posterior, sphere, at, projection, sensor, state, mean, np.zeros(3), mixture)


def _selected(posterior: Posterior, made: Average, effect: Effect) -> bool:
    """Whether a name is likely, or corrects a good part of what it may do."""
    if reaches(posterior.effect_probabilities[effect.name], posterior.evidence.odds.reported):
        return True
    ends = np.cumsum([LINEAR, *(len(q) for _, q in made.sensor.effects)])
    k = next(k for k, (other, _) in enumerate(made.sensor.effects) if other is effect)
    own, q = slice(ends[k], ends[k + 1]), made.sensor.effects[k][1]
    size = made.prior_sd[ends[k] - LINEAR : ends[k + 1] - LINEAR]
    if not size.all():  # only in sets that are hardly likely
        return False
    corrects = float(np.sum((q / size) ** 2))
    return corrects >= SELECTED_LEAST * (corrects + float(np.sum(np.diag(made.covariance)[own] / size**2)))


def _linear_alone(
    posterior: Posterior, at: HoldsAt, linear: Sensor, mixture: Sequence[Components], sphere: OverSphere
) -> Average:
    """The ``linear`` sensor with the errors that all likely sets make of it:
    what is handed on where no effect is corrected."""
    rows = posterior.evidence.rows
    state = State.of(rows.problem, linear)
    projection, mean = Projection.of(posterior, at, []), state.theta - rows.state.theta
    return _with_errors(posterior, sphere, at, projection, linear, state, mean, np.zeros(3), mixture)


def _with_errors(
    posterior: Posterior,
    sphere: OverSphere | None,
    at: HoldsAt,
    projection: Projection,
    sensor: Sensor,
    state: State,
    mean: Floats,
    process_bias: Floats,
    mixture: Sequence[Components],
) -> Average:
    G = parameters_by_theta(posterior.evidence.rows.problem, state)
    smooth = sphere if sphere is not None and sphere.smooth in projection.effects else None
    spread = Spread.of(posterior, mixture, mean, projection, process_bias, at.t_s, smooth)
    probabilities = {**posterior.effect_probabilities, Empirical().name: posterior.unmodelled_probability}
    weights = {effect.name: probabilities[effect.name] for effect in projection.effects}
    loss, unmodelled = float("nan"), None
    if sphere is not None:
        J, reported = sphere.by_parameters(posterior, projection.effects), mean.copy()
        reported[BIAS] += process_bias
        loss = sphere.loss(J @ reported)
        # What the covariance of the parameters does not hold of |a|.
        beside = loss - float(np.einsum("mi,ij,mj->", J, spread.whole, J, optimize=True)) / len(J)
        unmodelled = _noticeable(np.array([beside, sphere.across]), sphere.there.error)
    return Average(
        sensor, G @ spread.whole @ G.T, G @ spread.thermal @ G.T, np.sqrt(spread.prior), weights, unmodelled, loss
    )


def _noticeable(square: Floats, error: float) -> Unmodelled | None:
    """Of mean squares over the ``error`` of a pose."""
    along, across = np.sqrt(np.maximum(square, 0.0)) * (square > NOTICEABLE**2) * error
    return Unmodelled(float(along), float(across)) if along or across else None


def _likeliest(posterior: Posterior) -> list[Effect]:
    """Of each name that is listed the form and the shape of the greatest
    weight, the likeliest name first."""
    weight: dict[int, float] = defaultdict(float)
    effects: dict[int, Effect] = {}
    corrects: dict[str, float] = defaultdict(float)
    for w, found in zip(posterior.set_probabilities, posterior.sets, strict=True):
        scaled = found.coefficients
        ends = np.cumsum([0, *(posterior.evidence.terms[i].rank for i in found.members)])
        for i, first, last in zip(found.members, ends, ends[1:], strict=False):
            term = posterior.evidence.terms[i]
            if term.effect is not None:
                weight[id(term.effect)] += float(w)
                effects[id(term.effect)] = term.effect
                corrects[term.name] += float(w) * rms(scaled[first:last])
    least = NOTICEABLE * posterior.evidence.rows.median_standard_error
    out: dict[str, Effect] = {}
    for key in sorted(weight, key=lambda key: -weight[key]):
        out.setdefault(effects[key].name, effects[key])
    return [
        out[n]
        for n, p in posterior.effect_probabilities.items()
        if reaches(p, posterior.evidence.odds.reported) or corrects[n] > least
    ]


def _mean(posterior: Posterior, projection: Projection) -> tuple[Floats, dict[int, Floats]]:
    """(9+p,) deviations; and by part the rows that are left, weighted by the
    inverse of their covariance."""
    evidence = posterior.evidence
    rows = evidence.rows
    scaled = np.zeros(evidence.columns.count)
    by_part: dict[int, Floats] = defaultdict(lambda: np.zeros(len(rows.y)))
    for found, weight in zip(posterior.sets, posterior.set_probabilities, strict=True):
        if weight < NEGLIGIBLE_PROBABILITY:
            continue
        share = found.part_probabilities * weight
        mean = share[:, None] * found.mean
        places = evidence.places(found.members)
        scaled[places] += mean.sum(axis=0)
        columns = evidence.columns.at(places)
        for part, of_part, q in zip(found.parts, share, mean, strict=True):
            by_part[part] += of_part * rows.y - columns @ q
    deviation = projection.by_term @ scaled
    residuals: dict[int, Floats] = {}
    for part, target in by_part.items():
        inverse = evidence.precision(part)
        solved = inverse_of(rows.linear.T @ inverse @ rows.linear) @ (rows.linear.T @ inverse @ target)
        deviation[:9] += solved / rows.lengths
        residuals[part] = inverse @ (target - rows.linear @ solved)
    return deviation, residuals


def _where_linearised(posterior: Posterior, deviation: Floats, projection: Projection) -> State:
    """Adjust the nine parameters until the exact residuals are those of the
    linear model. This absorbs the higher orders of the effects."""
    rows = posterior.evidence.rows
    wanted = -rows.y + rows.linear @ (rows.lengths * deviation[:9]) + projection.columns @ deviation[9:]
    state = State(np.concatenate([rows.state.theta + deviation[:9], deviation[9:]]), projection.effects)
    nearest, found = np.inf, state
    for _ in range(STEPS):
        with np.errstate(over="ignore", invalid="ignore"):  # where the poses show too little it may go anywhere
            r, _, _ = linearise_all(rows.problem, state, jacobian=False)
            off = rows.basis.T @ (wanted - r / rows.error)
            if not np.linalg.norm(off) < nearest:
                return found
        nearest, found = float(np.linalg.norm(off)), state
        step = np.linalg.lstsq(rows.linear, rows.basis @ off, rcond=None)[0] / rows.lengths
        state = State(state.theta + np.concatenate([step, np.zeros(len(deviation) - 9)]), projection.effects)
    return state


def _process_bias(posterior: Posterior, left: Mapping[int, Floats], t_s: float) -> Floats:
    evidence = posterior.evidence
    out = np.zeros(3)
    for part, weighted in left.items():
        assumed = evidence.parts[part]
        if assumed.kind is not None and assumed.kind.what is UnmodelledKind.TIME:
            out += assumed.tau**2 * assumed.kind.bias_at(evidence.rows, t_s) @ weighted
    return out
