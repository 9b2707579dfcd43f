"""What held in each pose beside its attitude: the logged channels, the time, and what follows from the poses.

Time and rates come with any poses; the specific force in the pose before, and the scatter in g², need the scale of the
outputs, and are added once a fit knows it (`with_scale`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    HELD,
    RUN,
    SCATTER,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    condition_of,
    is_derived,
    rate_of,
)
from triaxcal.errors import InvalidData
from triaxcal.poses.pose import Pose


def conditions(channels: Mapping[str, Floats], reference: Mapping[str, float]) -> dict[str, Floats]:
    """Deviations of the channels from their references; a channel with no reference is left out."""
    return {name: np.asarray(channels[name]) - value for name, value in reference.items() if name in channels}


def channels_of(poses: Sequence[Pose]) -> dict[str, Floats]:
    """The channels' means by pose, (n,) each, their rates, and the time of each pose and for how long it was held."""
    out: dict[str, Floats] = {}
    for channel in sorted(set.intersection(*(set(p.channels) for p in poses)) if poses else set()):
        name = condition_of(channel)
        out[name] = np.array([p.channels[channel] for p in poses])
        if all(channel in p.rates for p in poses):
            out[rate_of(name)] = np.array([p.rates[channel] for p in poses])
    out[SINCE_START] = np.array([p.t_s for p in poses])
    out[TIME] = out[SINCE_START] - np.array([p.run.middle_s for p in poses])
    out[HELD] = np.array([p.end_s - p.start_s for p in poses])
    if any(p.run.of > 1 for p in poses):
        out[RUN] = np.array([float(p.run.index) for p in poses])
    return out


def with_scale(
    channels: Mapping[str, Floats], poses: Sequence[Pose], scale_factor: Floats, bias: Floats
) -> dict[str, Floats]:
    """With the conditions that need ``scale_factor`` (3,) output/g and ``bias`` (3,) g."""
    now = np.array([p.mean for p in poses])
    before = np.array([p.mean if p.before is None else p.before for p in poses])
    change = (now - before) / scale_factor
    before = before / scale_factor - bias
    scatter = np.array([p.scatter for p in poses]) / scale_factor**2
    own = zip((BEFORE, CHANGE, SCATTER), (before, change, scatter), strict=True)
    return dict(channels) | {name: values[:, i] for names, values in own for i, name in enumerate(names)}


def of_unknown_history(poses: Sequence[Pose], effects: Iterable[Effect]) -> tuple[int, ...]:
    """Which poses nothing is known of that one of the effects needs: what was before them. The conditions have them as
    if the unit had rested there before."""
    needed = {n for e in effects for n in e.needs} & {*BEFORE, *CHANGE}
    return tuple(i for i, p in enumerate(poses) if p.before is None) if needed else ()


def references(channels: Mapping[str, Floats]) -> dict[str, float]:
    """Whence conditions are counted: channels and time from their means, what is itself a deviation from zero.

    Rounded, so that a reference temperature reads well and fits a float32 register: to a tenth, or to a tenth of the
    range where that is finer.
    """
    zero = {name for name in channels if is_derived(name)} - {TIME}
    return {
        name: 0.0 if name in zero else round(float(np.mean(values)), _decimals(float(np.ptp(values))))
        for name, values in channels.items()
        if np.isfinite(values).all()
    }


def _decimals(span: float) -> int:
    return max(1, 1 - math.floor(math.log10(span))) if span > 0 else 6


def conditions_elsewhere(
    poses: Sequence[Pose],
    reference: Mapping[str, float],
    scale_factor: Floats,
    bias: Floats,
    moment: tuple[float, float] | None = None,
) -> dict[str, Floats]:
    """`conditions` of poses of another recording than that which ``reference`` is of, whose clock is its own: effects
    of time count as at one ``moment`` (`of_moment`). Raises InvalidData where a channel is missing.
    """
    channels = with_scale(channels_of(poses), poses, scale_factor, bias)
    channels[RUN] = np.full(len(poses), np.inf)
    missing = [n for n in reference if n not in channels]
    if missing:
        named = ", ".join(map(channel_of, missing))
        raise InvalidData(f"the poses have no channel {named}, which the calibration needs")
    channels |= {name: np.full(len(poses), value) for name, value in of_moment(reference, moment).items()}
    return conditions(channels, reference)


def of_moment(reference: Mapping[str, float], moment: tuple[float, float] | None) -> dict[str, float]:
    """The clocks at a moment, given as seconds from the first sample and as `TIME` counts them; long after the start,
    and at the reference of `TIME`, where that is None."""
    since_start_s, time_s = moment or (np.inf, reference.get(TIME, 0.0))
    return {SINCE_START: since_start_s, TIME: time_s}


def at_reference(names: Iterable[str], n: int) -> dict[str, Floats]:
    """n times the conditions at which every effect is at its reference: no deviation, and long after the start."""
    return {name: np.full(n, np.inf if name in (SINCE_START, RUN) else 0.0) for name in names}


def of_readings(
    channels: Mapping[str, Floats], reference: Mapping[str, float], n: int, clocks: Mapping[str, Floats | float]
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """`conditions` of n single readings, for whoever applies a calibration; and those that are needed and were not
    given: a channel, its rate, scatter, the pose before. These count as at their reference.

    A derived condition may be among the ``channels``, unless the reference knows a logged channel of that name.
    """
    given = {condition_of(name) if condition_of(name) in reference else name: v for name, v in channels.items()}
    known: dict[str, Floats | float] = {**clocks, **given}
    default = at_reference(reference, n)
    held = {
        name: np.broadcast_to(np.asarray(known[name], dtype=float), (n,)) - value if name in known else default[name]
        for name, value in reference.items()
    }
    return held, tuple(name for name in reference if name not in known and name != HELD)
