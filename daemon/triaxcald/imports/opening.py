"""Opens the log of others that goes with a profile's driver."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.imports.of_can import is_own, own_log

DRIVERS = ("can", "mcap")


@contextmanager
def opened_log(path: Path, driver: str) -> Iterator[td.logs.Log]:
    """The log of frames for the ``driver`` can, of messages for mcap. Raises
    InputError where it is of the other kind, LogError."""
    own = driver == "can" and is_own(path)
    with nullcontext(own_log(path)) if own else td.logs.opened(path) as log:
        if isinstance(log.kind, td.logs.Kind) != (driver == "can"):
            name = log.kind.name if isinstance(log.kind, td.logs.Kind) else log.kind
            held = "frames of CAN" if driver == "can" else "messages"
            raise InputError(f"{path}: {name}, which holds no {held}; the profile's driver is '{driver}'")
        yield log
