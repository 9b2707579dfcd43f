"""Folders with outcomes of known content."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.documents import to_text

AN_HOUR_AGO_NS = 3600 * 10**9
Write = Callable[..., Path]


def document(**changed: Any) -> dict[str, Any]:
    """The least that an outcome has; ``changed`` keys replace or join it."""
    return {
        "format": "triaxcal.outcome/1",
        "unit": "left",
        "serial": "1042",
        "station": "bench",
        "ended": "2026-01-31T12:00:00.000+00:00",
        "verdict": "pass",
        "reason": "within the limits",
        "exit_code": 0,
        "device_state": "new_verified",
        "contents": {},
    } | changed


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes an outcome that looks as if it had been there for an hour, so that the index trusts its stamp."""

    def write(name: str = "a", text: str | None = None, **changed: Any) -> Path:
        path = tmp_path / f"{name}.outcome.json"
        path.write_text(to_text(document(**changed)) if text is None else text, encoding="utf-8")
        aged = path.stat().st_mtime_ns - AN_HOUR_AGO_NS
        os.utime(path, ns=(aged, aged))
        return path

    return write
