"""Packages that a bare install lacks, and which extra of it brings them."""

from __future__ import annotations

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


def lacking(e: ModuleNotFoundError) -> str | None:
    """What to install; None where it is no package of ours."""
    module = (e.name or "").partition(".")[0]
    if module not in EXTRAS:
        return None
    name = CALLED.get(module, module)
    return f"the package {name} is not installed; pip install 'triaxcal[{EXTRAS[module]}]' brings it"
