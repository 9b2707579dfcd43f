"""A simulated unit on a simulated fixture: the file that describes it, its
physics, its place on a bus."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import AfterValidator, Field

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.mounting import ALIGNED, ORIENTATIONS
from triaxcald.simulation.time_base import ElasticTimeBase, TimeBase
from triaxcald.simulation.unit import ReferenceUnit

Triple = tuple[float, float, float]


class SensorTruth(td.Strict):
    """The sensor's true coefficients; ``noise_g`` is white, of one sample."""

    scale_factor: Triple = (-2.410618, -2.403823, -2.371761)
    misalignment: Triple = (625.454406e-5, 404.734018e-5, -65.046441e-5)
    bias: Triple = (564.518583e-5, -288.4559e-5, 463.952349e-5)
    noise_g: Annotated[float, Field(ge=0)] = 2e-4
    effects: Mapping[str, Mapping[str, float]] = Field(default_factory=dict)


class Surroundings(td.Strict):
    temperature_c: float = 25.0
    ramp_c_per_s: float = 0.0
    swing_c: float = 0.0
    swing_period_s: Annotated[float, Field(gt=0)] = 600.0


CHECK_POSES, CHECK_TOURS = 14, 3
"""More poses than a station asks for by default, so that one that comes late
still finds enough; and after so many restarts the first ones come again."""


class Fixture(td.Strict):
    """The fixture. By itself it goes through the poses of the plan, in its order,
    the first once more, again and again; and after a restart of a unit once
    through others, to check by. Else an operator turns it, who follows a run."""

    poses: Annotated[int, Field(ge=9, le=1000)] = 26
    hold_s: Annotated[float, Field(gt=0)] = 4.0
    move_s: Annotated[float, Field(gt=0)] = 1.5
    attitude_error_deg: Annotated[float, Field(ge=0, le=20)] = 2.0
    reaction_s: Annotated[float, Field(ge=0, le=600, description="from an instruction to the operator's turn")] = 1.0
    wrong_turns: Annotated[float, Field(ge=0, le=0.5, description="share of the operator's turns")] = 0.02


def _one_of_24(name: str) -> str:
    if name not in ORIENTATIONS:
        raise ValueError(f"expected one of the 24 right-handed orientations, as {ALIGNED} or +y-x+z")
    return name


class DeviceFile(td.Strict):
    """`triaxcal sim DEVICE.toml`."""

    format: Literal["triaxcal.device/1"]
    profile: Annotated[str, Field(description="name of a built-in reference profile")]
    serial: Annotated[int, Field(ge=0, lt=2**32)] = 1
    speed: Annotated[float, Field(gt=0, le=1000, description="unit seconds a second of the wall clock, at most")] = 1.0
    seed: Annotated[int, Field(ge=0)] = 0
    eeprom: Annotated[
        str | None, Field(pattern=r"^[^\x00]+$", description="file that holds the EEPROM between runs")
    ] = None
    slot: Annotated[str | None, Field(description="of the station that is followed; by default this file's stem")] = (
        None
    )
    mounting: Annotated[str, AfterValidator(_one_of_24), Field(description="the unit's axes along the fixture's")] = (
        ALIGNED
    )
    bus: dict[str, Any]
    sensor: SensorTruth = SensorTruth()
    surroundings: Surroundings = Surroundings()
    fixture: Fixture = Fixture()


class Turning(tc.synthetic.Path, Protocol):
    """How a fixture turns, in its own axes."""

    def restarted(self, t_s: float) -> None:
        """A unit on it starts again, as after its registers were written."""


@dataclass(frozen=True)
class Mounted:
    """The turning in the axes of a unit; ``rotation`` is one of `ORIENTATIONS`."""

    fixture: Turning
    rotation: tc.Floats

    def specific_force(self, t_s: tc.Floats) -> tc.Floats:
        return np.asarray(self.fixture.specific_force(t_s) @ self.rotation.T)

    def before(self, t_s: tc.Floats) -> tc.Floats:
        return np.asarray(self.fixture.before(t_s) @ self.rotation.T)


@dataclass(frozen=True)
class CheckedTumble(tc.synthetic.Tumble):
    """Goes through ``tours`` (t,k,3), one after each restart, and then on with
    its own directions."""

    tours: tc.Floats = field(kw_only=True)
    _begun: list[int] = field(default_factory=list, init=False)

    def restarted(self, t_s: float) -> None:
        """It sets out at the next move."""
        self._begun.append(int(t_s // self.step_s) + 1)

    def taken(self, step: tc.Ints) -> tc.Floats:
        found = super().taken(step)
        for i, first in enumerate(self._begun):
            tour = self.tours[i % len(self.tours)]
            on_tour = (step >= first) & (step < first + len(tour))
            found[on_tour] = tour[step[on_tour] - first]
        return found


@dataclass(frozen=True)
class SyntheticPhysics:
    """Binds the metrology's synthetic unit to the simulated electronics."""

    unit: tc.synthetic.SyntheticUnit
    fixture: Turning

    def sample(self, unit_time_s: Any) -> tuple[Any, Any]:
        return self.unit.sample(unit_time_s)

    def restarted(self, unit_time_s: float) -> None:
        self.fixture.restarted(unit_time_s)


def load_device(path: Path) -> DeviceFile:
    """Raises InputError, ProfileError."""
    try:
        text = td.toml_text.read_toml(path, expected=td.toml_text.DEVICE, pipe=True)
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e
    return td.toml_text.validate(
        DeviceFile, td.toml_text.parse_toml(text, where=str(path), expected=td.toml_text.DEVICE), text, where=str(path)
    )


def physics_of(device: DeviceFile, *, where: str = "device", fixture: Turning | None = None) -> SyntheticPhysics:
    """On the ``fixture``, by default one of its own that turns by itself. Raises
    InputError where an effect is not known or not simulated; ``where`` names the
    file in it."""
    effects = [_effect(name, held, where) for name, held in device.sensor.effects.items()]
    truth = device.sensor
    sensor = tc.Sensor(np.array(truth.scale_factor), np.array(truth.misalignment), np.array(truth.bias), tuple(effects))
    place = device.surroundings
    environment = tc.synthetic.Environment(place.temperature_c, place.ramp_c_per_s, place.swing_c, place.swing_period_s)
    fixture = tumble_of(device) if fixture is None else fixture
    path = Mounted(fixture, ORIENTATIONS[device.mounting])
    return SyntheticPhysics(
        tc.synthetic.SyntheticUnit(sensor, path, np.full(3, truth.noise_g), environment, seed=device.seed), fixture
    )


def _effect(name: str, held: Mapping[str, float], where: str) -> tuple[tc.effects.Effect, tc.Floats]:
    """An effect and its coefficients, as a device file has them. Raises
    InputError."""
    here = f"{where}: sensor.effects.{name}"
    try:
        forms = tc.effects.effect_named(name).forms
    except KeyError:
        raise InputError(f"{here}: no effect of that name is known") from None
    known = list(dict.fromkeys(n for e in forms for n in (*(c.name for c in e.coefficients), *e.shape)))
    try:
        effect, coefficients = tc.effects.effect_of(name, held)
    except KeyError:
        if unknown := set(held) - set(known):
            raise InputError(f"{here}.{min(unknown)}: known coefficients: {', '.join(known)}") from None
        raise InputError(f"{here}: {', '.join(held)} are not of one form of it") from None
    if bad := next((n for n, (v, _) in effect.shape.items() if not v > 0), None):
        raise InputError(f"{here}.{bad}: has to be above 0")
    if lacking := set(effect.needs) - tc.synthetic.COVARIATES:
        needed = ", ".join(map(tc.effects.channel_of, sorted(lacking)))
        raise InputError(f"{here}: a simulated unit has no {needed}, which it goes with")
    return effect, coefficients


def tumble_of(device: DeviceFile) -> CheckedTumble:
    """The plan's directions in its order, the first once more, and others to
    check by; each off by the fixture's attitude error."""
    fixture = device.fixture
    try:
        plan = np.array([v for _, v in tc.planning.directions(fixture.poses)])
    except tc.InvalidData as e:
        raise InputError(f"fixture.poses: {e}") from e
    rng = np.random.default_rng([device.seed, 1])
    taken = plan
    for _ in range(CHECK_TOURS):
        taken = np.concatenate([taken, [v for _, v in tc.planning.elsewhere(taken, CHECK_POSES)]])
    off = taken + rng.standard_normal(taken.shape) * np.radians(fixture.attitude_error_deg)
    off /= np.linalg.norm(off, axis=1, keepdims=True)
    n = len(plan)
    return CheckedTumble(
        np.concatenate([off[:n], off[:1]]),
        fixture.hold_s,
        fixture.move_s,
        tours=off[n:].reshape(CHECK_TOURS, CHECK_POSES, 3),
    )


@dataclass
class SimulatedUnit:
    """A described unit, ready to be served. ``unit`` is the electronics, for
    whoever wants to look inside."""

    device: DeviceFile
    bundle: td.Bundle
    unit: ReferenceUnit
    time_base: TimeBase
    bus: Any

    @property
    def truth(self) -> Mapping[str, Mapping[str, float]]:
        return self.device.sensor.effects

    def serve(self) -> AbstractAsyncContextManager[Any]:
        """On its bus, until the context ends. Raises BusError."""
        if isinstance(self.bus, td.can.CanBus):
            from triaxcald.simulation.can_unit import CanUnit  # each with the packages of its bus

            return CanUnit(self.unit, self.time_base, self.bus)
        assert isinstance(self.bus, td.modbus.ModbusBus)
        from triaxcald.simulation.modbus_unit import ModbusUnit

        return ModbusUnit(self.unit, self.time_base, self.bus.where, unit_id=self.bus.unit_id)


def simulate(
    device: DeviceFile,
    *,
    where: str,
    stored: bytes | None = None,
    fixture: Turning | None = None,
    time_base: TimeBase | None = None,
) -> SimulatedUnit:
    """Build the unit; ``fixture`` and ``time_base`` are its own by default. Raises
    InputError, ProfileError."""
    bundle = td.load_bundle(Path(device.profile))
    driver = td.driver_named(bundle.profile.driver, where=where)
    if bundle.profile.name not in ("triax-ref-can", "triax-ref-modbus"):
        raise InputError(f"{where}: profile: only triax-ref-can and triax-ref-modbus are simulated")
    bus = td.toml_text.validate(driver.bus_model, device.bus, b"", where=f"{where}: bus")
    unit = ReferenceUnit(
        physics_of(device, where=where, fixture=fixture),
        serial_number=device.serial,
        stored=stored,
        rate_hz=bundle.profile.sampling.rate_hz,
    )
    return SimulatedUnit(device, bundle, unit, time_base or ElasticTimeBase(device.speed), bus)
