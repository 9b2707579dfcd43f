"""Documents of many units: learned odds (`triaxcal.odds/1`), and what a loop document
says of its unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.catalogue import CATALOGUE
from triaxcal.errors import InvalidData
from triaxcal.evidence.prior import Odds
from triaxcal.interchange.calibration_document import Document
from triaxcal.model.directions import FULL, directions
from triaxcal.population.odds import LearnedEffect, LearnedOdds, SeenUnit, seen_effects
from triaxcal.population.runs import SeenEffect, SeenPoses, UnitRun
from triaxcal.rounding import uncertainty

if TYPE_CHECKING:
    from triaxcal import schema

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
    loop = _loop_in(document, where)
    prior = Odds().unmodelled_probability if loop.odds is None else loop.odds.unmodelled_probability
    effects = {} if loop.unexplained.significant else _effects_in(loop)
    return SeenUnit(effects, loop.unexplained.probability, prior)


def _loop_in(document: Mapping[str, Any], where: str) -> schema.Loop:
    from triaxcal import schema

    loop = schema.Loop.read(document.get("result", document))
    if loop is None:
        raise InvalidData(f"{where}: expected a loop document")
    return loop


def _effects_in(loop: schema.Loop) -> dict[str, SeenEffect]:
    """The effects of the catalogue and those that the document names. Those that the
    poses could not show are not known; a name that is not listed is unlikely."""
    stated: dict[str, float | None] = dict.fromkeys((e.name for e in CATALOGUE), 0.0)
    stated |= loop.probabilities
    stated |= {f.effect: f.probability for f in loop.findings}
    blind = [name for name in loop.calibration.blind_to if not stated.get(name)]
    stated = {name: p for name, p in stated.items() if name not in blind}
    # The possible names had the odds of any effect between them, but for learned ones.
    names = stated.keys() | {name for finding in loop.findings for name in finding.alternatives}
    odds = {name: Odds().of_effect(name, len(names)) for name in names}
    odds |= {} if loop.odds is None else {name: o for name, o in loop.odds.effects.items() if o is not None}
    return seen_effects(stated, [(f.effect, f.probabilities) for f in loop.findings if f.alternatives], odds)


NEAR = float(np.cos(np.radians(17.0)))
"""Cosine within which a pose is that of the plan: half of the 35° between two of
26."""
TEMPERATURE_C = 25.0
"""Temperature to which coefficients of different recordings are brought."""


def unit_run_in(
    document: Mapping[str, Any],
    *,
    serial: str,
    time_s: float,
    where: str,
    temperature_c: float = TEMPERATURE_C,
    mounting: Floats | None = None,
    resolution: float | None = None,
    **places: Any,
) -> UnitRun:
    """The run of a loop or certificate document, at one temperature for all. ``places``
    are those of `UnitRun` (batch, station, fixture, …, hour). ``mounting`` (3,3) turns
    directions along the unit's axes to those of the fixture. Planned directions are
    the nearest of the plan of 26. Raises InvalidData for another document."""
    loop = _loop_in(document, where)
    c = loop.calibration
    error = c.standard_error
    coefficients = np.array([*c.scale_factor, *c.misalignment, *c.bias])
    errors = np.array([*error.scale_factor, *error.misalignment, *error.bias], dtype=float)
    seen = {name: SeenEffect(e.probability, _coefficients_in(loop, name), e.prior_odds)
            for name, e in _effects_in(loop).items()}  # fmt: skip
    read_c = c.channel_reference.get(TEMPERATURE)
    figures = {} if read_c is None else {"temperature": (read_c, 0.0)}
    if read_c is not None:
        for k, axis in enumerate("xyz"):
            for name, scale, first in (("temperature_bias", 1.0, 6), ("temperature_scale_factor", coefficients[k], 0)):
                if name in c.effects and axis in seen[name].coefficients:
                    coefficients[first + k] += seen[name].coefficients[axis][0] * scale * (temperature_c - read_c)
    return UnitRun(
        serial, time_s, coefficients, errors, effects=seen, poses=_poses_in(c, mounting), resolution=resolution,
        figures=figures, **places,
    )  # fmt: skip


def _coefficients_in(loop: schema.Loop, name: str) -> dict[str, tuple[float, float]]:
    each = [(f.effect, f.coefficients) for f in loop.findings] + [(c.effect, c.coefficients) for c in loop.candidates]
    found = dict(reversed(each)).get(name, {})
    return {
        key: (one.value, np.nan if one.standard_error is None else one.standard_error)
        for key, one in found.items()
        if not isinstance(one, float) and one.value is not None
    }


def _poses_in(c: schema.Calibration, mounting: Floats | None) -> SeenPoses | None:
    """The poses that the fit used, if all have their figures."""
    used = [p for p in c.poses if p.used]
    residual = [p.residual_g if p.before_residual_g is None else p.before_residual_g for p in used]
    rows = [[*p.mean, r, p.standard_error_g, *p.direction] for p, r in zip(used, residual, strict=True)]
    if not rows or any(value is None for row in rows for value in row):
        return None
    table = np.array(rows, dtype=float)
    measured = table[:, 5:]
    plan = np.array([v for _, v in directions(FULL)], dtype=float)
    plan /= np.linalg.norm(plan, axis=1, keepdims=True)
    cosine = measured @ plan.T
    near = cosine.max(axis=1) > NEAR
    turn = np.eye(3) if mounting is None else np.asarray(mounting, dtype=float)
    known = bool(near.all())
    return SeenPoses(
        table[:, :3], table[:, 3], table[:, 4],
        measured @ turn.T if known else None,
        plan[cosine.argmax(axis=1)] @ turn.T if known else None,
        mounting,
    )  # fmt: skip
