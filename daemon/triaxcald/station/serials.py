"""The serial numbers that the units of one run report: a unit that answers in
two places is one of them mixed up."""

from __future__ import annotations

from dataclasses import dataclass, field

from triaxcald.errors import SerialTwice


@dataclass
class SerialsSeen:
    _places: dict[str, tuple[str, str]] = field(default_factory=dict)

    def add(self, serial: str | None, unit: str, address: str) -> None:
        """Raises SerialTwice if another place has reported it before. None is a
        serial that nobody can read."""
        here = unit, address
        other = here if serial is None else self._places.setdefault(serial, here)
        if other != here:
            places = ", and ".join(f"unit {name} ({where})" for name, where in (other, here))
            raise SerialTwice(f"serial {serial} answers in two places: {places}")

    def discard(self, unit: str) -> None:
        """What this unit has reported."""
        self._places = {serial: place for serial, place in self._places.items() if place[0] != unit}
