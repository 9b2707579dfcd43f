"""Drivers by entry point: ours, somebody else's, and one that is broken."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from triaxcal_drivers.catalogue import driver_named, listed
from triaxcal_drivers.errors import DriverMissing
from triaxcal_drivers.modbus.driver import ModbusDriver

DRIVER = """
from pydantic import BaseModel
from triaxcal_drivers.profile import Profile

class Serial(Profile):
    letters: str

class SerialDriver:
    profile_model = Serial
    bus_model = BaseModel
"""

PROFILE = """
format = "triaxcal.profile/1"
name = "their-unit"
driver = "their-serial"
letters = "xyz"
identity = { vendor = "they", product = "unit" }
output = { unit = "counts" }
sampling = { rate_hz = 10.0 }
streams = { readings = {} }
"""


@pytest.fixture
def elsewhere(tmp_path: Path):
    """Installs a package with an entry point in a folder of its own; gives what Python says there."""

    def install(name: str, module: str, target: str) -> None:
        (tmp_path / f"{name}.py").write_text(module)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[triaxcal.drivers]\n{target}\n")
        (info / "RECORD").write_text("")

    def python(code: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
            capture_output=True,
            text=True,
            check=True,
            timeout=180,
        ).stdout

    install.python = python
    return install


@pytest.mark.slow
def test_a_driver_installed_by_somebody_else_is_found(elsewhere):
    elsewhere("their_drivers", DRIVER, "their-serial = their_drivers:SerialDriver")
    found = json.loads(
        elsewhere.python(
            "import json; from triaxcal_drivers.catalogue import listed;"
            "print(json.dumps([[d.name, d.target, d.distribution, d.fault] for d in listed()]))"
        )
    )
    assert ["their-serial", "their_drivers:SerialDriver", "their_drivers", None] in found
    assert [d[0] for d in found] == sorted(["can", "mcap", "modbus", "their-serial"])


def test_a_profile_for_it_is_read_by_it(elsewhere):
    elsewhere("their_drivers", DRIVER, "their-serial = their_drivers:SerialDriver")
    said = elsewhere.python(
        "from triaxcal_drivers.catalogue import parse_bundle\n"
        f"bundle = parse_bundle({PROFILE.encode()!r}, None, where='p')\n"
        "print(type(bundle.profile).__name__, bundle.profile.letters)"
    )
    assert said.split() == ["Serial", "xyz"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError"),
        ("raise RuntimeError('wants a licence')", "wants a licence"),
        ("", "AttributeError"),
    ],
)
def test_a_driver_that_does_not_load_is_listed_with_the_reason(elsewhere, module, reason):
    elsewhere("their_drivers", module, "their-serial = their_drivers:SerialDriver")
    found = json.loads(
        elsewhere.python(
            "import json; from triaxcal_drivers.catalogue import listed;"
            "print(json.dumps({d.name: d.fault for d in listed()}))"
        )
    )
    assert reason in found["their-serial"]
    assert "driver 'their-serial' (their_drivers:SerialDriver) cannot be loaded" in found["their-serial"]
    assert found["modbus"] is None


@pytest.mark.slow
def test_a_driver_whose_packages_are_not_there_is_listed_with_what_brings_them(elsewhere):
    lacking = DRIVER.replace("class SerialDriver:", 'class SerialDriver:\n    packages = ("json", "no_such_module")')
    assert lacking != DRIVER
    elsewhere("their_drivers", lacking, "their-serial = their_drivers:SerialDriver")
    said = elsewhere.python(
        "from triaxcal_drivers.catalogue import listed; from triaxcal_drivers.hints import EXTRAS, absent\n"
        "print({d.name: d.fault for d in listed()}['their-serial']); EXTRAS['no_such_module'] = 'can'\n"
        "print(absent(['no_such_module']))"
    )
    assert said.splitlines() == [
        "the package no_such_module is not installed",
        "the package no_such_module is not installed; pip install 'triaxcal[can]' brings it",
    ]


@pytest.mark.parametrize(
    ("driver", "opens"), [("can", "triaxcal_drivers.can.device"), ("modbus", "triaxcal_drivers.modbus.device")]
)
def test_a_driver_names_no_package_that_opening_a_device_does_not_import(elsewhere, driver, opens):
    said = elsewhere.python(f"import sys, {opens}; print(*sys.modules)")
    named = driver_named(driver).packages
    assert set(named) <= set(said.split())
    assert named


@pytest.mark.slow
def test_asking_for_one_driver_imports_no_other(elsewhere):
    elsewhere("their_drivers", "raise RuntimeError", "their-serial = their_drivers:SerialDriver")
    said = elsewhere.python(
        "import sys; from triaxcal_drivers.catalogue import driver_named\n"
        "print('triaxcal_drivers.modbus.driver' in sys.modules, end=' ')\n"
        "driver_named('modbus')\n"
        "print('triaxcal_drivers.modbus.driver' in sys.modules, 'can' in sys.modules)"
    )
    assert said.split() == ["False", "True", "False"]


def test_our_drivers_are_listed():
    assert {d.name: d.target for d in listed() if d.distribution == "triaxcal"} == {
        "can": "triaxcal_drivers.can.driver:CanDriver",
        "mcap": "triaxcal_drivers.mcap.driver:McapDriver",
        "modbus": "triaxcal_drivers.modbus.driver:ModbusDriver",
    }


def test_a_driver_is_named():
    assert isinstance(driver_named("modbus"), ModbusDriver)


def test_an_unknown_driver_names_the_nearest():
    with pytest.raises(DriverMissing, match=r"^p\.toml: no driver named 'modbuss'; did you mean 'modbus'\?$"):
        driver_named("modbuss", where="p.toml")


def test_a_driver_like_no_other_names_those_installed():
    with pytest.raises(DriverMissing, match=r"^no driver named 'zigbee'; installed: .*modbus"):
        driver_named("zigbee")
