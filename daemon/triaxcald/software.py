"""Which software made a document or a recording."""

from __future__ import annotations

import platform
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
