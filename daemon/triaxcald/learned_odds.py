"""The file of learned odds by which a unit is diagnosed: read, refused where it is of
another part number, and carried in the recording."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import triaxcal as tc
from triaxcald.errors import InputError
from triaxcald.inputs import document_bytes, parse_document
from triaxcald.station.config import Station
from triaxcald.work import Work

RECORD = "odds"
"""The metadata record that names it."""


@dataclass(frozen=True)
class OddsFile:
    """``data`` are the bytes that the ``odds`` were read from."""

    name: str
    data: bytes
    odds: tc.population.LearnedOdds

    @classmethod
    def read(cls, path: str, part_number: str | None = None) -> OddsFile:
        """Raises InputError; InvalidData also for odds of another part number."""
        return cls.parsed(document_bytes(path), path, part_number)

    @classmethod
    def parsed(cls, data: bytes, name: str, part_number: str | None = None) -> OddsFile:
        document = parse_document(data, where=name)
        return cls(Path(name).name, data, tc.interchange.odds_of(document, where=name, part_number=part_number))

    @property
    def prior(self) -> tc.evidence.Odds:
        return self.odds.prior

    def require_of(self, part_number: str | None, what: str) -> None:
        """Raises InvalidData where they are of another part number than ``what``."""
        own = self.odds.part_number
        if own is not None and part_number is not None and own != part_number:
            raise tc.InvalidData(f"{self.name}: odds of part number {own}, and {what} has {part_number}")

    @property
    def document(self) -> tc.interchange.Document:
        """As a loop names what it was found by."""
        return {
            "sha256": hashlib.sha256(self.data).hexdigest(),
            "part_number": self.odds.part_number,
            "units": self.odds.units,
            "effects": {name: tc.rounding.uncertainty(learned.odds) for name, learned in self.odds.effects.items()},
            "unmodelled_probability": tc.rounding.chance(self.odds.unmodelled_probability),
        }


def odds_of_station(station: Station) -> OddsFile | None:
    """The file that the station names; None if it names none. Raises InputError if it
    holds no odds."""
    if station.file.odds is None:
        return None
    where = f"{station.path}: odds"
    try:
        return OddsFile.read(str(station.path.parent / station.file.odds))
    except (InputError, tc.TriaxcalError) as e:
        raise InputError(f"{where}: {e}") from e


def odds_for(station: Station, work: Mapping[str, Work], path: str | None = None) -> OddsFile | None:
    """The odds in the file at ``path``, else those that the station names, for units
    that are measured for this ``work``, by slot. Raises InputError; InvalidData for
    another part number."""
    odds = OddsFile.read(path) if path else odds_of_station(station)
    if odds is not None:
        for slot, of_unit in work.items():
            odds.require_of(of_unit.part_number, f"unit {slot}")
    return odds
