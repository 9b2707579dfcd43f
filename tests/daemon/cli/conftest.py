"""The finished run's readings as text, and commands that several tests ask the same of."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from triaxcald.cli.commands import main


@pytest.fixture(scope="session")
def exported(finished_run: Any, once: Callable[..., Path]) -> Path:
    """The CAN unit's readings as `log export` writes them."""

    def make(folder: Path) -> None:
        with contextlib.redirect_stderr(io.StringIO()):
            assert main(["log", "export", str(finished_run.can), "-o", str(folder / "can.csv")]) == 0

    return once("exported", make) / "can.csv"


@dataclass(frozen=True)
class Said:
    """What a command said: its exit code and its two streams."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one document on standard output, to be changed at will."""
        return json.loads(self.out)


@pytest.fixture
def asked(triaxcal: Callable[..., Any], once: Callable[..., Path]) -> Callable[..., Said]:
    """Runs a command that writes nothing, on files that stay as they are: once for all tests that ask the same."""

    def ask(*arguments: Any) -> Said:
        words = [str(a) for a in arguments]

        def make(folder: Path) -> None:
            done = triaxcal(*words)
            (folder / "said.json").write_text(json.dumps([done.code, done.out, done.err]), "utf-8")

        folder = once(f"asked-{hashlib.sha256(json.dumps(words).encode()).hexdigest()[:24]}", make)
        return Said(*json.loads((folder / "said.json").read_text("utf-8")))

    return ask


@pytest.fixture(scope="session")
def calibrations(finished_run: Any, once: Callable[..., Path]) -> Path:
    """A folder with what `fit` and `diagnose` make of the CAN unit: linear.json and closed.json."""

    def make(folder: Path) -> None:
        for command, name in (("fit", "linear.json"), ("diagnose", "closed.json")):
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                assert main([command, str(finished_run.can), "-o", str(folder / name)]) == 0

    return once("calibrations", make)
