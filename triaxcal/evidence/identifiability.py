"""Which effects poses cannot show in full, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import SCATTER, Effect, channel_of, is_derived, rate_of
from triaxcal.evidence.marginal_likelihood import Evidence
from triaxcal.evidence.unmodelled_kernels import reading_geometry
from triaxcal.model.directions import spiral
from triaxcal.planning.design import VISIBLE
from triaxcal.poses.covariates import static_covariates

SAME = 0.1
"""Of the largest combination of coefficients all over the sphere: two that
differ in |a| by less do so by the misalignments of the axes, and look the same."""


class Why(StrEnum):
    NOT_LOGGED = "not_logged"
    SOMETIMES_LOGGED = "sometimes_logged"
    """The channel is missing in some poses."""
    RATE_UNKNOWN = "rate_unknown"
    NOT_KNOWN = "not_known"
    """A covariate that follows from the poses does not here."""
    STOOD_STILL = "stood_still"
    EVEN_RATE = "even_rate"
    """The channel changes no faster in one pose than in another."""
    EVEN_SCATTER = "even_scatter"
    MOVED_ALONG = "moved_along"
    """Too few poses, or what the effect goes with moved along with their
    directions."""
    FEW_DIRECTIONS = "few_directions"


@dataclass(frozen=True)
class NotIdentifiable:
    """``channel`` is empty where no channel is to blame."""

    why: Why
    channel: str = ""


def not_identifiable(evidence: Evidence, catalogue: Sequence[Effect]) -> Mapping[str, NotIdentifiable]:
    """By name, in the order of the ``catalogue``."""
    shown = {name for name in {term.name for term in evidence.terms} if name and _in_full(evidence, name)}
    return {effect.name: _why(evidence, effect) for effect in catalogue if effect.name not in shown}


def _in_full(evidence: Evidence, name: str) -> bool:
    """Whether no combination of all the coefficients of some shape looks like
    the nine parameters; apart from those that |a| shows nowhere."""
    rows = evidence.rows
    for term in evidence.terms:
        if term.name == name and term.effect is not None and len(term.kept) == len(term.effect.coefficients):
            columns = np.asarray(term.columns) @ _shown_somewhere(evidence, term.effect)
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            left = rows.beyond_linear(columns)
            if rows.residual_dof >= columns.shape[1] and np.linalg.svd(left, compute_uv=False)[-1] > VISIBLE:
                return True
    return False


def _shown_somewhere(evidence: Evidence, effect: Effect) -> Floats:
    """(p,r) combinations of the coefficients, of which |a| shows each somewhere
    on the sphere. Of an effect that needs a covariate it shows all."""
    p = len(effect.coefficients)
    if effect.needs:
        return np.eye(p)
    rows = evidence.rows
    sensor = rows.state.sensor(rows.problem)
    geometry = reading_geometry(rows, sensor.output(spiral(4 * p) * rows.problem.reference, {}))
    shown = np.einsum("ni,nip->np", geometry.by_bias, effect.basis(geometry.along, {}))
    size, combinations = np.linalg.svd(shown, full_matrices=False)[1:]
    return np.asarray(combinations[size > SAME * size[0]].T)


def _why(evidence: Evidence, effect: Effect) -> NotIdentifiable:
    rows = evidence.rows
    known, still = rows.problem.channel_reference, static_covariates(rows.poses)
    for name in effect.needs:
        rate, channel = name.endswith(rate_of("")), channel_of(name.removesuffix(rate_of("")))
        logged = any(channel in p.channels for p in rows.poses)
        if name not in known and (rate or not is_derived(name)) and not (rate and logged):
            return NotIdentifiable(Why.SOMETIMES_LOGGED if logged else Why.NOT_LOGGED, channel)
        if name not in known:
            return NotIdentifiable(Why.RATE_UNKNOWN, channel) if rate else NotIdentifiable(Why.NOT_KNOWN, name)
        if name in still:
            if name in SCATTER:
                return NotIdentifiable(Why.EVEN_SCATTER)
            return NotIdentifiable(Why.EVEN_RATE if rate else Why.STOOD_STILL, channel)
    return NotIdentifiable(Why.MOVED_ALONG if effect.needs else Why.FEW_DIRECTIONS)
