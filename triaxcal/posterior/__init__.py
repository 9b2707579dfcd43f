"""What acts beyond the linear model, with which probability: one evidence for effects, outliers and what has no name.

`triaxcal.loop` tells what follows from it; `benchmarks.frozen` holds it against what went before.
"""

from triaxcal.posterior.actions import Action, Do
from triaxcal.posterior.advice import Advice, Expected, advice
from triaxcal.posterior.average import Average, Refusal, average, refusal
from triaxcal.posterior.findings import Another, Findings, Named, Unexplained, findings
from triaxcal.posterior.odds import Odds
from triaxcal.posterior.posterior import Posterior, posterior
from triaxcal.posterior.together import Together, together

__all__ = [
    "Action", "Advice", "Another", "Average", "Do", "Expected", "Findings", "Named", "Odds", "Posterior", "Refusal",
    "Together", "Unexplained", "advice", "average", "findings", "posterior", "refusal", "together",
]  # fmt: skip
