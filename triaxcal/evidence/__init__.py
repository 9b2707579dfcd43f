"""The posterior of all departures from the linear model: one evidence for effects,
outliers and unmodelled parts.

`triaxcal.diagnosis` draws the conclusions; `benchmarks.frozen` compares them with
those of earlier versions.
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
