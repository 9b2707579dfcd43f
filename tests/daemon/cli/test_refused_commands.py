"""What cannot be done is refused before anything is done: calibrations for other devices, stations nobody works by."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.demo import LIMIT_G, DemoUnit, _kept
from triaxcald.outcome import Code, Ending, Papers, outcome_document
from triaxcald.provision.state import Held
from triaxcald.run.unit_run import Outcome
from triaxcald.simulation.unit import Stored, factory_calibration
from triaxcald.verification import Verification

Run = Callable[..., Any]
OLD = Stored(factory_calibration())
CAL = {
    "format": "triaxcal.calibration/1",
    "scale_factor": [-2.41, -2.405, -2.37],
    "misalignment": [0.006, 0.004, -0.001],
    "bias": [0.005, -0.003, 0.004],
    "effects": {},
}
NOBODY = {"host": "127.0.0.1", "port": 1}
NINE = ", ".join(f"{name}.{axis}" for name in ("scale_factor", "misalignment", "bias") for axis in "xyz")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reference": 9.80665}, "the reference is 9.80665; registers are in units of g"),
        ({"reference": 50}, "the reference is 50; registers are in units of g"),
        ({"scale_factor": [2.41, -2.405, -2.37]}, "scale_factor.x is 2.41, of another sign than the device's: fit"),
        ({"scale_factor": [-2.41, -2.405, 2.37]}, "scale_factor.z is 2.37, of another sign than the device's: fit"),
    ],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_calibration_that_was_not_made_for_such_a_device_is_refused(
    workshop: Any, triaxcal: Run, change: dict[str, Any], words: str, dry: list[str]
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, **change}))
    triaxcal("provision", cal, workshop.station({"bus": NOBODY}), *dry).failed(3, f"refused: {cal}: {words}")


def test_the_signs_are_those_that_the_station_gives_the_unit(workshop: Any, triaxcal: Run) -> None:
    turned = workshop.write("turned.json", json.dumps({**CAL, "scale_factor": [2.41, -2.405, -2.37]}))
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"bus": served.bus, "signs": [1, -1, -1]})
        assert triaxcal("provision", turned, station, "--dry-run").code == 0
        cal = workshop.write("cal.json", json.dumps(CAL))
        triaxcal("provision", cal, station, "--dry-run").failed(3, "scale_factor.x is -2.41, of another sign")


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
@pytest.mark.parametrize(
    ("homeless", "named"),
    [
        ("misalignment", "misalignment.x, misalignment.y, misalignment.z"),
        (r"\w+", NINE),
    ],
)
def test_a_profile_without_a_home_for_each_of_the_nine_is_refused(
    workshop: Any, triaxcal: Run, homeless: str, named: str, dry: list[str]
) -> None:
    text = (BUILT_IN / "triax-ref-modbus.toml").read_text()
    workshop.write("homeless.toml", re.sub(rf'role = "{homeless}\.[xyz]"', 'description = ""', text))
    cal = workshop.write("cal.json", json.dumps(CAL))
    station = workshop.station({"bus": NOBODY, "profile": "homeless.toml"})
    triaxcal("provision", cal, station, *dry).failed(3, f"triax-ref-modbus: the device has no register for {named}")


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_profile_without_registers_is_refused(workshop: Any, triaxcal: Run, dry: list[str]) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    station = workshop.station({"profile": "generic-modbus-poll", "bus": NOBODY})
    triaxcal("provision", cal, station, *dry).failed(3, f"generic-modbus-poll: the device has no register for {NINE}")


def test_a_certificate_goes_to_no_other_unit(workshop: Any, triaxcal: Run) -> None:
    """Where station and certificate disagree nobody is asked; where they do not, the device has the last word."""
    cal = workshop.write("cal.json", json.dumps({"unit": {"serial": "0815"}, "result": {"calibration": CAL}}))
    with workshop.serve(workshop.device()) as served:
        other = workshop.station({"bus": served.bus, "serial": "4711"}, name="other.toml")
        silent = workshop.station({"bus": served.bus}, name="silent.toml")
        for dry in ([], ["--dry-run"]):
            done = triaxcal("provision", cal, other, *dry)
            done.failed(3, f"{cal}: is for the unit with serial 0815, the station expects 4711")
            triaxcal("provision", cal, silent, *dry).failed(4, "is serial 4711, expected 0815")
        assert served.unit.eeprom == OLD.image()


def test_leading_zeros_make_no_other_unit(workshop: Any, triaxcal: Run) -> None:
    """A certificate writes the number with four digits at least, a station file as its author likes."""
    cal = workshop.write("cal.json", json.dumps({"unit": {"serial": "0042"}, "result": {"calibration": CAL}}))
    with workshop.serve(workshop.device(serial=42)) as served:
        station = workshop.station({"bus": served.bus, "serial": "42"})
        assert triaxcal("provision", cal, station, "--dry-run").code == 0


def test_a_certificate_whose_serial_is_no_text(workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps({"unit": {"serial": 4711}, **CAL}))
    station = workshop.station({"bus": NOBODY})
    triaxcal("provision", cal, station).failed(2, f"{cal}: unit.serial: expected text, not 4711")


HUGE = 10**400


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"bias": [HUGE, 0, 0]}, "not numbers where numbers belong"),
        ({"scale_factor": [1, 1, -HUGE]}, "not numbers where numbers belong"),
        ({"reference": HUGE}, "not numbers where numbers belong"),
        ({"channel_reference": {"temp_c": HUGE}}, "not numbers where numbers belong"),
        ({"effects": {"temperature_bias": {a: {"value": HUGE} for a in "xyz"}}}, "not numbers where numbers belong"),
        ({"bias": [int("9" * 4000), 0, 0]}, "not numbers where numbers belong"),
        ({"effects": {"temperature_bias": {a: {"value": 1e-4} for a in "xyz"}}},
         "channel_reference.temp_c: missing; the effect temperature_bias needs it"),
        ({"effects": {"bias_drift": {a: {"value": 1e-4} for a in "xyz"}}, "channel_reference": {"temp_c": 25}},
         "channel_reference.t_s: missing; the effect bias_drift needs it"),
    ],
)  # fmt: skip
def test_a_calibration_document_that_no_sensor_could_have(
    finished_run: Any, workshop: Any, triaxcal: Run, change: dict[str, Any], words: str
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, **change}))
    triaxcal("verify", cal, finished_run.can, "--json").failed(2, f"{cal}: {words}")
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}})
    triaxcal("provision", cal, station).failed(2, f"{cal}: {words}")


def test_a_number_of_thousands_of_digits(finished_run: Any, workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL).replace("0.005", "1" + 5000 * "0"))
    triaxcal("verify", cal, finished_run.can).failed(2, f"{cal}: not JSON that can be read: ")


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "change",
    [
        {"bias": [1e200, 0, 0]},
        {"bias": [1e300, 1e300, 1e300]},
        {"misalignment": [1e200, 1e200, 1e200]},
        {"scale_factor": [-1e-310, -1, -1]},
        {"reference": 1e300},
    ],
)
def test_verify_by_numbers_that_give_no_finite_magnitude(
    finished_run: Any, workshop: Any, triaxcal: Run, change: dict[str, Any]
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, **change}))
    done = triaxcal("verify", cal, finished_run.can, "--limit", "1", "--json")
    done.failed(2, f"{cal}: its numbers and the readings of {finished_run.can} give no finite magnitude")
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"reference": 0.89}, "reference: input should be greater than or equal to 0.9, not 0.89"),
        ({"reference": 9.80665}, "reference: input should be less than or equal to 1.1, not 9.80665"),
        ({"plan": {"poses": 1000, "apart_deg": 60}}, "plan.poses: there are not so many directions 60 degrees apart"),
        ({"plan": {"poses": 9, "check_poses": 100, "apart_deg": 45}}, "plan.check_poses: there are not so many"),
        ({"plan": {"poses": 1001}}, "plan.poses: input should be less than or equal to 1000"),
        ({"folder": "a\0b"}, "folder: string should match pattern"),
    ],
)
def test_a_station_that_nobody_could_work_by(
    workshop: Any, triaxcal: Run, settings: dict[str, Any], words: str
) -> None:
    station = workshop.station({"bus": NOBODY}, **settings)
    triaxcal("run", station).failed(2, str(station), words)


@pytest.mark.parametrize("reference", [0.9, 0.9974, 1.1])
def test_gravity_as_it_is_anywhere_is_no_fault(workshop: Any, triaxcal: Run, reference: float) -> None:
    triaxcal("run", workshop.station({"bus": NOBODY}, reference=reference)).failed(4, "cannot connect to ")


def test_a_unit_whose_profile_can_be_no_file(workshop: Any, triaxcal: Run) -> None:
    station = workshop.station({"bus": NOBODY, "profile": "a\0b"})
    triaxcal("run", station).failed(2, f"{station}, line 7: units.0.profile: string should match pattern")


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_run_that_nobody_reads_the_result_of_fails_all_the_same(workshop: Any, unbuffered: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [Path(sys.executable).with_name("triaxcal"), "run", workshop.station({"bus": NOBODY}), "--json"],
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        timeout=180,
    )
    os.close(writing)
    assert done.returncode == 4
    assert done.stderr.splitlines()[-1].startswith("triaxcal: STOPPED unit unit0: cannot connect to ")


@pytest.mark.parametrize(("found", "kept", "code"), [(True, True, 0), (True, False, 1), (False, True, 1)])
def test_a_demo_ends_well_only_if_the_effect_was_found_and_stays_gone_after_a_power_cycle(
    tmp_path: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, found: bool, kept: bool, code: int
) -> None:
    def document(unit: str) -> dict[str, Any]:
        ending, at = Ending.of(Code.NO_LIMIT, "no limit"), "2026-01-31T12:00:00.000+00:00"
        return outcome_document(
            ending, Held(), Papers(), unit=unit, serial=None, station="demo", ended=at, software={}, supersedes=None
        )

    async def done(folder: Path, seed: int, progress: Any, ended: Any) -> list[DemoUnit]:
        well = DemoUnit({}, Outcome("can", 0, document("can"), Held()), None, True, True)
        return [well, DemoUnit({}, Outcome("modbus", 0, document("modbus"), Held()), None, found, kept)]

    monkeypatch.setattr("triaxcald.demo.run_demo", done)
    shown = triaxcal("demo", "--out", tmp_path, "--json")
    assert shown.code == code
    assert [(u["found"], u["kept"]) for u in shown.json["units"]] == [(True, True), (found, kept)]


def test_kept_is_what_is_within_the_limit_after_the_power_cycle() -> None:
    def check(error_g: float) -> Verification:
        return Verification([], np.full(3, error_g), np.zeros(3))

    assert _kept(check(0.9 * LIMIT_G))
    assert not _kept(check(1.1 * LIMIT_G))
    assert not _kept(Verification([], np.zeros(0), np.zeros(0)))
    assert not _kept(None)
