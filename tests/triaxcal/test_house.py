"""The walls of the house: who may import whom, and what the metrology needs to live."""

from __future__ import annotations

import ast
import itertools
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import triaxcal
import triaxcal_drivers

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
    if module.name.split(".")[1] != "schema":  # the room of the models, which need pydantic
        __import__(module.name)

from triaxcal.estimate.pose_fit import fit
from triaxcal.diagnosis import diagnose
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

sensor = Sensor(np.full(3, 2.0), np.zeros(3), np.full(3, 0.01))
poses = noisy_poses(sensor, np.array([v for _, v in directions(26)]), 1e-5, np.random.default_rng(0))
assert abs(fit(poses).sensor.scale_factor[0] - 2.0) < 1e-3
assert diagnose(poses).after.terms == ("linear",)
calibration = triaxcal.calibrate(poses)
again = triaxcal.Calibration.from_dict(calibration.to_dict())
a, uncertainty = again.apply(np.array([2.0, 0.0, 0.0]), uncertainty=True)
assert abs(a[0] - 1.0) < 0.1
t = np.arange(400) * 0.01
still = np.tile([0.0, 0.0, 2.0], (400, 1)) + 1e-5 * np.random.default_rng(1).standard_normal((400, 3))
assert len(triaxcal.find_poses(t, still)) == 1
tops = {name.partition(".")[0] for name in sys.modules}
print(*sorted(tops - sys.stdlib_module_names - {"__main__", "__mp_main__"}))
"""


@pytest.mark.slow
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


def test_the_models_of_documents_are_loaded_when_they_are_asked_for() -> None:
    code = "import sys, triaxcal as tc; tc.schema; print('pydantic' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True False\n"


def test_no_contract_between_the_houses_is_broken() -> None:
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()", "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.parametrize(("alias", "house"), [("tc", triaxcal), ("td", triaxcal_drivers)])
def test_the_daemon_takes_public_names_of_a_house_alone(alias: str, house: ModuleType) -> None:
    daemon = ROOT / "daemon"
    taken = {
        (f"{file.relative_to(daemon)}:{node.lineno}", _chain(node))
        for file in sorted(daemon.rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Attribute) and _chain(node)[:1] == (alias,)
    }
    assert len({names[1:3] for _, names in taken}) > 100
    assert [(where, names) for where, names in sorted(taken) if not _is_public(house, names[1:])] == []


def _chain(node: ast.expr) -> tuple[str, ...]:
    """`tc.units.ErrorUnit` as its names; empty where it is anything else."""
    if isinstance(node, ast.Name):
        return (node.id,)
    if isinstance(node, ast.Attribute) and (above := _chain(node.value)):
        return (*above, node.attr)
    return ()


def _is_public(module: object, names: Sequence[str]) -> bool:
    """Whether each name is one that the module before it offers: in its
    ``__all__``, or of its own making and without an underscore."""
    for name in names:
        if not isinstance(module, ModuleType):
            return True
        offered = getattr(module, "__all__", None)
        if name.startswith("_") or (name not in offered if offered is not None else not hasattr(module, name)):
            return False
        module = getattr(module, name)
    return True


LAZY = [
    ".".join(face.relative_to(Path(house.__file__).parents[1]).parent.parts)
    for house in (triaxcal, triaxcal_drivers)
    for face in sorted(Path(house.__file__).parent.rglob("__init__.py"))
    if "lazily(" in face.read_text()
]
"""Packages that load their public names when these are first used."""


def test_both_houses_and_rooms_of_both_load_lazily() -> None:
    assert {"triaxcal", "triaxcal.text", "triaxcal_drivers", "triaxcal_drivers.can"} <= set(LAZY)


@pytest.mark.parametrize("package", LAZY)
def test_a_type_checker_sees_the_names_that_are_loaded_lazily(package: str) -> None:
    face = import_module(package)
    loaded = {(package, name) for name in getattr(face, "_ROOMS", ())}
    loaded |= {(f"{package}.{module}", name) for module, names in getattr(face, "_NAMES", {}).items() for name in names}
    assert set(_seen_by_a_type_checker(Path(str(face.__file__)).read_text())) == loaded


def _seen_by_a_type_checker(source: str) -> Iterator[tuple[str, str]]:
    """Module and name of each import under ``if TYPE_CHECKING``."""
    for block in ast.parse(source).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for statement in block.body:
                if isinstance(statement, ast.ImportFrom):
                    yield from ((str(statement.module), alias.asname or alias.name) for alias in statement.names)


def test_the_metrology_says_that_it_is_typed() -> None:
    assert (Path(triaxcal.__file__).parent / "py.typed").is_file()


WORDS_LEAST = 4
"""A string of fewer is a name."""
SAYS = ("text", "number_format", "units")
RAISED = ("Refused", "InvalidData")
"""Classes under these are exceptions, which bring their own line."""
EFFECTS = "effects"
"""An effect's file says what a person should do about it, as its contract has it."""
SCHEMA = "schema"
"""A model describes its keys, for the reference."""


def test_sentences_are_made_in_one_room() -> None:
    package = Path(triaxcal.__file__).parent
    others = (*SAYS, EFFECTS, SCHEMA)
    found = [
        f"{file.relative_to(package)}:{line}: {text}"
        for file in sorted(package.rglob("*.py"))
        if file.relative_to(package).with_suffix("").parts[0] not in others
        for line, text in _sentences(ast.parse(file.read_text()))
    ]
    assert found == []


def test_a_sentence_is_told_from_a_docstring_a_name_and_the_line_of_an_exception() -> None:
    source = """
def f(n):
    "This is what it does for you."
    if n:
        raise ValueError(f"there are {n} of them too many")
    x = "first and last"
    return f"there are {n} of them too many"


class Far(Refused):
    def __init__(self):
        super().__init__("it is too far away from here")
"""
    assert list(_sentences(ast.parse(source))) == [(7, "there are  of them too many")]


def test_constants_have_a_reason_beside_them() -> None:
    package = Path(triaxcal.__file__).parent
    found = [
        f"{file.relative_to(package)}:{line}: {names}"
        for file in sorted(package.rglob("*.py"))
        for line, names in _bare_constants(file.read_text())
    ]
    assert found == []


def test_a_reason_is_a_docstring_below_or_a_comment_beside_or_above() -> None:
    source = """
LEAST = 9
"The parameters of a line."
MOST: int = 26  # all of a cube
# Of the standard.
A, B = 1.0, 2.0
NAME, WORDS = "nine", {"x": True}
GRID = tuple(range(3))
TABLE[0] = 4.0
PARTS = 5
"""
    assert list(_bare_constants(source)) == [(8, "GRID"), (10, "PARTS")]


def _bare_constants(source: str) -> Iterator[tuple[int, str]]:
    """Line and names of the constants of a module with a number in them, and no reason beside."""
    lines, body = source.splitlines(), ast.parse(source).body
    for statement, below in itertools.zip_longest(body, body[1:]):
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
        names = ast.unparse(target).strip("()")
        values = [c.value for c in ast.walk(statement.value) if isinstance(c, ast.Constant)]
        if "[" in names or not names.isupper() or not any(type(v) in (int, float) for v in values):
            continue
        docstring = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        beside = "#" in lines[(statement.end_lineno or statement.lineno) - 1]
        above = lines[statement.lineno - 2].startswith("#")
        if not (docstring or beside or above):
            yield statement.lineno, names


def _sentences(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and words of the strings of a module that are neither a docstring nor of an exception or a warning."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Raise | ast.Expr) and not _is_call(child):
            continue
        if isinstance(child, ast.ClassDef) and any(isinstance(b, ast.Name) and b.id in RAISED for b in child.bases):
            continue
        if isinstance(child, ast.Call) and ast.unparse(child.func) == "warnings.warn":
            continue
        parts = child.values if isinstance(child, ast.JoinedStr) else [child]
        words = "".join(p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str))
        if len(words.split()) >= WORDS_LEAST:
            yield child.lineno, words
        if not isinstance(child, ast.JoinedStr):
            yield from _sentences(child)


def _is_call(child: ast.stmt) -> bool:
    return isinstance(child, ast.Expr) and isinstance(child.value, ast.Call | ast.Yield | ast.Await)
