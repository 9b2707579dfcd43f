"""Covariates of the poses: logged channels, time, and functions of the poses.

Time and rates come with any poses. The specific force in the previous pose, and the
scatter in g², need the scale of the outputs; they are added once a fit knows it
(`with_scale`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    DURATION,
    LAGS_S,
    RUN,
    SCATTER,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    covariate_of,
    is_derived,
    lag_in,
    lag_of,
    rate_of,
)
from triaxcal.errors import InvalidData
from triaxcal.poses.pose import Pose

MOVES = 3.0
"""A channel is static unless its means, or its rates, differ by so many of their
standard errors (rms)."""
SCATTER_MOVES = 0.1
"""Scatter is static unless it differs from pose to pose by this share, and by `MOVES`
times its sampling error."""


def covariates(channels: Mapping[str, Floats], reference: Mapping[str, float]) -> dict[str, Floats]:
    """Deviations of the channels from their references; a channel without a reference
    is omitted."""
    return {name: np.asarray(channels[name]) - value for name, value in reference.items() if name in channels}


def channels_of(poses: Sequence[Pose], wanted: Iterable[str] = ()) -> dict[str, Floats]:
    """(n,) each: the channels' means and rates by pose, and time and duration of the
    poses; lags of channels (`lag_of`) as far as they are among the covariates
    ``wanted``."""
    out: dict[str, Floats] = {}
    for channel in sorted(set.intersection(*(set(p.channels) for p in poses)) if poses else set()):
        name = covariate_of(channel)
        out[name] = np.array([p.channels[channel] for p in poses])
        if all(channel in p.rates for p in poses):
            out[rate_of(name)] = np.array([p.rates[channel] for p in poses])
    out[SINCE_START] = np.array([p.t_s for p in poses])
    out[TIME] = out[SINCE_START] - np.array([p.run.middle_s for p in poses])
    out[DURATION] = np.array([p.end_s - p.start_s for p in poses])
    if any(p.run.of > 1 for p in poses):
        out[RUN] = np.array([float(p.run.index) for p in poses])
    out |= _lags(out, poses, wanted)
    return out


def _lags(channels: Mapping[str, Floats], poses: Sequence[Pose], wanted: Iterable[str]) -> dict[str, Floats]:
    """(n,) each: the lags, recording by recording; the channel counts as static
    before its first pose."""
    out: dict[str, Floats] = {}
    runs = np.array([p.run.index for p in poses])
    t_s = np.array([p.t_s for p in poses])
    for name in wanted:
        lag = lag_in(name)
        if lag is None or lag[0] not in channels:
            continue
        out[name] = np.zeros(len(poses))
        # Poses of one recording in order of time.
        for run in np.unique(runs):
            rows = np.flatnonzero(runs == run)
            rows = rows[np.argsort(t_s[rows], kind="stable")]
            # Extrapolate the channel to the start of the first pose.
            first, values = poses[rows[0]], channels[lag[0]][rows]
            at_start = values[0] - (first.t_s - first.start_s) * first.rates.get(channel_of(lag[0]), 0.0)
            since = lag_deviation(np.insert(t_s[rows], 0, first.start_s), np.insert(values, 0, at_start), lag[1])
            out[name][rows] = since[1:]
    return out


def lag_deviation(t_s: Floats, values: Floats, constant_s: float) -> Floats:
    """(n,) deviation y − c of a first-order lag, τ y′ = c − y, from the channel c
    that it follows, at ascending times (n,) with values c (n,). The channel is linear
    in between, and constant for a long time before the first value."""
    out = np.zeros(len(values))
    # Exact solution over a step: e^(−x) of the old deviation, less the change times (1
    # − e^(−x))/x, x = step/τ.
    for i, (step_s, change) in enumerate(zip(np.diff(t_s), np.diff(values), strict=True)):
        x = step_s / constant_s
        caught = -math.expm1(-x)
        out[i + 1] = out[i] * (1 - caught) - change * (caught / x if x > 0 else 1.0)
    return out


def rate_of_lag(behind_by: Floats, rate: Floats, constant_s: float) -> Floats:
    """(n,) derivative of `lag_deviation`, per second, for a channel of this
    ``rate``."""
    return -behind_by / constant_s - rate


def lags_for(effects: Iterable[Effect]) -> tuple[str, ...]:
    """All lags of the channels of which the effects need any lag: the search may
    change the time constant."""
    found = {lag[0] for e in effects for n in e.needs if (lag := lag_in(n))}
    return tuple(lag_of(channel, constant_s) for channel in sorted(found) for constant_s in LAGS_S)


def with_scale(
    channels: Mapping[str, Floats], poses: Sequence[Pose], scale_factor: Floats, bias: Floats
) -> dict[str, Floats]:
    """The channels with the covariates that need ``scale_factor`` (3,) output/g and
    ``bias`` (3,) g: previous pose, change, scatter."""
    now = np.array([p.mean for p in poses])
    before = np.array([p.mean if p.before is None else p.before for p in poses])
    change = (now - before) / scale_factor
    before = before / scale_factor - bias
    scatter = np.array([p.scatter for p in poses]) / scale_factor**2
    own = zip((BEFORE, CHANGE, SCATTER), (before, change, scatter), strict=True)
    return dict(channels) | {name: values[:, i] for names, values in own for i, name in enumerate(names)}


def of_unknown_history(poses: Sequence[Pose], effects: Iterable[Effect]) -> tuple[int, ...]:
    """Poses whose preceding pose is unknown although an effect needs it. Their
    covariates assume rest in the same attitude."""
    needed = {n for e in effects for n in e.needs} & {*BEFORE, *CHANGE}
    return tuple(i for i, p in enumerate(poses) if p.before is None) if needed else ()


def references(channels: Mapping[str, Floats]) -> dict[str, float]:
    """Zero points of the covariates: the means of channels and time, zero for other
    derived covariates.

    Rounded, so that a reference temperature reads well and fits a float32 register:
    to a tenth, or to a tenth of the range where that is finer.
    """
    zero = {name for name in channels if is_derived(name)} - {TIME}
    return {
        name: 0.0 if name in zero else round(float(np.mean(values)), _decimals(float(np.ptp(values))))
        for name, values in channels.items()
        if np.isfinite(values).all()
    }


def _decimals(span: float) -> int:
    return max(1, 1 - math.floor(math.log10(span))) if span > 0 else 6


def covariates_elsewhere(
    poses: Sequence[Pose],
    reference: Mapping[str, float],
    scale_factor: Floats,
    bias: Floats,
    moment: tuple[float, float] | None = None,
) -> dict[str, Floats]:
    """`covariates` of poses of another recording than that of ``reference``, whose
    clock is its own: effects of time are evaluated at one ``moment`` (`of_moment`).
    Raises InvalidData where a channel is missing."""
    channels = with_scale(channels_of(poses, reference), poses, scale_factor, bias)
    channels[RUN] = np.full(len(poses), np.inf)
    missing = [n for n in reference if n not in channels]
    if missing:
        named = ", ".join(map(channel_of, missing))
        raise InvalidData(f"the poses have no channel {named}, which the calibration needs")
    channels |= {name: np.full(len(poses), value) for name, value in of_moment(reference, moment).items()}
    return covariates(channels, reference)


def of_moment(reference: Mapping[str, float], moment: tuple[float, float] | None) -> dict[str, float]:
    """The clocks at a moment, in seconds from the first sample and as `TIME` counts;
    for None long after the start, at the reference of `TIME`."""
    since_start_s, time_s = moment or (np.inf, reference.get(TIME, 0.0))
    return {SINCE_START: since_start_s, TIME: time_s}


def at_reference(names: Iterable[str], n: int) -> dict[str, Floats]:
    """Covariates (n,) at which every effect is at its reference: no deviation, long
    after the start."""
    return {name: np.full(n, np.inf if name in (SINCE_START, RUN) else 0.0) for name in names}


def at_moment(reference: Mapping[str, float], n: int, moment: tuple[float, float] | None) -> dict[str, Floats]:
    """Covariates (n,) of a unit in use: no deviation, and the clocks at the
    ``moment`` (`of_moment`)."""
    clocks = of_moment(reference, moment)
    held = {name: np.full(n, t - reference[name]) for name, t in clocks.items() if name in reference}
    return at_reference(reference, n) | held


def of_readings(
    channels: Mapping[str, Floats], reference: Mapping[str, float], n: int, clocks: Mapping[str, Floats | float]
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """`covariates` of n single readings, for the application of a calibration; and
    the needed covariates that are missing: a channel, its rate, scatter, the previous
    pose. These count as at their reference.

    A derived covariate may be among the ``channels``, unless the reference knows a
    logged channel of that name.
    """
    given = {covariate_of(name) if covariate_of(name) in reference else name: v for name, v in channels.items()}
    known: dict[str, Floats | float] = {**clocks, **given}
    default = at_reference(reference, n)
    held = {
        name: np.broadcast_to(np.asarray(known[name], dtype=float), (n,)) - value if name in known else default[name]
        for name, value in reference.items()
    }
    return held, tuple(name for name in reference if name not in known and name != DURATION)


def static_covariates(poses: Sequence[Pose]) -> set[str]:
    """Covariates that differ from pose to pose by no more than their own noise.

    A coefficient of such a covariate would be fitted to noise.
    """
    still = set()
    for name in sorted(set.intersection(*(set(p.channels) for p in poses))):
        if not _moves([p.channels[name] for p in poses], [p.channel_errors.get(name, 0.0) for p in poses]):
            still.add(covariate_of(name))
        if not _moves([p.rates.get(name, 0.0) for p in poses], [p.rate_errors.get(name, 0.0) for p in poses]):
            still.add(rate_of(covariate_of(name)))
    scatter = np.array([p.scatter for p in poses])
    chance = np.sqrt(2 / np.array([max(p.samples, 2) for p in poses]))
    share = scatter.std(axis=0) / np.maximum(scatter.mean(axis=0), 1e-300)
    if not np.any(share > max(SCATTER_MOVES, MOVES * float(np.sqrt(np.mean(chance**2))))):
        still |= set(SCATTER)
    return still


def _moves(values: list[float], errors: list[float]) -> bool:
    return float(np.std(values)) > MOVES * float(np.sqrt(np.mean(np.square(errors))))


# Covariates that a whole recording shows and a single reading does not: rates of
# channels and their lags.

PARTS = 8
"""Averages over the time of a rate."""


def followed(covariate: str) -> str:
    """The channel of a rate or lag; empty for any other covariate."""
    lag = lag_in(covariate)
    return lag[0] if lag else covariate.removesuffix(rate_of("")) if covariate.endswith(rate_of("")) else ""


@dataclass(frozen=True, eq=False)
class InStream:
    """``covariates`` of a recording by name: times (m,) in s, and the values (m,)
    there."""

    covariates: Mapping[str, tuple[Floats, Floats]]

    @classmethod
    def of(
        cls, pieces: Iterable[tuple[Floats, Mapping[str, Floats]]], wanted: Sequence[str], over_s: float
    ) -> InStream:
        """Rates and lags among the ``wanted`` covariates whose channel is logged. A
        recording comes in ``pieces``, ascending times (n,) with the channels (n,)
        each; a rate is the slope of a straight line over ``over_s``."""
        held: dict[str, list[tuple[Floats, Floats]]] = {followed(name): [] for name in wanted}
        # Average the channels over an eighth of the time of a rate.
        for t_s, channels in pieces if wanted else ():
            for name in held.keys() & channels.keys():
                held[name].append(_averages(t_s, channels[name], over_s))
        found = {}
        # Lag by the exact filter, rate by a moving straight line.
        for name in wanted:
            pairs = held[followed(name)]
            times, values = (np.concatenate([np.empty(0), *(pair[k] for pair in pairs)]) for k in (0, 1))
            if len(times) > 1:
                lag = lag_in(name)
                found[name] = times, lag_deviation(times, values, lag[1]) if lag else _slopes(times, values, over_s)
        return cls(found)

    def at(self, t_s: Floats) -> dict[str, Floats]:
        """(n,) values of each covariate at times (n,)."""
        return {name: np.interp(t_s, times, values) for name, (times, values) in self.covariates.items()}


def _averages(t_s: Floats, values: Floats, over_s: float) -> tuple[Floats, Floats]:
    """Times and values (m,) averaged over intervals of ``over_s`` / `PARTS`, from
    ascending times (n,)."""
    _, index, count = np.unique(np.floor(t_s * (PARTS / over_s)), return_inverse=True, return_counts=True)
    return np.bincount(index, t_s) / count, np.bincount(index, values) / count


def _slopes(t_s: Floats, values: Floats, over_s: float) -> Floats:
    """(m,) slopes of straight lines through all values within half of ``over_s``;
    zero where there is only one. Sums are taken about each moment: sums from the
    start of a long recording would lose digits."""
    count, t, v, tt, tv = np.zeros((5, len(t_s)))
    here = np.arange(len(t_s))
    # Sums over neighbours at a fixed distance in the index.
    for step in range(-PARTS, PARTS + 1):
        there = np.clip(here + step, 0, len(t_s) - 1)
        dt, dv = t_s[there] - t_s, values[there] - values
        inside = (there == here + step) & (np.abs(dt) <= over_s * (0.5 + 0.5 / PARTS))  # no rounding decides the last
        count, t, v = count + inside, t + inside * dt, v + inside * dv
        tt, tv = tt + inside * dt * dt, tv + inside * dt * dv
    # Slope = cov(t, v) / var(t).
    spread = tt - t * t / count
    return np.where(count > 1, (tv - t * v / count) / np.where(count > 1, spread, 1.0), 0.0)
