"""Each test of the folder `inside`, as it ended on a kernel with CAN."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.guest.inner import INSIDE, Inner, no_kernel


def inner_tests() -> list[str]:
    """By file and name, read from the source: none of it can be imported where there is no such kernel."""
    return [
        f"{file.name}::{statement.name}"
        for file in sorted(Path(INSIDE).glob("test_*.py"))
        for statement in ast.parse(file.read_text("utf-8")).body
        if isinstance(statement, ast.FunctionDef) and statement.name.startswith("test_")
    ]


@pytest.mark.slow
@pytest.mark.timeout(1500)  # the first ones wait for the guest, which has a time limit of its own
@pytest.mark.parametrize("name", inner_tests())
def test_on_a_can_kernel(name: str, ended: dict[str, Inner]) -> None:
    inner = ended.get(name)
    assert inner is not None, f"{name} was not run; run were {', '.join(ended)}"
    if inner.outcome == "skipped":
        no_kernel(inner.said)
    if inner.outcome == "failed":
        pytest.fail(f"inside: {inner.said}", pytrace=False)
