"""Where the fit begins: poses as a problem, its closed form, and the refusal of poses that cannot carry one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import channels_of
from triaxcal.ellipsoid import closed_form, coefficients
from triaxcal.errors import InvalidData, Refused
from triaxcal.plan import dilution, distinct, linear_design, most_wanted
from triaxcal.poses import Pose
from triaxcal.problem import Problem, State, linearise

DILUTION_LIMIT = 100.0
"""Above this a set of poses is refused: some combination of parameters is a hundred times worse than one pose."""
NOISE_LIMIT = 0.1
"""Poses are refused where noise alone, times the dilution, is this share of the reference."""
POSES_LEAST = 9


def problem_of(poses: Sequence[Pose], *, signs: Sequence[float] = (1, 1, 1), reference: float = 1.0) -> Problem:
    """Raises InvalidData, Refused where there are fewer than nine poses."""
    if len(poses) < POSES_LEAST:
        raise Refused(
            f"{len(poses)} still poses; nine parameters need at least {POSES_LEAST}, 14 or 26 are better",
            wanted=_wanted_for(poses, signs),
        )
    u = np.array([p.mean for p in poses])
    low, high = u.min(axis=0), u.max(axis=0)
    flat = [axis for axis, same in zip("xyz", high - low <= 0, strict=True) if same]
    if flat:
        raise Refused(f"the output of axis {', '.join(flat)} never changes; it cannot be calibrated")
    if not all(s in (1, -1) for s in signs):
        raise InvalidData(f"signs must be +1 or −1, not {signs}")
    if not (np.isfinite(reference) and reference > 0):
        raise InvalidData(f"the reference must be a positive number, not {reference}")
    channels = channels_of(list(poses))
    return Problem(
        u=u,
        covariance=np.array([p.covariance for p in poses]),
        channels=channels,
        channel_reference={n: _round(float(np.mean(v))) for n, v in channels.items() if np.isfinite(v).all()},
        middle=(low + high) / 2,
        half=(high - low) / 2,
        signs=np.asarray(signs, dtype=float),
        reference=reference,
    )


def _round(value: float) -> float:
    """To a tenth, so that a reference temperature reads well and fits a float32 register."""
    return round(value, 1)


def start(problem: Problem, poses: Sequence[Pose], signs: Sequence[float]) -> State:
    """The closed form as a starting point, after it is sure that the poses can carry nine parameters."""
    x = (problem.u - problem.middle) / problem.half
    rough = x / np.linalg.norm(x, axis=1, keepdims=True)
    try:
        A, c = closed_form(problem.u)
        a = (problem.u - c) @ A.T
        spread = dilution(a, linear_design(a / np.linalg.norm(a, axis=1, keepdims=True), x))
    except Refused as e:
        raise Refused(f"{e}; {_count(rough)}", wanted=_wanted_for(poses, signs)) from None
    k, angles, b = coefficients(A * problem.reference, c)
    ax, ay, az = angles
    sx, sy, sz = problem.signs
    D = problem.signs * problem.half / k
    w = problem.signs * b - problem.middle * D / problem.half
    state = State(np.concatenate([D, w, [ax * sy * sz, ay * sx * sz, az * sx * sy]]), ())
    noise = float(np.sqrt(np.mean(linearise(problem, state)[2] ** 2))) / problem.reference
    known = spread * noise < NOISE_LIMIT
    if not spread < DILUTION_LIMIT:
        raise Refused(
            f"the poses cannot carry nine parameters: some combination of them would be {spread:.3g} times as "
            f"uncertain as one pose (limit {DILUTION_LIMIT:g}); {_count(a)}",
            wanted=_labels(a * problem.signs) if known else _wanted_for(poses, signs),
        )
    if not known:
        raise Refused(
            f"the poses cannot carry nine parameters: they differ by little more than their noise; {_count(a)}",
            wanted=_wanted_for(poses, signs),
        )
    return state


def _count(a: Floats) -> str:
    return f"{len(a)} poses in {distinct(a)} distinct directions"


def _wanted_for(poses: Sequence[Pose], signs: Sequence[float]) -> tuple[str, ...]:
    """The poses that would mend a set, as far as its directions can be told without a fit."""
    if not poses:
        return _labels(np.zeros((0, 3)))
    u = np.array([p.mean for p in poses])
    middle = (u.max(axis=0) + u.min(axis=0)) / 2
    # Without a scale an axis that hardly moved would look like one that swung from end to end.
    half = float(np.max((u.max(axis=0) - u.min(axis=0)) / 2))
    error = float(np.sqrt(np.mean([np.trace(p.covariance) for p in poses])))
    if half <= error / NOISE_LIMIT:
        return _labels(np.zeros((0, 3)))
    return _labels((u - middle) / half * np.asarray(signs) + 1e-12)


def _labels(a: Floats) -> tuple[str, ...]:
    return tuple(label for label, _ in most_wanted(a))
