"""What a unit is measured for: order, batch, operator and the like, as given on the
command line or in the station file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
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

    def record(self) -> dict[str, str]:
        """As a metadata record of a recording: what is given, as text."""
        return {key: str(value) for key, value in self.document().items() if value is not None}

    @staticmethod
    def recorded(record: Mapping[str, str]) -> Work:
        """Back from a metadata record. Raises ValueError on a record that is none."""
        known = {f.name for f in fields(Work)}
        held: dict[str, Any] = {key: value for key, value in record.items() if key in known}
        if "slot" not in held:
            raise ValueError("no slot")
        if "attempt" in held:
            held["attempt"] = int(held["attempt"])
        return Work(**held)


KEYS: Final = ("serial", "operator", "order", "batch", "part_number", "fixture", "slot", "attempt", "reason")


def plain_serial(text: str) -> str:
    """Without leading zeros, also after a minus sign: a device holds a number."""
    return re.sub("^(-?)0+", r"\1", text.strip())


def wrong(text: str) -> str | None:
    """Why ``text`` is no text of `Work`; None if it is one."""
    if not text or len(text) > LONGEST:
        return f"expected 1 to {LONGEST} characters, not {len(text)}"
    if not text.isprintable():
        return "expected printable characters alone"
    return None


@dataclass(frozen=True)
class Attempt:
    """One attempt at a unit: ``run`` is its id, ``started`` its start (UTC, ISO 8601),
    ``recording`` the file name of its recording, ``settles`` the id of the run that a
    `provision --resume` or `restore` settles."""

    run: str
    started: str
    work: Work
    recording: str | None = None
    settles: str | None = None
