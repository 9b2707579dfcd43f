"""Units with a part at fault go through `triaxcal run`: what the loop calls it, what they hold then, and what they say.

The fault is one of `servo_triad`, which knows no effects. Every unit comes with the best calibration of nine parameters
that its maker could give it, so that its error before is that of the fault alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.end_to_end.servo_triad import (
    DESIGN_C,
    Fault,
    Fixture,
    OnFixture,
    Room,
    Triad,
    drawn,
    soft_servo,
    uneven_ladder,
    uneven_stage,
    warm_magnets,
    warm_reference,
)
from tests.virtual_line import virtual_line
from triaxcald.simulation.unit import COVERED, CRC, TABLE, ReferenceUnit, Stored, checksum

SERIAL, RATE_HZ = 4711, 100.0
BUS = {"host": "127.0.0.1", "port": 502}
HOLD_S, MOVE_S = 1.5, 0.5
PLAN = {"poses": 26, "hold_s": 0.6, "check_poses": 6}
LIMIT_G = 1e-4
DAY = Room(start_c=23.0, rise_c=8.0, rise_s=25.0, cycle_c=2.0, cycle_s=31.0)
ANOTHER_DAY = Room(start_c=25.0, rise_c=4.0, rise_s=60.0, cycle_c=3.0, cycle_s=70.0)
NEAR_NOISE = 3.0
"""Noise alone puts one to two and a half standard errors of a pose's mean into what 26 poses make of a unit."""


@dataclass(frozen=True)
class Finished:
    """What a run leaves: its document's part for the unit, what `diagnose` makes of its recording, and the EEPROM as it
    was and as it is."""

    triad: Triad
    document: Mapping[str, Any]
    result: Mapping[str, Any]
    before: bytes
    after: bytes

    @property
    def listed(self) -> list[set[str]]:
        """By finding, all that it may be."""
        return [{f["effect"], *f["alternatives"]} for f in self.result["findings"]]

    @property
    def likely(self) -> set[str]:
        """Effects that are likelier than not; of those that are not certain no probability is stated."""
        return {name for name, p in self.result["probabilities"].items() if p is None or p >= 0.5}

    @property
    def standard_error(self) -> dict[str, float]:
        """By role, of what is corrected."""
        effects = self.result["calibration"]["effects"].items()
        return {f"{name}.{x}": c[x]["standard_error"] for name, c in effects for x in c if x != "weight"}

    @property
    def noise_g(self) -> float:
        """Standard error of a pose's mean along an axis."""
        return float(self.triad.noise_g / np.sqrt(HOLD_S * RATE_HZ))


@pytest.fixture
def run(workshop: Any, triaxcal: Callable[..., Any]) -> Callable[..., Finished]:
    """Puts a unit with the faults on the line."""

    def go(*faults: Fault, seed: int) -> Finished:
        rng = np.random.default_rng(seed)
        triad = drawn(rng, *faults)
        planned = np.array([p["up"] for p in triaxcal("plan", "--poses", "26", "--json").json["poses"]])
        physics = OnFixture(triad, Fixture(_tumbled(rng, planned), HOLD_S, MOVE_S), DAY, seed)
        before = _nine_parameters(triad)
        unit = ReferenceUnit(physics, serial_number=SERIAL, stored=before)
        limits = {"rms_g": LIMIT_G, "verification_rms_g": LIMIT_G}
        station = workshop.station({"serial": str(SERIAL), "bus": BUS}, plan=PLAN, limits=limits)
        with virtual_line(unit):
            done = triaxcal("run", station, "--json")
        (document,) = done.json["units"]
        assert document["error"] is None
        assert document["exit_code"] == done.code
        result = triaxcal("diagnose", document["recording"], "--json").json
        return Finished(triad, document, result, before, unit.eeprom)

    return go


def _tumbled(rng: np.random.Generator, planned: np.ndarray) -> np.ndarray:
    """The plan, as well as a hand keeps to it; then poses not taken yet, and now and then, if asked for, the first."""
    off = planned + 0.03 * rng.standard_normal(planned.shape)
    more = _anywhere(rng, 200)
    more[4::5] = off[0]
    up = np.concatenate([off, more])
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _anywhere(rng: np.random.Generator, count: int) -> np.ndarray:
    v = rng.standard_normal((count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _nine_parameters(triad: Triad) -> bytes:
    """The EEPROM as the maker fills it, who has a turntable: straight lines through the volts of known attitudes."""
    up = _anywhere(np.random.default_rng(0), 1000)
    volts = triad.volts(up, np.full(len(up), DESIGN_C))
    held = {"reference_temperature": DESIGN_C}
    for i, (axis, angles) in enumerate({"x": "zy", "y": "x", "z": ""}.items()):
        columns = np.column_stack([up[:, i:], np.ones(len(up))])
        scale, *across, zero = np.linalg.lstsq(columns, volts[:, i], rcond=None)[0]
        held |= {f"scale_factor_{axis}": scale, f"bias_{axis}": zero / scale}
        held |= {f"misalignment_{a}": v / scale for a, v in zip(angles, across, strict=True)}
    copy = {name: TABLE[name].encode(held.get(name, 0.0)) for name in COVERED}
    return Stored({**copy, CRC: checksum(copy)}).image()


def _power_up(triad: Triad, eeprom: bytes, fixture: Fixture) -> ReferenceUnit:
    """Another day: the unit knows its EEPROM and nothing else."""
    return ReferenceUnit(OnFixture(triad, fixture, ANOTHER_DAY, 1), serial_number=SERIAL, stored=eeprom)


def _error_g(triad: Triad, eeprom: bytes) -> float:
    """Rms length of what the unit's own output is off the truth, in attitudes that it was not calibrated in."""
    fixture = Fixture(_anywhere(np.random.default_rng(99), 24), hold_s=8.0, move_s=1.0)
    samples = _power_up(triad, eeprom, fixture).advance(len(fixture.up) * fixture.step_s - 0.5)
    attitude, way = fixture.at(samples.unit_time_s)
    says = [samples.corrected[(attitude == i) & (way == 0)].mean(axis=0) * 1e-6 for i in range(len(fixture.up))]
    return float(np.sqrt(np.mean(np.sum((np.array(says) - fixture.up) ** 2, axis=1))))


def _held(triad: Triad, eeprom: bytes) -> dict[str, float]:
    """By name, the registers that the unit has after power came back."""
    unit = _power_up(triad, eeprom, Fixture(np.eye(3), HOLD_S, MOVE_S))
    return {name: TABLE[name].decode(unit.read(name, 0.0)) for name in COVERED}


def _by_turntable_and_oven(triad: Triad) -> dict[tuple[str, str], np.ndarray]:
    """How each axis (3,) departs from a straight line and from itself when warm, by known forces along it: as the
    registers have it, whose role and whose name begin so."""

    def volts(force: float, warmer_k: float = 0.0) -> np.ndarray:
        return np.asarray(np.diag(triad.volts(force * triad.axes, np.full(3, DESIGN_C + warmer_k))))

    def scale(warmer_k: float = 0.0) -> np.ndarray:
        return (volts(1.0, warmer_k) - volts(-1.0, warmer_k)) / 2

    return {
        ("second_order_nonlinearity", "second_order"): ((volts(1.0) + volts(-1.0)) / 2 - volts(0.0)) / scale(),
        ("temperature_bias", "temperature_bias"): (volts(0.0, 5.0) - volts(0.0, -5.0)) / 10 / scale(),
        ("temperature_scale_factor", "temperature_scale_factor"): (scale(5.0) - scale(-5.0)) / 10 / scale(),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "effects"),
    [
        ([soft_servo], {"second_order_nonlinearity"}),
        ([warm_reference, warm_magnets], {"temperature_bias", "temperature_scale_factor"}),
    ],
)
def test_what_a_part_at_fault_does_is_found_written_and_gone_from_the_output_after_a_power_cycle(
    run: Callable[..., Finished], faults: list[Fault], effects: set[str]
) -> None:
    unit = run(*faults, seed=31)
    assert unit.likely == effects
    assert all(unit.result["calibration"]["effects"][effect]["weight"] > 0.9 for effect in effects)
    assert unit.result["unexplained"]["significant"] is False
    assert unit.document["outcome"]["device_state"] == "new_verified"
    assert unit.document["exit_code"] == 0

    held = _held(unit.triad, unit.after)
    for (role, name), truth in _by_turntable_and_oven(unit.triad).items():
        for axis, value in zip("xyz", truth, strict=True):
            allowed = 5 * unit.standard_error.get(f"{role}.{axis}", 0.0)
            assert held[f"{name}_{axis}"] == pytest.approx(value, abs=allowed + 1e-12)

    own = unit.document["verification"]
    assert own["after_rms_g"] < own["before_rms_g"] / 4
    before, after = _error_g(unit.triad, unit.before), _error_g(unit.triad, unit.after)
    assert before > 2.5e-4
    assert after < before / 5
    assert after < NEAR_NOISE * unit.noise_g


def _same_calibration(unit: Finished) -> bool:
    """A calibration that was put back counts as a write, and is the old one."""
    held = Stored.from_image(unit.after)
    return held.valid and held.calibration == Stored.from_image(unit.before).calibration


@pytest.mark.slow
def test_what_no_register_takes_is_named_and_left_to_the_host_and_the_unit_gets_its_old_calibration_back(
    run: Callable[..., Finished],
) -> None:
    unit = run(uneven_stage, seed=31)
    (may_be,) = unit.listed
    assert "scale_factor_asymmetry" in may_be
    assert unit.document["outcome"]["measured"]["left_to_host"] == ["scale_factor_asymmetry"]
    assert unit.document["after"]["rms_g"] < LIMIT_G  # so it was tried
    assert unit.document["verification"]["verdict"] == "outside limits"
    assert unit.document["outcome"]["device_state"] == "old"
    assert unit.document["certificate"] is None
    assert unit.document["exit_code"] == 1
    assert _same_calibration(unit)
    assert _error_g(unit.triad, unit.after) == _error_g(unit.triad, unit.before)


@pytest.mark.slow
def test_what_no_catalogue_has_stays_unexplained_and_the_unit_as_it_was(run: Callable[..., Finished]) -> None:
    unit = run(uneven_ladder, seed=31)
    result = unit.result
    assert result["findings"] == []
    assert result["unexplained"]["significant"] is True
    assert result["unexplained"]["rms_g"] > LIMIT_G
    assert result["call"] == "investigate"
    assert result["not_corrected"] == "unmodelled"
    assert result["calibration"]["effects"] == {}
    (why,) = unit.document["outcome"]["outside"]
    assert why.startswith("rms_g ")
    assert unit.document["registers_written"] == []
    assert unit.document["exit_code"] == 1
    assert unit.after == unit.before
