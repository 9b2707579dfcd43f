"""The lines of an uncertainty budget: what each rests on, what would halve it,
what is not in it."""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch

from triaxcal.number_format import micro_g
from triaxcal.text.cautions import excess
from triaxcal.uncertainty import statements as of

AS_STATED = "as stated"


@singledispatch
def basis(b: of.Basis) -> str:
    """How a component was found. Raises TypeError for a kind that has no words."""
    raise TypeError(f"no words for {type(b).__name__}")


@basis.register
def _(b: of.WithinPoseScatter) -> str:
    return f"scatter inside {b.poses} poses of {b.duration_s:.3g} s, with its autocorrelation"


@basis.register
def _(b: of.Creep) -> str:
    return f"{b.poses} poses creep; rectangular over the change in each"


@basis.register
def _(b: of.BirgeFactor) -> str:
    return f"residuals are {b.ratio:.2f} times what noise explains"


@basis.register
def _(b: of.Excess) -> str:
    return f"residuals show {excess(b.excess)}"


@basis.register
def _(b: of.StatedReference) -> str:
    if b.latitude_deg is None:
        return AS_STATED
    whose = AS_STATED if b.stated else "that of gravity anomalies over the Earth"
    return f"normal gravity at latitude {b.latitude_deg:g}°, height {b.height_m:g} m; its uncertainty {whose}"


@basis.register
def _(b: of.RegisterSteps) -> str:
    return f"steps of {b.registers} registers; rectangular"


@basis.register
def _(b: of.NotHeld) -> str:
    return "effects that the registers do not have: the other coefficients take their place, as nearly as they can"


@basis.register
def _(b: of.NoParameter) -> str:
    return "what acts in some direction and no parameter describes, as probable and as large as the poses leave it"


@basis.register
def _(b: of.AveragedModels) -> str:
    which = f"; {', '.join(b.names)} may act or not" if b.names else ""
    return f"the spread over all that may act, each by its probability{which}"


@basis.register
def _(b: of.UnmodelledTemperature) -> str:
    untold = "" if b.identifiable else ", but these poses cannot tell what that did"
    how = f", with a sensitivity {AS_STATED}" if b.stated else ""
    moved = f"the temperature moved by {b.moved_k:.2g} K from pose to pose"
    return f"{_both(b.effects)} not in the model{how}; {moved}{untold}"


@basis.register
def _(b: of.ProbableTemperature) -> str:
    return (
        f"{_both(b.effects)}, which are not in the model, by the probability and the size that the poses leave them; "
        f"the temperature moved by {b.moved_k:.2g} K from pose to pose"
    )


@basis.register
def _(b: of.ThermometerAt) -> str:
    return f"thermal effects, counted from {b.reference_c:.4g} °C"


@basis.register
def _(_: of.KeptParameters) -> str:
    return "scale factors, misalignments and effects are those of the earlier calibration, with its uncertainty"


@basis.register
def _(b: of.ChangedSince) -> str:
    known = "as measured between recordings of this unit" if b.measured else "assumed as usual for such units"
    return f"what changes from recording to recording, {known}: scale factors in full, biases as the poses leave it"


def remedy(r: of.Remedy, small: Callable[[float], str] = micro_g) -> str:
    """What would halve a component. ``small`` writes an error of the magnitude
    in the reference's unit."""
    match r:
        case of.LongerOrMorePoses(hold_s, poses) if hold_s <= 0:  # of poses of which only the means are known
            return f"record {poses} poses"
        case of.LongerOrMorePoses(hold_s, poses):
            return f"hold each pose for {hold_s:.2g} s, or record {poses} poses (against 1/f noise the latter)"
        case of.CreepHalved():
            return "wait before each pose until the outputs creep by half as much"
        case of.CompleteModel():
            return "find what the model lacks (diagnose, and what it advises); more poses, some of them repeated"
        case of.FittedAnew():
            return "record a whole set of poses (triaxcal plan) and fit all parameters anew"
        case of.ReferenceKnown(to_g):
            return f"know the reference to {small(to_g)}"
        case of.HostCorrects():
            return "correct in the host what the registers cannot hold"
        case of.FinerRegisters():
            return "registers with one bit more"
        case of.ModelsDistinguished():
            return "record what tells them apart, as advised"
        case of.TemperatureModelled(effects):
            return f"take into the model what the residuals come from: {_both(effects)}, or another effect"
        case of.PosesAtOtherTemperatures(effects):
            return (
                "record more poses, or the same ones again in another order, while the temperature differs, until "
                f"{_both(effects)} can be fitted"
            )
        case of.SteadierTemperature(effects):
            return f"hold the temperature twice as steady, or let it swing until {_both(effects)} can be fitted"
        case of.TemperatureKnown(to_k):
            return f"know the temperature to {to_k:.2g} K"
    raise TypeError(f"no words for {type(r).__name__}")


def not_evaluated(source: of.NotEvaluated, small: Callable[[float], str] = micro_g) -> str:
    """A source that the budget does not contain; ``small`` as in `remedy`."""
    match source:
        case of.ReferenceTakenAsExact():
            return "reference: taken as exact; state its uncertainty, or a latitude and height"
        case of.TemperatureNotLogged(channel):
            return f"temperature: there is no channel {channel}"
        case of.ThermometerNotStated():
            return "thermometer: its uncertainty was not stated"
        case of.SingleReading(cross_validated_g):
            return (
                f"lack of fit of a single reading: {small(cross_validated_g)} cross-validated, of which the budget "
                "contains only its effect on the parameters"
            )
        case of.PosesWithoutScatter():
            return "noise: some poses have no scatter inside to tell it from"
    raise TypeError(f"no words for {type(source).__name__}")


def _both(names: tuple[str, ...]) -> str:
    return " and ".join(names)
