"""Which software made a document or a recording."""

from __future__ import annotations

import platform
import secrets
import time
import uuid
from importlib.metadata import version


def drawn_with() -> dict[str, str]:
    """Versions of what draws a report, which other versions draw otherwise;
    known without loading it, since a recorder draws nothing."""
    return {"matplotlib": version("matplotlib"), "jinja2": version("jinja2")}


def software() -> dict[str, str]:
    """Versions of what computes the numbers, and the computer that does."""
    from triaxcald.computer import computer  # loads the linear algebra

    return {**versions(), **computer()}


def versions() -> dict[str, str]:
    """The same without the computer, for what computes nothing."""
    return {
        "triaxcal": version("triaxcal"),
        "numpy": version("numpy"),
        "scipy": version("scipy"),
        "python": platform.python_version(),
    }


# The identifier of one run: a UUID of version 7 (RFC 9562), which sorts by time.


def new_run_id(time_ns: int | None = None) -> str:
    """48 bits of milliseconds since 1970, then random bits; ``time_ns`` is the
    time since the epoch, by default now."""
    milliseconds = (time.time_ns() if time_ns is None else time_ns) // 1_000_000
    value = (milliseconds & (1 << 48) - 1) << 80 | secrets.randbits(80)
    value = value & ~(0xF << 76) | 0x7 << 76  # version
    value = value & ~(0x3 << 62) | 0x2 << 62  # variant
    return str(uuid.UUID(int=value))
