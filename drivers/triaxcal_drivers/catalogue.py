"""The drivers that are installed, found by entry point; none is imported until
asked for."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, cast

from triaxcal_drivers.errors import DriverMissing
from triaxcal_drivers.extras import absent, lacking
from triaxcal_drivers.nearest import clipped, closest

if TYPE_CHECKING:
    from triaxcal_drivers.interface import Driver

GROUP = "triaxcal.drivers"


@dataclass(frozen=True)
class Listed:
    """An installed driver; ``fault`` says why it cannot be used, where it
    cannot."""

    name: str
    target: str
    distribution: str
    fault: str | None = None


def _points() -> dict[str, EntryPoint]:
    return {p.name: p for p in entry_points(group=GROUP)}


def driver_named(name: str, *, where: str = "") -> Driver:
    """Raises DriverMissing with the nearest name, or with the reason why it
    cannot be imported."""
    lead = f"{where}: " if where else ""
    points = _points()
    if name not in points:
        close = closest(name, points)
        hint = f"; did you mean '{close}'?" if close else f"; installed: {', '.join(sorted(points)) or 'none'}"
        raise DriverMissing(f"{lead}no driver named '{clipped(name)}'{hint}")
    try:
        return cast("Driver", points[name].load()())
    except Exception as e:
        why = (lacking(e) if isinstance(e, ModuleNotFoundError) else None) or repr(e)
        raise DriverMissing(f"{lead}driver '{name}' ({points[name].value}) cannot be loaded: {why}") from e


def listed() -> list[Listed]:
    """Every installed driver, tried; for `triaxcal devices`."""
    found = []
    for name, point in sorted(_points().items()):
        fault = None
        try:
            fault = absent(getattr(driver_named(name), "packages", ()))
        except DriverMissing as e:
            fault = str(e)
        found.append(Listed(name, point.value, point.dist.name if point.dist else "?", fault))
    return found
