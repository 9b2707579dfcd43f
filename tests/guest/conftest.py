"""The tests of `inside` are run on a kernel with CAN, all at once, and told here one by one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.guest.can_kernel import why_not_the_guest, why_not_the_host
from tests.guest.inner import INSIDE, Inner, inside_the_guest, no_kernel, on_the_host, read

collect_ignore = [str(INSIDE)]


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
        no_kernel(f"no kernel with CAN came up: {(folder / 'console').read_text()[-1000:]} {said[-1000:]}")
    return dict(read(results))
