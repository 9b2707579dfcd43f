"""The walls of the house: who may import whom, and what the metrology needs to live."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import triaxcal

ROOT = Path(__file__).parents[2]

ALONE = """
import importlib.abc
import sys


class Walls(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        allowed = sys.stdlib_module_names | {"numpy", "scipy", "triaxcal"}
        # The standard library keeps its build's settings in a module that it does not list.
        if name.partition(".")[0] not in allowed and not name.startswith("_sysconfigdata"):
            raise ModuleNotFoundError(f"walled off: {name}", name=name)
        return None


sys.meta_path.insert(0, Walls())

import pkgutil

import numpy as np

import triaxcal

for module in pkgutil.walk_packages(triaxcal.__path__, "triaxcal."):
    __import__(module.name)

from triaxcal.fit import fit
from triaxcal.loop import diagnose
from triaxcal.plan.directions import directions
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

sensor = Sensor(np.full(3, 2.0), np.zeros(3), np.full(3, 0.01))
poses = noisy_poses(sensor, np.array([v for _, v in directions(26)]), 1e-5, np.random.default_rng(0))
assert abs(fit(poses).sensor.scale_factor[0] - 2.0) < 1e-3
assert diagnose(poses).after.terms == ("linear",)
tops = {name.partition(".")[0] for name in sys.modules}
print(*sorted(tops - sys.stdlib_module_names - {"__main__", "__mp_main__"}))
"""


def test_the_metrology_lives_on_numpy_and_scipy_alone() -> None:
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert {"numpy", "scipy", "triaxcal"} <= loaded
    strangers = {"pydantic", "can", "cantools", "canopen", "pymodbus", "serial", "mcap", "google", "matplotlib",
                 "jinja2", "rich", "triaxcald", "triaxcal_drivers"}  # fmt: skip
    assert not loaded & strangers


def test_the_wall_holds() -> None:
    walled = ALONE.partition("import pkgutil")[0] + "import pydantic\n"
    done = subprocess.run([sys.executable, "-c", walled], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "walled off: pydantic" in done.stderr


def test_no_contract_between_the_houses_is_broken() -> None:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()", "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_the_metrology_says_that_it_is_typed() -> None:
    assert (Path(triaxcal.__file__).parent / "py.typed").is_file()
