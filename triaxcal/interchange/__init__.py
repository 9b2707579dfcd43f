"""Values in the formats of other programs: JSON documents, written and read, and
samples as arrays or tables."""

from typing import TYPE_CHECKING

from triaxcal.interchange.calibration_document import (
    WEIGHT,
    Document,
    assumed_in,
    attitudes_document,
    budget_document,
    calibration_document,
    coefficients_document,
    datasheet_document,
    holds_of,
    poses_document,
    residual_document,
    turning_document,
)
from triaxcal.interchange.calibration_reading import (
    but_is,
    calibration_of,
    calibration_part,
    correlation_of,
    effect_errors_of,
    expanded_uncertainty_in,
    holds_at_of,
    linear_errors_of,
    logged_in,
    reference_unit_in,
    sensor_of,
)
from triaxcal.lazy import lazily

if TYPE_CHECKING:
    from triaxcal.interchange.pooled_documents import agreement_document, with_recordings
    from triaxcal.interchange.population_documents import odds_document, odds_of, seen_unit_in, unit_run_in

_NAMES = {
    "pooled_documents": ("agreement_document", "with_recordings"),
    "population_documents": ("odds_document", "odds_of", "seen_unit_in", "unit_run_in"),
}
"""They import the posterior, which most commands do not need."""

__all__ = [
    "WEIGHT",
    "Document",
    "agreement_document",
    "assumed_in",
    "attitudes_document",
    "budget_document",
    "but_is",
    "calibration_document",
    "calibration_of",
    "calibration_part",
    "coefficients_document",
    "correlation_of",
    "datasheet_document",
    "effect_errors_of",
    "expanded_uncertainty_in",
    "holds_at_of",
    "holds_of",
    "linear_errors_of",
    "logged_in",
    "odds_document",
    "odds_of",
    "poses_document",
    "reference_unit_in",
    "residual_document",
    "seen_unit_in",
    "sensor_of",
    "turning_document",
    "unit_run_in",
    "with_recordings",
]


if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
