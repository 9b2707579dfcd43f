"""What a unit is measured for: order, batch, operator and the like, as given on the
command line or in the station file."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

RECORD: Final = "work"
"""Name of the metadata record in a recording."""
LONGEST = 64
"""Characters of each text: a bar code of that length still scans."""


@dataclass(frozen=True)
class Work:
    """``serial`` is the expected serial number, ``slot`` the name of the unit in the
    station file, ``attempt`` counts from 1 for each serial number in the folder,
    ``reason`` is that of a re-test. Texts have at most 64 printable characters."""

    slot: str
    serial: str | None = None
    operator: str | None = None
    order: str | None = None
    batch: str | None = None
    part_number: str | None = None
    fixture: str | None = None
    attempt: int | None = None
    reason: str | None = None

    def document(self) -> dict[str, Any]:
        """In the order of the contract."""
        held = asdict(self)
        return {key: held[key] for key in KEYS}


KEYS: Final = ("serial", "operator", "order", "batch", "part_number", "fixture", "slot", "attempt", "reason")


def wrong(text: str) -> str | None:
    """Why ``text`` is no text of `Work`; None if it is one."""
    if not text or len(text) > LONGEST:
        return f"expected 1 to {LONGEST} characters, not {len(text)}"
    if not text.isprintable():
        return "expected printable characters alone"
    return None
