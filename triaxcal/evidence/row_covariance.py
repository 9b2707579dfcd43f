"""Covariances of all rows and their inverses, without dense matrices.

A covariance is diagonal, or of low rank on top of the unit noise. Both give an
inverse with a diagonal and a few axes. No singular matrix is inverted: for each axis
the inverse lacks a share between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from triaxcal.arrays import Floats

NOTHING = 1e-9
"""Share of the noise variance that is negligible."""


@dataclass(frozen=True, eq=False)
class RowPrecision:
    """A symmetric matrix (N,N), applied by ``@`` from either side: diag(``weight``) −
    A diag(``taken``) Aᵀ with weight (N,), axes A (N,k) and taken (k,).
    ``half_log_det`` is half the logarithm of its determinant."""

    weight: Floats
    axes: Floats
    taken: Floats
    half_log_det: float

    __array_ufunc__ = None  # an array leaves ``@`` to this class

    def __matmul__(self, columns: Floats) -> Floats:
        """The matrix times columns (N,) or (N,q)."""
        along = (self.axes.T @ columns).T * self.taken
        return np.asarray((columns.T * self.weight - along @ self.axes.T).T)

    def __rmatmul__(self, rows: Floats) -> Floats:
        """Rows (N,) or (q,N) times the matrix."""
        return np.asarray((self @ rows.T).T)


@dataclass(frozen=True, eq=False)
class OwnVariances:
    """Independent ``variances`` (N,) of the rows."""

    variances: Floats

    def times(self, scale: float) -> OwnVariances:
        return OwnVariances(scale * self.variances)

    def beyond(self, basis: Floats) -> Floats:
        """(N,) variances after projection off an orthonormal ``basis`` (N,r)."""
        share = basis**2
        crossed = (basis.T * self.variances) @ basis
        return np.asarray(
            self.variances * (1 - 2 * share.sum(axis=1)) + np.einsum("ni,ij,nj->n", basis, crossed, basis)
        )

    def precision(self, tau: float) -> RowPrecision:
        """Inverse of 1 + τ² diag(variances)."""
        weight = 1 / (1 + tau**2 * self.variances)
        return RowPrecision(weight, np.empty((len(weight), 0)), np.empty(0), 0.5 * float(np.log(weight).sum()))

    def precisions_beyond(self, basis: Floats, taus: Sequence[float]) -> list[RowPrecision]:
        """The same for each τ, after projection off an orthonormal ``basis``
        (N,r)."""
        return [_beyond(self.precision(tau), basis) for tau in taus]


def _beyond(whole: RowPrecision, basis: Floats) -> RowPrecision:
    """P − P B (Bᵀ P B)⁻¹ Bᵀ P for a diagonal P: projection off the ``basis`` B in its
    metric."""
    weighted = basis * whole.weight[:, None]
    value, axes = np.linalg.eigh(basis.T @ weighted)
    value = np.maximum(value, np.finfo(float).tiny)
    half_log_det = whole.half_log_det - 0.5 * float(np.log(value).sum())
    return RowPrecision(whole.weight, weighted @ (axes / np.sqrt(value)), np.ones(len(value)), half_log_det)


@dataclass(frozen=True, eq=False)
class LowRank:
    """Covariance F Fᵀ of functions of few degrees of freedom; ``factor`` F is
    (N,r)."""

    factor: Floats

    def times(self, scale: float) -> LowRank:
        return LowRank(np.sqrt(scale) * self.factor)

    @property
    def variances(self) -> Floats:
        """(N,) variances of the rows."""
        return np.asarray(np.sum(self.factor**2, axis=1))

    def beyond(self, basis: Floats) -> Floats:
        """(N,) variances after projection off an orthonormal ``basis`` (N,r)."""
        return self._left_by(basis).variances

    def precision(self, tau: float) -> RowPrecision:
        """Inverse of 1 + τ² F Fᵀ."""
        return _precision(*self._principal(tau), tau)

    def precisions_beyond(self, basis: Floats, taus: Sequence[float]) -> list[RowPrecision]:
        """The same for each τ, after projection off an orthonormal ``basis``
        (N,r)."""
        axes, variance = self._left_by(basis)._principal(max(taus))
        whole, taken = np.concatenate([basis, axes], axis=1), np.ones(basis.shape[1])
        each = (_precision(axes, variance, tau) for tau in taus)
        return [replace(left, axes=whole, taken=np.concatenate([taken, left.taken])) for left in each]

    def _left_by(self, basis: Floats) -> LowRank:
        return LowRank(self.factor - basis @ (basis.T @ self.factor))

    def _principal(self, tau: float) -> tuple[Floats, Floats]:
        """Principal axes (N,k) and variances (k,) that are not negligible at size
        τ."""
        if not self.factor.size:
            return self.factor, np.empty(0)
        axes, variance = self._all_principal
        shown = tau**2 * variance > NOTHING
        return axes[:, shown], variance[shown]

    @cached_property
    def _all_principal(self) -> tuple[Floats, Floats]:
        axes, size, _ = np.linalg.svd(self.factor, full_matrices=False)
        return axes, size**2


def inverse_of(precision: Floats) -> Floats:
    """(…,d,d) inverses of symmetric matrices (…,d,d). Combinations that are
    determined no better than rounding get the variance that rounding gives them,
    effectively unknown."""
    # Scale to a unit diagonal, then invert with a floor on the eigenvalues.
    size = np.sqrt(np.maximum(np.diagonal(precision, axis1=-2, axis2=-1), np.finfo(float).tiny))
    scaled = precision / size[..., :, None] / size[..., None, :]
    value, axes = np.linalg.eigh(scaled)
    value = np.maximum(value, value.shape[-1] * np.finfo(float).eps)
    axes = axes / size[..., :, None]
    return np.asarray((axes / value[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _precision(axes: Floats, variance: Floats, tau: float) -> RowPrecision:
    # (1 + τ² A v Aᵀ)⁻¹ = 1 − A (1 − 1/(1 + τ² v)) Aᵀ.
    spread = 1 + tau**2 * variance
    return RowPrecision(np.ones(len(axes)), axes, 1 - 1 / spread, -0.5 * float(np.log(spread).sum()))
