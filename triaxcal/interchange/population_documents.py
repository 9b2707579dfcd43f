"""Documents of many units: learned odds (`triaxcal.odds/1`), and what a loop document
says of its unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from triaxcal.effects.catalogue import CATALOGUE
from triaxcal.errors import InvalidData
from triaxcal.evidence.prior import Odds
from triaxcal.interchange.calibration_document import Document
from triaxcal.population.odds import LearnedEffect, LearnedOdds, SeenUnit, seen_effects
from triaxcal.rounding import uncertainty

FORMAT = "triaxcal.odds/1"


def odds_document(odds: LearnedOdds) -> Document:
    from triaxcal import schema  # pydantic, which nothing else here needs

    return schema.LearnedOdds(
        format="triaxcal.odds/1",
        part_number=odds.part_number,
        units=odds.units,
        effects={
            name: schema.LearnedEffect.model_validate(
                {"odds": uncertainty(learned.odds), "units": uncertainty(learned.units)}
            )
            for name, learned in odds.effects.items()
        },
        unmodelled_probability=float(uncertainty(odds.unmodelled_probability) or odds.unmodelled_probability),
    ).document()


def odds_of(document: Mapping[str, Any], *, where: str, part_number: str | None = None) -> LearnedOdds:
    """Raises InvalidData, which begins with ``where``, for another document, and for
    odds of another part number than the unit's."""
    from triaxcal import schema

    if document.get("format") != FORMAT:
        raise InvalidData(f"{where}: expected a document of format {FORMAT}, not {document.get('format')!r}")
    if fault := schema.LearnedOdds.fault_in(document):
        raise InvalidData(f"{where}: {fault}")
    found = schema.LearnedOdds.model_validate(document)
    if part_number is not None and found.part_number is not None and part_number != found.part_number:
        raise InvalidData(f"{where}: odds of part number {found.part_number}, and the unit has {part_number}")
    return LearnedOdds(
        found.part_number,
        found.units,
        {name: LearnedEffect(learned.odds, learned.units or 0.0) for name, learned in found.effects.items()},
        found.unmodelled_probability,
    )


def seen_unit_in(document: Mapping[str, Any], *, where: str) -> SeenUnit:
    """What a loop or certificate document says of its unit. Raises InvalidData for
    another document."""
    from triaxcal import schema

    part = document.get("result", document)
    loop = schema.Loop.read(part)
    if loop is None:
        raise InvalidData(f"{where}: expected a loop document")
    prior = Odds()
    odds = {} if loop.odds is None else {name: o for name, o in loop.odds.effects.items() if o is not None}
    unmodelled_prior = prior.unmodelled_probability if loop.odds is None else loop.odds.unmodelled_probability
    unmodelled = loop.unexplained.probability
    stated: dict[str, float | None] = dict.fromkeys((e.name for e in CATALOGUE), 0.0)
    stated |= dict.fromkeys(loop.calibration.blind_to or ())
    stated |= loop.probabilities
    stated |= {f.effect: f.probability for f in loop.findings}
    groups = [(f.effect, f.probabilities) for f in loop.findings if f.alternatives]
    effects = {} if loop.unexplained.significant else seen_effects(stated, groups, odds)
    return SeenUnit(effects, unmodelled, unmodelled_prior)
