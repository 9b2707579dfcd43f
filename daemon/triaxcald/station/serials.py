"""The serial numbers that the units of one run report: a unit that answers in
two places is one of them mixed up."""

from __future__ import annotations

from dataclasses import dataclass, field

from triaxcald.errors import StationError


@dataclass
class SerialsSeen:
    _places: dict[str, str] = field(default_factory=dict)

    def add(self, serial: str | None, unit: str, address: str) -> None:
        """Raises StationError where another place has reported it before. None
        is a serial that nobody can read."""
        place = f"unit {unit} ({address})"
        other = place if serial is None else self._places.setdefault(serial, place)
        if other != place:
            raise StationError(f"serial {serial} answers in two places: {other}, and {place}")
