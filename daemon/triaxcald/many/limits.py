"""What this process may use of its machine: a container may have less than all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

CGROUPS: Final = Path("/sys/fs/cgroup")
OWN: Final = Path("/proc/self/cgroup")


def processors(groups: Path = CGROUPS, own: Path = OWN) -> int:
    """At least 1. A share of a processor counts as one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for text in _said("cpu.max", groups, own):
        quota, _, period = text.partition(" ")
        if quota.isdigit() and period.isdigit() and int(period):
            cores = min(cores, -(-int(quota) // int(period)))
    return max(1, cores)


def memory(groups: Path = CGROUPS, own: Path = OWN) -> int | None:
    """Bytes that its control group may take; None without a limit."""
    return min((int(text) for text in _said("memory.max", groups, own) if text.isdigit()), default=None)


def _said(name: str, groups: Path, own: Path) -> list[str]:
    """By the control groups (version 2) of this process and those above them. A
    container has its own as the root."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return []
    path = next((line.removeprefix("0::").strip("/") for line in lines if line.startswith("0::")), None)
    if path is None:
        return []
    found = []
    for group in (groups / path, *(groups / path).parents):
        if group.is_relative_to(groups):
            try:
                found.append((group / name).read_text().strip())
            except OSError:
                continue
    return found
