"""What of a station is another, once its file has been written anew."""

from __future__ import annotations

from triaxcald.station.config import Place, Station


def names_in(station: Station) -> set[str]:
    """Of its units and buses."""
    return {place.unit.name for place in station.places} | {bus.name for bus in station.buses}


def changed(before: Station, after: Station) -> set[str]:
    """Names of units and buses that are gone, new, or not as they were. All are,
    where the station says something else of itself: each recording holds the
    station file by which it is read."""
    if _itself(before) != _itself(after):
        return names_in(before) | names_in(after)
    old, new = _each(before), _each(after)
    return {name for name in old.keys() | new.keys() if old.get(name) != new.get(name)}


def _itself(station: Station) -> object:
    return station.file.model_copy(update={"units": (), "buses": ()})


def _each(station: Station) -> dict[str, object]:
    units = {place.unit.name: _of_unit(place) for place in station.places}
    return {**units, **{bus.name: (bus.settings, bus.given) for bus in station.buses}}


def _of_unit(place: Place) -> object:
    return place.unit, place.bundle.text, dict(place.bundle.files)
