"""How well an effect of the catalogue, with any coefficients and shape, can pass for what is in a recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.undeclared.generator import Recording, along, misses, true_errors
from tests.undeclared.scene import TEMPERATURE, Scene
from tests.undeclared.visible import Linear


def best_imitation(r: Recording) -> tuple[str, float]:
    """The name that leaves least beside the nine parameters and its own coefficients on all axes, and what it leaves:
    s of the rest. Without catalogued effects in the recording, no reasoning on these poses can see more.
    """
    here = r.take.scene
    linear = Linear.of(r.triad, r.triad.outputs(here.pose_force), true_errors(r.triad, here, r.noise))
    miss = misses(r.take.added_g, here, r.triad)
    left = []
    for name, columns in _catalogue(here):
        centred = columns - columns.mean(axis=0)
        left.append((linear.beside(along(centred, here, r.triad)).size(miss), name))
    size, name = min(left)
    return name, size


def _catalogue(here: Scene) -> Iterator[tuple[str, np.ndarray]]:
    """Names with columns (k,3,c) by pose."""
    f, t = here.pose_force, here.by_pose(here.t_s)
    before = np.concatenate([f[:1], f[:-1]])
    product = np.stack([f[:, 0] * f[:, 1], f[:, 1] * f[:, 2], f[:, 2] * f[:, 0]], axis=1)
    yield "second_order_nonlinearity", _each(f**2)
    yield "third_order_nonlinearity", _each(f**3)
    yield "scale_factor_asymmetry", _each(np.abs(f))
    yield "cross_coupling", np.concatenate([_same(p) for p in product.T], axis=2)
    yield "hysteresis", _each(np.sign(f - before))
    yield "hysteresis", _each(before)
    for channel, values in here.channels.items():
        held, rate = here.by_pose(values), here.by_pose(here.rates[channel])
        of = "temperature_" if channel == TEMPERATURE else "channel_"
        yield of + "bias", _same(held)
        yield of + "scale_factor", _each(f * (held - held.mean())[:, None])
        if channel == TEMPERATURE:
            x = (held - held.mean()) / np.ptp(held)
            yield "temperature_bias_quadratic", np.concatenate([_same(x), _same(x**2)], axis=2)
            yield "thermal_gradient", _same(rate)
    x = 2 * t / here.duration_s - 1
    yield "bias_drift", np.concatenate([_same(x), _same(x**2)], axis=2)
    for tau in here.duration_s * np.geomspace(0.03, 1.0, 12):
        yield "warm_up", _same(np.exp(-t / tau))
    for i in range(1, here.poses):
        yield "bias_step", _same((np.arange(here.poses) >= i).astype(float))
    if here.shaking.variance.any():
        yield "vibration_rectification", _each(here.shaking.variance)


def _each(values: np.ndarray) -> np.ndarray:
    """(k,3,3): each axis its own of values (k,3)."""
    return np.asarray(values[:, :, None] * np.eye(3))


def _same(values: np.ndarray) -> np.ndarray:
    """(k,3,3): each axis the same values (k,)."""
    return np.asarray(values[:, None, None] * np.eye(3))
