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
from triaxcal.interchange.calibration_document import LINEAR
from triaxcal.interchange.calibration_reading import (
    calibration_of,
    calibration_part,
    logged_in,
    number_in,
    uncertainty_over_error,
)
from triaxcal.uncertainty.next_recording import Source


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
    scatter, noise = _scatter(part)
    return Earlier(
        replace(fitted, blind_to=tuple(map(str, blind_to)) if isinstance(blind_to, list) else ()),
        fitted.covariance * np.outer(raised, raised),
        scatter_g=scatter,
        noise_g=noise,
        start_to_start=start_to_start if start_to_start >= 0 else None,
        measured=told.get("source") == Source.MEASURED.value,
        temperatures_c=None if warm is None else (float(warm.min()), float(warm.max())),
        origin=origin,
        linear_only=earlier_in(alone, origin, where=f"{where}: linear_only") if isinstance(alone, Mapping) else None,
    )


def _scatter(part: Mapping[str, Any]) -> tuple[float, float]:
    """By the residuals: a standard deviation of |a| that every pose had beside
    its noise, and one that has the noise in it. An update hands on the first,
    which its few poses tell little of."""
    held, updated, poses = part.get("residual"), part.get("rezero"), part.get("poses")
    residual = held if isinstance(held, Mapping) else {}
    rms, floor = number_in(residual.get("rms_g")), number_in(residual.get("noise_floor_g"))
    used = sum(bool(p.get("used", True)) for p in poses if isinstance(p, Mapping)) if isinstance(poses, list) else 0
    left = used - (len(LINEAR) * 3 if not isinstance(updated, Mapping) else 3)
    whole = rms * math.sqrt(used / left) if left > 0 else math.nan
    if isinstance(updated, Mapping):
        known = number_in(updated.get("scatter_g"))
        return (known if known >= 0 else 0.0), whole
    beside = whole**2 - floor**2
    return (math.sqrt(beside) if beside > 0 else 0.0), whole
