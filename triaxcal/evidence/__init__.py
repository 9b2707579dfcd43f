"""What acts beyond the linear model, with which probability: one evidence for
effects, outliers and what has no name.

`triaxcal.diagnosis` tells what follows from it; `benchmarks.frozen` holds it
against what went before.
"""

from triaxcal.evidence.model_average import Average, Refusal, average, refusal
from triaxcal.evidence.next_measurement import Action, ActionKind, Advice, Expected, advice
from triaxcal.evidence.partial_residuals import POSE, Quantity, Trace, unit_of
from triaxcal.evidence.pooled import Pooled, pool
from triaxcal.evidence.posterior import ChangePoint, Findings, Named, Posterior, Unexplained, findings
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.search import posterior_of

__all__ = [
    "POSE",
    "Action",
    "ActionKind",
    "Advice",
    "Average",
    "ChangePoint",
    "Expected",
    "Findings",
    "Named",
    "Odds",
    "Pooled",
    "Posterior",
    "Quantity",
    "Refusal",
    "Trace",
    "Unexplained",
    "advice",
    "average",
    "findings",
    "pool",
    "posterior_of",
    "refusal",
    "unit_of",
]
