"""A sensor whose truth is known: attitude path, environment, noise and any
effect of the catalogue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, LAGS_S, SINCE_START, TIME, lag_in, lag_of, rate_of
from triaxcal.model.gravity import STANDARD_GRAVITY
from triaxcal.model.sensor import Sensor
from triaxcal.poses.covariates import lag_deviation
from triaxcal.poses.pose import Pose

LAGS = {lag_of(TEMPERATURE, constant_s): constant_s for constant_s in LAGS_S}
COVARIATES = frozenset({TEMPERATURE, rate_of(TEMPERATURE), *LAGS, TIME, SINCE_START, DURATION, *BEFORE, *CHANGE})
"""What an effect of a synthetic unit may go with."""


class Path(Protocol):
    """The attitude of a unit over time."""

    def specific_force(self, t_s: Floats) -> Floats:
        """a (n,3) in g at times (n,) from the start."""

    def before(self, t_s: Floats) -> Floats:
        """a (n,3) in g in the pose before, that at times (n,) is held or left;
        that of the first pose itself in it."""


LEVER_M = 0.1
"""Of a sensor in the middle of a unit that a hand turns about its edge."""


@dataclass(frozen=True)
class Tumble:
    """A path from pose to pose, for ever: ``hold_s`` still in each direction,
    then ``move_s`` on the shortest arc.

    ``directions`` (k,3) of up in the sensor's frame, unit vectors. The move
    follows a minimum-jerk profile; the sensor sits ``lever_m`` off the axis it
    turns about and feels the tangential and the centripetal acceleration.
    """

    directions: Floats
    hold_s: float
    move_s: float
    lever_m: float = LEVER_M

    @property
    def step_s(self) -> float:
        return self.hold_s + self.move_s

    @property
    def round_s(self) -> float:
        """Seconds until the path is back at its first pose."""
        return self.step_s * len(self.directions)

    def before(self, t_s: Floats) -> Floats:
        """a (n,3) in g in the pose before, that at times (n,) is held or left;
        that of the first pose itself in it."""
        return self.taken(np.maximum(self._step(t_s) - 1, 0))

    def taken(self, step: Ints) -> Floats:
        """(n,3) the directions at steps (n,) of the path, counted from 0."""
        return np.asarray(self.directions[step % len(self.directions)])

    def _step(self, t_s: Floats) -> Ints:
        return np.asarray(np.floor_divide(t_s, self.step_s).astype(int))

    def specific_force(self, t_s: Floats) -> Floats:
        """a (n,3) in g at times (n,) from the start."""
        step = self._step(t_s)
        x = (t_s - step * self.step_s - self.hold_s) / self.move_s
        return turn(self.taken(step), self.taken(step + 1), x, self.move_s, self.lever_m)


def turn(here: Floats, there: Floats, x: Floats, move_s: float, lever_m: float = LEVER_M) -> Floats:
    """a (n,3) in g on the way from the directions ``here`` to ``there`` (n,3), after
    the shares ``x`` (n,) of ``move_s``: below 0 here, above 1 there.

    The way is the shortest arc with a minimum-jerk profile; ``lever_m`` as in `Tumble`.
    """
    x = np.clip(x, 0.0, 1.0)
    angle = np.arccos(np.clip(np.sum(here * there, axis=1), -1.0, 1.0))
    across = _square(here, there)
    turned = angle * (10 * x**3 - 15 * x**4 + 6 * x**5)
    rate = angle * (30 * x**2 - 60 * x**3 + 30 * x**4) / move_s
    acceleration = angle * (60 * x - 180 * x**2 + 120 * x**3) / move_s**2
    along = np.cos(turned)[:, None] * here + np.sin(turned)[:, None] * across
    tangent = -np.sin(turned)[:, None] * here + np.cos(turned)[:, None] * across
    lever_g = lever_m / STANDARD_GRAVITY
    a: Floats = along * (1 - lever_g * rate**2)[:, None] + tangent * (lever_g * acceleration)[:, None]
    return a


def _square(here: Floats, there: Floats) -> Floats:
    """Unit vectors at right angles to ``here``, towards ``there``; any where
    the two are opposite."""
    across = there - np.sum(here * there, axis=1, keepdims=True) * here
    length = np.linalg.norm(across, axis=1, keepdims=True)
    spare = np.cross(here, np.where(np.abs(here[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    spare /= np.linalg.norm(spare, axis=1, keepdims=True)
    return np.where(length > 1e-9, across / np.maximum(length, 1e-300), spare)


@dataclass(frozen=True)
class Environment:
    """Temperature: a start value, a steady ramp, and a slow swing about both."""

    temperature_c: float = 25.0
    ramp_c_per_s: float = 0.0
    swing_c: float = 0.0
    swing_period_s: float = 600.0

    def temperature(self, t_s: Floats) -> Floats:
        swing = self.swing_c * np.sin(2 * np.pi * t_s / self.swing_period_s)
        return np.asarray(self.temperature_c + self.ramp_c_per_s * t_s + swing)

    def temperature_rate(self, t_s: Floats) -> Floats:
        turn = 2 * np.pi / self.swing_period_s
        return np.asarray(self.ramp_c_per_s + self.swing_c * turn * np.cos(turn * t_s))

    def temperature_lag(self, t_s: Floats, constant_s: float) -> Floats:
        """By how much a first-order lag is off the temperature, which stood
        still before the start."""
        turn = 2 * np.pi / self.swing_period_s
        x, gone = turn * constant_s, np.exp(-np.asarray(t_s) / constant_s)
        swing = self.swing_c * x / (1 + x**2) * (gone - np.cos(turn * t_s) - x * np.sin(turn * t_s))
        return np.asarray(self.ramp_c_per_s * constant_s * (gone - 1) + swing)


@dataclass
class SyntheticUnit:
    """A sensor on its path. ``noise_g`` (3,) is white, of one sample; effects
    count from ``channel_reference``, and from zero what goes with the
    temperature's rate, the time since the start or the pose before
    (`COVARIATES`)."""

    sensor: Sensor
    path: Path
    noise_g: Floats
    environment: Environment = field(default_factory=Environment)
    channel_reference: Mapping[str, float] = field(default_factory=lambda: {"temp_c": 25.0, TIME: 0.0})
    seed: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def sample(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Outputs (n,3) and temperature (n,) at times (n,). The noise goes on
        from call to call."""
        t_s = np.asarray(t_s, dtype=float)
        temperature = self.environment.temperature(t_s)
        a = self.path.specific_force(t_s)
        held = {TEMPERATURE: temperature, TIME: t_s}
        covariates = {n: v - self.channel_reference[n] for n, v in held.items() if n in self.channel_reference}
        covariates |= {SINCE_START: t_s, DURATION: np.zeros(len(t_s))}
        covariates[rate_of(TEMPERATURE)] = self.environment.temperature_rate(t_s)
        needs = {name for effect, _ in self.sensor.effects for name in effect.needs}
        covariates |= {n: self.environment.temperature_lag(t_s, LAGS[n]) for n in needs & LAGS.keys()}
        if needs & {*BEFORE, *CHANGE}:
            before = self.path.before(t_s) @ self.sensor.axes.T
            change = a @ self.sensor.axes.T - before
            covariates |= dict(zip((*BEFORE, *CHANGE), (*before.T, *change.T), strict=True))
        clean = self.sensor.output(a, covariates)
        noise = self._rng.standard_normal((len(t_s), 3)) * self.noise_g * self.sensor.scale_factor
        return clean + noise, temperature


def noisy_poses(
    sensor: Sensor,
    directions: Floats,
    standard_error_g: float | Floats,
    rng: np.random.Generator,
    *,
    channels: Mapping[str, Sequence[float] | Floats] | None = None,
    channel_reference: Mapping[str, float] | None = None,
    hold_s: float = 10.0,
) -> list[Pose]:
    """Pose means as a perfect detector would give them, one after the other,
    ``hold_s`` apart.

    ``standard_error_g`` of a mean: one number, (3,) by axis, or (n,3).
    Covariates count from ``channel_reference`` (0 where not given).
    """
    n = len(directions)
    error = np.broadcast_to(np.asarray(standard_error_g, dtype=float), (n, 3)) * np.abs(sensor.scale_factor)
    t_s = (np.arange(n) + 0.5) * hold_s
    held = {name: np.asarray(v, dtype=float) for name, v in (channels or {}).items()}
    reference = channel_reference or {}
    s = directions @ sensor.axes.T
    before = np.concatenate([s[:1], s[:-1]])
    own = {TIME: t_s, SINCE_START: t_s, DURATION: np.full(n, hold_s)}
    own |= {name: before[:, i] for i, name in enumerate(BEFORE)} | {
        name: (s - before)[:, i] for i, name in enumerate(CHANGE)
    }
    needs = {name for effect, _ in sensor.effects for name in effect.needs} - held.keys()
    lags = {name: lag for name in needs if (lag := lag_in(name)) and lag[0] in held}
    own |= {name: lag_deviation(t_s, held[channel], constant_s) for name, (channel, constant_s) in lags.items()}
    covariates = {name: v - reference.get(name, 0.0) for name, v in {**held, **own}.items()}
    u = sensor.output(directions, covariates) + rng.standard_normal((n, 3)) * error
    return [
        Pose(
            start_s=i * hold_s,
            end_s=(i + 1) * hold_s,
            samples=1000,
            mean=u[i],
            covariance=np.diag(error[i] ** 2),
            dof=1e6,
            channels={name: float(v[i]) for name, v in held.items()},
            before=u[i - 1] if i else None,
        )
        for i in range(n)
    ]
