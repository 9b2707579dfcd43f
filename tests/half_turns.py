"""A unit in its fixture, stood on every face in two orientations by a hand: streams of known truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from triaxcal.frames.faces import LABELS
from triaxcal.frames.unit_frames import SyntheticFixture
from triaxcal.model.directions import directions
from triaxcal.model.gravity import STANDARD_GRAVITY
from triaxcal.model.sensor import Sensor

RATE_HZ, NOISE_G = 100.0, 2e-4
OTHERS = [(label, up) for label, up in directions(26) if len(label) > 2]


@dataclass(frozen=True)
class Hand:
    """How it turns: for how long, how far the sensor is off the axis, how it shakes, whether it stops half-way."""

    seconds: tuple[float, float]
    off_axis_m: tuple[float, float] = (0.005, 0.05)
    shakes_g: tuple[float, float] = (0.003, 0.03)
    band_hz: tuple[float, float] = (3.0, 30.0)
    stops_s: tuple[float, float] = (0.0, 0.0)

    def turn(self, before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n,3) g in the body's frame, by half a circle from ``before`` to ``after``, two ups on one face."""
        moving_s, stop_s = rng.uniform(*self.seconds), rng.uniform(*self.stops_s)
        t = np.arange(0, moving_s + stop_s, 1 / RATE_HZ)
        half = moving_s / 2
        if stop_s:
            angle = np.pi / 2 * (smooth(t / half) + smooth((t - half - stop_s) / half))
        else:
            angle = np.pi * smooth(t / moving_s)
        speed = np.gradient(angle, 1 / RATE_HZ)
        normal, tilt = (before + after) / 2, (before - after) / 2
        out = np.linalg.svd(normal[None])[2][1]
        lever_g = rng.uniform(*self.off_axis_m) / STANDARD_GRAVITY
        pull = -(speed**2)[:, None] * out + np.gradient(speed, 1 / RATE_HZ)[:, None] * np.cross(normal, out)
        felt = np.cos(angle)[:, None] * tilt + np.sin(angle)[:, None] * np.cross(normal, tilt)
        at_work = np.sqrt(speed / speed.max()) if stop_s else np.sqrt(np.sin(np.pi * t / t[-1]).clip(0))
        shaking = rng.uniform(*self.shakes_g) * at_work[:, None] * shaken(len(t), self.band_hz, rng)
        return np.asarray(normal + felt + lever_g * pull + shaking)


# The pull towards the axis is all that a slow smooth turn shows; nearer to the axis it would be lost in the noise.
HANDS = {
    "lifts it and puts it down": Hand((1.0, 4.0), band_hz=(0.5, 12.0)),
    "is quick": Hand((1.0, 1.6), band_hz=(0.5, 12.0)),
    "slides it on the table": Hand((1.0, 4.0)),
    "slides it slowly": Hand((4.0, 8.0)),
    "changes its grip half-way": Hand((1.4, 3.0), stops_s=(0.5, 1.4)),
    "turns it about the sensor itself": Hand((2.0, 6.0), (0.0, 0.0), band_hz=(10.0, 49.0)),
    "turns it smoothly": Hand((1.5, 4.0), shakes_g=(0.0, 0.0)),
    "turns it smoothly and slowly": Hand((4.0, 6.0), (0.02, 0.05), shakes_g=(0.0, 0.0)),
}


@dataclass(frozen=True)
class Stood:
    """A stream (n,) s and (n,3) outputs, when it was still (k,2) s, labels (k,), and the rotation that is sought."""

    t_s: np.ndarray
    u: np.ndarray
    holds: np.ndarray
    labels: tuple[str, ...]
    rotation: Rotation

    @property
    def time_ns(self) -> np.ndarray:
        return np.round(self.t_s * 1e9).astype(np.int64)


def smooth(x: np.ndarray) -> np.ndarray:
    """A minimum-jerk path from 0 to 1."""
    x = np.clip(x, 0, 1)
    return np.asarray(10 * x**3 - 15 * x**4 + 6 * x**5)


def shaken(n: int, band_hz: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """(n,3) of unit variance."""
    sections = butter(2, band_hz, "band", fs=RATE_HZ, output="sos")
    out = sosfilt(sections, rng.standard_normal((n + 400, 3)), axis=0)
    return np.asarray((out / out[400:].std())[400:])


def carried(before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """From one side onto another."""
    n = int(rng.uniform(1.0, 4.0) * RATE_HZ)
    x = ((np.arange(n) + 0.5) / n)[:, None]
    across = np.cross(before, after + 1e-3 * rng.standard_normal(3))
    turned = Rotation.from_rotvec(
        smooth(x) * np.arccos(np.clip(before @ after, -1, 1)) * across / np.linalg.norm(across)
    )
    return np.asarray(turned.apply(before) + 0.02 * np.sqrt(np.sin(np.pi * x)) * shaken(n, (3.0, 12.0), rng))


def knock(n: int, height_g: float, width_s: float) -> np.ndarray:
    """(n,3) g: a blow on the table in the middle of a hold."""
    t = (np.arange(n) - n / 2) / RATE_HZ
    return np.asarray((height_g * np.exp(-0.5 * (t / width_s) ** 2) * np.sin(40 * t))[:, None] * [1.0, -0.6, 0.4])


def stood(
    sensor: Sensor,
    hand: Hand,
    tilt: float,
    seed: int,
    *,
    others: bool = True,
    knocks: tuple[float, float] | None = None,
) -> Stood:
    """On six faces, each in two orientations; then the ``others`` of 26 sides. ``knocks`` (height g, width s) come in
    every third hold."""
    rng = np.random.default_rng([seed, round(tilt * 1e6)])
    fixture = SyntheticFixture.drawn(rng, 1e-3, tilt)
    mount = Rotation.from_rotvec(rng.normal(0, 0.03, 3))
    plan = [(label, h + turn) for label in LABELS for h in [rng.uniform(0, 6)] for turn in (0.0, np.pi)]
    labels = [label for label, _ in plan] + [label for label, _ in OTHERS if others]
    up = mount.inv().apply([*fixture.ups(plan), *(v for _, v in OTHERS if others)])
    parts: list[np.ndarray] = []
    holds = []
    for i, here in enumerate(up):
        if i:
            turns = labels[i] == labels[i - 1]
            parts.append(hand.turn(up[i - 1], here, rng) if turns else carried(up[i - 1], here, rng))
        begin, n = sum(map(len, parts)), int(rng.uniform(4.0, 7.0) * RATE_HZ)
        held = np.repeat(here[None], n, axis=0)
        parts.append(held + knock(n, *knocks) if knocks and i % 3 == 0 else held)
        holds.append((begin / RATE_HZ, (begin + n) / RATE_HZ))
    a = np.concatenate(parts)
    u = sensor.output(a + NOISE_G * rng.standard_normal(a.shape), {})
    axes = np.array([np.eye(3)["XYZ".index(x[1])] * (-1 if x[0] == "-" else 1) for x in LABELS])
    datum, _ = Rotation.align_vectors(axes, np.array([fixture.inward[label] for label in LABELS]))
    return Stood(np.arange(len(a)) / RATE_HZ, u, np.array(holds), tuple(labels), datum * mount)
