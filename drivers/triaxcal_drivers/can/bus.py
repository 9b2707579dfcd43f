"""Opening a CAN bus."""

from __future__ import annotations

from typing import Any

import can

from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.errors import BusError


def open_bus(settings: CanBus) -> can.BusABC:
    """Blocking. Raises BusError."""
    options: dict[str, Any] = dict(settings.options)
    if settings.bitrate is not None:
        options["bitrate"] = settings.bitrate
    try:
        return can.Bus(settings.channel, settings.interface, ignore_config=True, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as e:
        reason = " ".join(str(e).split()) or type(e).__name__
        raise BusError(f"cannot open {settings.interface} {settings.channel}: {reason}") from e
