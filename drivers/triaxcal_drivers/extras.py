"""Packages that a bare install lacks, and which extra of it brings them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

EXTRAS = {
    "can": "can",
    "canopen": "can",
    "cantools": "can",
    "pymodbus": "modbus",
    "serial": "modbus",
    "msgpack": "station",
}
"""By the name that is imported."""
CALLED = {"can": "python-can", "serial": "pyserial"}
"""Where the package has another name than what is imported."""


def absent(modules: Iterable[str]) -> str | None:
    """What to install, of modules by the names that are imported; None where all are there."""
    missing = next((m for m in modules if importlib.util.find_spec(m) is None), None)
    if missing is None:
        return None
    return lacking(ModuleNotFoundError(name=missing)) or f"the package {missing} is not installed"


def lacking(e: ModuleNotFoundError) -> str | None:
    """What to install; None where it is no package of ours."""
    module = (e.name or "").partition(".")[0]
    if module not in EXTRAS:
        return None
    name = CALLED.get(module, module)
    return f"the package {name} is not installed; pip install 'triaxcal[{EXTRAS[module]}]' brings it"
