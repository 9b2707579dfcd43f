"""What only many units show: distributions, control charts, capability, gauge studies
and drift; effects of places and times; the odds of effects for the next unit of a type.
From figures of units to values. No I/O, no clock."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triaxcal.lazy import lazily

if TYPE_CHECKING:
    from triaxcal.population.capability import (
        LEVEL,
        PPK_LEAST,
        Capability,
        capability_of,
        one_sided_interval,
        ppk_of,
        share_interval,
        two_sided_interval,
    )
    from triaxcal.population.control_charts import (
        Cusum,
        Ewma,
        Individuals,
        cusum,
        cusum_run_length,
        ewma,
        ewma_run_length,
        individuals,
        individuals_run_length,
        mean_of,
        one_sided_run_length,
    )
    from triaxcal.population.distributions import (
        GROUP_LEAST,
        QUANTILES,
        Distribution,
        Heterogeneity,
        distribution,
        heterogeneity,
        holm,
        normality_p,
    )
    from triaxcal.population.drift import (
        Drift,
        Movement,
        Moving,
        Part,
        RecalibrationInterval,
        change_after,
        drift_of,
        recalibration_interval,
    )
    from triaxcal.population.figures import LEAST_RUNS
    from triaxcal.population.gauge import (
        Component,
        GaugeStudy,
        Method,
        Source,
        gauge_study,
    )
    from triaxcal.population.hypotheses import Form, PlacePrior
    from triaxcal.population.odds import LearnedEffect, LearnedOdds, SeenUnit, learned_odds
    from triaxcal.population.runs import PlaceKind, SeenEffect, SeenPoses, UnitRun
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
    "capability": (
        "LEVEL",
        "PPK_LEAST",
        "Capability",
        "capability_of",
        "one_sided_interval",
        "ppk_of",
        "share_interval",
        "two_sided_interval",
    ),
    "control_charts": (
        "Cusum",
        "Ewma",
        "Individuals",
        "cusum",
        "cusum_run_length",
        "ewma",
        "ewma_run_length",
        "individuals",
        "individuals_run_length",
        "mean_of",
        "one_sided_run_length",
    ),
    "distributions": (
        "GROUP_LEAST",
        "QUANTILES",
        "Distribution",
        "Heterogeneity",
        "distribution",
        "heterogeneity",
        "holm",
        "normality_p",
    ),
    "drift": (
        "Drift",
        "Movement",
        "Moving",
        "Part",
        "RecalibrationInterval",
        "change_after",
        "drift_of",
        "recalibration_interval",
    ),
    "figures": ("LEAST_RUNS",),
    "gauge": (
        "Component",
        "GaugeStudy",
        "Method",
        "Source",
        "gauge_study",
    ),
    "odds": ("LearnedEffect", "LearnedOdds", "SeenUnit", "learned_odds"),
    "runs": ("PlaceKind", "SeenEffect", "SeenPoses", "UnitRun"),
    "hypotheses": ("Form", "PlacePrior"),
    "statements": ("Change", "Pattern", "Place", "PlacedEffects", "Statement", "Verdict", "placed_effects"),
}

__all__ = [
    "GROUP_LEAST",
    "LEAST_RUNS",
    "LEVEL",
    "PPK_LEAST",
    "QUANTILES",
    "Capability",
    "Change",
    "Component",
    "Cusum",
    "Distribution",
    "Drift",
    "Ewma",
    "Form",
    "GaugeStudy",
    "Heterogeneity",
    "Individuals",
    "LearnedEffect",
    "LearnedOdds",
    "Method",
    "Movement",
    "Moving",
    "Part",
    "Pattern",
    "Place",
    "PlaceKind",
    "PlacePrior",
    "PlacedEffects",
    "RecalibrationInterval",
    "SeenEffect",
    "SeenPoses",
    "SeenUnit",
    "Source",
    "Statement",
    "UnitRun",
    "Verdict",
    "capability_of",
    "change_after",
    "cusum",
    "cusum_run_length",
    "distribution",
    "drift_of",
    "ewma",
    "ewma_run_length",
    "gauge_study",
    "heterogeneity",
    "holm",
    "individuals",
    "individuals_run_length",
    "learned_odds",
    "mean_of",
    "normality_p",
    "one_sided_interval",
    "one_sided_run_length",
    "placed_effects",
    "ppk_of",
    "recalibration_interval",
    "share_interval",
    "two_sided_interval",
]

if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
