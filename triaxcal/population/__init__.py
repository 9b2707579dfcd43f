"""What only many units show: effects of places and times, and the odds of effects for
the next unit of a type."""

from typing import TYPE_CHECKING

from triaxcal.lazy import lazily

if TYPE_CHECKING:
    from triaxcal.population.odds import LearnedEffect, LearnedOdds, SeenUnit, learned_odds
    from triaxcal.population.runs import PlaceKind, SeenEffect, SeenPoses, UnitRun
    from triaxcal.population.single_effects import Form, PlacePrior
    from triaxcal.population.statements import (
        Change,
        Pattern,
        Place,
        PlacedEffects,
        Statement,
        Verdict,
        placed_effects,
    )

_NAMES = {
    "odds": ("LearnedEffect", "LearnedOdds", "SeenUnit", "learned_odds"),
    "statements": ("Change", "Pattern", "Place", "PlacedEffects", "Statement", "Verdict", "placed_effects"),
    "runs": ("PlaceKind", "SeenEffect", "SeenPoses", "UnitRun"),
    "single_effects": ("Form", "PlacePrior"),
}

__all__ = [
    "Change",
    "Form",
    "LearnedEffect",
    "LearnedOdds",
    "Pattern",
    "Place",
    "PlaceKind",
    "PlacePrior",
    "PlacedEffects",
    "SeenEffect",
    "SeenPoses",
    "SeenUnit",
    "Statement",
    "UnitRun",
    "Verdict",
    "learned_odds",
    "placed_effects",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(__name__, _NAMES)
