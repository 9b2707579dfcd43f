"""Guidance of the operator: poses so far, present stillness, next direction. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

import triaxcal as tc
from triaxcald.station.faces import described

COVERED_DEG = 25.0
"""Largest angle between a pose and the direction of the plan that it covers."""
SAME_DEG = 10.0
"""Angle to the first pose that always suffices for its repetition, however close other
poses are to each other."""


Vector = tuple[float, float, float]


@dataclass(frozen=True)
class NextPose:
    """The pose to take next: the ``label`` in the plan and the direction of up in the
    unit's axes, of length 1. ``once_more``: it was taken before, and is wanted
    again."""

    label: str
    vector: Vector
    once_more: bool = False

    def __str__(self) -> str:
        """The axes that point up; of a direction that only a number names also its
        description."""
        numbered = not self.label.startswith(("+", "-"))
        up = f"{self.label} ({described(np.array(self.vector))})" if numbered else f"{self.label} up"
        return f"{up} once more: the first pose again shows drift" if self.once_more else up


@dataclass(frozen=True)
class Guide:
    """State of a pose acquisition: ``found`` of ``wanted`` distinct poses; ``held_s``
    is the present time of stillness (0 during a motion), of ``hold_s`` that a pose
    needs.

    ``next`` is the next pose; None if the acquisition is complete, or if any pose not
    taken yet will do. ``too_short``: the present pose has to be held longer.

    ``missing`` are the labels of the uncovered poses of the plan, in its order, or the
    best one first where that is ``ranked``.
    ``repeat_due``: the first pose is wanted once more, after all others. ``at`` is the
    label of the present pose in the plan, None during a motion and off the plan.
    ``counted_s`` are times inside the poses that were long enough, for the next
    evaluation. ``taken`` are the directions of the distinct poses, ``lacking`` those of
    the ``missing``, ``up`` that of the present pose, None during a motion; all in the
    unit's axes.
    """

    found: int
    wanted: int
    held_s: float
    hold_s: float
    next: NextPose | None = None
    too_short: bool = False
    missing: tuple[str, ...] = ()
    repeat_due: bool = False
    at: str | None = None
    counted_s: tuple[float, ...] = ()
    only_near: bool = False
    """Whether poses keep coming in unwanted directions, so that they must suffice."""
    ranked: bool = False
    taken: tuple[Vector, ...] = ()
    lacking: tuple[Vector, ...] = ()
    up: Vector | None = None

    @property
    def complete(self) -> bool:
        return (self.found >= self.wanted or self.only_near) and not self.repeat_due

    @property
    def text(self) -> str:
        """The instruction to the operator, in words."""
        if self.complete:
            return "done"
        if self.too_short:
            return f"hold still, {self.held_s:.1f} of {self.hold_s:.1f} s"
        return "turn the unit to a pose not taken yet" if self.next is None else f"next: {self.next}"


def guide(
    poses: Sequence[tc.StillSpan],
    *,
    wanted: int,
    hold_s: float,
    apart_deg: float,
    now_s: float,
    nominal_scale_factor: Sequence[float] | None,
    nominal_offset: Sequence[float] = (0.0, 0.0, 0.0),
    plan: bool = True,
    repeat: bool = False,
    counted_s: Collection[float] = (),
    apart_from: tc.Floats | None = None,
    targets: Sequence[tc.planning.Direction] | None = None,
    best_first: bool = False,
) -> Guide:
    """Judge the poses so far, which may come in any order; ``repeat`` asks for
    the first of them again at the end.

    With ``apart_from`` (n,3), directions of up, only poses apart from those count.
    The request for such poses ends once twice ``wanted`` other poses have come, or as
    many as ``apart_from`` has.

    ``targets`` are the wanted directions, by default those of a plan with ``wanted``
    poses. They are wanted in their order, or with ``best_first`` by how much each of
    them lowers the uncertainty of the magnitude; ``wanted`` may be less than they are.

    ``now_s`` is the time of the latest sample, on the time scale of the poses. A pose
    around one of ``counted_s`` was long enough before: it still counts if its ends
    have moved, as the estimate of the noise improved.
    """
    last = poses[-1] if poses else None
    # A pose that is still growing ends a guard window before the latest sample.
    still_s = last.end_s - last.start_s if last is not None and now_s - last.end_s < 0.5 else 0.0
    up = ups(poses, nominal_scale_factor, nominal_offset)
    enough = [p.end_s - p.start_s >= hold_s or any(p.start_s <= t <= p.end_s for t in counted_s) for p in poses]
    held = [v for v, is_enough in zip(up, enough, strict=True) if is_enough]
    taken = [] if apart_from is None else list(apart_from)
    distinct: list[tc.Floats] = []
    since: list[tc.Floats] = []
    others: list[tc.Floats] = []
    for v in held:
        if _near(v, taken, apart_deg):
            if not _near(v, others, apart_deg):
                others.append(v)
        elif len(distinct) < wanted and not _near(v, distinct, apart_deg):
            distinct.append(v)
            since = []
        else:
            since.append(v)
    found = len(distinct)
    in_all = found + len(others)
    only_near = bool(taken) and found < wanted <= in_all and in_all >= min(2 * wanted, len(taken))

    if targets is None:
        targets = (
            tc.planning.directions(wanted) if plan else tc.planning.elsewhere(np.array(taken), wanted) if taken else []
        )
    # A pose that does not count may cover a direction; at last that is wanted again.
    missing = (_uncovered(targets, held) or _uncovered(targets, distinct)) if found < wanted else ()
    if best_first and missing:
        missing = _best_first(targets, held, missing)
    due = repeat and found >= wanted and not _near(distinct[0], since, max(apart_deg, SAME_DEG))
    at = next(iter(_covered(targets, up[-1:])), None) if still_s else None
    following = None
    if due:
        following = _again(targets, distinct[0])
    elif missing and not only_near:
        following = _pose_of(*next(target for target in targets if target[0] == missing[0]))
    too_short = 0 < still_s < hold_s and not enough[-1]
    middles = tuple((p.start_s + p.end_s) / 2 for p, is_enough in zip(poses, enough, strict=True) if is_enough)
    return Guide(
        found, wanted, still_s, hold_s, following, too_short, missing, due, at, middles, only_near, best_first,
        taken=tuple(map(_vector, distinct)),
        lacking=tuple(_vector(v) for label, v in targets if label in missing),
        up=_vector(up[-1]) if still_s else None,
    )  # fmt: skip


def _vector(v: tc.Floats) -> Vector:
    x, y, z = v.tolist()
    return (x, y, z)


def _near(v: tc.Floats, others: Sequence[tc.Floats], degrees: float) -> bool:
    return any(float(v @ d) >= np.cos(np.radians(degrees)) for d in others)


def _uncovered(targets: Sequence[tc.planning.Direction], held: Sequence[tc.Floats]) -> tuple[str, ...]:
    covered = _covered(targets, held)
    return tuple(label for label, _ in targets if label not in covered)


def _covered(targets: Sequence[tc.planning.Direction], held: Sequence[tc.Floats] | tc.Floats) -> set[str]:
    """Labels of the directions that the poses ``held`` are nearest to, and near
    enough."""
    if not targets or not len(held):
        return set()
    cosines = np.array(held) @ np.array([v for _, v in targets]).T
    nearest = np.argmax(cosines, axis=1)
    close = cosines[np.arange(len(held)), nearest] >= np.cos(np.radians(COVERED_DEG))
    return {targets[i][0] for i in nearest[close]}


def _best_first(
    targets: Sequence[tc.planning.Direction], held: Sequence[tc.Floats], missing: Sequence[str]
) -> tuple[str, ...]:
    """``missing``, the best next pose first. Directions of the plan stand for the poses
    that cover them: measured ones move with the noise, and the order with them."""
    covered = _covered(targets, held)
    taken = np.array([v for label, v in targets if label in covered]).reshape(-1, 3)
    left = [target for target in targets if target[0] in missing]
    return tuple(label for label, _ in tc.planning.best_first(taken, left))


def _pose_of(label: str, v: tc.Floats, *, once_more: bool = False) -> NextPose:
    return NextPose(label, _vector(v), once_more)


def _again(targets: Sequence[tc.planning.Direction], v: tc.Floats) -> NextPose:
    """The direction of the plan nearest to the pose ``v``; without a plan the pose
    itself."""
    if not targets:
        return _pose_of("first", v, once_more=True)
    label, direction = max(targets, key=lambda target: float(target[1] @ v))
    return _pose_of(label, direction, once_more=True)


def ups(
    poses: Sequence[tc.StillSpan], nominal: Sequence[float] | None, offset: Sequence[float] = (0.0, 0.0, 0.0)
) -> tc.Floats:
    """Up in the unit's frame, roughly: by the nominal scale factor and the nominal
    ``offset``, else by the range of the outputs so far."""
    if not poses:
        return np.zeros((0, 3))
    u = np.array([p.mean for p in poses])
    if nominal is not None:
        a = (u - np.asarray(offset)) / np.asarray(nominal)
    else:
        middle = (u.max(axis=0) + u.min(axis=0)) / 2
        a = (u - middle) / max(float(np.max(np.ptp(u, axis=0))) / 2, 1e-300)
    return np.asarray(a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300))
