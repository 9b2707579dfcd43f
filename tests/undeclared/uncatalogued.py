"""Effects that no catalogue has, in g along the sensitive axes. A loop can only say that something is left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.undeclared.physics import Effect, axes_drawn, on_axes, several, sizes
from tests.undeclared.scene import Scene, Triad


def adc_wave(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Integral nonlinearity of a converter: a wave over its scale, of 0.05 to 0.7 g, alike in every converter."""
    period, phase = 10 ** rng.uniform(np.log10(0.05), np.log10(0.7)), rng.uniform(0, 2 * np.pi, 3)
    axes = axes_drawn(rng)
    columns = on_axes(axes, lambda s: np.sin(2 * np.pi * (s.force + triad.bias) / period + phase))
    return outside("adc_wave", f"converter's wave of {period:.3f} g", columns, sizes(rng, len(axes)))


def magnetic_field(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """The room's field in the body frame, through a matrix (soft iron); a constant (hard iron) is bias."""
    dip = np.radians(rng.uniform(20, 75))
    field = np.array([np.cos(dip), 0.0, -np.sin(dip)])
    matrix = rng.standard_normal((3, 3))

    def columns(s: Scene) -> np.ndarray:
        body = s.attitude @ field
        return np.asarray((body @ matrix.T)[s.pose][:, :, None])

    return outside("magnetic_field", f"magnetic field of dip {np.degrees(dip):.0f}°", columns, np.ones(1))


def stand_twist(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A stand that is not flat pulls on the case: a smooth function of azimuth."""
    weight = rng.standard_normal((3, 4)) * [1, 1, 0.6, 0.6]

    def columns(s: Scene) -> np.ndarray:
        az = s.azimuth
        waves = np.stack([np.cos(az), np.sin(az), np.cos(2 * az), np.sin(2 * az)], axis=1)
        return np.asarray((waves @ weight.T)[s.pose][:, :, None])

    return outside("stand_twist", "twist by azimuth", columns, np.ones(1))


def pose_duration(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """The mean of what builds up for as long as a pose is held."""
    axes = axes_drawn(rng)
    columns = on_axes(axes, lambda s: s.held_s[s.pose])
    return outside("pose_duration", "bias by the length of the pose", columns, sizes(rng, len(axes)))


def random_walk(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    path = np.cumsum(rng.standard_normal((scene.poses + 1, 3)), axis=0)

    def columns(s: Scene) -> np.ndarray:
        return np.asarray(path[np.minimum(s.pose, len(path) - 1)][:, :, None])

    return outside("random_walk", "bias that walks at random from pose to pose", columns, np.ones(1))


def cable(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A cable pulls in some of the poses, more or less."""
    pulls = (rng.random(scene.poses) < rng.uniform(0.25, 0.6)) * rng.uniform(0.5, 1.5, scene.poses)
    force = rng.standard_normal(3)

    def columns(s: Scene) -> np.ndarray:
        here = pulls[np.minimum(s.pose, len(pulls) - 1)]
        return np.asarray((here[:, None] * force)[:, :, None])

    return outside("cable", f"cable that pulls in {int((pulls > 0).sum())} poses", columns, np.ones(1))


def long_memory(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A glue that creeps: the bias follows the forces of several poses before, each less than the next."""
    keeps, axes = rng.uniform(0.6, 0.9), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        state = np.empty_like(s.pose_force)
        state[0] = s.pose_force[0]
        for i in range(1, s.poses):
            state[i] = keeps * state[i - 1] + (1 - keeps) * s.pose_force[i - 1]
        return np.asarray(state[s.pose])

    text = f"memory over {1 / (1 - keeps):.1f} poses"
    return outside("long_memory", text, on_axes(axes, shape), sizes(rng, len(axes)))


def sunlight(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Light on one face of the case."""
    lamp = np.array([np.cos(0.6), 0.0, np.sin(0.6)])
    face = rng.standard_normal(3)
    face /= np.linalg.norm(face)
    force = rng.standard_normal(3)

    def columns(s: Scene) -> np.ndarray:
        lit = np.maximum(s.attitude @ lamp @ face, 0.0)
        return np.asarray((lit[:, None] * force)[s.pose][:, :, None])

    return outside("sunlight", "light on one face", columns, np.ones(1))


def slow_oscillation(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A machine next door that swings the supply every few poses, in no logged channel."""
    period = scene.duration_s / rng.uniform(4.0, 9.0)
    axes = axes_drawn(rng)
    parts = [
        on_axes(axes, lambda s: np.sin(2 * np.pi * s.t_s / period)),
        on_axes(axes, lambda s: np.cos(2 * np.pi * s.t_s / period)),
    ]
    return outside("slow_oscillation", f"period of {period:.1f} s", several(*parts), sizes(rng, 2 * len(axes)))


def dead_zone(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Stiction: less response near zero force, within 0.05 to 0.2 g."""
    width, axes = rng.uniform(0.05, 0.2), axes_drawn(rng)
    columns = on_axes(axes, lambda s: -s.force * np.exp(-((s.force / width) ** 2)))
    return outside("dead_zone", f"dead zone of {width:.3f} g", columns, sizes(rng, len(axes)))


def outside(kind: str, text: str, columns: Callable[[Scene], np.ndarray], coefficients: np.ndarray) -> Effect:
    return Effect(kind, None, text, columns, coefficients, of_recording=True)


_DRAWN = (
    adc_wave,
    magnetic_field,
    stand_twist,
    pose_duration,
    random_walk,
    cable,
    long_memory,
    sunlight,
    slow_oscillation,
    dead_zone,
)
KINDS = tuple(f.__name__ for f in _DRAWN)


def drawn(rng: np.random.Generator, kind: str, scene: Scene, triad: Triad) -> Effect:
    for effect in _DRAWN:
        if effect.__name__ == kind:
            return effect(rng, scene, triad)
    raise ValueError(f"effect {kind!r}: expected one of {', '.join(KINDS)}")
