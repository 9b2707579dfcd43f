"""A calibration document as what is known of a unit before a later recording
(`triaxcal.inputs.bias_update`)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from triaxcal.effects import TEMPERATURE
from triaxcal.estimate.calibration import Origin
from triaxcal.inputs.bias_update import Earlier
from triaxcal.interchange.calibration_reading import (
    calibration_of,
    calibration_part,
    logged_in,
    number_in,
    uncertainty_over_error,
)
from triaxcal.model.sensor import LINEAR
from triaxcal.uncertainty.another_day import Source


def earlier_in(document: Mapping[str, Any], origin: Origin, *, where: str) -> Earlier:
    """Of a calibration, loop or certificate document. Its covariance has what
    the budget has beside the fit. Raises InvalidData."""
    part = calibration_part(document, where=where)
    fitted = calibration_of(part, where=where)
    budget, following = part.get("uncertainty"), part.get("next_recording")
    raised = uncertainty_over_error(budget if isinstance(budget, Mapping) else {}, fitted)
    told = following if isinstance(following, Mapping) else {}
    start_to_start = number_in(told.get("start_to_start_g"))
    blind_to, alone = part.get("blind_to"), part.get("linear_only")
    warm = logged_in(part, where=where).get(TEMPERATURE)
    scatter, dof, noise = _scatter(part)
    return Earlier(
        replace(fitted, blind_to=tuple(map(str, blind_to)) if isinstance(blind_to, list) else ()),
        fitted.covariance * np.outer(raised, raised),
        scatter_g=scatter,
        residual_dof=dof,
        noise_g=noise,
        start_to_start=start_to_start if start_to_start >= 0 else None,
        measured=told.get("source") == Source.MEASURED.value,
        temperatures_c=None if warm is None else (float(warm.min()), float(warm.max())),
        origin=origin,
        linear_only=earlier_in(alone, origin, where=f"{where}: linear_only") if isinstance(alone, Mapping) else None,
    )


def _scatter(part: Mapping[str, Any]) -> tuple[float, float, float]:
    """By the residuals: a standard deviation of |a| that every pose had beside
    its noise, by how many degrees of freedom, and one that has the noise in it.
    An update hands on the first, which its few poses tell little of."""
    residual, updated, poses = (part.get(name) for name in ("residual", "rezero", "poses"))
    held = residual if isinstance(residual, Mapping) else {}
    used = sum(bool(p.get("used", True)) for p in poses if isinstance(p, Mapping)) if isinstance(poses, list) else 0
    if isinstance(updated, Mapping):
        known, dof = (max(number_in(updated.get(name)), 0.0) for name in ("scatter_g", "scatter_dof"))
        return known, dof, number_in(held.get("rms_g")) * math.sqrt(used / max(used - 3, 1))
    left = max(used - LINEAR, 0)
    variance = number_in(held.get("rms_g")) ** 2 * used / left if left else math.nan
    beside = variance - number_in(held.get("noise_floor_g")) ** 2
    return (math.sqrt(beside) if beside > 0 else 0.0), float(left), math.sqrt(variance)
