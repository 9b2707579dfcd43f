"""One thread of linear algebra, whatever the environment says; and the computer's name."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest
from threadpoolctl import threadpool_info

from triaxcald.computer import BLAS, KERNEL, KEYS, PROCESSOR, compute_with_one_thread, computer

THREADS = """
import json
from threadpoolctl import threadpool_info
print(json.dumps([b["num_threads"] for b in threadpool_info() if b["user_api"] == "blas"]))
"""


def run(code: str, **environment: str) -> Any:
    done = subprocess.run(
        [sys.executable, "-c", code + THREADS],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "from triaxcald.computer import compute_with_one_thread\ncompute_with_one_thread()\nimport scipy.optimize",
        "from triaxcald.cli.commands import main\nmain(['plan', '--json'])",
        "from triaxcald.cli.commands import main\nmain(['audit', '/nowhere.mcap'])\nimport scipy.linalg",
    ],
)
def test_a_command_computes_with_one_thread(code: str) -> None:
    threads = run(code)
    assert len(threads) >= 1
    assert set(threads) == {1}


@pytest.mark.slow
def test_the_metrology_as_a_library_leaves_the_threads_alone() -> None:
    assert run("import numpy, scipy.linalg, triaxcal, triaxcal.api") == run("import numpy, scipy.linalg")


def test_the_computer_is_named_by_processor_library_and_kernel() -> None:
    compute_with_one_thread()
    found = computer()
    assert tuple(found) == KEYS
    blas = [b for b in threadpool_info() if b["user_api"] == "blas"]
    assert {b["num_threads"] for b in blas} <= {1}
    for b in blas:
        assert b["version"] in found[BLAS]
        assert b["architecture"] in found[KERNEL]
    assert found[PROCESSOR] not in ("", "unknown")


@pytest.mark.slow
def test_the_kernel_is_the_one_that_computes() -> None:
    code = "import json\nfrom triaxcald.computer import computer\nprint(json.dumps(computer()))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OPENBLAS_CORETYPE": "Nehalem"},
        capture_output=True,
        text=True,
        check=True,
    )
    blas = [b for b in threadpool_info() if b["internal_api"] == "openblas"]
    if not blas or sys.platform != "linux" or os.uname().machine != "x86_64":
        pytest.skip("no OpenBLAS for x86-64")
    assert json.loads(done.stdout)[KERNEL] == "Nehalem"
