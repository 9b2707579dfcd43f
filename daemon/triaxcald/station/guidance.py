"""What to tell the operator: how many poses are there, is it still now, where to turn next. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.plan import directions
from triaxcal.poses import Pose

COVERED_DEG = 25.0


@dataclass(frozen=True)
class Guide:
    """``found`` of ``wanted`` distinct poses; ``held_s`` how long the unit has been still now (0 when it moves).

    ``missing`` are the labels of the plan's poses that none has come near to.
    """

    found: int
    wanted: int
    held_s: float
    hint: str
    missing: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        return self.found >= self.wanted


def guide(
    poses: Sequence[Pose],
    *,
    wanted: int,
    hold_s: float,
    apart_deg: float,
    now_s: float,
    nominal_scale_factor: Sequence[float] | None,
    plan: bool = True,
) -> Guide:
    """Judge the poses so far. ``now_s`` is the time of the latest sample, counted as the poses' times are."""
    held = [p for p in poses if p.end_s - p.start_s >= hold_s]
    last = poses[-1] if poses else None
    # A pose that is still growing ends a guard window before the latest sample.
    still_s = last.end_s - last.start_s if last is not None and now_s - last.end_s < 0.5 else 0.0
    up = _directions(poses, nominal_scale_factor)
    rows = [i for i, p in enumerate(poses) if p in held]
    distinct: list[Floats] = []
    for v in up[rows]:
        if all(float(v @ d) < np.cos(np.radians(apart_deg)) for d in distinct):
            distinct.append(v)
    found = min(len(distinct), wanted)
    if found >= wanted:
        return Guide(found, wanted, still_s, "done")
    missing = tuple(
        label
        for label, v in (directions(wanted) if plan else ())
        if all(float(v @ d) < np.cos(np.radians(COVERED_DEG)) for d in distinct)
    )
    if 0 < still_s < hold_s:
        hint = f"hold still, {still_s:.1f} of {hold_s:.1f} s"
    elif missing:
        hint = f"next: {missing[0]} up"
    else:
        hint = "turn the unit to a pose not taken yet"
    return Guide(found, wanted, still_s, hint, missing)


def _directions(poses: Sequence[Pose], nominal: Sequence[float] | None) -> Floats:
    """Up in the unit's frame, roughly: by the nominal scale factor, else by the range of the outputs so far."""
    if not poses:
        return np.zeros((0, 3))
    u = np.array([p.mean for p in poses])
    if nominal is not None:
        a = u / np.asarray(nominal)
    else:
        middle = (u.max(axis=0) + u.min(axis=0)) / 2
        a = (u - middle) / max(float(np.max(np.ptp(u, axis=0))) / 2, 1e-300)
    return np.asarray(a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300))
