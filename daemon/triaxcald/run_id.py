"""The identifier of one run: a UUID of version 7 (RFC 9562), which sorts by
time."""

from __future__ import annotations

import secrets
import time
import uuid


def new_run_id(time_ns: int | None = None) -> str:
    """48 bits of milliseconds since 1970, then random bits; ``time_ns`` is the
    time since the epoch, by default now."""
    milliseconds = (time.time_ns() if time_ns is None else time_ns) // 1_000_000
    value = (milliseconds & (1 << 48) - 1) << 80 | secrets.randbits(80)
    value = value & ~(0xF << 76) | 0x7 << 76  # version
    value = value & ~(0x3 << 62) | 0x2 << 62  # variant
    return str(uuid.UUID(int=value))
