"""Recordings with an effect inside that nobody declares, and what is true of them.

A recording is a random triad in random poses with random noise; the effect is one of `physics.KINDS`, one of
`uncatalogued.KINDS`, of `invented.KINDS`, of `invented_later.KINDS` or of `further.KINDS`, two of the first ("two") or
nothing ("none").
Its size is s, see `visible`: what is drawn is scaled until s is what was asked for.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tests.undeclared import further, invented, invented_later, physics, uncatalogued
from tests.undeclared.noise import Noise
from tests.undeclared.physics import Effect
from tests.undeclared.scene import (
    OTHER_CHANNELS,
    TEMPERATURE,
    History,
    Scene,
    Triad,
    anywhere,
    as_mounted,
    scene,
    temperature,
    wandering,
)
from tests.undeclared.visible import Linear, magnitude, nine_of, standard_errors
from triaxcal.model.samples import Samples

KINDS = (*physics.KINDS, *uncatalogued.KINDS, *invented.KINDS, *invented_later.KINDS, *further.KINDS)
LARGEST_G = 0.05
"""An effect that adds more than this in any pose is no longer a small error of a sensor."""
OF_TEMPERATURE = (
    "temperature_bias",
    "temperature_bias_quadratic",
    "temperature_scale_factor",
    "thermal_gradient",
    "angle_by_temperature",
    "temperature_cross_axis",
    "gain_by_square_of_temperature",
)
LEAST_SWING_C = 0.2
"""No sensor shows an effect of a temperature that moves by less."""
DRAWS = 300
HELD_OUT = 15
CHANNEL_NOISE = 1e-3
"""Of a channel's reading, in units of how far it usually wanders."""


class CannotShow(Exception):
    """What was drawn cannot reach the size in these poses."""


@dataclass(frozen=True)
class Take:
    """One run of the recorder: the scene, the noise (n,3) in g, the effects' part (n,3) in g, channels as logged."""

    scene: Scene
    noise_g: np.ndarray
    added_g: np.ndarray
    channels: dict[str, np.ndarray]

    def samples(self, triad: Triad, *, effect: bool = True) -> Samples:
        sensed = self.scene.force + self.noise_g
        if effect:
            sensed = sensed + self.added_g
        time_ns = np.round(np.arange(len(sensed)) * (1e9 / self.scene.rate_hz)).astype(np.int64)
        return Samples(time_ns, triad.outputs(sensed), self.channels)


@dataclass(frozen=True)
class Recording:
    """``effects`` with their ``sizes`` s, each alone, and ``ranks``: how many combinations of an effect's coefficients
    the poses show beside the nine parameters. ``held_out`` is the same unit in other poses.
    """

    seed: int
    kind: str
    triad: Triad
    noise: Noise
    effects: tuple[Effect, ...]
    sizes: tuple[float, ...]
    ranks: tuple[int, ...]
    beside: tuple[float, ...]
    """s of each effect beside the columns of the others."""
    errors_g: np.ndarray
    """(k,) true standard errors of |a|."""
    take: Take
    held_out: Take

    @property
    def signs(self) -> tuple[float, ...]:
        return tuple(float(s) for s in np.sign(self.triad.scale))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects that a catalogue has."""
        return tuple(e.name for e in self.effects if e.name is not None)

    def samples(self, *, effect: bool = True) -> Samples:
        return self.take.samples(self.triad, effect=effect)

    def held_out_samples(self, *, effect: bool = True) -> Samples:
        return self.held_out.samples(self.triad, effect=effect)

    def __str__(self) -> str:
        parts = [f"{e} (s = {s:.1f})" for e, s in zip(self.effects, self.sizes, strict=True)]
        return "; ".join(parts) or "nothing"


def recording(
    seed: int,
    kind: str | None = None,
    size: float | tuple[float, float] = 20.0,
    poses: int = 26,
    noise: str = "white",
) -> Recording:
    """``kind`` None is one of the catalogue's at random; ``size`` is s, or its limits, drawn evenly in the logarithm
    for each effect by itself. The same arguments give the same recording.
    """
    rng = np.random.default_rng([seed, poses, zlib.crc32(f"{kind} {noise}".encode())])
    low, high = size if isinstance(size, tuple) else (size, size)
    for _ in range(DRAWS):
        chosen = str(rng.choice(physics.KINDS)) if kind is None else kind
        names = _kinds_of(rng, chosen)
        wanted = [float(np.exp(rng.uniform(np.log(low), np.log(high)))) for _ in names]
        try:
            return _drawn(rng, seed, chosen, names, wanted, poses, noise)
        except CannotShow:
            continue
    raise CannotShow(f"{kind}, s = {size}, {poses} poses: not in {DRAWS} draws")


def _effect(rng: np.random.Generator, name: str, here: Scene, channel: str, triad: Triad) -> Effect:
    if name in physics.KINDS:
        return physics.drawn(rng, name, here, channel)
    for others in (invented, invented_later, further):
        if name in others.KINDS:
            return others.drawn(rng, name, here, triad)
    return uncatalogued.drawn(rng, name, here, triad)


def _kinds_of(rng: np.random.Generator, kind: str) -> list[str]:
    if kind == "none":
        return []
    if kind == "two":
        return [str(k) for k in rng.choice(physics.KINDS, 2, replace=False)]
    if kind == "outside":
        return [str(rng.choice(uncatalogued.KINDS))]
    return [kind]


def _drawn(
    rng: np.random.Generator, seed: int, kind: str, names: list[str], wanted: list[float], poses: int, noise_kind: str
) -> Recording:
    triad, rate_hz = Triad.drawn(rng), float(rng.choice([50.0, 100.0, 200.0]))
    noise = Noise.drawn(rng, noise_kind, rate_hz)
    channel = str(rng.choice(list(OTHER_CHANNELS)))
    up = as_mounted(rng, poses)
    typical_s = 8.5 * len(up)
    histories = {TEMPERATURE: temperature(rng, typical_s)[1]}
    if rng.random() < 0.4 or any(n.startswith("channel_") for n in names):
        histories[channel] = wandering(rng, *OTHER_CHANNELS[channel], typical_s)
    here = scene(rng, triad, up, rate_hz, histories, shaken="vibration_rectification" in names)
    effects = [_effect(rng, n, here, channel, triad) for n in names]
    errors = true_errors(triad, here, noise)
    linear = Linear.of(triad, triad.outputs(here.pose_force), errors)
    effects = [scaled(e, here, triad, linear, s) for e, s in zip(effects, wanted, strict=True)]
    columns = [column_misses(e, here, triad) for e in effects]
    there = _held_out(rng, triad, here, rate_hz, histories)
    carried = [e for e in effects if not e.of_recording]
    return Recording(
        seed=seed,
        kind=kind,
        triad=triad,
        noise=noise,
        effects=tuple(effects),
        sizes=tuple(linear.size(misses(e.added(here), here, triad)) for e in effects),
        ranks=tuple(linear.rank(c) for c in columns),
        beside=tuple(_beside(i, effects, columns, here, triad, linear) for i in range(len(effects))),
        errors_g=errors,
        take=_take(rng, here, noise, effects),
        held_out=_take(rng, there, noise, carried),
    )


def _held_out(
    rng: np.random.Generator, triad: Triad, here: Scene, rate_hz: float, histories: Mapping[str, History]
) -> Scene:
    """Random directions, in a stretch of the same conditions; the machine runs in as many poses and as loud."""
    spare_s = max(here.duration_s - 8.5 * HELD_OUT, 0.0)
    there = scene(rng, triad, anywhere(rng, HELD_OUT), rate_hz, histories, begins_s=rng.uniform(0, spare_s))
    pick = rng.integers(0, here.poses, HELD_OUT)
    shaking = replace(here.shaking, amplitude=here.shaking.amplitude[pick], phase=here.shaking.phase[pick])
    return replace(there, shaking=shaking)


def _take(rng: np.random.Generator, here: Scene, noise: Noise, effects: Sequence[Effect]) -> Take:
    added = np.zeros_like(here.force)
    for e in effects:
        added += e.added(here)
    shown = noise.draw(rng, len(here.t_s)) + here.shaking.at(here.pose)
    logged = {}
    for name, values in here.channels.items():
        usual = 10.0 if name == TEMPERATURE else OTHER_CHANNELS[name][1]
        logged[name] = values + CHANNEL_NOISE * usual * rng.standard_normal(len(values))
    return Take(here, shown, added, logged)


def true_errors(triad: Triad, here: Scene, noise: Noise) -> np.ndarray:
    """(k,) of |a| in the poses of a scene, from the known noise, its memory included."""
    variance = [
        noise.variance_of_mean(n) + here.shaking.variance_of_mean(i, n) for i, n in enumerate(here.end - here.begin)
    ]
    return standard_errors(triad, triad.outputs(here.pose_force), np.array(variance))


def misses(added: np.ndarray, here: Scene, triad: Triad) -> np.ndarray:
    """(k,) of |a| under the true nine parameters, by what is added (n,3) in g to the samples."""
    return magnitude(triad.outputs(here.pose_force + here.by_pose(added)), nine_of(triad)) - 1


def column_misses(effect: Effect, here: Scene, triad: Triad) -> np.ndarray:
    """(k,c) by how much |a| goes with each coefficient."""
    by_pose = here.by_pose(effect.columns(here))
    return along(by_pose - by_pose.mean(axis=0), here, triad)  # a constant is bias


def along(by_pose: np.ndarray, here: Scene, triad: Triad) -> np.ndarray:
    """(k,…) change of |a| by what is added (k,3,…) to the force along the sensitive axes, to first order."""
    return np.asarray(np.einsum("ki,ij,kj...->k...", here.up, np.linalg.inv(triad.axes), by_pose))


def scaled(effect: Effect, here: Scene, triad: Triad, linear: Linear, wanted: float) -> Effect:
    """Of size s = ``wanted``. Raises CannotShow where that takes more than `LARGEST_G`."""
    e = effect.scaled(1e-6)
    columns = column_misses(e, here, triad)
    stands = effect.kind in OF_TEMPERATURE and np.ptp(here.channels[TEMPERATURE]) < LEAST_SWING_C
    if stands or not linear.rank(columns):
        raise CannotShow(effect.kind)
    shown = linear.size(columns @ e.coefficients)
    for _ in range(4):
        e = e.scaled(wanted / shown)
        added = e.added(here)
        if not np.abs(here.by_pose(added)).max() <= LARGEST_G:
            raise CannotShow(effect.kind)
        shown = linear.size(misses(added, here, triad))
    if abs(shown / wanted - 1) > 0.01:
        raise CannotShow(effect.kind)
    return e


def _beside(
    i: int, effects: Sequence[Effect], columns: Sequence[np.ndarray], here: Scene, triad: Triad, linear: Linear
) -> float:
    for j, c in enumerate(columns):
        if j != i:
            linear = linear.beside(c)
    return linear.size(misses(effects[i].added(here), here, triad))
