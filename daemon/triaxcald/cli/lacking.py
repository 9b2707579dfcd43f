"""What the poses of a recording still lack, whether they carry a fit or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.initial_estimate import rough_directions, wanted_for
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import FULL, cube_directions, most_wanted
from triaxcal.planning.addition import ENOUGH, Addition, Had, additions
from triaxcal.planning.clock import PLANS_CLOCK
from triaxcal.planning.design import ask, channels_needed, profile_times
from triaxcal.planning.noise import fitted_beside, noise_of
from triaxcal.poses.covariates import channels_of
from triaxcal.poses.pose import Pose


@dataclass(frozen=True)
class Lacking:
    """``had`` are the poses that carry a fit, None where they do not, and
    ``dilution`` that of the linear fit to them; ``wanted`` the poses to add;
    ``noise`` the standard error of a typical pose beside the effects, in parts
    of the reference; ``now`` the effects' standard errors without the poses to
    add, in that unit; ``absent`` the channels that the recording has not;
    ``moves`` in words how the channels have to move."""

    had: Had | None
    dilution: float | None
    wanted: list[Addition]
    noise: float | None
    now: Mapping[str, Mapping[str, float | None]]
    absent: tuple[str, ...]
    moves: dict[str, str]


def lacking(poses: Sequence[Pose], effects: Sequence[Effect], *, signs: Sequence[float], reference: float) -> Lacking:
    """Raises Refused where nothing of the effects can be seen at all."""
    asked_for = list(effects)
    logged = channels_of(list(poses)) if poses else {}
    absent = [c for c in channels_needed(asked_for) if c not in logged or not np.isfinite(logged[c]).all()]
    moves = dict.fromkeys(absent, "is not in the recording: log it, and move it")
    there = [e for e in asked_for if not set(e.needs) & set(absent)]
    asked = ask(there)
    if asked_for and not absent and asked.rank == 0:
        raise Refused(f"|a| shows nothing of {', '.join(e.name for e in effects)} beside the nine parameters")
    try:
        linear = fit(poses, signs=signs, reference=reference)
    except Refused as e:
        where = dict(cube_directions())
        up, _ = rough_directions(poses, signs)
        had = _had(up, np.ones(len(up)), poses if len(up) else [], moves, channels_needed(asked.effects))
        labels = e.wanted or wanted_for(poses, signs)
        wanted = additions(had, asked, [(label, where[label]) for label in labels])
        return Lacking(None, None, wanted, None, {}, tuple(absent), moves)
    beside = fitted_beside(poses, there, signs=signs, reference=reference) if there else linear
    had, noise = _had_of(beside, moves, channels_needed(asked.effects))
    first = most_wanted(had.up, enough=ENOUGH, most=FULL, weights=had.weights)
    now = asked.errors(asked.rows(had.up, {n: v * had.half.get(n, 1.0) for n, v in had.held.items()}), had.weights)
    return Lacking(had, linear.dilution, additions(had, asked, first), noise, now, tuple(absent), moves)


def _had_of(c: Calibration, moves: dict[str, str], channels: Sequence[str]) -> tuple[Had, float | None]:
    used = [p for p in c.poses if p.used]
    error = noise_of(c)
    typical = None if error is None else float(np.sqrt(np.median(error**2)))
    weights = np.ones(len(used)) if error is None or typical is None else (typical / error) ** 2
    up = np.array([p.direction for p in used])
    had = _had(up, weights, [p.pose for p in used], moves, channels)
    return replace(had, axes=c.sensor.axes), None if typical is None else typical / c.reference


def _had(up: Floats, weights: Floats, poses: Sequence[Pose], moves: dict[str, str], channels: Sequence[str]) -> Had:
    """Adds to ``moves`` the channels that stood still."""
    held: dict[str, Floats] = {c: np.zeros(len(up)) for c in channels} | {TIME: profile_times(len(up))}
    half = dict.fromkeys((*channels, TIME), 1.0)
    for name, values in channels_of(list(poses)).items() if poses else ():
        span = float(np.ptp(values))
        if name in half and span > 0:
            half[name] = span / 2
            held[name] = (values - values.min()) / half[name] - 1
            if name != TIME:
                moves[name] = f"from {values.min():.4g} to {values.max():.4g} in the recording; levels are within that"
        elif name in channels:
            moves[name] = f"stood still at {values[0]:.4g}: move it to either side of that"
    return Had(up, weights, held | {PLANS_CLOCK: held[TIME]}, half)
