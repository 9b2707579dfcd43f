"""Further effects that no catalogue has, drawn after the method was fixed: nothing was chosen by them.

Those of the unit are in its next recording too, unlike those of the stand, the room and the day. Two are neighbours of
what the catalogue has: play is the hysteresis by the way on which a pose was reached, and is told as such; glue that
creeps after each turn leaves means that go with the pose before, as hysteresis does, and slopes inside the poses that
hysteresis does not have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.undeclared.physics import Effect, axes_drawn, on_axes, sizes
from tests.undeclared.scene import Scene, Triad
from tests.undeclared.uncatalogued import outside


def backlash(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A loose part that comes to rest on one side or the other, by the way in which the unit was turned last."""

    def shape(s: Scene) -> np.ndarray:
        way = np.sign(np.diff(s.pose_force, axis=0, prepend=0.0))
        return np.asarray(way[s.pose])

    axes = axes_drawn(rng)
    columns = on_axes(axes, shape)
    return Effect("backlash", "hysteresis", "play, by the way of the last turn", columns, sizes(rng, len(axes)))


def zero_crossing(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A bridge whose two halves differ: a step of the output where the force changes its sign."""
    width = rng.uniform(0.005, 0.03)
    text = f"step over {width:.3f} g at zero"
    return replace(_by_axes(rng, "zero_crossing", text, lambda s: np.tanh(s.force / width)), of_recording=False)


def settling(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Glue that creeps after each turn towards what it now carries, and begins anew with the next."""
    share, axes = rng.uniform(0.1, 0.6), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        tau_s = share * float(np.median(s.held_s))
        change = np.diff(s.pose_force, axis=0, prepend=s.pose_force[:1])
        since_s = np.maximum(s.t_s - s.t_s[s.begin[s.pose]], 0.0)
        return np.asarray(change[s.pose] * np.exp(-since_s / tau_s)[:, None])

    text = f"creep after each turn, {share:.2f} of the time that poses are held"
    return Effect("settling", None, text, on_axes(axes, shape), sizes(rng, len(axes)))


def telegraph(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A defect that traps charge and lets it go: the bias hops between two levels at random times."""
    level = np.cumsum(rng.random(scene.poses + 1) < rng.uniform(0.15, 0.4)) % 2 - 0.5
    force = rng.standard_normal(3)

    def columns(s: Scene) -> np.ndarray:
        return np.asarray((level[np.minimum(s.pose, len(level) - 1)][:, None] * force)[:, :, None])

    return outside("telegraph", "bias that hops between two levels", columns, np.ones(1))


def flickering_gain(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A supply that nobody logs and that is another in each pose: the scale factors go with it."""
    ripple = rng.standard_normal(scene.poses + 1)

    def columns(s: Scene) -> np.ndarray:
        return np.asarray((ripple[np.minimum(s.pose, len(ripple) - 1)][:, None] * s.force)[:, :, None])

    return outside("flickering_gain", "scale factor at random in each pose", columns, np.ones(1))


def transverse(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A beam that is pulled across: what acts perpendicular to an axis, by its amount alone."""

    def shape(s: Scene) -> np.ndarray:
        across = np.sum(s.force**2, axis=1, keepdims=True) - s.force**2
        return np.asarray(np.maximum(across, 0.0) ** 0.25)

    return replace(_by_axes(rng, "transverse", "root of the force across", shape), of_recording=False)


def sagging_fixture(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A fixture that bends under the unit and strains its case, by three bumps a turn."""
    phase, force = rng.uniform(0, 2 * np.pi), rng.standard_normal(3)

    def columns(s: Scene) -> np.ndarray:
        around = np.arctan2(s.up[:, 1], s.up[:, 0])
        bent = np.hypot(s.up[:, 0], s.up[:, 1]) ** 3 * np.cos(3 * around + phase)
        return np.asarray((bent[:, None] * force)[s.pose][:, :, None])

    return outside("sagging_fixture", "three bumps a turn about the unit's z", columns, np.ones(1))


def two_operators(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Every other pose is held by somebody with warmer hands."""
    force, first = rng.standard_normal(3), int(rng.integers(2))

    def columns(s: Scene) -> np.ndarray:
        hand = (s.pose + first) % 2 - 0.5
        return np.asarray((hand[:, None] * force)[:, :, None])

    return outside("two_operators", "bias in every other pose", columns, np.ones(1))


def heater(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A heater that goes on and off a few times, which no channel shows."""
    period, duty, phase = scene.duration_s / rng.uniform(2.0, 6.0), rng.uniform(0.3, 0.7), rng.uniform()
    return _by_axes(
        rng,
        "heater",
        f"on and off every {period:.1f} s",
        lambda s: ((s.t_s / period + phase) % 1.0 < duty).astype(float),
    )


def square_root_of_time(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Moisture that diffuses into the package, from the moment at which it was opened, somewhere in the recording."""
    opened_s = scene.duration_s * rng.uniform(0.1, 0.6)
    return _by_axes(
        rng,
        "square_root_of_time",
        f"root of the time since {opened_s:.1f} s",
        lambda s: np.sqrt(np.maximum(s.t_s - opened_s, 0.0) / s.duration_s),
    )


def _by_axes(rng: np.random.Generator, kind: str, text: str, shape: Callable[[Scene], np.ndarray]) -> Effect:
    axes = axes_drawn(rng)
    return outside(kind, text, on_axes(axes, shape), sizes(rng, len(axes)))


_DRAWN = (
    backlash,
    zero_crossing,
    settling,
    telegraph,
    flickering_gain,
    transverse,
    sagging_fixture,
    two_operators,
    heater,
    square_root_of_time,
)
KINDS = tuple(f.__name__ for f in _DRAWN)


def drawn(rng: np.random.Generator, kind: str, scene: Scene, triad: Triad) -> Effect:
    return next(effect for effect in _DRAWN if effect.__name__ == kind)(rng, scene, triad)
