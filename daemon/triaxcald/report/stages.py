"""The plain model, the one that is handed on, and the errors of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from triaxcald.report.figures import number
from triaxcald.report.untrusted import mapping


@dataclass(frozen=True)
class Residual:
    """Errors of the magnitude in g, and the probability that pure noise leaves
    as much."""

    rms_g: float | None = None
    max_abs_g: float | None = None
    cross_validated_rms_g: float | None = None
    noise_floor_g: float | None = None
    lack_of_fit_p: float | None = None
    weighted_rms: float | None = None
    reduced_chi2: float | None = None


@dataclass(frozen=True)
class Stage:
    """A model: its errors and, where known, the residual of every pose in g."""

    label: str
    residual: Residual
    held_out_rms_g: float | None = None
    pose_residual_g: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class HoldOut:
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None
    poses: int | None
    contradicts: bool = False
    """Whether these poses contradict the calibration."""


def residual_of(value: object) -> Residual | None:
    known = mapping(value)
    return Residual(*(number(known.get(field.name)) for field in fields(Residual))) if known else None


def held_out_of(document: Mapping[str, object]) -> HoldOut | None:
    known = mapping(document.get("held_out"))
    if not known:
        return None
    poses = number(known.get("poses"))
    return HoldOut(
        number(known.get("before_rms_g")),
        number(known.get("after_rms_g")),
        number(known.get("noise_floor_g")),
        None if poses is None else int(poses),
        known.get("contradicts") is not None,
    )


def stages_of(
    document: Mapping[str, object],
    calibration: Mapping[str, object],
    by_pose_g: tuple[Sequence[float | None], Sequence[float | None]],
    held_out: HoldOut | None,
) -> tuple[Stage, ...]:
    """Before and after; one where they are the same. ``by_pose_g`` has the
    residuals of both."""
    before_g, after_g = by_pose_g
    after = residual_of(document.get("after")) or residual_of(calibration.get("residual"))
    before = residual_of(document.get("before"))
    if before is None and after is None:
        return ()
    held_after_g = held_out.after_rms_g if held_out else None
    if before is None or before == after:
        return (Stage("This model", after or Residual(), held_after_g, _series(after_g)),)
    first = Stage("Before", before, held_out.before_rms_g if held_out else None, _series(before_g))
    return (first,) if after is None else (first, Stage("After", after, held_after_g, _series(after_g)))


def _series(values: Sequence[float | None]) -> NDArray[np.float64] | None:
    """Residuals as an array with NaN for a missing one; None when all are
    missing."""
    array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return None if array.size == 0 or bool(np.isnan(array).all()) else array
