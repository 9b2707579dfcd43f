"""The whole line on two simulated units, one on CAN and one on Modbus, each
with an effect hidden in it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import INTERRUPTED, InputError
from triaxcald.files import write_text
from triaxcald.provision.state import DeviceState
from triaxcald.run.unit_run import Outcome, TrayRun, UnitRun
from triaxcald.signing.keys import FOLDER as KEYS
from triaxcald.signing.keys import new_key, private_keys
from triaxcald.signing.trust import trust_key
from triaxcald.simulation.bench import DeviceFile, SimulatedUnit, simulate
from triaxcald.station.collection import Progress
from triaxcald.station.config import load_station
from triaxcald.verification import Verification

KEY = "demo"
SPEED = 20.0
HIDDEN = ("second_order_nonlinearity", "temperature_bias", "temperature_scale_factor")
"""Effects that the reference unit has registers for."""
SIZES = {"second_order_nonlinearity": 4e-4, "temperature_bias": 4e-5, "temperature_scale_factor": 4e-5}
LIMIT_G = 5e-5
STATION = """\
format = "triaxcal.station/1"
name = "demo"

[plan]
poses = 26
hold_s = 3.0
check_poses = 8

[limits]
rms_g = {limit_g}
verification_rms_g = {limit_g}

[[units]]
name = "can"
profile = "triax-ref-can"
serial = "{can_serial}"
bus = {{ interface = "virtual", channel = "{channel}", node_id = 5 }}

[[units]]
name = "modbus"
profile = "triax-ref-modbus"
serial = "{modbus_serial}"
bus = {{ host = "127.0.0.1", port = {port}, unit_id = 1 }}
"""


@dataclass(frozen=True)
class DemoUnit:
    """One unit's outcome beside its truth.

    ``found`` says that what was hidden probably acts, by the diagnosis, and
    nothing else; ``kept`` that the device's own output is within the limit
    still after a power cycle.
    """

    hidden: Mapping[str, Mapping[str, float]]
    outcome: Outcome
    after_power_cycle: Verification | None
    found: bool
    kept: bool


async def run_demo(folder: Path, seed: int, progress: Progress, ended: Callable[[Outcome], None]) -> list[DemoUnit]:
    """Recordings, certificates and reports go to ``folder``; ``ended`` receives each
    outcome. Raises InputError
    where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(f"{folder}: {e.strerror}") from e
    channel = f"triaxcal-demo-{id(progress)}"
    devices = _devices(seed, channel)
    async with AsyncExitStack() as first:
        units = [simulate(d, where="demo") for d in devices]
        servers = [await first.enter_async_context(unit.serve()) for unit in units]
        make_key(folder)
        path = folder / "station.toml"
        write_text(path, _station(devices, channel, servers[1].bus.port))
        outcomes = await TrayRun(load_station(path), progress, ended=ended)
        if any(outcome.exit_code == INTERRUPTED for outcome in outcomes):
            return [DemoUnit(u.truth, o, None, False, False) for u, o in zip(units, outcomes, strict=True)]
    # The plug is pulled on both: what follows knows nothing but their EEPROMs.
    checks = await _after_power_cycle(devices, units, channel, path, progress, outcomes)
    return [
        DemoUnit(unit.truth, outcome, check, _found(unit, outcome), _kept(check))
        for unit, outcome, check in zip(units, outcomes, checks, strict=True)
    ]


def make_key(folder: Path) -> None:
    """A trusted key of the demo's own, if it has none yet; none without the extra
    `sign`. Raises InputError."""
    if td.hints.absent(("cryptography",)) is None and not private_keys(folder / KEYS):
        made = new_key(folder / KEYS, KEY, None)
        trust_key(folder, KEY, made.public)


def demo_effects(seed: int) -> list[tuple[str, dict[str, float]]]:
    """Two different effects with their sizes, one for each unit."""
    rng = np.random.default_rng(seed)
    return [(str(effect), _draw(str(effect), rng)) for effect in rng.choice(HIDDEN, 2, replace=False)]


def _devices(seed: int, channel: str) -> list[DeviceFile]:
    rng = np.random.default_rng(seed)
    effects = rng.choice(HIDDEN, 2, replace=False)
    places: list[dict[str, Any]] = [
        {"profile": "triax-ref-can", "bus": {"interface": "virtual", "channel": channel, "node_id": 5}},
        {"profile": "triax-ref-modbus", "bus": {"host": "127.0.0.1", "port": 0, "unit_id": 1}},
    ]
    return [
        DeviceFile.model_validate(
            {
                "format": "triaxcal.device/1",
                "serial": int(rng.integers(1000, 9999)) // 2 * 2 + number,  # no two alike
                "speed": SPEED,
                "seed": int(rng.integers(2**31)),
                "sensor": {"effects": {str(effect): _draw(str(effect), rng)}},
                "surroundings": {"swing_c": 6.0, "swing_period_s": 47.0},
                **place,
            },
            strict=False,
        )
        for number, (effect, place) in enumerate(zip(effects, places, strict=True))
    ]


def _draw(effect: str, rng: np.random.Generator) -> dict[str, float]:
    sizes = SIZES[effect] * rng.uniform(0.6, 1.4, 3) * rng.choice([-1, 1], 3)
    return dict(zip("xyz", (float(v) for v in sizes), strict=True))


def _station(devices: list[DeviceFile], channel: str, port: int) -> str:
    can, modbus = (f"{d.serial:04d}" for d in devices)
    return STATION.format(limit_g=LIMIT_G, can_serial=can, modbus_serial=modbus, channel=channel, port=port)


async def _after_power_cycle(
    devices: list[DeviceFile],
    units: list[SimulatedUnit],
    channel: str,
    path: Path,
    progress: Progress,
    outcomes: Any,
) -> list[Verification | None]:
    async with AsyncExitStack() as second:
        stored = [u.unit.eeprom for u in units]
        # Other attitudes and other noise, or the poses of the calibration would
        # judge it.
        anew = [device.model_copy(update={"seed": device.seed + 1}) for device in devices]
        again = [simulate(d, where="demo", stored=s) for d, s in zip(anew, stored, strict=True)]
        servers = [await second.enter_async_context(unit.serve()) for unit in again]
        write_text(path, _station(devices, channel, servers[1].bus.port))
        station = load_station(path)
        runs = [UnitRun(station, place, progress) for place in station.places]
        todo = [run.check() for run, outcome in zip(runs, outcomes, strict=True) if _written(outcome)]
        done = iter(await asyncio.gather(*todo))
        return [next(done) if _written(outcome) else None for outcome in outcomes]


def _written(outcome: Outcome) -> bool:
    return outcome.held.state is DeviceState.NEW_VERIFIED


def _kept(check: Verification | None) -> bool:
    return check is not None and check.rms_g is not None and check.rms_g <= LIMIT_G


def _found(unit: SimulatedUnit, outcome: Outcome) -> bool:
    if outcome.certified is None or outcome.certified.loop is None:
        return False
    likely = {name for name, p in outcome.certified.loop.probabilities.items() if p >= tc.evidence.Odds().reported}
    return likely == set(unit.truth)
