"""The covariance of a model average: within each set, part and choice of sizes,
and between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE, TEMPERATURE
from triaxcal.effects.contract import Effect
from triaxcal.evidence.mixture_components import Components
from triaxcal.evidence.over_sphere import OverSphere, Smooth
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.reported_parameters import Projection
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.model.sensor import LINEAR

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
