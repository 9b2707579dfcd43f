"""What `import triaxcal` promises: every name is there, loaded when asked for, and hidden by no module."""

from __future__ import annotations

import subprocess
import sys

import pytest

import triaxcal as tc

AFTER_ALL = """
import importlib, pkgutil, types
import triaxcal as tc
for module in pkgutil.walk_packages(tc.__path__, "triaxcal."):
    importlib.import_module(module.name)
rooms = [name for name in tc.__all__ if isinstance(getattr(tc, name), types.ModuleType)]
assert rooms == sorted(tc._ROOMS), rooms
for room in rooms:
    face = getattr(tc, room)
    hidden = [name for name in getattr(face, "__all__", ()) if isinstance(getattr(face, name), types.ModuleType)]
    assert room == "text" or not hidden, (room, hidden)
assert len(tc.plan(26)) == 27
assert callable(tc.budget) and callable(tc.verify) and callable(tc.diagnose)
"""


@pytest.mark.slow
def test_every_name_is_what_it_was_after_every_module_is_imported() -> None:
    done = subprocess.run([sys.executable, "-c", AFTER_ALL], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_importing_the_package_imports_neither_numpy_nor_a_room() -> None:
    code = "import sys, triaxcal; print('numpy' in sys.modules, [m for m in sys.modules if m.startswith('triaxcal.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False ['triaxcal.lazy']\n"


def test_the_names_are_listed_once_and_for_editors_too() -> None:
    assert len(set(tc.__all__)) == len(tc.__all__) <= 50
    assert set(tc.__all__) <= set(dir(tc))
    assert tc.__version__


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'triaxcal' has no attribute 'fit_poses'"):
        _ = tc.fit_poses
