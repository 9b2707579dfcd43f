"""What a budget rests on: what its user states, and how each component was
found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from triaxcal.errors import InvalidData
from triaxcal.model.gravity import local_gravity_g

# What the lines of a budget rest on, what would halve them, and what it leaves out:
# as values.


@dataclass(frozen=True)
class Basis:
    """How a component was found."""


@dataclass(frozen=True)
class WithinPoseScatter(Basis):
    """With its autocorrelation; the poses were held for ``duration_s`` in the
    median."""

    poses: int
    duration_s: float


@dataclass(frozen=True)
class Creep(Basis):
    """So many ``poses`` creep; rectangular over the change in each."""

    poses: int


@dataclass(frozen=True)
class BirgeFactor(Basis):
    """Residuals are ``ratio`` times what noise explains."""

    ratio: float


@dataclass(frozen=True)
class Excess(Basis):
    """Every pose has an ``excess`` standard deviation of |a|, in the reference,
    beside its noise."""

    excess: float


@dataclass(frozen=True)
class StatedReference(Basis):
    """The uncertainty of the reference; of normal gravity where there is a
    place. ``stated``, or that of gravity anomalies over the Earth."""

    latitude_deg: float | None = None
    height_m: float | None = None
    stated: bool = True


@dataclass(frozen=True)
class RegisterSteps(Basis):
    """Rectangular over the steps of so many ``registers``."""

    registers: int


@dataclass(frozen=True)
class NotHeld(Basis):
    """What holds the result lacks effects, whose place the other coefficients
    take."""


@dataclass(frozen=True)
class AveragedModels(Basis):
    """Over all that may act, each by its probability; ``names`` are those that
    are corrected and not certain."""

    names: tuple[str, ...]


@dataclass(frozen=True)
class NoParameter(Basis):
    """What probably acts on |a| and no parameter describes."""


@dataclass(frozen=True)
class UnmodelledTemperature(Basis):
    """The effects that the model lacks; the temperature moved by ``moved_k``
    from pose to pose. ``identifiable``: the poses can tell what that did.
    ``stated``: somebody said how sensitive such units are."""

    effects: tuple[str, ...]
    moved_k: float
    identifiable: bool
    stated: bool = False


@dataclass(frozen=True)
class ProbableTemperature(Basis):
    """The effects that the model lacks, each as probable and as large as the
    poses leave it; the temperature moved by ``moved_k`` from pose to pose."""

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
    """Of what changes from recording to recording, by the earlier calibration
    (``measured``) or assumed: all of the scale factors', and of the biases' as
    much as the poses leave open."""

    measured: bool


@dataclass(frozen=True)
class Remedy:
    """What would halve a component."""


@dataclass(frozen=True)
class LongerOrMorePoses(Remedy):
    """Hold each pose so long, or record so many."""

    hold_s: float
    poses: int


@dataclass(frozen=True)
class CreepHalved(Remedy):
    """Wait before each pose."""


@dataclass(frozen=True)
class CompleteModel(Remedy):
    """Find what the model lacks, and record more poses."""


@dataclass(frozen=True)
class FittedAnew(Remedy):
    """All parameters by a whole set of poses."""


@dataclass(frozen=True)
class ReferenceKnown(Remedy):
    """To the standard uncertainty ``to_g``, in the unit of the reference
    vector."""

    to_g: float


@dataclass(frozen=True)
class HostCorrects(Remedy):
    """Correct in the host what the registers cannot hold."""


@dataclass(frozen=True)
class FinerRegisters(Remedy):
    """By one bit."""


@dataclass(frozen=True)
class ModelsDistinguished(Remedy):
    """By the recordings that the findings ask for."""


@dataclass(frozen=True)
class TemperatureModelled(Remedy):
    """The residuals probably come from one of these ``effects``."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class PosesAtOtherTemperatures(Remedy):
    """Until these ``effects`` can be fitted."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class SteadierTemperature(Remedy):
    """Twice as steady; or one that swings until these ``effects`` can be
    fitted."""

    effects: tuple[str, ...]


@dataclass(frozen=True)
class TemperatureKnown(Remedy):
    """To the standard uncertainty ``to_k``."""

    to_k: float


@dataclass(frozen=True)
class NotEvaluated:
    """A source that nothing is known of."""


@dataclass(frozen=True)
class ReferenceTakenAsExact(NotEvaluated):
    """Its uncertainty was not stated."""


@dataclass(frozen=True)
class TemperatureNotLogged(NotEvaluated):
    """There is no such ``channel``."""

    channel: str


@dataclass(frozen=True)
class ThermometerNotStated(NotEvaluated):
    """Its uncertainty."""


@dataclass(frozen=True)
class SingleReading(NotEvaluated):
    """The lack of fit of a single reading, ``cross_validated_g``: the budget
    holds what that does to the parameters."""

    cross_validated_g: float


@dataclass(frozen=True)
class PosesWithoutScatter(NotEvaluated):
    """The noise of some poses is not known."""


# What no recording can tell, and somebody has to state.


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
