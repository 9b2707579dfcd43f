"""The correction: linear parameters and coefficients of effects, averaged over all
likely sets.

A document has one form and one shape for each effect. So every shape of a name is
projected onto the likeliest one: the coefficients approximate the sum of all shapes
best, in the poses and in the next recording."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, rms
from triaxcal.effects import CATALOGUE, TEMPERATURE
from triaxcal.effects.contract import Effect
from triaxcal.effects.empirical import Empirical
from triaxcal.estimate.calibration import (
    BirgeRatio,
    Calibration,
    Caution,
    ExcessVariance,
    ReferenceEpoch,
    Residual,
    ResidualsTooSmall,
    Unmodelled,
)
from triaxcal.estimate.fit_assessment import too_small
from triaxcal.estimate.likelihood import State, linearise, linearise_all, parameters_by_theta
from triaxcal.evidence.covariances import UnmodelledKind, inverse_of
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.mixture import NEGLIGIBLE_PROBABILITY, Components, OverSphere, Projection, Smooth, components
from triaxcal.evidence.posterior import Posterior, shapes_of
from triaxcal.model.sensor import LINEAR, Sensor
from triaxcal.poses.degrees_of_freedom import lack_of_fit_p, within_pose_dof
from triaxcal.rounding import reaches
from triaxcal.uncertainty.propagation import extrapolated, gain_given_prior

# The covariance of a model average: within each set, part and choice of sizes, and
# between them (law of total covariance).

BIAS = slice(3, 6)
"""The parameters of the search to which a bias adds unscaled."""
THERMAL = frozenset(effect.name for effect in CATALOGUE if TEMPERATURE in effect.needs)


@dataclass(frozen=True, eq=False)
class Spread:
    """Covariances of the parameters as deviations: the ``whole`` covariance
    (9+p,9+p), its part ``thermal`` from sets with an unlisted thermal effect, and
    ``prior`` (p,), the prior variances of the coefficients."""

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
        """Covariance within and between cells. The biases are those of the epoch
        ``t_s``, with the contribution of a process in time. With a ``sphere``, the
        last effect of the ``projection`` is its smooth term."""
        listed = {effect.name for effect in projection.effects}
        whole, thermal = np.zeros((2, len(mean), len(mean)))
        prior, total = np.zeros(len(mean) - LINEAR), 0.0
        # Sum the second moments about the mean over all cells, by their probability.
        for cells in mixture:
            size, here = _moments(cells, posterior, mean, projection, process_bias, t_s, sphere)
            total += float(cells.share.sum())
            whole += here
            prior += size
            if cells.names & (THERMAL - listed):
                thermal += here
        return cls(_sound(whole / total), _sound(thermal / total), prior / total)


def _sound(covariance: Floats) -> Floats:
    """The nearest covariance without negative variances, which rounding may leave."""
    if (np.diag(covariance) >= 0).all():
        return covariance
    size, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)


def smooth_mean(
    posterior: Posterior, mixture: Sequence[Components], projection: Projection, sphere: OverSphere
) -> Floats:
    """(h,) mean coefficients of the smooth term, conditional on the parameters of a
    ``projection`` without such a term."""
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
    """(9+p,d) map from the parameters of the cells to the reported ones."""
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
    """Sums over the choices of sizes, weighted by their probability: prior variances
    (p,) of the coefficients, and second moments (9+p,9+p) about the mean of the
    average."""
    rows, assumed = posterior.evidence.rows, posterior.evidence.parts[cells.part]
    # Prior variance of the reported coefficients.
    to = _by_cells(cells, posterior, projection)
    size = cells.share @ (cells.sizes**2 @ (to[LINEAR:, LINEAR:] ** 2).T)
    added, wandering = np.zeros(len(mean)), np.zeros((len(mean), len(mean)))
    # The smooth term, as a function of the cell's parameters and of the data.
    if sphere is not None:
        smooth = _smooth_of(cells, posterior, projection, projection.effects[:-1], sphere)
        own = slice(len(mean) - len(smooth.constant), len(mean))
        to[own], added[own], wandering[own, own] = smooth.by_parameters, smooth.constant, smooth.error
        size[own.start - LINEAR :] += cells.share.sum() * smooth.prior
    # Deviation of the cell's mean from that of the average.
    off = cells.conditional_mean @ to.T + added - mean
    off[:, BIAS] -= process_bias
    # A process in time predicts the bias at the epoch from the residuals.
    if assumed.kind is not None and assumed.kind.what is UnmodelledKind.TIME:
        there = assumed.tau**2 * assumed.kind.bias_at(rows, t_s) @ cells.inverse
        off[:, BIAS] += cells.residuals @ there.T
        wandering[BIAS, BIAS] = assumed.tau**2 * (
            assumed.kind.scale * np.eye(3) - there @ assumed.kind.bias_at(rows, t_s).T
        )
        to[BIAS] -= there @ cells.design
    # Within the cells, A C Aᵀ times the noise; between them, d dᵀ.
    shared = cells.share * cells.noise
    spread = to @ np.tensordot(shared, cells.conditional_covariance, axes=1) @ to.T + shared.sum() * wandering
    return size, spread + (cells.share[:, None] * off).T @ off


NOTICEABLE = 0.1
"""In standard errors of a pose: an unlikely name with a smaller correction is not
listed."""
SELECTED_LEAST = 0.03
"""An unlikely name is dropped if its mean correction holds less than this share of
its expected square: its coefficients would add uncertainty and hardly any
correction."""
STEPS = 3
"""Gauss–Newton steps, for nine parameters a few parts in a thousand from the
solution."""


class Refusal(StrEnum):
    """The reason for no correction of effects."""

    UNMODELLED = "unmodelled"
    """An unmodelled part probably acts: an average over names would follow it under
    the wrong conditions."""
    CHANGE_POINT = "another"
    """The poses do not share one calibration: a unit or its channels were
    exchanged."""
    ONE_POSE = "one_pose"
    """A name is certain, but has a probability below one half without some single
    pose."""
    GAIN = "gain"
    """No name is certain, and the expected error would decrease too little."""


@dataclass(frozen=True, eq=False)
class Average:
    """``sensor`` has one entry for each likely name, with the mean of its
    coefficients; sets without the effect count as zero. Its biases contain the
    process in time at the reference epoch. ``covariance`` (9+p,9+p) of scale factors,
    misalignments, biases and coefficients is taken within the sets and between them;
    ``thermal`` is its part from sets with an unlisted thermal effect; ``prior_sd``
    (p,) are prior standard deviations of the coefficients under the posterior
    probabilities and sizes. ``weights`` are the probabilities of the names. ``loss``
    is the expected mean square error of |a| over the sphere in the next recording, in
    units of the error of a pose; NaN where not computed."""

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


def average(posterior: Posterior, at: ReferenceEpoch, mixture: Sequence[Components] | None = None) -> Average:
    """The average over all sets, sizes and parts of the named effects, for the epoch
    ``at``. ``mixture`` are the likeliest sets (`components`), where already known."""
    mixture = components(posterior) if mixture is None else mixture
    return _of_likely(posterior, None, at, mixture)


def least_loss(
    posterior: Posterior, at: ReferenceEpoch, linear: Sensor, mixture: Sequence[Components]
) -> tuple[Average, Refusal | None]:
    """The correction with the least expected error, and the reason for no effects in
    it. The candidates are the ``linear`` sensor and the averages that the posterior
    allows (`refusal`). Names none of which is certain are corrected only where the
    expected mean square decreases enough (`Odds.gain_by_names`)."""
    odds = posterior.evidence.odds
    sphere = OverSphere.of(posterior, at, mixture)
    alone = _linear_alone(posterior, at, linear, mixture, sphere)
    # Named effects, if nothing forbids it: their loss against that of the linear
    # sensor.
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
    # A smooth function of direction, if an unmodelled part acts.
    whole = _smooth(posterior, sphere, at, mixture)
    return (whole if whole.loss <= odds.gain * alone.loss else alone), why


def _of_likely(
    posterior: Posterior, sphere: OverSphere | None, at: ReferenceEpoch, mixture: Sequence[Components]
) -> Average:
    listed = _likeliest(posterior)
    made = _of_listed(posterior, sphere, at, listed, mixture)
    kept = [effect for effect in listed if _selected(posterior, made, effect)]
    return made if len(kept) == len(listed) else _of_listed(posterior, sphere, at, kept, mixture)


def _of_listed(
    posterior: Posterior,
    sphere: OverSphere | None,
    at: ReferenceEpoch,
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


def _smooth(posterior: Posterior, sphere: OverSphere, at: ReferenceEpoch, mixture: Sequence[Components]) -> Average:
    """The sensor with the mean of all functions of direction as a smooth term, and
    the nine parameters of the best fit with it; between the poses the function is
    interpolated. Effects of temperature, time or memory are omitted: without a true
    hypothesis nothing supports them under other conditions."""
    rows = posterior.evidence.rows
    # Project effects of the force alone, then add the smooth term.
    projection = Projection.of(posterior, at, [e for e in _likeliest(posterior) if not e.needs])
    coefficients = _mean(posterior, projection)[0][LINEAR:]
    further = smooth_mean(posterior, mixture, projection, sphere)
    projection, coefficients = projection.with_effect(posterior, sphere.smooth), np.concatenate([coefficients, further])
    # Fit the nine parameters to the poses that are no outliers.
    used = np.flatnonzero(posterior.outlier_probabilities < posterior.evidence.odds.reported)
    left = (rows.y - projection.columns @ coefficients)[used]
    nine = np.linalg.lstsq(rows.linear[used], left, rcond=None)[0] / rows.lengths
    mean = np.concatenate([nine, coefficients])
    state = _where_linearised(posterior, mean, projection)
    sensor = state.sensor(rows.problem)
    return _with_errors(posterior, sphere, at, projection, sensor, state, mean, np.zeros(3), mixture)


def _selected(posterior: Posterior, made: Average, effect: Effect) -> bool:
    """Whether a name is likely, or corrects enough of its expected contribution."""
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
    posterior: Posterior, at: ReferenceEpoch, linear: Sensor, mixture: Sequence[Components], sphere: OverSphere
) -> Average:
    """The ``linear`` sensor with the errors from all likely sets: the result where no
    effect is corrected."""
    rows = posterior.evidence.rows
    state = State.of(rows.problem, linear)
    projection, mean = Projection.of(posterior, at, []), state.theta - rows.state.theta
    return _with_errors(posterior, sphere, at, projection, linear, state, mean, np.zeros(3), mixture)


def _with_errors(
    posterior: Posterior,
    sphere: OverSphere | None,
    at: ReferenceEpoch,
    projection: Projection,
    sensor: Sensor,
    state: State,
    mean: Floats,
    process_bias: Floats,
    mixture: Sequence[Components],
) -> Average:
    # Transform from theta to the reported parameters.
    G = parameters_by_theta(posterior.evidence.rows.problem, state)
    smooth = sphere if sphere is not None and sphere.smooth in projection.effects else None
    spread = Spread.of(posterior, mixture, mean, projection, process_bias, at.t_s, smooth)
    probabilities = {**posterior.effect_probabilities, Empirical().name: posterior.unmodelled_probability}
    weights = {effect.name: probabilities[effect.name] for effect in projection.effects}
    loss, unmodelled = float("nan"), None
    if sphere is not None:
        # Expected loss over the sphere, at the reported parameters.
        J, reported = sphere.by_parameters(posterior, projection.effects), mean.copy()
        reported[BIAS] += process_bias
        loss = sphere.loss(J @ reported)
        # Mean square error of |a| that the parameter covariance does not contain.
        remaining = loss - float(np.einsum("mi,ij,mj->", J, spread.whole, J, optimize=True)) / len(J)
        unmodelled = _noticeable(np.array([remaining, sphere.across]), sphere.there.error)
    return Average(
        sensor, G @ spread.whole @ G.T, G @ spread.thermal @ G.T, np.sqrt(spread.prior), weights, unmodelled, loss
    )


def _noticeable(square: Floats, error: float) -> Unmodelled | None:
    """Unmodelled standard deviations from mean squares over the ``error`` of a pose;
    None where both are negligible."""
    along, across = np.sqrt(np.maximum(square, 0.0)) * (square > NOTICEABLE**2) * error
    return Unmodelled(float(along), float(across)) if along or across else None


def _likeliest(posterior: Posterior) -> list[Effect]:
    """The form and shape of the greatest weight for each listed name, the likeliest
    name first."""
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
    """(9+p,) mean deviations of the parameters; and by part the residuals, weighted
    by the inverse of their covariance."""
    evidence = posterior.evidence
    rows = evidence.rows
    scaled = np.zeros(evidence.columns.count)
    by_part: dict[int, Floats] = defaultdict(lambda: np.zeros(len(rows.y)))
    # Mean of the scaled coefficients; by part, the rows less the effects.
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
    # Project onto the listed effects; the nine parameters by generalised least squares.
    deviation = projection.by_term @ scaled
    residuals: dict[int, Floats] = {}
    for part, target in by_part.items():
        inverse = evidence.precision(part)
        solved = inverse_of(rows.linear.T @ inverse @ rows.linear) @ (rows.linear.T @ inverse @ target)
        deviation[:9] += solved / rows.lengths
        residuals[part] = inverse @ (target - rows.linear @ solved)
    return deviation, residuals


def _where_linearised(posterior: Posterior, deviation: Floats, projection: Projection) -> State:
    """The state whose exact residuals equal those of the linear model, by adjustment
    of the nine parameters. This absorbs the higher orders of the effects."""
    rows = posterior.evidence.rows
    wanted = -rows.y + rows.linear @ (rows.lengths * deviation[:9]) + projection.columns @ deviation[9:]
    state = State(np.concatenate([rows.state.theta + deviation[:9], deviation[9:]]), projection.effects)
    nearest, found = np.inf, state
    # Gauss–Newton on the nine parameters, as long as the difference decreases.
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


# The corrected calibration: the model average as a calibration, with the residuals
# of the poses under it.


def corrected(before: Calibration, posterior: Posterior, at: ReferenceEpoch) -> tuple[Calibration, Refusal | None]:
    """The calibration with the likely effects at their mean coefficients, and the
    reason for no effects in it. ``before`` is the linear calibration of all given
    poses: where no effect is corrected (`least_loss`), it stays, with the errors from
    all likely sets."""
    model_average, refused = least_loss(posterior, at, before.sensor, components(posterior))
    rows = posterior.evidence.rows
    needed = dict.fromkeys(name for effect, _ in model_average.sensor.effects for name in effect.needs)
    after = replace(
        before,
        sensor=model_average.sensor,
        covariance=model_average.covariance,
        thermal=model_average.thermal,
        prior_sd=model_average.prior_sd,
        weights=model_average.weights,
        unmodelled=model_average.unmodelled,
        shape_errors=_shape_errors(posterior, model_average),
        channel_reference={name: rows.problem.channel_reference[name] for name in needed},
        birge_ratio=1.0,
        excess_g=0.0,
        dof=rows.noise.students_dof + rows.residual_dof,
        slopes=rows.slopes,
        # What residuals show beyond noise is in the covariance, by the
        # probability of whatever may have made it.
        cautions=_without(before.cautions, BirgeRatio, ExcessVariance),
        holds_at=at,
        linear_only=before if model_average.sensor.effects else None,
    )
    if not model_average.sensor.effects:
        return after, refused
    beyond = extrapolated(after)
    after = after if beyond is None else replace(after, cautions=(*after.cautions, beyond))
    after = _with_residuals(after, rows, model_average)
    others = _without(after.cautions, ResidualsTooSmall)
    return replace(after, cautions=(*others, *too_small(after.residual))), refused


def _without(cautions: Sequence[Caution], *kinds: type[Caution]) -> tuple[Caution, ...]:
    return tuple(c for c in cautions if not isinstance(c, kinds))


def _shape_errors(posterior: Posterior, model_average: Average) -> dict[str, float]:
    """Errors of the shapes in the calibration, about the posterior means."""
    out = {}
    for effect, _ in model_average.sensor.effects:
        for name, shape in shapes_of(posterior, effect.name).items():
            if shape.standard_error is not None:
                off = shape.value - effect.shape[name][0]
                out[f"{effect.name}.{name}"] = float(np.hypot(shape.standard_error, off))
    return out


def _with_residuals(c: Calibration, rows: LinearisedData, model_average: Average) -> Calibration:
    """Residuals in the recording's own poses, at their own times; NaN for faulty
    poses that lack a channel."""
    logged = set.intersection(*(set(p.pose.channels) for p in c.poses if p.used))
    known = [i for i, p in enumerate(c.poses) if logged <= set(p.pose.channels)]
    nan = float("nan")
    unknown = (i for i in range(len(c.poses)) if i not in known)
    rest = {i: replace(c.poses[i], residual_g=nan, studentized=nan, total_standard_error_g=None) for i in unknown}
    found = _with_known_residuals(replace(c, poses=tuple(c.poses[i] for i in known)), rows, model_average, known)
    both = dict(zip(known, found.poses, strict=True)) | rest
    return replace(found, poses=tuple(both[i] for i in range(len(c.poses))))


def _with_known_residuals(
    c: Calibration, rows: LinearisedData, model_average: Average, places: list[int]
) -> Calibration:
    poses = [p.pose for p in c.poses]
    u, covariates = np.array([p.mean for p in poses]), c.covariates_of(poses)
    length, by_u = c.sensor.magnitude(u, covariates)
    direction = c.sensor.up(u, covariates)
    r = length - c.reference
    error = np.sqrt(np.einsum("ni,nij,nj->n", by_u, np.array([p.covariance for p in poses]), by_u))
    leverage = np.zeros(len(poses))
    of_place = {place: i for i, place in enumerate(places)}
    used = [k for k, place in enumerate(rows.places) if c.poses[of_place[int(place)]].used]
    of_used = np.array([of_place[int(place)] for place in rows.places[used]])
    leverage[of_used] = _leverage(rows, used, model_average)
    free = np.maximum(1 - leverage, 1e-6)
    results = tuple(
        replace(
            p,
            direction=direction[i],
            residual_g=float(r[i]),
            standard_error_g=float(error[i]),
            studentized=float(r[i] / error[i] / np.sqrt(free[i])),
            leverage=float(leverage[i]),
            total_standard_error_g=None,
        )
        for i, p in enumerate(c.poses)
    )
    if Empirical().name in c.terms:  # whose linear part is a fit of its own: no one knows how much a pose decides
        return replace(c, residual=Residual.of(r[of_used], error[of_used]), poses=results)
    own, noise, left = r[of_used], error[of_used], len(used) - float(leverage.sum())
    pure = within_pose_dof([poses[i] for i in of_used])
    residual = Residual.of(
        own,
        noise,
        cross_validated_rms_g=rms(own / free[of_used]),
        lack_of_fit_p=lack_of_fit_p(float(np.sum((own / noise) ** 2)), left, pure),
        left=left,
    )
    return replace(c, residual=residual, poses=results)


def _leverage(rows: LinearisedData, used: list[int], model_average: Average) -> Floats:
    """(n,) leverage of those poses, with the priors of the coefficients."""
    problem = replace(rows.problem.only(np.array(used)), slopes=None)
    _, J, error = linearise(problem, State.of(problem, model_average.sensor))
    weighted = J / error[:, None]
    return np.asarray(
        np.clip(np.einsum("np,pn->n", weighted, gain_given_prior(weighted, model_average.prior_sd)), 0.0, 1.0)
    )
