"""Several simulated units on one fixture, with one clock."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.mounting import ORIENTATIONS
from triaxcald.simulation.bench import DeviceFile, Fixture, SimulatedUnit, Turning, load_device, simulate, tumble_of
from triaxcald.simulation.operating import Habits, Operator
from triaxcald.simulation.time_base import ElasticTimeBase, TimeBase
from triaxcald.simulation.unit import read_eeprom

OPERATORS_SEED = 2
"""Beside a file's own seed: 1 is that of the fixture that turns by itself."""


@dataclass(frozen=True)
class Described:
    """A device file."""

    path: Path
    device: DeviceFile

    @property
    def slot(self) -> str:
        return self.device.slot or self.path.stem

    @property
    def eeprom(self) -> Path | None:
        return self.path.parent / self.device.eeprom if self.device.eeprom else None


@dataclass(frozen=True)
class Tray:
    """Units that turn together, in the order of their files. ``operator`` is None
    where the fixture turns by itself."""

    described: tuple[Described, ...]
    units: tuple[SimulatedUnit, ...]
    time_base: TimeBase
    operator: Operator | None


def load_tray(paths: Sequence[Path], *, followed: bool) -> Tray:
    """Raises InputError, ProfileError: one line."""
    described = tuple(Described(path, load_device(path)) for path in paths)
    fixture = _fixture(described)
    first = described[0].device.model_copy(update={"fixture": fixture})
    time_base = ElasticTimeBase(_speed(described))
    operator = _operator(described, fixture, first.seed) if followed else None
    turning = tumble_of(first) if operator is None else None
    units = []
    for d in described:
        path: Turning | None = turning if operator is None else operator.paths[d.slot]
        stored = read_eeprom(d.eeprom) if d.eeprom else None
        units.append(simulate(d.device, where=str(d.path), stored=stored, fixture=path, time_base=time_base))
    _require_different(described, "serial", lambda d: d.device.serial)
    _require_different(described, "eeprom", lambda d: d.eeprom and d.eeprom.resolve())
    buses = {d.path: unit.bus for d, unit in zip(described, units, strict=True)}
    _require_different(described, "bus", lambda d: _address(buses[d.path]))
    return Tray(described, tuple(units), time_base, operator)


def _operator(described: Sequence[Described], fixture: Fixture, seed: int) -> Operator:
    _require_different(described, "slot", lambda d: d.slot)
    habits = Habits(fixture.reaction_s, fixture.wrong_turns, fixture.attitude_error_deg, fixture.move_s)
    mounted: Mapping[str, tc.Floats] = {d.slot: ORIENTATIONS[d.device.mounting] for d in described}
    return Operator(mounted, habits, [seed, OPERATORS_SEED])


def _speed(described: Sequence[Described]) -> float:
    """One fixture has one clock. Raises InputError."""
    first = described[0]
    for d in described:
        if d.device.speed != first.device.speed:
            raise InputError(
                f"{d.path}: speed: {d.device.speed:g}, but {first.device.speed:g} in {first.path}; "
                "units on one fixture have one clock"
            )
    return first.device.speed


def _fixture(described: Sequence[Described]) -> Fixture:
    """As the files that have a ``[fixture]`` describe it. Raises InputError."""
    having = [d for d in described if "fixture" in d.device.model_fields_set]
    if not having:
        return Fixture()
    first = having[0]
    for d in having:
        for key, value in d.device.fixture:
            if value != (other := getattr(first.device.fixture, key)):
                raise InputError(
                    f"{d.path}: fixture.{key}: {value:g}, but {other:g} in {first.path}; "
                    "all units are on one fixture, which one file may describe for all"
                )
    return first.device.fixture


def _address(bus: object) -> Hashable:
    """A unit of a CAN bus, a serial port, or a TCP port; None for any free port."""
    if isinstance(bus, td.can.CanBus):
        return bus.claim()
    assert isinstance(bus, td.modbus.ModbusBus)
    if bus.serial_port is not None:
        from triaxcald.simulation.modbus_unit import PTY  # with the packages of its bus

        return bus.model_copy(update={"serial_port": bus.serial_port.removeprefix(PTY)}).claim().serial_port
    return (td.canonical_host(bus.host or ""), bus.port) if bus.port else None


def _require_different(described: Sequence[Described], key: str, of: Callable[[Described], Hashable]) -> None:
    """What is None is not compared. Raises InputError."""
    seen: dict[Hashable, Path] = {}
    for d in described:
        value = of(d)
        if value is not None and value in seen:
            raise InputError(f"{d.path}: {key}: the same as in {seen[value]}")
        seen[value] = d.path
