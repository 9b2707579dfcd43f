"""What commands make of the finished run: its readings as text, calibrations of it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
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


@pytest.fixture(scope="session")
def calibrations(finished_run: Any, once: Callable[..., Path]) -> Path:
    """A folder with what `fit` and `diagnose` make of the CAN unit: linear.json and closed.json."""

    def make(folder: Path) -> None:
        for command, name in (("fit", "linear.json"), ("diagnose", "closed.json")):
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                assert main([command, str(finished_run.can), "-o", str(folder / name)]) == 0

    return once("calibrations", make)
