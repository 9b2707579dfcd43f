"""Effects that have a name, as bench-top physics: what each adds to the force along the sensitive axes, in g.

Terms of nonlinearity as in IEEE Std 1293 (K2, K3, Kip, Kio, Kpo, ΔK1), of the force along each input axis. Nothing here
is taken from the package under test but the names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests.undeclared.scene import OTHER_CHANNELS, TEMPERATURE, Scene

Columns = Callable[[Scene], np.ndarray]
"""(n,3,c): what a coefficient of one adds to each sample and axis."""


@dataclass(frozen=True)
class Effect:
    """``name`` as the loop should say it, None for what no catalogue has; ``coefficients`` (c,) of the columns.

    ``of_recording`` is true of what the next recording begins anew, ``shakes`` of what a machine has to run for.
    """

    kind: str
    name: str | None
    text: str
    columns: Columns
    coefficients: np.ndarray
    of_recording: bool = False
    shakes: bool = False

    def added(self, scene: Scene) -> np.ndarray:
        """(n,3) g."""
        return np.asarray(self.columns(scene) @ self.coefficients)

    def scaled(self, factor: float) -> Effect:
        return replace(self, coefficients=self.coefficients * factor)

    def __str__(self) -> str:
        return f"{self.text} × [{', '.join(f'{c:.3g}' for c in self.coefficients)}]"


def axes_drawn(rng: np.random.Generator) -> list[int]:
    """All three, one, or two."""
    count = int(rng.choice([3, 1, 2], p=[0.5, 0.3, 0.2]))
    return sorted(int(i) for i in rng.permutation(3)[:count])


def sizes(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count,) of either sign, none very small beside the others."""
    return np.asarray(rng.uniform(0.3, 1.0, count) * rng.choice([-1.0, 1.0], count))


def on_axes(axes: list[int], shape: Callable[[Scene], np.ndarray]) -> Columns:
    """A coefficient an axis: ``shape`` gives (n,3), of which each axis keeps its own, or (n,), the same for each."""

    def columns(scene: Scene) -> np.ndarray:
        values = shape(scene)
        out = np.zeros((len(scene.t_s), 3, len(axes)))
        for j, i in enumerate(axes):
            out[:, i, j] = values if values.ndim == 1 else values[:, i]
        return out

    return columns


def several(*parts: Columns) -> Columns:
    return lambda scene: np.concatenate([p(scene) for p in parts], axis=2)


def _own(rng: np.random.Generator, kind: str, text: str, shape: Callable[[Scene], np.ndarray]) -> Effect:
    axes = axes_drawn(rng)
    return Effect(kind, kind, f"{text}, axes {_named(axes)}", on_axes(axes, shape), sizes(rng, len(axes)))


def _named(axes: list[int]) -> str:
    return "".join("xyz"[i] for i in axes)


def second_order(rng: np.random.Generator) -> Effect:
    return _own(rng, "second_order_nonlinearity", "K2 a²", lambda s: s.force**2)


def third_order(rng: np.random.Generator) -> Effect:
    return _own(rng, "third_order_nonlinearity", "K3 a³", lambda s: s.force**3)


def asymmetry(rng: np.random.Generator) -> Effect:
    return _own(rng, "scale_factor_asymmetry", "ΔK1 |a|/2", lambda s: np.abs(s.force) / 2)


def cross_coupling(rng: np.random.Generator) -> Effect:
    """On each axis Kip, Kio and Kpo, or one of them."""
    axes = axes_drawn(rng)
    pairs = {"ip": (0, 1), "io": (0, 2), "po": (1, 2)}
    names = list(pairs) if rng.random() < 0.5 else [str(rng.choice(list(pairs)))]
    parts = []
    for i in axes:
        for name in names:
            p, q = ((i + k) % 3 for k in pairs[name])
            parts.append(on_axes([i], lambda s, p=p, q=q: s.force[:, p] * s.force[:, q]))  # type: ignore[misc]
    text = f"K{'/'.join(names)}, axes {_named(axes)}"
    return Effect("cross_coupling", "cross_coupling", text, several(*parts), sizes(rng, len(parts)))


def _middle(rng: np.random.Generator, values: np.ndarray) -> float:
    """Somewhere in the middle of a channel's range."""
    low, high = float(values.min()), float(values.max())
    return low + rng.uniform(0.3, 0.7) * (high - low)


def temperature_bias(rng: np.random.Generator) -> Effect:
    return _own(rng, "temperature_bias", "bias · (T − 20 °C)", lambda s: s.channels[TEMPERATURE] - 20.0)


def temperature_bias_quadratic(rng: np.random.Generator, scene: Scene) -> Effect:
    """A parabola whose vertex lies in the range: a straight line alone does not do."""
    vertex = _middle(rng, scene.channels[TEMPERATURE])
    kind = "temperature_bias_quadratic"
    return _own(rng, kind, f"bias · (T − {vertex:.2f} °C)²", lambda s: (s.channels[TEMPERATURE] - vertex) ** 2)


def temperature_scale_factor(rng: np.random.Generator, scene: Scene) -> Effect:
    at = _middle(rng, scene.channels[TEMPERATURE])
    text = f"scale factor · (T − {at:.2f} °C)"
    return _own(rng, "temperature_scale_factor", text, lambda s: s.force * (s.channels[TEMPERATURE] - at)[:, None])


def thermal_gradient(rng: np.random.Generator) -> Effect:
    return _own(rng, "thermal_gradient", "bias · dT/dt", lambda s: s.rates[TEMPERATURE])


def channel_bias(rng: np.random.Generator, channel: str) -> Effect:
    usual = OTHER_CHANNELS[channel][0]
    e = _own(rng, "channel_bias", f"bias · ({channel} − {usual:g})", lambda s: s.channels[channel] - usual)
    return replace(e, name=f"channel_bias:{channel}")


def channel_scale_factor(rng: np.random.Generator, scene: Scene, channel: str) -> Effect:
    at = _middle(rng, scene.channels[channel])
    e = _own(
        rng,
        "channel_scale_factor",
        f"scale factor · ({channel} − {at:.4g})",
        lambda s: s.force * (s.channels[channel] - at)[:, None],
    )
    return replace(e, name=f"channel_scale_factor:{channel}")


def bias_drift(rng: np.random.Generator, scene: Scene) -> Effect:
    """Straight, or curved."""
    length, axes, curved = scene.duration_s, axes_drawn(rng), bool(rng.random() < 0.5)
    powers = (1, 2) if curved else (1,)
    parts = [on_axes(axes, lambda s, p=p: (s.t_s / length) ** p) for p in powers]  # type: ignore[misc]
    text = f"bias drift, {'curved' if curved else 'straight'}, axes {_named(axes)}"
    coefficients = sizes(rng, len(axes) * len(powers))
    return Effect("bias_drift", "bias_drift", text, several(*parts), coefficients, of_recording=True)


def warm_up(rng: np.random.Generator, scene: Scene) -> Effect:
    tau = scene.duration_s * 10 ** rng.uniform(-1.3, -0.3)
    e = _own(rng, "warm_up", f"bias · exp(−t / {tau:.1f} s)", lambda s: np.exp(-s.t_s / tau))
    return replace(e, of_recording=True)


def bias_step(rng: np.random.Generator, scene: Scene) -> Effect:
    """Between two poses or inside one; at least two poses lie on either side."""
    pose = int(rng.integers(2, scene.poses - 2))
    inside = bool(rng.random() < 0.4)
    low, high = (scene.begin[pose], scene.end[pose]) if inside else (scene.end[pose - 1], scene.begin[pose])
    at = scene.t_s[low] + rng.uniform(0.0, 1.0) * (scene.t_s[high] - scene.t_s[low])
    where = f"inside pose {pose}" if inside else f"before pose {pose}"
    e = _own(rng, "bias_step", f"bias step at {at:.2f} s, {where}", lambda s: (s.t_s >= at).astype(float))
    return replace(e, of_recording=True)


def hysteresis(rng: np.random.Generator) -> Effect:
    """By the sign of the change since the pose before, or by the force there. The unit had rested in its first pose."""

    def before(s: Scene) -> np.ndarray:
        return np.concatenate([s.pose_force[:1], s.pose_force[:-1]])

    if rng.random() < 0.5:
        return _own(rng, "hysteresis", "sign of the change", lambda s: np.sign(s.pose_force - before(s))[s.pose])
    return _own(rng, "hysteresis", "force in the pose before", lambda s: before(s)[s.pose])


def vibration_rectification(rng: np.random.Generator) -> Effect:
    """K2 of a vibration that averages to nothing is not nothing."""
    e = _own(rng, "vibration_rectification", "variance of the shaking", lambda s: s.shaking.variance[s.pose])
    return replace(e, shakes=True)


KINDS = (
    "second_order_nonlinearity",
    "third_order_nonlinearity",
    "scale_factor_asymmetry",
    "cross_coupling",
    "temperature_bias",
    "temperature_bias_quadratic",
    "temperature_scale_factor",
    "thermal_gradient",
    "channel_bias",
    "channel_scale_factor",
    "bias_drift",
    "warm_up",
    "bias_step",
    "hysteresis",
    "vibration_rectification",
)


def drawn(rng: np.random.Generator, kind: str, scene: Scene, channel: str) -> Effect:
    """``channel`` is the one besides temperature that an effect of a channel goes with."""
    anywhere = {
        "second_order_nonlinearity": second_order,
        "third_order_nonlinearity": third_order,
        "scale_factor_asymmetry": asymmetry,
        "cross_coupling": cross_coupling,
        "temperature_bias": temperature_bias,
        "thermal_gradient": thermal_gradient,
        "hysteresis": hysteresis,
        "vibration_rectification": vibration_rectification,
    }
    here = {
        "temperature_bias_quadratic": temperature_bias_quadratic,
        "temperature_scale_factor": temperature_scale_factor,
        "bias_drift": bias_drift,
        "warm_up": warm_up,
        "bias_step": bias_step,
    }
    if kind in anywhere:
        return anywhere[kind](rng)
    if kind in here:
        return here[kind](rng, scene)
    if kind == "channel_bias":
        return channel_bias(rng, channel)
    if kind == "channel_scale_factor":
        return channel_scale_factor(rng, scene, channel)
    raise ValueError(f"effect {kind!r}: expected one of {', '.join(KINDS)}")
