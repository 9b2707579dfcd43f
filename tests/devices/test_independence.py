"""The devices judge the drivers, and so must know nothing of them."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
DEVICES = sorted(p for p in HERE.glob("*.py") if not p.name.startswith("test_"))


def imported(path: Path) -> set[str]:
    """Top-level packages."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append(node.module or "")
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("path", DEVICES, ids=lambda path: path.stem)
def test_a_device_knows_the_standard_library_and_a_can_bus_only(path: Path) -> None:
    allowed = {*sys.stdlib_module_names, "tests", *({"can"} if path.stem == "canopen" else ())}
    assert imported(path) <= allowed
