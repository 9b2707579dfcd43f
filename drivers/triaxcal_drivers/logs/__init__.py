"""Logs of a bus that other programs recorded: BLF, ASC, candump, TRC, MF4,
pcap."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triaxcal_drivers.lazy import lazily

if TYPE_CHECKING:
    from triaxcal_drivers.logs.can_frames import EXTENDED, Account, LoggedFrame, Remark
    from triaxcal_drivers.logs.dates import LONGEST_NS
    from triaxcal_drivers.logs.kinds import MCAP, MCAP_KIND, Kind, Log, opened

_NAMES = {
    "can_frames": (
        "Account",
        "EXTENDED",
        "LoggedFrame",
        "Remark",
    ),
    "dates": ("LONGEST_NS",),
    "kinds": (
        "Kind",
        "Log",
        "MCAP",
        "MCAP_KIND",
        "opened",
    ),
}

__all__ = [
    "EXTENDED",
    "LONGEST_NS",
    "MCAP",
    "MCAP_KIND",
    "Account",
    "Kind",
    "Log",
    "LoggedFrame",
    "Remark",
    "opened",
]

if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
