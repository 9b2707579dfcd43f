"""What no recording can tell, and somebody has to state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from triaxcal.errors import InvalidData
from triaxcal.model.gravity import local_gravity_g
from triaxcal.uncertainty.budget_statements import StatedReference


@dataclass(frozen=True)
class Stated:
    """What no recording can tell, as standard uncertainties; None where nobody
    stated it.

    ``reference`` in the reference's unit, with what it rests on;
    ``thermometer_k``; ``rounding`` the steps of the registers that take the
    result, by parameter (`Calibration.parameters`), in its unit. ``not_held``
    is the rms over the sphere by which what holds the result is off the whole
    correction, in the reference's unit. ``thermal_sensitivity`` is by how much
    a kelvin changes the bias of such units, in references, and their scale
    factors, relatively.
    """

    reference: float | None = None
    reference_basis: StatedReference = field(default_factory=StatedReference)
    thermometer_k: float | None = None
    thermal_sensitivity: float | None = None
    rounding: Mapping[str, float] = field(default_factory=dict)
    not_held: float = 0.0

    @classmethod
    def at(
        cls,
        latitude_deg: float | None,
        height_m: float | None,
        reference: float | None = None,
        *,
        thermometer_k: float | None = None,
        thermal_sensitivity: float | None = None,
    ) -> Stated:
        """Where the reference is gravity by `triaxcal.model.gravity`: a stated
        uncertainty, in g, comes before that of the formula. Without a place,
        what is stated."""
        if latitude_deg is None or height_m is None:
            return cls(reference, thermometer_k=thermometer_k, thermal_sensitivity=thermal_sensitivity)
        basis = StatedReference(latitude_deg, height_m, stated=reference is not None)
        by_formula = local_gravity_g(latitude_deg, height_m)[1]
        return cls(by_formula if reference is None else reference, basis, thermometer_k, thermal_sensitivity)

    def __post_init__(self) -> None:
        for name, value in (("reference", self.reference), ("thermometer", self.thermometer_k)):
            if value is not None and not 0 <= value < np.inf:
                raise InvalidData(f"the uncertainty of the {name} must be a number of at least 0, not {value}")
        known = self.thermal_sensitivity
        if known is not None and not 0 <= known < np.inf:
            raise InvalidData(f"the thermal sensitivity must be a number of at least 0, not {known}")
