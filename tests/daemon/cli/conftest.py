"""The finished run's readings as text."""

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
