"""The tests of `inside` are run on a kernel with CAN, all at once, and told here one by one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.guest.can_kernel import why_not_the_guest, why_not_the_host
from tests.guest.inner import INSIDE, Inner, inside_the_guest, no_kernel, on_the_host, read

collect_ignore = [str(INSIDE)]
FLOATING_POINT = "put_fp_registers"
"""Where Debian's kernel of version 6.1 dies before its first program: it restores less of the state than the processor
of the host has, which the host refuses. No test can mend that, so it is a reason to skip, also where the guest is
required."""


@pytest.fixture(scope="session")
def ended(once: Callable[[str, Callable[[Path], None]], Path]) -> dict[str, Inner]:
    """How each test ended, by file and name."""
    no_guest = why_not_the_guest()
    if no_guest and (no_host := why_not_the_host()):
        no_kernel(f"{no_guest}; {no_host}")
    folder = once("guest", on_the_host if no_guest else inside_the_guest)
    results = folder / "results.xml"
    said = (folder / "said").read_text() if (folder / "said").exists() else ""
    if not results.exists():
        console = (folder / "console").read_text()
        if FLOATING_POINT in console:
            pytest.skip("user-mode Linux does not run on this processor, whose floating-point state is larger (AMX)")
        no_kernel(f"no kernel with CAN came up: {console[-1000:]} {said[-1000:]}")
    return dict(read(results))
