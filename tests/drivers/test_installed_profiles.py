"""Profiles of other packages, by entry point: packages with metadata on the path, sound ones and broken ones."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.catalogue import BUILT_IN

GENERIC = (BUILT_IN / "generic-modbus-poll.toml").read_text()
SOURCE = "ACME X1 manual, revision 3, page 17"


def profile(name: str, *, source: str = SOURCE) -> str:
    text = GENERIC.replace('name = "generic-modbus-poll"', f'name = "{name}"\nsource = "{source}"')
    assert f'"{name}"' in text
    return text


def metadata(folder: Path, name: str, entries: str) -> None:
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[triaxcal.profiles]\n{entries}\n")
    (info / "RECORD").write_text("")


def package(folder: Path, name: str, files: dict[str, str], *, module: str = "", target: str = "") -> None:
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(module)
    for file, text in files.items():
        (folder / name / file).write_text(text)
    metadata(folder, name, f"them = {target or name}")


Listing = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def triaxcal_beside(tmp_path: Path) -> Listing:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
        return subprocess.run(
            [sys.executable, "-m", "triaxcald.cli", *arguments],
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
            timeout=180,
            cwd=tmp_path,
        )

    return run


def rows_of(done: subprocess.CompletedProcess[str]) -> dict[tuple[str, str], dict[str, Any]]:
    assert done.returncode == 0, done
    return {(p["distribution"], p["name"]): p for p in json.loads(done.stdout)["profiles"]}


@pytest.mark.parametrize(
    ("module", "target"),
    [
        ("", "acme"),
        ("from pathlib import Path\nFOLDER = Path(__file__).parent\n", "acme:FOLDER"),
        ("FOLDER = __file__.rpartition('/')[0]\n", "acme:FOLDER"),
    ],
)
def test_the_profiles_of_a_package_are_listed_and_go_by_their_names(
    tmp_path: Path, triaxcal_beside: Listing, module: str, target: str
) -> None:
    files = {"acme-x1.toml": profile("acme-x1"), "acme-x2.toml": profile("acme-x2", source="")}
    package(tmp_path, "acme", files, module=module, target=target)
    rows = rows_of(triaxcal_beside("devices", "--json"))
    assert rows["acme", "acme-x1"] == {
        "name": "acme-x1", "title": "Plain polled accelerometer, Modbus", "driver": "modbus", "fault": None,
        "distribution": "acme", "source": SOURCE,
    }  # fmt: skip
    assert rows["acme", "acme-x2"]["source"] == ""
    assert {p.stem for p in BUILT_IN.glob("*.toml")} == {name for package, name in rows if package == "triaxcal"}
    assert SOURCE in triaxcal_beside("devices").stdout.replace("\n", " ")
    checked = triaxcal_beside("devices", "check", "acme-x1", "--json")
    assert (checked.returncode, json.loads(checked.stdout)["source"]) == (0, SOURCE)


BROKEN: dict[str, tuple[dict[str, str], str, str, str]] = {
    "raises": ({"p1.toml": profile("p1")}, "1 / 0\n", "", "ZeroDivisionError"),
    "exits": ({"p1.toml": profile("p1")}, "raise SystemExit(3)\n", "", "SystemExit"),
    "lacks_a_module": ({"p1.toml": profile("p1")}, "import no_such_module\n", "", "no_such_module"),
    "names_nothing": ({"p1.toml": profile("p1")}, "", "names_nothing:FOLDER", "FOLDER"),
    "no_folder": ({"p1.toml": profile("p1")}, "FOLDER = '/no/such/folder'\n", "no_folder:FOLDER", "no folder"),
    "no_path": ({"p1.toml": profile("p1")}, "FOLDER = 5\n", "no_path:FOLDER", "TypeError"),
    "empty": ({}, "", "", "no profile"),
    "a_module": ({"p1.toml": profile("p1"), "inner.py": ""}, "", "a_module.inner", "expected a package"),
}  # fmt: skip


def test_broken_packages_are_listed_and_break_no_others(tmp_path: Path, triaxcal_beside: Listing) -> None:
    package(tmp_path, "acme", {"acme-x1.toml": profile("acme-x1")})
    for name, (files, module, target, _) in BROKEN.items():
        package(tmp_path, name, files, module=module, target=target)
    package(tmp_path, "wrong", {"w1.toml": profile("w1").replace("rate_hz", "rate_hzz"), "w2.toml": "\0"})
    package(tmp_path, "zz_same", {"acme-x1.toml": profile("acme-x1"), "triax-ref-can.toml": profile("triax-ref-can")})
    done = triaxcal_beside("devices", "--json")
    rows = rows_of(done)
    assert rows["acme", "acme-x1"]["fault"] is None
    assert rows["triaxcal", "triax-ref-can"]["fault"] is None
    for name, (*_, reason) in BROKEN.items():
        assert reason in rows[name, "them"]["fault"], name
    assert "did you mean 'rate_hz'?" in rows["wrong", "w1"]["fault"]
    assert rows["wrong", "w2"]["fault"]
    assert "acme has a profile of that name" in rows["zz_same", "acme-x1"]["fault"]
    assert "triaxcal has a profile of that name" in rows["zz_same", "triax-ref-can"]["fault"]
    shown = triaxcal_beside("devices")
    assert shown.returncode == 0
    assert {line.split(": ")[1] for line in shown.stderr.splitlines()} >= {"them", "w1", "w2"}
    found = triaxcal_beside("devices", "check", "acme-x1", "--json")
    assert found.returncode == 0
    absent = triaxcal_beside("devices", "check", "acme-x3")
    assert (absent.returncode, absent.stderr.count("\n")) == (2, 1)
    assert "acme-x1" in absent.stderr


DRIVER = """
from pydantic import BaseModel
from triaxcal_drivers.profile import Profile

class SerialDriver:
    profile_model = Profile
    bus_model = BaseModel
"""
SERIAL = """
format = "triaxcal.profile/1"
name = "their-unit"
driver = "their-serial"
identity = { vendor = "they", product = "unit" }
output = { unit = "counts" }
sampling = { rate_hz = 10.0 }
streams = { readings = { column = 3, channels = { ux = 0, uy = { at = 1 }, uz = 2 } } }
"""


def test_a_package_may_bring_a_driver_and_its_profiles(tmp_path: Path, triaxcal_beside: Listing) -> None:
    package(tmp_path, "theirs", {"their-unit.toml": SERIAL}, module=DRIVER)
    entries = tmp_path / "theirs-1.0.dist-info" / "entry_points.txt"
    entries.write_text(entries.read_text() + "[triaxcal.drivers]\ntheir-serial = theirs:SerialDriver\n")
    assert rows_of(triaxcal_beside("devices", "--json"))["theirs", "their-unit"]["driver"] == "their-serial"
    done = triaxcal_beside("devices", "check", "their-unit", "--json")
    (stream,) = json.loads(done.stdout)["streams"]
    assert (stream["place"], [c["place"] for c in stream["channels"]]) == ("column 3", ["0", "at 1", "2"])
