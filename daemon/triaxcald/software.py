"""Which software made a document or a recording."""

from __future__ import annotations

import platform
import secrets
import time
import uuid
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from threadpoolctl import ThreadpoolController


def drawn_with() -> dict[str, str]:
    """Versions of what draws a report, which other versions draw otherwise;
    known without loading it, since a recorder draws nothing."""
    return {"matplotlib": version("matplotlib"), "jinja2": version("jinja2")}


def software() -> dict[str, str]:
    """Versions of what computes the numbers, and the computer that does."""
    from triaxcald.software import computer  # loads the linear algebra

    return {**versions(), **computer()}


def versions() -> dict[str, str]:
    """The same without the computer, for what computes nothing."""
    return {
        "triaxcal": version("triaxcal"),
        "numpy": version("numpy"),
        "scipy": version("scipy"),
        "python": platform.python_version(),
    }


# The computer that figures are computed on: its processor, and the linear algebra
# that numpy and scipy bring.

PROCESSOR, BLAS, KERNEL = "processor", "blas", "blas_kernel"
KEYS = (PROCESSOR, BLAS, KERNEL)
"""Beside the versions of software, where it is said what computed a result."""
_CPUINFO = Path("/proc/cpuinfo")


def compute_with_one_thread() -> None:
    """Linear algebra in this process, for good: whoever computes figures that
    an audit compares calls it first. Costs next to nothing when called again."""
    _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@cache
def computer() -> dict[str, str]:
    """Names of the processor, of BLAS and of the code that it has for this
    processor; of numpy's, and of scipy's where that is another."""
    libraries = sorted(_libraries().info(), key=lambda of: str(of["filepath"]).partition("site-packages")[2])
    found = [library for library in libraries if library["user_api"] == "blas"]
    return {
        PROCESSOR: _processor(),
        BLAS: _joined(f"{b['internal_api']} {b.get('version') or ''}".strip() for b in found),
        KERNEL: _joined(b.get("architecture") or "" for b in found),
    }


def _joined(names: Any) -> str:
    """Each once, in their order."""
    return ", ".join(dict.fromkeys(filter(None, names))) or "unknown"


def _processor() -> str:
    try:
        lines = _CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine() or "unknown"


# The identifier of one run: a UUID of version 7 (RFC 9562), which sorts by time.


def new_run_id(time_ns: int | None = None) -> str:
    """48 bits of milliseconds since 1970, then random bits; ``time_ns`` is the
    time since the epoch, by default now."""
    milliseconds = (time.time_ns() if time_ns is None else time_ns) // 1_000_000
    value = (milliseconds & (1 << 48) - 1) << 80 | secrets.randbits(80)
    value = value & ~(0xF << 76) | 0x7 << 76  # version
    value = value & ~(0x3 << 62) | 0x2 << 62  # variant
    return str(uuid.UUID(int=value))
