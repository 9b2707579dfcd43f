"""What acts beyond the linear model, with which probability: one evidence for effects, outliers and what has no name.

`triaxcal.diagnosis` tells what follows from it; `benchmarks.frozen` holds it against what went before.
"""

from triaxcal.evidence.actions import Action, ActionKind
from triaxcal.evidence.advice import Advice, Expected, advice
from triaxcal.evidence.average import Average, Refusal, average, refusal
from triaxcal.evidence.findings import Another, Findings, Named, Unexplained, findings
from triaxcal.evidence.odds import Odds
from triaxcal.evidence.pooled import Pooled, pool
from triaxcal.evidence.posterior import Posterior, posterior_of

__all__ = [
    "Action",
    "ActionKind",
    "Advice",
    "Another",
    "Average",
    "Expected",
    "Findings",
    "Named",
    "Odds",
    "Pooled",
    "Posterior",
    "Refusal",
    "Unexplained",
    "advice",
    "average",
    "findings",
    "pool",
    "posterior_of",
    "refusal",
]  # fmt: skip
