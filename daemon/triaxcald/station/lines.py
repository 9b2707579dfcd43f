"""What units and listeners of a station share: whether a line carries those who
are on it, and whether they drive it alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.catalogue import driver_named
from triaxcal_drivers.interface import LineLoad
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald.errors import InputError
from triaxcald.station.buses import BusPlace
from triaxcald.station.config import Place


def check_lines(places: Sequence[Place], buses: Sequence[BusPlace] = (), *, where: str) -> None:
    """Every shared line carries those of its units that are recorded, and all
    of them drive it alike, who listens too. A unit alone has what the line
    gives, and its losses are counted. Raises InputError with the arithmetic."""
    _check_buses(places, buses, where=where)
    lines: dict[str, list[tuple[int, str, LineLoad]]] = {}
    for i, place in enumerate(places):
        loads = getattr(driver_named(place.bundle.profile.driver), "loads", None)
        of_streams: Mapping[str, LineLoad] = loads(place.bundle, place.bus) if loads else {}
        for name in (READINGS, CORRECTED):  # which are recorded side by side
            if name in of_streams:
                load = of_streams[name]
                lines.setdefault(load.line, []).append((i, f"{place.unit.name} {name}", load))
    for line, units in lines.items():
        first = units[0][2]
        for i, _, load in units:
            if load.settings != first.settings:
                raise InputError(
                    f"{where}: unit {places[i].unit.name} asks for {load.settings} on {line}, unit "
                    f"{places[units[0][0]].unit.name} for {first.settings}"
                )
        total = sum(load.share for _, _, load in units)
        if total > 1 and len({i for i, _, _ in units}) > 1:
            each = " + ".join(
                f"{name} {load.reads_per_s:.3g}/s × {1e3 * load.read_s:.3g} ms" for _, name, load in units
            )
            raise InputError(
                f"{where}: {line} at {first.settings} cannot carry its units at their rates: "
                f"{each} = {total:.0%} of its time; drive it faster, or lower sampling.rate_hz of the profiles"
            )


def _check_buses(places: Sequence[Place], buses: Sequence[BusPlace], *, where: str) -> None:
    """Raises InputError."""
    on_buses = [(f"unit {p.unit.name}", p.bus) for p in places if isinstance(p.bus, BusSettings)]
    first: dict[str, tuple[str, BusSettings]] = {}
    for who, settings in (*on_buses, *((f"bus {b.name}", b.settings) for b in buses)):
        other, theirs = first.setdefault(settings.name, (who, settings))
        if settings.driven != theirs.driven:
            raise InputError(
                f"{where}: {who} asks for {settings.driven} on {settings.name}, {other} for {theirs.driven}"
            )
