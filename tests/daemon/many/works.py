"""Work at one recording as tests want it. Workers import it by name."""

from __future__ import annotations

import mmap
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np

from triaxcald.many import Finding
from triaxcald.recording.reader import digest_of

FIFO = "fifo"
"""Beside the recordings; nobody writes to it."""


def tells(path: Any) -> Finding:
    return Finding({"pid": os.getpid()})


def reads(path: Path) -> Finding:
    return Finding({"pid": len(digest_of(path))})


def holds_once(path: Path) -> Finding:
    """A recording called victim is held the first time, for ever."""
    mark = path.with_suffix(".pid")
    if path.name == "victim" and not mark.exists():
        mark.write_text(f"{os.getpid()}\n")
        _for_ever(path)
    return tells(path)


def dies(path: Path) -> Finding:
    """A recording called deadly takes its worker with it, every time."""
    if path.name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    return tells(path)


def grows(path: Path) -> Finding:
    """A recording called large wants 16 GiB, piece by piece."""
    if path.name == "large":
        held = [np.ones(2**20) for _ in range(2048)]
        return Finding({"pid": len(held)})
    return tells(path)


def maps(path: Path) -> Finding:
    """A recording called large takes 1 GiB that no limit of a process's data counts."""
    if path.name == "large":
        held = mmap.mmap(-1, 2**30)
        for at in range(0, 2**30, mmap.PAGESIZE):
            held[at] = 1
        _for_ever(path)
    return tells(path)


def breaks(path: Path) -> Finding:
    if path.name == "odd":
        raise AttributeError("no such thing")
    return tells(path)


def _for_ever(path: Path) -> None:
    with (path.parent / FIFO).open() as fifo:
        fifo.read()
