"""The steps of the loop: the plain model, the model with each effect in turn, and the errors of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from triaxcald.report.figures import clean, effect_title, number
from triaxcald.report.untrusted import mapping

AFTER = "After"


@dataclass(frozen=True)
class Residual:
    """Errors of the magnitude in g, and the probability that pure noise leaves as much."""

    rms_g: float | None = None
    max_abs_g: float | None = None
    cross_validated_rms_g: float | None = None
    noise_floor_g: float | None = None
    lack_of_fit_p: float | None = None


@dataclass(frozen=True)
class Stage:
    """The model at one step of the loop: its errors and, where known, the residual of every pose in g.

    ``adds`` is the effect by which it differs from the step before.
    """

    label: str
    residual: Residual
    held_out_rms_g: float | None = None
    pose_residual_g: NDArray[np.float64] | None = None
    adds: str = ""
    p_value: float | None = None

    @property
    def title(self) -> str:
        """The label, with the effect that the last step added."""
        return f"{self.label}: + {self.adds}" if self.label == AFTER and self.adds else self.label


@dataclass(frozen=True)
class HeldOut:
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None
    poses: int | None


def residual_of(value: object) -> Residual | None:
    known = mapping(value)
    return Residual(*(number(known.get(field.name)) for field in fields(Residual))) if known else None


def held_out_of(document: Mapping[str, object]) -> HeldOut | None:
    known = mapping(document.get("held_out"))
    if not known:
        return None
    poses = number(known.get("poses"))
    return HeldOut(
        number(known.get("before_rms_g")),
        number(known.get("after_rms_g")),
        number(known.get("noise_floor_g")),
        None if poses is None else int(poses),
    )


def stages_of(
    document: Mapping[str, object],
    calibration: Mapping[str, object],
    before_g: Sequence[float | None],
    after_g: Sequence[float | None],
    held_out: HeldOut | None,
) -> tuple[Stage, ...]:
    """Before, after each effect but the last, and after the last one; ``before_g`` and ``after_g`` by pose."""
    after = residual_of(document.get("after")) or residual_of(calibration.get("residual"))
    before = residual_of(document.get("before"))
    if before is None and after is None:
        return ()
    held_after_g = held_out.after_rms_g if held_out else None
    if before is None or before == after:
        return (Stage("This model", after or Residual(), held_after_g, _series(after_g)),)
    first = Stage("Before", before, held_out.before_rms_g if held_out else None, _series(before_g))
    if after is None:
        return (first,)
    steps = list(_steps(document.get("findings"), {str(t) for t in _entries(calibration.get("terms"))}, len(after_g)))
    adds, p_value = (steps[-1].adds, steps[-1].p_value) if steps else ("", None)
    last = Stage(AFTER, after, held_after_g, _series(after_g), adds, p_value)
    return (first, *(s for s in steps[:-1] if s.residual != Residual()), last)


def _steps(findings: object, terms: set[str], pose_count: int) -> Iterator[Stage]:
    """The effects that the model took, in order, each with the errors of the model that it made."""
    for known in map(mapping, _entries(findings)):
        effect = str(known.get("effect", ""))
        if effect not in terms:
            continue
        per_pose = known.get("pose_residual_g")
        series = _series([number(value) for value in per_pose]) if isinstance(per_pose, list) else None
        whole = series if series is not None and series.size == pose_count else None
        title = clean(effect_title(effect)).lower()
        yield Stage(
            f"+ {title}", residual_of(known.get("residual")) or Residual(), None, whole, title,
            number(known.get("p_value")),
        )  # fmt: skip


def _entries(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else ()


def _series(values: Sequence[float | None]) -> NDArray[np.float64] | None:
    """Residuals as an array with NaN for a missing one; None when all are missing."""
    array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return None if array.size == 0 or bool(np.isnan(array).all()) else array
