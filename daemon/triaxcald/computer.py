"""The computer that figures are computed on: its processor, and the linear
algebra that numpy and scipy bring.

Several threads add numbers up in another order than one, so that the last
digits depend on how many there are.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path
from typing import Any

import numpy.linalg
import scipy.linalg  # brings a library of linear algebra of its own
from threadpoolctl import ThreadpoolController

from triaxcald.memory import require_room_for_buffers

PROCESSOR, BLAS, KERNEL = "processor", "blas", "blas_kernel"
KEYS = (PROCESSOR, BLAS, KERNEL)
"""Beside the versions of software, where it is said what computed a result."""
_CPUINFO = Path("/proc/cpuinfo")
_TAKES_A_BUFFER = 128
"""Rows of a product that no library computes without its buffer; OpenBLAS has
other code for small ones, of up to 100 rows."""


def compute_with_one_thread() -> None:
    """Linear algebra in this process, for good: whoever computes figures that
    an audit compares calls it first. Costs next to nothing when called again."""
    _libraries().limit(limits=1, user_api="blas")
    _take_buffers()


@cache
def _take_buffers() -> None:
    """Each library takes its own at its first product: an inverse may do without,
    because scipy finds that a matrix is diagonal. Raises MemoryError where the
    limit of the address space leaves no room for them."""
    require_room_for_buffers()
    square = numpy.ones((_TAKES_A_BUFFER, _TAKES_A_BUFFER))
    numpy.dot(square, square.T.copy())
    scipy.linalg.blas.dgemm(1.0, square, square)


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
