"""Packages that a bare install lacks, and which extra of it brings them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable

EXTRAS = {
    "can": "can",
    "canopen": "can",
    "pymodbus": "modbus",
    "serial": "modbus",
    "msgpack": "station",
    "asammdf": "logs",
    "rosbags": "logs",
    "lz4": "logs",
}
"""By the name that is imported."""
CALLED = {"can": "python-can", "serial": "pyserial"}
"""Where the package has another name than what is imported."""


def absent(modules: Iterable[str]) -> str | None:
    """What to install, of modules by the names that are imported; None where
    all are there."""
    missing = [m for m in modules if importlib.util.find_spec(m) is None]
    if not missing:
        return None
    ours = [m for m in missing if m in EXTRAS]
    extras = {EXTRAS[m] for m in ours}
    return _told((ours or missing)[0], extras.pop() if len(extras) == 1 else "station" if extras else None)


def lacking(e: ModuleNotFoundError) -> str | None:
    """What to install; None where it is no package of ours."""
    module = (e.name or "").partition(".")[0]
    return _told(module, EXTRAS[module]) if module in EXTRAS else None


def _told(module: str, extra: str | None) -> str:
    brings = f"; pip install 'triaxcal[{extra}]' brings it" if extra else ""
    return f"the package {CALLED.get(module, module)} is not installed{brings}"
