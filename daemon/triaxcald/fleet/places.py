"""Effects of places in a fleet, and the odds of effects that its units teach."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.fleet.reading import Certified, Row
from triaxcald.fleet.recorded import Recorded, recorded_in
from triaxcald.fleet.values import Fleet
from triaxcald.inputs import DOCUMENT_MOST, parse_document
from triaxcald.service.quality import COEFFICIENTS

WHOLE_MOST: Final = 2000
"""Runs of which certificates are read whole, with their poses, and recordings opened:
more take minutes. Of larger fleets the coefficients and effects count, without
poses."""
FACTORS: Final = ("part_number", "batch", "station", "fixture", "slot", "operator")
Tell = Callable[[int, int], None]


@dataclass(frozen=True)
class PlaceOfEffect:
    """``probability`` that it is this place, if the effect acts."""

    kind: str
    name: str
    probability: float


@dataclass(frozen=True)
class Placed:
    """An effect of a place, as a page shows it. ``kind`` and ``place`` are those of the
    likeliest of ``places``. ``since`` and ``until`` are dates, UTC, None where it acts
    from the first run on, and to the last; ``since_interval`` has the former with
    95 %."""

    verdict: str
    places: tuple[PlaceOfEffect, ...]
    since: str | None
    since_interval: tuple[str, str] | None
    until: str | None
    figure: str
    probability: float
    size: str
    text: str

    @property
    def document(self) -> dict[str, Any]:
        first = self.places[0]
        return {
            "kind": first.kind,
            "place": first.name,
            "verdict": self.verdict,
            "places": [asdict(place) | {"probability": tc.rounding.chance(place.probability)} for place in self.places],
            "since": self.since,
            "since_interval": None if self.since_interval is None else list(self.since_interval),
            "until": self.until,
            "figure": self.figure,
            "probability": tc.rounding.chance(self.probability),
            "size": self.size,
            "text": self.text,
        }


def placed(fleet: Fleet, folder: Path | None, tell: Tell = lambda done, of: None) -> list[Placed]:
    """What belongs to a place or a time instead of a unit. ``folder`` has the
    certificates, None without them; ``tell`` is called with the number of runs read so
    far, and of all."""
    runs = [run for run in _runs(fleet, folder, tell) if run is not None]
    if len(runs) < tc.population.LEAST_RUNS:
        return []
    found = tc.population.placed_effects(runs)
    return [_shown(statement) for statement in (*found.statements, *found.candidates)]


def _shown(of: tc.population.Statement) -> Placed:
    began = of.since_interval_s
    return Placed(
        of.verdict.value,
        tuple(PlaceOfEffect(place.kind.value, place.name, p) for place, p in of.places.items()),
        None if of.since_s is None else _day(of.since_s),
        None if began is None else (_day(began[0]), _day(began[1])),
        None if of.until_s is None else _day(of.until_s),
        tc.text.population.pattern(of.pattern),
        of.probability,
        tc.text.population.sizes(of),
        tc.text.population.line(of, _day),
    )


def _day(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).date().isoformat()


def _runs(fleet: Fleet, folder: Path | None, tell: Tell) -> list[tc.population.UnitRun | None]:
    whole = folder is not None and len(fleet.rows) <= WHOLE_MOST
    found = []
    for i, (row, paper) in enumerate(zip(fleet.rows, fleet.certified, strict=True)):
        tell(i, len(fleet.rows))
        document = _document(folder, row) if whole and paper is not None else None
        found.append(_run(fleet, i, paper, document, folder))
    return found


def _run(
    fleet: Fleet, i: int, paper: Certified | None, document: Any | None, folder: Path | None
) -> tc.population.UnitRun | None:
    """None of a run without nine coefficients, or of an unknown unit."""
    row = fleet.rows[i]
    if fleet.unit[i] < 0:
        return None
    serial, time_s = fleet.serials[fleet.unit[i]], row["ended_us"] / 1e6
    at = datetime.fromtimestamp(time_s, UTC)
    places = {name: row[name] for name in FACTORS} | {"hour": at.hour + at.minute / 60}
    if document is not None:
        beside = _recorded(folder, row)
        try:
            return tc.interchange.unit_run_in(
                document, serial=serial, time_s=time_s, where=str(row["certificate"]),
                mounting=beside.mounting, resolution=beside.resolution, **places,
            )  # fmt: skip
        except tc.InvalidData:
            pass  # a certificate that states no such figures; the outcome may
    values = np.array([np.nan if row[name] is None else row[name] for name in COEFFICIENTS], dtype=float)
    errors = [row[f"{name}_standard_error"] for name in COEFFICIENTS]
    if not np.isfinite(values).all():
        return None
    return tc.population.UnitRun(
        serial, time_s, values, np.array([np.nan if e is None else e for e in errors], dtype=float),
        effects=_effects(paper), **places,
    )  # fmt: skip


def _effects(paper: Certified | None) -> dict[str, tc.population.SeenEffect]:
    if paper is None:
        return {}
    return {
        name: tc.population.SeenEffect(
            seen.probability,
            {of: (value, np.nan if error is None else error) for of, (value, error, _) in seen.coefficients.items()},
        )
        for name, seen in paper.effects.items()
    }


def _document(folder: Path | None, row: Row) -> dict[str, Any] | None:
    """The certificate of a run; None where there is none to be read."""
    if folder is None or row["certificate"] is None:
        return None
    path = folder / Path(row["certificate"]).name
    try:
        return dict(parse_document(td.files.read_whole(path, DOCUMENT_MOST), where=str(path)))
    except (OSError, td.files.TooLarge, InputError):
        return None


def _recorded(folder: Path | None, row: Row) -> Recorded:
    if folder is None or row["recording"] is None:
        return Recorded()
    return recorded_in(folder / Path(row["recording"]).name, row["slot"])


# Odds.


def learned(
    fleets: Sequence[Fleet], source: str, folder: Path | None, tell: Tell = lambda done, of: None
) -> tc.interchange.Document:
    """`triaxcal.odds/1` of the units of one part number, by the last certificate of
    each. Raises InputError for several part numbers, and without certificates."""
    if len(fleets) > 1:
        there = ", ".join(fleet.part_number or "none" for fleet in fleets)
        raise InputError(f"-o: odds are of one part number, and there are {there}; choose one by --part-number")
    units: dict[int, tc.population.SeenUnit] = {}
    for fleet in fleets:
        for i in range(len(fleet.rows) - 1, -1, -1):
            tell(len(fleet.rows) - 1 - i, len(fleet.rows))
            unit = int(fleet.unit[i])
            if unit < 0 or unit in units or fleet.certified[i] is None:
                continue
            document = _document(folder, fleet.rows[i])
            if document is not None:
                try:
                    units[unit] = tc.interchange.seen_unit_in(document, where=str(fleet.rows[i]["certificate"]))
                except tc.InvalidData:
                    continue
    if not units:
        raise InputError(f"-o: {source} has no certificates, from which odds are learned")
    return tc.interchange.odds_document(
        tc.population.learned_odds(list(units.values()), part_number=fleets[0].part_number)
    )
