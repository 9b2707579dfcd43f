"""Ten effects more that no catalogue has, by somebody who did not know the method.

They were drawn after the method had been changed in sight of `invented`. Those of the unit are in its next recording
too, unlike those of the stand, the clamps, the hands and the day. Two are neighbours of what the catalogue has: the
adapters strain the case as an even function of the force along an axis would, as far as 14 directions can tell;
the heat of a coil follows the square of the force, and the scale factor with it, as in third order, but late.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from tests.undeclared.physics import Effect, axes_drawn, on_axes, several, sizes
from tests.undeclared.scene import TEMPERATURE, Scene, Triad
from tests.undeclared.uncatalogued import outside


def activity_dip(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A vibrating beam that meets another resonance at one force: its frequency is pushed off on either side of it."""
    level, width = rng.uniform(0.3, 0.95, 3) * rng.choice([-1.0, 1.0], 3), rng.uniform(0.02, 0.1)

    def shape(s: Scene) -> np.ndarray:
        x = (s.force - level) / width
        return np.asarray(2 * x / (1 + x**2))

    text = f"resonance {width:.3f} g wide at {', '.join(f'{v:.2f}' for v in level)} g"
    return _of_unit(_by_axes(rng, "activity_dip", text, shape))


def shared_supply(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Three coils on one thin wire: the scale factors fall with the current that all of them draw."""

    def shape(s: Scene) -> np.ndarray:
        return np.asarray(s.force * np.abs(s.force).sum(axis=1, keepdims=True))

    return _of_unit(_by_axes(rng, "shared_supply", "scale factor by the current of all coils", shape))


def loose_part(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A screw left in the case: it lies in the lowest of a few corners, and strains what it lies on."""
    corners = rng.standard_normal((int(rng.integers(3, 7)), 3))
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    strain = rng.standard_normal(corners.shape)

    def columns(s: Scene) -> np.ndarray:
        lies = np.argmin(s.up @ corners.T, axis=1)
        return np.asarray(strain[lies][s.pose][:, :, None])

    return _of_unit(outside("loose_part", f"part that lies in one of {len(corners)} corners", columns, np.ones(1)))


def self_heating(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A coil warms its magnet by the square of its current, and the scale factor follows over one to four poses."""
    tau_s = float(rng.uniform(1.0, 4.0) * np.median(scene.held_s))

    def shape(s: Scene) -> np.ndarray:
        return s.force * _late(s.force**2, s.force[:1] ** 2, tau_s * s.rate_hz)

    return _of_unit(_by_axes(rng, "self_heating", f"scale factor by the coil's own heat, {tau_s:.1f} s late", shape))


def angle_by_temperature(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A block of two metals: the angles between the axes go with the temperature."""
    seen = scene.channels[TEMPERATURE]
    at, across = float(rng.uniform(seen.min(), seen.max())), axes_drawn(rng)
    parts = []
    for i in across:
        one, other = sorted({0, 1, 2} - {i})
        parts.append(on_axes([one], lambda s, j=other: s.force[:, j] * (s.channels[TEMPERATURE] - at)))  # type: ignore[misc]
    text = f"angles about {''.join('xyz'[i] for i in across)} · (T − {at:.2f} °C)"
    return _of_unit(outside("angle_by_temperature", text, several(*parts), sizes(rng, len(parts))))


def hand_heat(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Hands warm the case for as long as they move it, and it cools on the stand."""
    tau_s = float(rng.uniform(0.3, 1.0) * np.median(scene.held_s))

    def shape(s: Scene) -> np.ndarray:
        moved = 1.0 - s.still
        return _late(moved, moved.mean(keepdims=True), tau_s * s.rate_hz)

    return _by_axes(rng, "hand_heat", f"heat of hands, gone after {tau_s:.1f} s", shape)


def auto_zero(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Electronics that drift and set themselves to zero every so often."""
    period_s, phase = scene.duration_s / rng.uniform(3.0, 8.0), rng.uniform()
    return _by_axes(
        rng, "auto_zero", f"drift set to zero every {period_s:.1f} s", lambda s: (s.t_s / period_s + phase) % 1.0
    )


def gain_step(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A resistor that cracks somewhere in the recording: the scale factor is another from there on."""
    at_s = scene.duration_s * rng.uniform(0.15, 0.85)
    return _by_axes(
        rng, "gain_step", f"scale factor step at {at_s:.1f} s", lambda s: s.force * (s.t_s >= at_s)[:, None]
    )


def chip_under_case(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A chip of metal under the unit in one pose: the clamp bends the case over it.

    It is none of the first or the last quarter: a bias step on three axes can be anything in a few poses at an end.
    """
    quarter = scene.poses // 4
    pose, force = int(rng.integers(quarter, scene.poses - quarter)), rng.standard_normal(3)

    def columns(s: Scene) -> np.ndarray:
        return np.asarray(((s.pose == pose).astype(float)[:, None] * force)[:, :, None])

    return outside("chip_under_case", f"case bent in pose {pose}", columns, np.ones(1))


def adapters(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """One adapter for faces, one for edges, one for corners of a cube: each strains the case in its own way."""
    strain = rng.standard_normal((3, 3))

    def columns(s: Scene) -> np.ndarray:
        adapter = np.digitize(np.abs(s.up).sum(axis=1), [1.2, 1.6])  # 1 on faces, √2 on edges, √3 on corners
        return np.asarray(strain[adapter][s.pose][:, :, None])

    return outside("adapters", "strain by adapter", columns, np.ones(1))


def _by_axes(rng: np.random.Generator, kind: str, text: str, shape: Callable[[Scene], np.ndarray]) -> Effect:
    axes = axes_drawn(rng)
    return outside(kind, text, on_axes(axes, shape), sizes(rng, len(axes)))


def _of_unit(effect: Effect) -> Effect:
    return replace(effect, of_recording=False)


def _late(values: np.ndarray, first: np.ndarray, tau: float) -> np.ndarray:
    """First order with a memory of ``tau`` samples, of values (n,…), at rest with ``first`` before the first sample."""
    keeps = np.exp(-1 / tau)
    return np.asarray(first + lfilter([1 - keeps], [1.0, -keeps], values - first, axis=0))


_DRAWN = (
    activity_dip,
    shared_supply,
    loose_part,
    self_heating,
    angle_by_temperature,
    hand_heat,
    auto_zero,
    gain_step,
    chip_under_case,
    adapters,
)
KINDS = tuple(f.__name__ for f in _DRAWN)


def drawn(rng: np.random.Generator, kind: str, scene: Scene, triad: Triad) -> Effect:
    return next(effect for effect in _DRAWN if effect.__name__ == kind)(rng, scene, triad)
