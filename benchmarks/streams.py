"""Streams of a unit that is held and moved, whose truth is known: rates, noise, machines, hands, moves, creep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import butter, sosfilt

from benchmarks.noise import first_order, flicker, moving_average, white
from triaxcal.arrays import Floats, Ints
from triaxcal.model.sensor import Sensor

PAPER_UNIT = Sensor(
    np.array([-2.410618, -2.403823, -2.371761]),
    np.array([625.454406e-5, 404.734018e-5, -65.046441e-5]),
    np.array([564.518583e-5, -288.4559e-5, 463.952349e-5]),
)
Noise = Callable[[int, np.random.Generator], Floats]


@dataclass(frozen=True)
class Condition:
    """What a stream is made of. Accelerations in g, times in seconds."""

    name: str
    rate_hz: float = 100.0
    hold_s: tuple[float, float] = (5.0, 5.0)
    move_s: tuple[float, float] = (1.5, 1.5)
    poses: int = 26
    apart_deg: float | None = None
    """None: spread over the sphere."""
    noise: Noise = white
    noise_g: float | tuple[float, float, float] = 2e-4
    by_hand: bool = False
    vibration_g: float = 0.0
    vibration_hz: float = 29.7
    machine: str = "steady"
    """steady, switching (between and within poses), some poses (half of them, more or less loud), or impulses."""
    noise_like: bool = False
    """The machine hisses in an octave from its frequency on, instead of humming."""
    jitter_g: float = 0.0
    """Of the hand that moves the unit, white."""
    bump_g: float = 0.0
    bump_s: float = 0.1
    ringing_g: float = 0.0
    ringing_s: float = 0.3
    creep_g: float = 0.0
    """In every third pose, across the measured vector."""
    step_g: float = 0.0
    """Of the output; 0 for none."""
    offset: float = 0.0
    pulls: bool = True


@dataclass(frozen=True)
class Stream:
    t_s: Floats
    readings: Floats
    clean: Floats
    holds: list[tuple[float, float]]
    truth: Floats


def directions_of(c: Condition, rng: np.random.Generator) -> Floats:
    if c.apart_deg is not None:
        angle = np.radians(c.apart_deg) * np.arange(c.poses)
        return np.stack([np.cos(angle), np.sin(angle) * 0.8, np.sin(angle) * 0.6], axis=1)
    v = rng.standard_normal((20 * c.poses, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    chosen = [v[0]]
    for here in v[1:]:
        if here @ chosen[-1] < np.cos(np.radians(5.0)):
            chosen.append(here)
    return np.array(chosen[: c.poses])


def made(c: Condition, seed: int) -> Stream:
    """A stream of a condition, and its truth."""
    rng = np.random.default_rng([seed, *c.name.encode()])
    directions = directions_of(c, rng)
    holds, moves = rng.uniform(*c.hold_s, c.poses), rng.uniform(*c.move_s, c.poses - 1)
    start = np.r_[0, np.cumsum(holds[:-1] + moves)]
    end = start + holds
    t = np.arange(int(end[-1] * c.rate_hz)) / c.rate_hz
    pose = pose_at(t, start)
    a = directions[pose]
    moving = t >= end[pose]
    for i in range(c.poses - 1):
        at = np.flatnonzero(moving & (pose == i))
        a[at] = path(directions[i], directions[i + 1], (t[at] - end[i]) / moves[i], moves[i], c.by_hand, rng)
    if c.jitter_g:
        into = np.clip((t - end[pose]) / np.r_[moves, 1.0][pose], 0, 1)
        a += (c.jitter_g * np.sin(np.pi * into) ** 0.5)[:, None] * rng.standard_normal(a.shape)
    a += after_moves(c, t, start, pose, rng) + bumps(c, t, start, holds, rng)
    creep = np.zeros_like(a)
    for i in range(1, c.poses, 3):
        across = np.cross(directions[i], rng.standard_normal(3))
        across *= c.creep_g / np.linalg.norm(across)
        into = ((t - start[i]) / holds[i] - 0.5)[:, None]
        creep += np.where((pose == i)[:, None] & ~moving[:, None], into, 0) * across
    clean = PAPER_UNIT.output(a + creep, {})
    noise = c.noise(len(t), rng) * c.noise_g + vibration(c, t, start, holds, rng)
    u = clean + noise * PAPER_UNIT.scale_factor + c.offset
    if c.step_g:
        step = c.step_g * 2.4
        u = np.round(u / step) * step
    truth = PAPER_UNIT.output(directions, {}) + c.offset
    return Stream(t, u, clean + c.offset, list(zip(start, end, strict=True)), truth)


def pose_at(t: Floats, start: Floats) -> Ints:
    """The pose at each time, or the one before the move."""
    return np.asarray(np.searchsorted(start, t, side="right") - 1)


def path(here: Floats, there: Floats, x: Floats, seconds: float, by_hand: bool, rng: np.random.Generator) -> Floats:
    """Specific force on the way: a minimum-jerk arc, or the irregular path and the tremor of a hand."""
    smooth = 10 * x**3 - 15 * x**4 + 6 * x**5
    angle = float(np.arccos(np.clip(here @ there, -1, 1)))
    across = there - (here @ there) * here
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(here, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    a = np.cos(angle * smooth)[:, None] * here + np.sin(angle * smooth)[:, None] * across
    if by_hand:
        middle = (x * (1 - x) * 4)[:, None]
        for _ in range(3):
            wave = np.sin(2 * np.pi * rng.uniform(0.3, 1.5) * x * seconds + rng.uniform(0, 6))[:, None]
            a += middle**1.5 * wave * rng.normal(0, 0.25, 3)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        tremor = np.sin(2 * np.pi * (9 * x * seconds + 0.3 * np.sin(5 * x)) + rng.uniform(0, 6))[:, None]
        a += np.sqrt(middle) * tremor * rng.normal(0, 0.02, 3)
    rate = angle * (30 * x**2 - 60 * x**3 + 30 * x**4) / seconds
    acceleration = angle * (60 * x - 180 * x**2 + 120 * x**3) / seconds**2
    lever = 0.1 / 9.80665
    return np.asarray(
        a * (1 - lever * rate**2)[:, None] + np.cross(np.cross(here, across), a) * lever * acceleration[:, None]
    )


def after_moves(c: Condition, t: Floats, start: Floats, pose: Floats, rng: np.random.Generator) -> Floats:
    """Ringing that dies away from the moment the unit is put down."""
    out = np.zeros((len(t), 3))
    if not c.ringing_g:
        return out
    into = t - start[pose]
    way = rng.standard_normal((len(start), 3))[pose]
    ring = np.exp(-into / c.ringing_s) * np.sin(2 * np.pi * 7.3 * into)
    return np.asarray(np.where((pose > 0)[:, None], c.ringing_g * ring[:, None] * way, 0.0))


def bumps(c: Condition, t: Floats, start: Floats, holds: Floats, rng: np.random.Generator) -> Floats:
    """Knocks inside every fourth pose."""
    out = np.zeros((len(t), 3))
    if c.bump_g:
        for i in range(0, len(start), 4):
            at = t - start[i] - holds[i] * rng.uniform(0.3, 0.7)
            out += (c.bump_g * np.exp(-0.5 * (at / c.bump_s) ** 2) * np.cos(25 * at))[:, None] * rng.standard_normal(3)
    return out


def vibration(c: Condition, t: Floats, start: Floats, holds: Floats, rng: np.random.Generator) -> Floats:
    """A machine beside the stand: two lines and a band about them, by axis."""
    if not c.vibration_g:
        return np.zeros((len(t), 3))
    wander = 1 + 0.2 * first_order(len(t), c.rate_hz, rng)
    lines = sum(
        np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6, 3)) * rng.uniform(0.3, 1, 3)
        for f in (c.vibration_hz, 2.07 * c.vibration_hz)
    )
    if c.noise_like:
        band = [c.vibration_hz, min(2 * c.vibration_hz, 0.48 * c.rate_hz)]
        sections = butter(2, band, "band", fs=c.rate_hz, output="sos")
        lines = sosfilt(sections, rng.standard_normal((len(t), 3)), axis=0)
        lines /= lines.std()
    out = c.vibration_g * wander * lines
    if c.machine == "some poses":
        out *= (rng.uniform(0.2, 1.0, len(start)) * (rng.random(len(start)) < 0.5))[pose_at(t, start)][:, None]
    if c.machine == "switching":
        edges = np.cumsum(rng.uniform(8, 30, 200))
        out *= (np.searchsorted(edges, t) % 2)[:, None]
    if c.machine == "impulses":
        since = t % 3.37
        out = 5 * c.vibration_g * np.exp(-since / 0.02)[:, None] * lines
    return np.asarray(out)


def coloured(kind: Callable[..., Floats], parameter: float) -> Noise:
    return lambda n, rng: kind(n, parameter, rng)


def _average(n: int, length: float, rng: np.random.Generator) -> Floats:
    return moving_average(n, int(length), rng)


SOME_POSES: dict[str, Any] = {"vibration_g": 1e-2, "machine": "some poses", "hold_s": (3.0, 8.0)}
SLOW_TURNS: dict[str, Any] = {"jitter_g": 0.01, "apart_deg": 10.0, "move_s": (6.0, 9.0)}
COVARIATES = [
    Condition("white, 100 Hz"),
    *(Condition(f"white, {r:g} Hz", r, poses=26 if r < 2000 else 14) for r in (20.0, 50.0, 1000.0)),
    Condition("white, 10 kHz", 10_000.0, poses=9, hold_s=(3.0, 3.0)),
    Condition("poses of 1 s, 100 Hz", hold_s=(1.0, 1.0), move_s=(0.8, 1.2)),
    Condition("poses of 1 s, 20 Hz", 20.0, hold_s=(1.0, 1.0), move_s=(0.8, 1.2)),
    Condition("poses of 1 s, 1 kHz", 1000.0, hold_s=(1.0, 1.0), move_s=(0.8, 1.2)),
    Condition("poses of 10 min", hold_s=(600.0, 600.0), poses=6),
    Condition("poses of 1 s to 60 s", hold_s=(1.0, 60.0), move_s=(0.8, 4.0)),
    Condition("moving average of 0.1 s", noise=coloured(_average, 10)),
    Condition("moving average of 0.3 s", noise=coloured(_average, 30)),
    Condition("AR(1), 0.1 s", noise=coloured(first_order, 10)),
    Condition("AR(1), 0.3 s", noise=coloured(first_order, 30)),
    Condition("AR(1), 0.5 s", noise=coloured(first_order, 50)),
    Condition("AR(1), 0.5 s, poses of 20 s", noise=coloured(first_order, 50), hold_s=(20.0, 20.0)),
    Condition("1/f below 0.01 Hz", noise=coloured(flicker, 0.0001)),
    Condition("1/f below 0.1 Hz", noise=coloured(flicker, 0.001)),
    Condition("1/f below 1 Hz", noise=coloured(flicker, 0.01)),
    Condition("1/f below 10 Hz", noise=coloured(flicker, 0.1)),
    Condition("noise 1 µg", noise_g=1e-6),
    Condition("noise 10 mg", noise_g=1e-2),
    Condition("noise 10 mg, slow moves", noise_g=1e-2, move_s=(3.0, 4.0)),
    Condition("noise unequal by axis", noise_g=(1e-5, 2e-4, 5e-3)),
    Condition("5° apart", apart_deg=5.0),
    Condition("5° apart, 10 mg", apart_deg=5.0, noise_g=1e-2),
    Condition("5° apart, 1 s, 5 mg", apart_deg=5.0, noise_g=5e-3, hold_s=(1.0, 2.0)),
    Condition("2° apart", apart_deg=2.0),
    Condition("by hand", by_hand=True, move_s=(0.8, 4.0), hold_s=(2.0, 8.0)),
    Condition("by hand, 10 µg", by_hand=True, move_s=(0.8, 4.0), hold_s=(2.0, 8.0), noise_g=1e-5),
    Condition("by hand, 5 mg", by_hand=True, move_s=(0.8, 4.0), hold_s=(2.0, 8.0), noise_g=5e-3),
    Condition("bumps 1 g, 20 ms", bump_g=1.0, bump_s=0.02, hold_s=(4.0, 8.0)),
    Condition("bumps 10 mg, 0.2 s", bump_g=0.01, bump_s=0.2, hold_s=(4.0, 8.0)),
    Condition("bumps 1 mg, 0.1 s", bump_g=0.001, bump_s=0.1, hold_s=(4.0, 8.0)),
    Condition("ringing 50 mg, 0.3 s", ringing_g=0.05, ringing_s=0.3),
    Condition("ringing 0.5 g, 0.1 s", ringing_g=0.5, ringing_s=0.1),
    Condition("vibration 2 mg", vibration_g=2e-3),
    Condition("vibration 20 mg, 1 kHz", 1000.0, vibration_g=2e-2),
    Condition("vibration 2 mg at 4 Hz", vibration_g=2e-3, vibration_hz=4.3),
    Condition("vibration 5 mg on and off", vibration_g=5e-3, machine="switching"),
    Condition("vibration 5 mg on and off, 1 kHz", 1000.0, vibration_g=5e-3, machine="switching"),
    Condition("vibration 10 mg, some poses", vibration_g=1e-2, machine="some poses", hold_s=(3.0, 8.0)),
    Condition("the same, moves that jitter", **SOME_POSES, jitter_g=0.03, by_hand=True),
    Condition("the same at 7 Hz", **SOME_POSES, jitter_g=0.03, vibration_hz=7.3),
    Condition("the same at 90 Hz, 1 kHz", 1000.0, **SOME_POSES, jitter_g=0.03, vibration_hz=90.0),
    Condition("noise-like vibration, some poses", **SOME_POSES, noise_like=True, vibration_hz=15.0),
    Condition("the same from 5 Hz, by hand", **SOME_POSES, noise_like=True, vibration_hz=5.0, by_hand=True),
    Condition("the same, AR(1), 0.3 s", **SOME_POSES, noise_like=True, jitter_g=0.03, noise=coloured(first_order, 30)),
    Condition("vibration, slow turns that jitter", **(SOME_POSES | SLOW_TURNS)),
    Condition("AR(1), 0.3 s, moves that jitter", noise=coloured(first_order, 30), jitter_g=0.03),
    Condition("AR(1), 0.3 s, slow turns that jitter", noise=coloured(first_order, 30), **SLOW_TURNS),
    Condition("impulses 25 mg every 3.4 s", vibration_g=5e-3, machine="impulses"),
    Condition("coarse steps of 1 mg", step_g=1e-3),
    Condition("coarse steps of 10 mg", step_g=1e-2, pulls=False),
    Condition("counts of 24 bits", noise_g=1e-4, step_g=1e-6, offset=2.0**23 * 2.4e-6),
    Condition("creep 2 mg in every third", creep_g=2e-3, pulls=False),
    Condition("creep 20 mg in every third", creep_g=2e-2, pulls=False),
]
