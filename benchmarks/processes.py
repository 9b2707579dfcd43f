"""What the processes of a benchmark share."""

from __future__ import annotations

import os


def one_thread() -> None:
    """To begin a process with: threads of linear algebra would only wait for those of the other processes."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
