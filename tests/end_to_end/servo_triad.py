"""A triad of servo accelerometers, part by part, on a tumble fixture in a room: the volts that a unit then digitizes.

What is wrong with such a triad is wrong with one of its parts. What that looks like from outside nobody here knows: it
is a designer's account of an instrument, which takes nothing from the package, neither its models nor their names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

DESIGN_C, REFERENCE_V = 25.0, 5.0


def _none() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True)
class Triad:
    """By axis (3,), but for ``axes`` (3,3), a unit vector for each sensitive axis, and bare numbers, the same for all
    three. A default is no fault. ``noise_g`` is white, of one sample.
    """

    axes: np.ndarray
    load_v: np.ndarray
    """At the load resistor at 1 g."""
    zero_v: np.ndarray
    noise_g: float
    sag_um: np.ndarray = field(default_factory=_none)
    """By which the loop lets the proof mass off its null at 1 g."""
    gradient_per_um: np.ndarray = field(default_factory=_none)
    """Of the magnet's field on that way, relative."""
    loss_per_k: np.ndarray = field(default_factory=_none)
    """Of the magnet's field, relative."""
    lift: np.ndarray = field(default_factory=_none)
    """Share of the reference voltage in the zero of the output stage."""
    reference_per_k: float = 0.0
    mismatch: np.ndarray = field(default_factory=_none)
    """Of the two halves of the output stage, one for each sign of the current: how far off their common gain."""
    ladder_v: np.ndarray = field(default_factory=_none)
    """Of the converter: its resistors are unequal, and the same again every ``ladder_period_v``."""
    ladder_period_v: float = 1.0

    def volts(self, force_g: np.ndarray, temperature_c: np.ndarray) -> np.ndarray:
        """(n,3), for the specific force (n,3) in the body frame and the temperature (n,) of the unit."""
        along = force_g @ self.axes.T
        heat = (temperature_c - DESIGN_C)[:, None]
        magnet = (1 + self.gradient_per_um * self.sag_um * along) * (1 - self.loss_per_k * heat)
        current = along / magnet
        stage = self.load_v * current * (1 + self.mismatch * np.sign(current))
        out = self.zero_v + stage + self.lift * REFERENCE_V * self.reference_per_k * heat
        return np.asarray(out + self.ladder_v * np.sin(2 * np.pi * out / self.ladder_period_v))


Fault = Callable[[np.random.Generator, Triad], Triad]


def drawn(rng: np.random.Generator, *faults: Fault) -> Triad:
    """In the frame that the sensitive axes themselves make: the third is z, the second lies in the plane of y and z."""
    ax, ay, az = np.radians(rng.uniform(-0.6, 0.6, 3))
    axes = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    load_v, zero_v = -2.4 * rng.uniform(0.98, 1.02, 3), rng.uniform(-0.02, 0.02, 3)
    triad = Triad(axes, load_v, zero_v, noise_g=float(rng.uniform(1.5e-4, 2.5e-4)))
    for fault in faults:
        triad = fault(rng, triad)
    return triad


def soft_servo(rng: np.random.Generator, triad: Triad) -> Triad:
    """Under load the proof mass leaves its null, for where the field is another."""
    gradient = _either_sign(rng) * rng.uniform(1.2e-4, 2e-4, 3)
    return replace(triad, sag_um=rng.uniform(4.0, 7.0, 3), gradient_per_um=gradient)


def warm_reference(rng: np.random.Generator, triad: Triad) -> Triad:
    """The reference voltage rises with heat, and the zeros with it."""
    lift = _either_sign(rng) * rng.uniform(0.4, 1.0, 3)
    return replace(triad, lift=lift, reference_per_k=float(rng.uniform(2.5e-5, 4e-5)))


def warm_magnets(rng: np.random.Generator, triad: Triad) -> Triad:
    """The magnets lose field with heat, and the same force takes more current."""
    return replace(triad, loss_per_k=rng.uniform(4e-5, 9e-5, 3))


def uneven_stage(rng: np.random.Generator, triad: Triad) -> Triad:
    return replace(triad, mismatch=_either_sign(rng) * rng.uniform(1.4e-3, 2.2e-3, 3))


def uneven_ladder(rng: np.random.Generator, triad: Triad) -> Triad:
    ladder_v = _either_sign(rng) * rng.uniform(1e-3, 1.5e-3, 3)
    return replace(triad, ladder_v=ladder_v, ladder_period_v=float(rng.uniform(0.5, 1.2)))


def _either_sign(rng: np.random.Generator) -> np.ndarray:
    return rng.choice([-1.0, 1.0], 3)


@dataclass(frozen=True)
class Room:
    """The unit warms itself by ``rise_c``, with the time constant ``rise_s``; the room's heating goes up and down."""

    start_c: float
    rise_c: float
    rise_s: float
    cycle_c: float
    cycle_s: float

    def temperature_c(self, t_s: np.ndarray) -> np.ndarray:
        """(n,) of the unit at times (n,)."""
        warmed = self.rise_c * (1 - np.exp(-t_s / self.rise_s))
        return np.asarray(self.start_c + warmed + self.cycle_c * np.sin(2 * np.pi * t_s / self.cycle_s))


@dataclass(frozen=True)
class Fixture:
    """Holds the unit in one attitude after the other, and then again; ``up`` (k,3) unit vectors in the body frame."""

    up: np.ndarray
    hold_s: float
    move_s: float

    @property
    def step_s(self) -> float:
        return self.hold_s + self.move_s

    def at(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which attitude it is in or leaves (n,), and how far it is on the way to the next (n,): 0 where it rests."""
        step = np.floor_divide(t_s, self.step_s).astype(int)
        return step % len(self.up), np.maximum(t_s - step * self.step_s - self.hold_s, 0.0) / self.move_s

    def force_g(self, t_s: np.ndarray) -> np.ndarray:
        """(n,3)"""
        attitude, share = self.at(t_s)
        here, there = self.up[attitude], self.up[(attitude + 1) % len(self.up)]
        way = (share**2 * (3 - 2 * share))[:, None]
        # A little to the side, for the straight way between opposite attitudes leads through no force at all.
        v = (1 - way) * here + way * there + way * (1 - way) * np.array([0.3, 0.5, 0.4])
        return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


class OnFixture:
    """What the simulated electronics are given: `triaxcald.simulation.physics.Physics`."""

    def __init__(self, triad: Triad, fixture: Fixture, room: Room, seed: int) -> None:
        self._triad, self._fixture, self._room = triad, fixture, room
        self._rng = np.random.default_rng(seed)

    def sample(self, unit_time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Volts (n,3), and °C (n,) of the thermometer. The noise goes on from call to call."""
        temperature_c = self._room.temperature_c(unit_time_s)
        clean = self._triad.volts(self._fixture.force_g(unit_time_s), temperature_c)
        noise_g = self._triad.noise_g * self._rng.standard_normal(clean.shape)
        return clean + self._triad.load_v * noise_g, temperature_c

    def restarted(self, unit_time_s: float) -> None:
        """The fixture goes on."""
