"""A unit, the poses it is put in, and the room around it: what a recording is made of, apart from effects."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tests.undeclared.noise import Shaking

History = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Of times (n,) in s: values (n,) and their rates (n,) a second."""
TEMPERATURE = "temp_c"
OTHER_CHANNELS = {"supply_v": (5.0, 0.2), "humidity": (45.0, 8.0), "pressure_hpa": (1010.0, 3.0), "coil_a": (0.8, 0.1)}
"""Name → usual value, and how far it wanders."""


@dataclass(frozen=True)
class Triad:
    """u = K (R a + b + e): ``scale`` (3,) output units a g, ``angles`` (3,) ax, ay, az in rad, ``bias`` (3,) g."""

    scale: np.ndarray
    angles: np.ndarray
    bias: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Triad:
        unit = rng.choice([1.0, 2.4, 9.80665, 16384.0, 2.0**20])
        scale = unit * 10 ** rng.uniform(-0.25, 0.25, 3) * rng.choice([-1.0, 1.0], 3)
        return cls(scale, np.radians(rng.uniform(-3, 3, 3)), rng.uniform(-0.03, 0.03, 3))

    @property
    def axes(self) -> np.ndarray:
        """R (3,3)."""
        ax, ay, az = self.angles
        return np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])

    def outputs(self, sensed: np.ndarray) -> np.ndarray:
        """(n,3) output units, of R a + e (n,3) in g."""
        return np.asarray(self.scale * (sensed + self.bias))


@dataclass(frozen=True)
class Scene:
    """One recording before noise. By sample: ``t_s`` (n,), ``force`` (n,3) R a in g, ``pose`` (n,) the pose that it
    belongs to, the last one while the unit is moved, ``still`` (n,), ``channels`` and ``rates`` name → (n,).
    By pose: ``up`` (k,3) in the body frame, ``attitude`` (k,3,3) that turns vectors of the room into the body frame,
    ``azimuth`` (k,), ``begin`` and ``end`` (k,) samples.
    """

    rate_hz: float
    t_s: np.ndarray
    force: np.ndarray
    pose: np.ndarray
    still: np.ndarray
    channels: Mapping[str, np.ndarray]
    rates: Mapping[str, np.ndarray]
    up: np.ndarray
    attitude: np.ndarray
    azimuth: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    shaking: Shaking

    @property
    def poses(self) -> int:
        return len(self.up)

    @property
    def duration_s(self) -> float:
        return float(self.t_s[-1])

    @property
    def held_s(self) -> np.ndarray:
        """(k,)"""
        return np.asarray((self.end - self.begin) / self.rate_hz)

    @property
    def pose_force(self) -> np.ndarray:
        """(k,3) R a of each pose."""
        return np.asarray(self.force[self.begin])

    def by_pose(self, values: np.ndarray) -> np.ndarray:
        """(k,…) means over the still part of values (n,…) by sample."""
        return np.array([values[b:e].mean(axis=0) for b, e in zip(self.begin, self.end, strict=True)])


def cube(count: int) -> np.ndarray:
    """(count,3) unit vectors: 6 faces and 8 vertices, with 26 the 12 edges too."""
    if count not in (14, 26):
        raise ValueError(f"14 or 26 directions, not {count}")
    corners = np.array([c for c in itertools.product((1.0, 0.0, -1.0), repeat=3) if any(c)])
    sides = np.abs(corners).sum(axis=1)
    kinds = (1, 3, 2) if count == 26 else (1, 3)
    return np.concatenate([corners[sides == k] / np.sqrt(k) for k in kinds])


def as_mounted(rng: np.random.Generator, count: int) -> np.ndarray:
    """(k,3) directions of a real fixture, each off by up to some degrees, in the order in which they are taken."""
    ideal = cube(count)
    most = np.radians(rng.uniform(1.0, 6.0))
    off = ideal + rng.uniform(0, np.tan(most), (count, 1)) * _across(rng, ideal)
    up = off / np.linalg.norm(off, axis=1, keepdims=True)
    if rng.random() < 0.7:
        up = up[rng.permutation(count)]
    return np.concatenate([up, up[:1]]) if rng.random() < 0.3 else up


def anywhere(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count,3) unit vectors, uniform on the sphere."""
    v = rng.standard_normal((count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _across(rng: np.random.Generator, up: np.ndarray) -> np.ndarray:
    v = rng.standard_normal(up.shape)
    v -= np.sum(v * up, axis=1, keepdims=True) * up
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def attitudes(up: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """(k,3,3) that turn vectors of the room (x, y level, z up) into the body frame, where up is ``up`` (k,3)."""
    level = np.where(np.abs(up[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = level - np.sum(level * up, axis=1, keepdims=True) * up
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(up, x)
    c, s = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
    return np.stack([c * x + s * y, -s * x + c * y, up], axis=2)


def temperature(rng: np.random.Generator, duration_s: float) -> tuple[str, History]:
    kind = str(rng.choice(["wandering", "rising", "warming", "almost constant"], p=[0.4, 0.25, 0.25, 0.1]))
    base, swing = rng.uniform(15, 30), rng.uniform(2, 20)
    wander = wandering(rng, 0.0, 1.0, duration_s)
    if kind == "wandering":
        return kind, _shifted(wander, base, swing / 2)
    if kind == "almost constant":
        return kind, _shifted(wander, base, rng.uniform(0.01, 0.05))
    tau = duration_s * rng.uniform(0.1, 0.6)

    def rising(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, rate = wander(t)
        return base + swing * t / duration_s + 0.03 * swing * value, swing / duration_s + 0.03 * swing * rate

    def warming(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return base - swing * np.exp(-t / tau), swing / tau * np.exp(-t / tau)

    return kind, rising if kind == "rising" else warming


def wandering(rng: np.random.Generator, centre: float, swing: float, duration_s: float) -> History:
    """Three sines of 0.3 to 2 durations."""
    omega = 2 * np.pi / (duration_s * rng.uniform(0.3, 2.0, 3))
    phase, size = rng.uniform(0, 2 * np.pi, 3), rng.uniform(0.3, 1.0, 3)
    size = size / size.sum()

    def of(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = t[:, None] * omega + phase
        return centre + swing * np.sin(angle) @ size, swing * np.cos(angle) @ (size * omega)

    return of


def _shifted(history: History, base: float, swing: float) -> History:
    def of(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, rate = history(t)
        return base + swing * value, swing * rate

    return of


def scene(
    rng: np.random.Generator,
    triad: Triad,
    up: np.ndarray,
    rate_hz: float,
    histories: Mapping[str, History],
    *,
    begins_s: float = 0.0,
    shaken: bool = False,
) -> Scene:
    """``begins_s`` is where the histories stand at the first sample. If ``shaken``, a machine
    shakes the stand in some poses.
    """
    count = len(up)
    hold = np.round(rng.uniform(3, 10, count) * rate_hz).astype(int)
    if rng.random() < 0.3:
        hold[:] = hold[0]
    move = np.round(rng.uniform(1.0, 3.0, count) * rate_hz).astype(int)
    begin = np.concatenate([[0], np.cumsum(hold + move)[:-1]])
    n = int(begin[-1] + hold[-1])
    a, still = np.empty((n, 3)), np.zeros(n, dtype=bool)
    for i in range(count):
        a[begin[i] : begin[i] + hold[i]] = up[i]
        still[begin[i] : begin[i] + hold[i]] = True
        if i + 1 < count:
            a[begin[i] + hold[i] : begin[i + 1]] = _moved(rng, up[i], up[i + 1], move[i], rate_hz)
    t = np.arange(n) / rate_hz
    values = {name: h(t + begins_s) for name, h in histories.items()}
    azimuth = rng.uniform(0, 2 * np.pi, count)
    return Scene(
        rate_hz=rate_hz,
        t_s=t,
        force=a @ triad.axes.T,
        pose=np.searchsorted(begin, np.arange(n), side="right") - 1,
        still=still,
        channels={name: v for name, (v, _) in values.items()},
        rates={name: r for name, (_, r) in values.items()},
        up=up,
        attitude=attitudes(up, azimuth),
        azimuth=azimuth,
        begin=begin,
        end=begin + hold,
        shaking=Shaking.drawn(rng, count, rate_hz) if shaken else Shaking.none(count),
    )


def _moved(rng: np.random.Generator, here: np.ndarray, there: np.ndarray, n: int, rate_hz: float) -> np.ndarray:
    """(n,3) specific force on the way: an arc, and a hand that is not steady."""
    angle = np.arccos(np.clip(here @ there, -1, 1))
    across = there - (here @ there) * here
    if np.linalg.norm(across) < 1e-6:
        across = _across(rng, here[None])[0]
        angle = max(angle, 0.3)  # a unit put back where it was is lifted all the same
    across /= np.linalg.norm(across)
    x = (np.arange(n) + 0.5) / n
    turned = angle * (10 * x**3 - 15 * x**4 + 6 * x**5)
    if here @ there > 1 - 1e-12:
        turned = angle * np.sin(np.pi * x) ** 2
    rough = np.cumsum(rng.standard_normal((n, 3)), axis=0) / np.sqrt(rate_hz)
    rough -= np.linspace(0, 1, n)[:, None] * rough[-1]
    wave = np.sin(np.pi * x)[:, None] * (0.1 * rough + 0.03 * rng.standard_normal((n, 3)))
    return np.asarray(np.cos(turned)[:, None] * here + np.sin(turned)[:, None] * across + wave)
