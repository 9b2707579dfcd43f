"""How the tests of `inside` ended on a kernel with CAN."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.guest.can_kernel import run_in_the_guest, run_on_the_host

PROJECT = Path(__file__).parents[2]
INSIDE = Path(__file__).parent / "inside"
REQUIRED = "TRIAXCAL_GUEST"
"""In the environment: "required" where a machine without such a kernel is a fault."""
TIMEOUT_S = 600.0  # ten times what it takes on a machine that does nothing else


@dataclass(frozen=True)
class Inner:
    """How a test ended there; ``outcome`` is "passed", "failed" or "skipped"."""

    outcome: str
    said: str


def no_kernel(reason: str) -> None:
    if os.environ.get(REQUIRED) == "required":
        pytest.fail(reason)
    pytest.skip(reason)


def _pytest(folder: Path) -> tuple[list[str], dict[str, str]]:
    """Without the project's own configuration, plugins and fixtures, which take longer to load than the tests last."""
    options = ["-q", "--durations=12", "-p", "no:cacheprovider", "--import-mode=importlib", "-c", "/dev/null"]
    places = ["--rootdir", str(INSIDE), "--confcutdir", str(INSIDE), "--junitxml", str(folder / "results.xml")]
    paths = os.pathsep.join(str(PROJECT / part) for part in ("", "daemon", "drivers"))
    environment = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return [sys.executable, "-m", "pytest", *options, *places, str(INSIDE)], environment


def inside_the_guest(folder: Path) -> None:
    """Leaves in the folder the results, what the command said, and what the kernel said or why it did not end."""
    command, environment = _pytest(folder)
    try:
        said = run_in_the_guest(command, folder, {**environment, REQUIRED: "inside"}, TIMEOUT_S)
    except RuntimeError as e:
        said = str(e)
    (folder / "console").write_text(said)


def on_the_host(folder: Path) -> None:
    """Likewise."""
    command, environment = _pytest(folder)
    try:
        said = run_on_the_host(command, environment, TIMEOUT_S)
    except RuntimeError as e:
        said = str(e)
    (folder / "console").write_text(said)


def read(results: Path) -> Iterator[tuple[str, Inner]]:
    for case in ElementTree.parse(results).getroot().iter("testcase"):
        file = case.get("classname", "").rpartition(".")[2]
        outcome, said = "passed", ""
        for child in case:
            if child.tag in ("failure", "error"):
                outcome, said = "failed", f"{said}{child.get('message')}\n{child.text}\n"
            elif child.tag == "skipped" and outcome == "passed":
                outcome, said = "skipped", str(child.get("message"))
        yield f"{file}.py::{case.get('name')}", Inner(outcome, said)
