"""What acts beyond the linear model, with which probability: one evidence for effects, outliers and what has no name.

`triaxcal.diagnosis` tells what follows from it; `benchmarks.frozen` holds it against what went before.
"""

from triaxcal.evidence.actions import Action, Do
from triaxcal.evidence.advice import Advice, Expected, advice
from triaxcal.evidence.average import Average, Refusal, average, refusal
from triaxcal.evidence.findings import Another, Findings, Named, Unexplained, findings
from triaxcal.evidence.odds import Odds
from triaxcal.evidence.posterior import Posterior, posterior
from triaxcal.evidence.together import Together, together

__all__ = [
    "Action", "Advice", "Another", "Average", "Do", "Expected", "Findings", "Named", "Odds", "Posterior", "Refusal",
    "Together", "Unexplained", "advice", "average", "findings", "posterior", "refusal", "together",
]  # fmt: skip
