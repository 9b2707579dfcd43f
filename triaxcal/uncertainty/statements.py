"""The basis of a budget: stated values, and the evaluation of each component."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from triaxcal.errors import InvalidData
from triaxcal.model.gravity import local_gravity_g

# Basis and remedy of the lines of a budget, and sources that it omits, as values.


@dataclass(frozen=True)
class Basis:
    """The evaluation of a component."""


@dataclass(frozen=True)
class WithinPoseScatter(Basis):
    """Scatter with its autocorrelation; the median duration of the poses is
    ``duration_s``."""

    poses: int
    duration_s: float


@dataclass(frozen=True)
class Creep(Basis):
    """Number of creeping ``poses``; rectangular distribution over the change in
    each."""

    poses: int


@dataclass(frozen=True)
class BirgeFactor(Basis):
    """Residuals are ``ratio`` times what noise explains."""

    ratio: float


@dataclass(frozen=True)
class Excess(Basis):
    """Every pose has an ``excess`` standard deviation of |a| over its noise, in the
    reference."""

    excess: float


@dataclass(frozen=True)
class StatedReference(Basis):
    """The uncertainty of the reference; that of normal gravity where there is a
    place. ``stated``, or that of gravity anomalies over the Earth."""

    latitude_deg: float | None = None
    height_m: float | None = None
    stated: bool = True


@dataclass(frozen=True)
class RegisterSteps(Basis):
    """Rectangular distribution over the steps of so many ``registers``."""

    registers: int


@dataclass(frozen=True)
class NotHeld(Basis):
    """The device lacks effects, which its other coefficients replace."""


@dataclass(frozen=True)
class AveragedModels(Basis):
    """Average over all possible effects by their probabilities; ``names`` are those
    that are corrected and not certain."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class NoParameter(Basis):
    """A probable contribution to |a| without a parameter."""


@dataclass(frozen=True)
class UnmodelledTemperature(Basis):
    """The effects that the model lacks; the temperature changed by ``moved_k`` from
    pose to pose. ``identifiable``: the poses can determine the effects. ``stated``:
    the sensitivity of such units was stated."""

    effects: tuple[str, ...]
    moved_k: float
    identifiable: bool
    stated: bool = False


@dataclass(frozen=True)
class ProbableTemperature(Basis):
    """The effects that the model lacks, with their posterior probabilities and sizes;
    the temperature changed by ``moved_k`` from pose to pose."""

    effects: tuple[str, ...]
    moved_k: float


@dataclass(frozen=True)
class ThermometerAt(Basis):
    """The thermal effects count from ``reference_c``."""

    reference_c: float


@dataclass(frozen=True)
class KeptParameters(Basis):
    """Scale factors, angles and effects are those of an earlier calibration,
    with its uncertainty."""


@dataclass(frozen=True)
class ChangedSince(Basis):
    """Changes from recording to recording, by the earlier calibration (``measured``)
    or assumed: those of the scale factors in full, those of the biases as far as the
    poses leave them open."""

    measured: bool


@dataclass(frozen=True)
class Remedy:
    """A measure that would halve a component."""


@dataclass(frozen=True)
class LongerOrMorePoses(Remedy):
    """Poses of ``hold_s`` each, or so many ``poses``."""

    hold_s: float
    poses: int


@dataclass(frozen=True)
class CreepHalved(Remedy):
    """Wait before each pose."""


@dataclass(frozen=True)
class CompleteModel(Remedy):
    """Complete the model, and record more poses."""


@dataclass(frozen=True)
class FittedAnew(Remedy):
    """Fit all parameters to a whole set of poses."""


@dataclass(frozen=True)
class ReferenceKnown(Remedy):
    """Know the reference to the standard uncertainty ``to_g``, in the unit of the
    reference vector."""

    to_g: float


@dataclass(frozen=True)
class HostCorrects(Remedy):
    """Correct in the host what the registers cannot hold."""


@dataclass(frozen=True)
class FinerRegisters(Remedy):
    """Registers finer by one bit."""


@dataclass(frozen=True)
class ModelsDistinguished(Remedy):
    """The recordings that the findings ask for."""


@dataclass(frozen=True)
class TemperatureModelled(Remedy):
    """The residuals probably come from one of these ``effects``."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class PosesAtOtherTemperatures(Remedy):
    """Poses at other temperatures, until these ``effects`` can be fitted."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class SteadierTemperature(Remedy):
    """Twice as steady a temperature; or one that varies until these ``effects`` can
    be fitted."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class TemperatureKnown(Remedy):
    """Know the temperature to the standard uncertainty ``to_k``."""

    to_k: float


@dataclass(frozen=True)
class NotEvaluated:
    """A source without information."""


@dataclass(frozen=True)
class ReferenceTakenAsExact(NotEvaluated):
    """Its uncertainty was not stated."""


@dataclass(frozen=True)
class TemperatureNotLogged(NotEvaluated):
    """There is no such ``channel``."""

    channel: str


@dataclass(frozen=True)
class ThermometerNotStated(NotEvaluated):
    """The uncertainty of the thermometer was not stated."""


@dataclass(frozen=True)
class SingleReading(NotEvaluated):
    """The lack of fit of a single reading, ``cross_validated_g``: the budget contains
    its effect on the parameters."""

    cross_validated_g: float


@dataclass(frozen=True)
class PosesWithoutScatter(NotEvaluated):
    """The noise of some poses is not known."""


# Values that no recording can determine.


@dataclass(frozen=True)
class Stated:
    """Values that no recording can determine, as standard uncertainties; None where
    not stated.

    ``reference`` in the reference's unit, with its basis; ``thermometer_k``;
    ``rounding`` are the steps of the registers by parameter
    (`Calibration.parameters`), in its unit. ``not_held`` is the rms difference over
    the sphere between the device's correction and the whole one, in the reference's
    unit. ``thermal_sensitivity`` is the change per kelvin of the bias of such units,
    in references, and of their scale factors, relative.
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
        """Values for a reference that is gravity by `triaxcal.model.gravity`: a
        stated uncertainty, in g, takes precedence over that of the formula. Without a
        place, the stated values."""
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
