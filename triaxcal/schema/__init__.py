"""One model for each document of the metrology: it checks what is written, reads
what was written, and yields the JSON Schema and the page of the reference.

The one room that imports pydantic. Nothing imports it until a document is
checked or read.
"""

from triaxcal.schema.calibration import Calibration
from triaxcal.schema.loop import (
    AnotherUnit,
    Candidate,
    Choice,
    Curve,
    Finding,
    HeldOut,
    Loop,
    OddsUsed,
    Rezero,
    Trace,
    Unexplained,
)
from triaxcal.schema.model import Figure, Model, Residual, Sha256, Text, Uncertainty, Word
from triaxcal.schema.odds import LearnedEffect, LearnedOdds
from triaxcal.schema.poses import Poses

__all__ = [
    "AnotherUnit",
    "Calibration",
    "Candidate",
    "Choice",
    "Curve",
    "Figure",
    "Finding",
    "HeldOut",
    "LearnedEffect",
    "LearnedOdds",
    "Loop",
    "Model",
    "OddsUsed",
    "Poses",
    "Residual",
    "Rezero",
    "Sha256",
    "Text",
    "Trace",
    "Uncertainty",
    "Unexplained",
    "Word",
]
