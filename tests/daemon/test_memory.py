"""What of freed memory goes back to the system."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

HOLES = """
import sys, numpy as np
from triaxcald.memory import large_apart, resident_bytes
if sys.argv[1] == "apart":
    large_apart()
np.ones(3_900_000)  # 30 MiB: freed, it raises the size from which glibc asks the system
held = []
for _ in range(20):
    large = [np.ones(800_000) for _ in range(4)]  # 6 MiB each
    held.append(np.ones(10_000))  # in use, behind them
    del large
    held.append(np.ones(10_000))
many = [np.ones(800_000) for _ in range(20)]
held.append(np.ones(10_000))
before = resident_bytes()
del many
print((before - resident_bytes()) / 2**20)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has another rule")
@pytest.mark.parametrize(("how", "least", "most"), [("apart", 115, 125), ("as glibc does", -1, 100)])
def test_large_blocks_go_back_to_the_system(how: str, least: float, most: float) -> None:
    freed = subprocess.run([sys.executable, "-c", HOLES, how], capture_output=True, text=True, check=True)
    assert least <= float(freed.stdout) <= most
