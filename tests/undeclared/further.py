"""Twenty effects more that no catalogue has, for the errors of the components: what |a| cannot show belongs to them.

Half of the kinds (`TUNED`) may be looked at while a method is made; the others (`HELD_BACK`) and their seeds judge it.
Those of the unit are in its next recording too. What goes with time, or with the poses before, is not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.undeclared.physics import Effect, axes_drawn, on_axes, several, sizes
from tests.undeclared.scene import TEMPERATURE, Scene, Triad
from tests.undeclared.uncatalogued import outside

Shape = Callable[[Scene], np.ndarray]


def squared_cross_axis(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """One axis reads the square of another: in |a| a product of two components, and told as such."""
    axes = axes_drawn(rng)
    others = [(i + int(rng.integers(1, 3))) % 3 for i in axes]
    parts = [on_axes([i], lambda s, j=j: s.force[:, j] ** 2) for i, j in zip(axes, others, strict=True)]  # type: ignore[misc]
    text = ", ".join(f"{'xyz'[i]} by {'xyz'[j]}²" for i, j in zip(axes, others, strict=True))
    return Effect("squared_cross_axis", "cross_coupling", text, several(*parts), sizes(rng, len(parts)))


def knee(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """One axis bends beyond some force, at one end or at both."""
    at, axis, ends = rng.uniform(0.55, 0.93), int(rng.integers(3)), [[1.0], [-1.0], [1.0, -1.0]][int(rng.integers(3))]
    parts = [on_axes([axis], lambda s, e=e: np.maximum(e * s.force - at, 0.0)) for e in ends]  # type: ignore[misc]
    text = f"bend beyond {at:.2f} g, {len(ends)} of 2 ends of {'xyz'[axis]}"
    return _of_unit(outside("knee", text, several(*parts), sizes(rng, len(parts))))


def missing_codes(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A converter that lacks codes above some level: a step of the output there."""
    levels = rng.uniform(-0.9, 0.9, int(rng.integers(1, 4)))
    jumps = sizes(rng, len(levels))
    axes = axes_drawn(rng)[:1]
    columns = on_axes(axes, lambda s: np.tanh((s.force[:, :, None] - levels) / 0.002) @ jumps)
    text = f"codes missing at {', '.join(f'{v:.2f}' for v in levels)} g"
    return _of_unit(outside("missing_codes", text, columns, np.ones(1)))


def relay_hysteresis(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A domain that flips when the force passes a threshold, and flips back at the opposite one."""
    threshold, axes = rng.uniform(0.3, 0.9), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        state, out = np.ones(3), np.empty_like(s.pose_force)
        for i, force in enumerate(s.pose_force):
            state = np.where(np.abs(force) > threshold, np.sign(force), state)
            out[i] = state
        return np.asarray(out[s.pose])

    text = f"flips at ±{threshold:.2f} g"
    return outside("relay_hysteresis", text, on_axes(axes, shape), sizes(rng, len(axes)))


def exponential_level(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A leakage current that grows with the level."""
    scale = rng.uniform(0.12, 0.5) * rng.choice([-1.0, 1.0])
    return _of_unit(
        _by_axes(rng, "exponential_level", f"exp(a / {scale:.2f} g)", lambda s: np.exp((s.force - 1) / scale))
        if scale > 0
        else _by_axes(rng, "exponential_level", f"exp(a / {scale:.2f} g)", lambda s: np.exp((s.force + 1) / scale))
    )


def sign_dependent(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """Another bias on either side of zero."""
    return _of_unit(_by_axes(rng, "sign_dependent", "sign of the force", lambda s: np.tanh(s.force / 0.01)))


def local_bump(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A part that touches in some directions."""
    centre, width, force = _unit(rng), rng.uniform(0.25, 0.7), rng.standard_normal(3)
    bump = _over_directions(lambda up: np.exp(-np.sum((up - centre) ** 2, axis=1) / 2 / width**2), force)
    return _of_unit(outside("local_bump", f"bump {width:.2f} wide", bump, np.ones(1)))


def temperature_cross_axis(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """The sensitivity across an axis goes with the temperature."""
    at = float(np.median(scene.channels[TEMPERATURE]))
    axes = axes_drawn(rng)
    parts = [
        on_axes([i], lambda s, j=(i + 1) % 3: s.force[:, j] * (s.channels[TEMPERATURE] - at))  # type: ignore[misc]
        for i in axes
    ]
    return _of_unit(outside("temperature_cross_axis", "across · T", several(*parts), sizes(rng, len(parts))))


def peak_memory(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A magnet keeps some of the largest force that it ever saw."""
    axes = axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        largest = np.maximum.accumulate(np.abs(s.pose_force), axis=0)
        first = np.argmax(np.abs(s.pose_force)[None] >= largest[:, None], axis=1)
        return np.take_along_axis(s.pose_force, first, axis=0)[s.pose]

    return outside("peak_memory", "the largest force so far", on_axes(axes, shape), sizes(rng, len(axes)))


def curved_gain(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """The scale factor goes up and comes down again."""
    peak = scene.duration_s * rng.uniform(0.2, 0.8)

    def shape(s: Scene) -> np.ndarray:
        return np.asarray(s.force * ((s.t_s - peak) / s.duration_s)[:, None] ** 2)

    return _by_axes(rng, "curved_gain", "scale factor · (t − t₀)²", shape)


def stick_slip(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A spring clamp that follows the force only when this has changed by enough."""
    threshold, axes = rng.uniform(0.4, 1.3), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        held, out = s.pose_force[0].copy(), np.empty_like(s.pose_force)
        for i, force in enumerate(s.pose_force):
            held = np.where(np.abs(force - held) > threshold, force, held)
            out[i] = held - force
        return np.asarray(out[s.pose])

    return outside("stick_slip", f"sticks within {threshold:.2f} g", on_axes(axes, shape), sizes(rng, len(axes)))


def cubed_cross_axis(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """One axis reads the cube of another."""
    axes = axes_drawn(rng)
    others = [(i + int(rng.integers(1, 3))) % 3 for i in axes]
    parts = [on_axes([i], lambda s, j=j: s.force[:, j] ** 3) for i, j in zip(axes, others, strict=True)]  # type: ignore[misc]
    return _of_unit(outside("cubed_cross_axis", "cubes across", several(*parts), sizes(rng, len(parts))))


def one_ended(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """An amplifier that gives way at one end, by a power of the level."""
    power, end = rng.uniform(3.0, 8.0), rng.choice([-1.0, 1.0])
    return _of_unit(
        _by_axes(rng, "one_ended", f"power {power:.1f} of one end", lambda s: np.maximum(end * s.force, 0.0) ** power)
    )


def ring(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A cable that is bent in some directions about its own axis."""
    centre, at, width, force = _unit(rng), rng.uniform(-0.5, 0.5), rng.uniform(0.2, 0.5), rng.standard_normal(3)
    bump = _over_directions(lambda up: np.exp(-((up @ centre - at) ** 2) / 2 / width**2), force)
    return _of_unit(outside("ring", f"ring {width:.2f} wide", bump, np.ones(1)))


def gain_by_square_of_temperature(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    at = float(np.median(scene.channels[TEMPERATURE]))
    return _of_unit(
        _by_axes(
            rng,
            "gain_by_square_of_temperature",
            "scale factor · T²",
            lambda s: s.force * ((s.channels[TEMPERATURE] - at)[:, None] ** 2),
        )
    )


def logarithmic(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A junction in the path: steep near zero, flat beyond."""
    width = rng.uniform(0.02, 0.2)
    return _of_unit(
        _by_axes(
            rng,
            "logarithmic",
            f"sign · log(1 + |a| / {width:.2f} g)",
            lambda s: np.sign(s.force) * np.log1p(np.abs(s.force) / width),
        )
    )


def staircase(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A worn converter: another error in each of some ranges of its scale."""
    count = int(rng.integers(4, 9))
    error, axes = rng.standard_normal((3, count)), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        place = np.clip(((s.force + 1.1) / 2.2 * count).astype(int), 0, count - 1)
        return np.stack([error[i, place[:, i]] for i in range(3)], axis=1)

    return _of_unit(outside("staircase", f"{count} ranges", on_axes(axes, shape), sizes(rng, len(axes))))


def tilted_square(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A beam that is not along any axis: the square of the force along it, in a direction of its own."""
    along, force = _unit(rng), rng.standard_normal(3)
    square = _over_directions(lambda up: (up @ along) ** 2, force)
    return _of_unit(outside("tilted_square", "square along a tilted beam", square, np.ones(1)))


def play(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A proof mass with play: it lags behind the force by a width."""
    width, axes = rng.uniform(0.1, 0.6), axes_drawn(rng)

    def shape(s: Scene) -> np.ndarray:
        at, out = s.pose_force[0].copy(), np.empty_like(s.pose_force)
        for i, force in enumerate(s.pose_force):
            at = np.clip(at, force - width, force + width)
            out[i] = at - force
        return np.asarray(out[s.pose])

    return outside("play", f"play of {width:.2f} g", on_axes(axes, shape), sizes(rng, len(axes)))


def swinging_gain(rng: np.random.Generator, scene: Scene, triad: Triad) -> Effect:
    """A supply that swings, and the scale factors with it."""
    period, phase = scene.duration_s / rng.uniform(1.0, 4.0), rng.uniform(0, 2 * np.pi)
    return _by_axes(
        rng,
        "swinging_gain",
        f"scale factor, period {period:.0f} s",
        lambda s: s.force * np.sin(2 * np.pi * s.t_s / period + phase)[:, None],
    )


def _unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def _over_directions(of: Callable[[np.ndarray], np.ndarray], force: np.ndarray) -> Callable[[Scene], np.ndarray]:
    def columns(s: Scene) -> np.ndarray:
        return np.asarray((of(s.up)[:, None] * force)[s.pose][:, :, None])

    return columns


def _by_axes(rng: np.random.Generator, kind: str, text: str, shape: Shape) -> Effect:
    axes = axes_drawn(rng)
    return outside(kind, text, on_axes(axes, shape), sizes(rng, len(axes)))


def _of_unit(effect: Effect) -> Effect:
    return replace(effect, of_recording=False)


_TUNED = (
    squared_cross_axis,
    knee,
    missing_codes,
    relay_hysteresis,
    exponential_level,
    sign_dependent,
    local_bump,
    temperature_cross_axis,
    peak_memory,
    curved_gain,
)
_HELD_BACK = (
    stick_slip,
    cubed_cross_axis,
    one_ended,
    ring,
    gain_by_square_of_temperature,
    logarithmic,
    staircase,
    tilted_square,
    play,
    swinging_gain,
)
TUNED = tuple(f.__name__ for f in _TUNED)
HELD_BACK = tuple(f.__name__ for f in _HELD_BACK)
KINDS = (*TUNED, *HELD_BACK)


def drawn(rng: np.random.Generator, kind: str, scene: Scene, triad: Triad) -> Effect:
    return next(effect for effect in (*_TUNED, *_HELD_BACK) if effect.__name__ == kind)(rng, scene, triad)
