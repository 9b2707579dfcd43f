"""The odds of effects for the next unit of a type (`triaxcal.odds/1`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from triaxcal.schema.model import Figure, Model, Text

Odds = Annotated[Figure, Field(gt=0, le=1)]
"""Odds against nothing: never none, and never more than even."""


class LearnedEffect(Model):
    odds: Annotated[Odds, Field(description="odds that it acts in the next unit, before any pose, up to 1")]
    units: Annotated[Figure | None, Field(ge=0, description="expected number of units so far that have it")] = None


class LearnedOdds(Model):
    """What `fleet` learns, and `run` and `diagnose` take."""

    format: Annotated[Literal["triaxcal.odds/1"], Field(description="format of this document")]
    part_number: Annotated[Text | None, Field(description="part number of the units; `null` holds for any")]
    units: Annotated[int, Field(ge=1, description="number of units that they are learned from")]
    effects: Annotated[
        dict[Text, LearnedEffect],
        Field(description="odds of [each effect](effects.md) by name; those of others are the catalogue's"),
    ]
    unmodelled_probability: Annotated[
        Figure, Field(gt=0, le=0.5, description="probability of something that no effect describes, before any pose")
    ]

    @classmethod
    def fault_in(cls, document: Mapping[str, Any]) -> str:
        """The key at fault and why; empty for a sound document."""
        try:
            cls.model_validate(document)
        except ValidationError as e:
            first = e.errors()[0]
            return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        return ""
