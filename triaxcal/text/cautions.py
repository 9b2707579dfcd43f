"""What speaks against a result."""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatch

import numpy as np

from triaxcal.estimate import calibration as of_fit
from triaxcal.frames import faces, orientations, standing, unit_frames
from triaxcal.inputs import attitude, bias_update, datasheet, rotation
from triaxcal.number_format import micro_g, number_of, plain
from triaxcal.poses.pose import moment, the_poses
from triaxcal.uncertainty.propagation import Extrapolated

RAISED = "the standard errors are raised by that"


@singledispatch
def caution(c: of_fit.Caution) -> str:
    """One line, without a full stop. Raises TypeError for a kind that has none."""
    raise TypeError(f"no sentence for {type(c).__name__}")


@caution.register
def _(c: of_fit.FaultyPosesExcluded) -> str:
    named = ", ".join(f"{the_poses([began])} ({fault})" for began, fault in c.faults)
    return f"excluded, because the outputs did not follow the acceleration: {named}"


@caution.register
def _(c: of_fit.UnknownHistoryExcluded) -> str:
    return f"excluded, because the pose before is not known: {_outliers(c.poses)}"


@caution.register
def _(c: of_fit.PosesExcludedByCaller) -> str:
    return f"excluded, as asked for: {_outliers(c.poses)}"


@caution.register
def _(c: of_fit.OutliersExcluded) -> str:
    said = f"excluded as outliers: {_outliers(c.poses)}"
    if c.doubtful:
        said += (
            "; by the noise inside the poses they are, by the other residuals all poses may repeat less well than "
            "their noise, and the standard errors allow for both"
        )
        said += f" ({excess(c.excess)})" if c.excess else ""
    return said


@caution.register
def _(c: of_fit.OutlierSetsTied) -> str:
    sets = " or ".join(" and ".join(map(moment, tied)) for tied in c.sets)
    return (
        f"some poses may be outliers ({sets}: the residuals do not tell these sets apart), or something else acts; "
        "none is excluded"
    )


@caution.register
def _(c: of_fit.PoorSpread) -> str:
    return (
        f"the poses are poorly spread: some combination of parameters is {c.dilution:.3g} times as uncertain as one "
        f"pose; add {', '.join(c.wanted)}"
    )


@caution.register
def _(c: of_fit.FewPoses) -> str:
    return f"{c.poses} poses for {c.parameters} parameters: the residual proves little"


@caution.register
def _(c: of_fit.HighLeverage) -> str:
    return f"{the_poses([c.began])} alone determines a parameter (leverage {c.leverage:.2f})"


@caution.register
def _(c: of_fit.ExcessVariance) -> str:
    return f"residuals show {excess(c.excess)}; the standard errors allow for it"


@caution.register
def _(c: of_fit.BirgeRatio) -> str:
    explained = "noise and the error of the attitudes explain" if c.attitudes else "the noise explains"
    return f"residuals are {c.ratio:.1f} times what {explained}; {RAISED}"


@caution.register
def _(_: of_fit.ResidualsTooSmall) -> str:
    return (
        "residuals are smaller than noise and creep inside the poses would make them: what moves the outputs inside a "
        "pose (a temperature, a stand that settles) moves the means less, so the standard errors are on the safe side"
    )


@caution.register
def _(c: Extrapolated) -> str:
    return (
        f"the calibration is to hold {c.beyond_s:.0f} s after the last pose: what effects of time make of the "
        f"readings there has a standard uncertainty of {micro_g(c.uncertainty_g)}"
    )


@caution.register
def _(c: attitude.AttitudesTied) -> str:
    return f"one attitude is wrong, and the data do not tell which; none is excluded: {' or '.join(map(_row, c.rows))}"


@caution.register
def _(c: attitude.AttitudeExcluded) -> str:
    up = ", ".join(f"{x:+.3f}" for x in c.up)
    return (
        f"excluded as wrong: {_row(c.row)}, whose attitude is {np.degrees(c.off_rad):.3g} degrees off; the readings "
        f"show up at ({up})"
    )


@caution.register
def _(c: attitude.AttitudesContradict) -> str:
    return (
        "the attitudes contradict each other by more than noise: their error is estimated at "
        f"{c.error_rad:.2g} rad by axis"
    )


@caution.register
def _(c: attitude.DeclaredErrorContradicted) -> str:
    return (
        f"the residuals contradict the declared error of the attitudes, {c.declared_rad:.2g} rad, and say "
        f"{c.error_rad:.2g} ± {c.uncertainty_rad:.1g} rad by axis; what was declared still weighs the readings, and "
        f"makes the standard errors up to {c.raised:.2g} times as large as --attitude-error {c.error_rad:.2g} would"
    )


@caution.register
def _(c: attitude.MagnitudeContradicts) -> str:
    return (
        f"attitudes disagree with |a|: under this fit the magnitude is off by {c.ratio:.1f} times its noise, most in "
        f"{_row(c.worst)}"
    )


@caution.register
def _(c: datasheet.DatasheetContradicted) -> str:
    return (
        f"datasheet and poses contradict each other (p {c.p:.1e}){_changed(c)}: the unit has changed, the datasheet's "
        f"standard errors are too small, or a pose was not still; the standard errors are raised by {c.raised:.1f}"
    )


def _changed(c: datasheet.DatasheetContradicted) -> str:
    moved = [f"{shift:+.1f} standard errors" for shift in c.shifts]
    part = "" if c.alone else "; a change of one value does not explain all of it"
    match c.parameters:
        case ():
            return ""
        case (only,):
            return f", most in {only}, which moved by {moved[0]}{part}"
        case names:
            each = " or ".join(f"{name} ({by})" for name, by in zip(names, moved, strict=True))
            return f", most in {each}, which these poses do not tell apart{part}"


@caution.register
def _(c: datasheet.StillOfDatasheet) -> str:
    return f"these poses say next to nothing of {', '.join(c.parameters)}: the values are still the datasheet's"


@caution.register
def _(c: bias_update.BiasMoved) -> str:
    times = plain(c.shift / c.expected, 2)
    return (
        f"the biases moved by {times} times what they do from recording to recording by the calibration "
        f"(probability {c.p:.1g})"
    )


@caution.register
def _(c: rotation.StretchesExcluded) -> str:
    stretches = "1 stretch" if c.stretches == 1 else f"{c.stretches} stretches"
    return f"excluded as outliers: {stretches} of the recording, {number_of(c.samples, 'sample')}"


@caution.register
def _(c: rotation.FewDirections) -> str:
    return (
        f"the directions are poorly spread (dilution {c.dilution:.3g}): turn the unit about more axes, so that every "
        "side is up at some time"
    )


@caution.register
def _(c: rotation.StretchesDiffer) -> str:
    return (
        f"stretches of the recording differ {c.ratio:.1f} times as much as white noise explains (coloured or filtered "
        "noise, drift, acceleration besides gravity, or an effect that the model lacks); the standard errors are "
        f"raised by up to {c.raised:.1f}, which does not cover a drift as long as the recording"
    )


@caution.register
def _(c: rotation.NoiseUnseen) -> str:
    return (
        f"{c.share:.0%} of the noise does not show from sample to sample (the unit turns fast for its sample rate, "
        "vibrates, or filters its output): how the axes share it is not known, and the standard errors contain that"
    )


@caution.register
def _(c: rotation.NoiseUnequal) -> str:
    return (
        f"the noise of one axis is {c.ratio:.1f} times that of another: this fit has no weights, still poses would "
        "give smaller errors"
    )


@caution.register
def _(_: rotation.CoarseSteps) -> str:
    return "the outputs are rounded to steps larger than their noise, which the standard errors do not contain"


@caution.register
def _(_: faces.AxesAssumed) -> str:
    return (
        "no labels were given: the sensor's axes are taken to lie near the faces' axes of the same name; a unit "
        "mounted turned by a quarter turn, or with another sign of a scale factor, would look the same"
    )


@caution.register
def _(_: faces.SeveralCubes) -> str:
    return (
        "the poses lie on the axes of more than one cube (faces and edges, say); taken is the one nearest to the "
        "sensor's own axes. Labels tell them apart"
    )


@caution.register
def _(c: unit_frames.UnitsDisagree) -> str:
    return (
        f"the units disagree on the fixture's faces by {c.ratio:.1f} times what noise and seating explain (p "
        f"{c.p:.1g}): not one fixture, or it changed, or a unit moved in it; {RAISED}"
    )


@caution.register
def _(c: unit_frames.FacesMissing) -> str:
    return (
        f"nothing stood with {', '.join(c.faces)} up: the least-squares frame is that of the other faces, and differs "
        "from that of all six by the errors of the faces"
    )


@caution.register
def _(c: unit_frames.FaceFarOff) -> str:
    return (
        f"a face is {c.angle_rad:.2g} rad off its axis: were these poses on the faces of one fixture, and the unit "
        "fixed in it?"
    )


@caution.register
def _(c: orientations.NotTurned) -> str:
    return (
        f"{_with_up(c.face, c.began.start_s)} differ less than half a turn makes them on the other faces: taken as not "
        "turned by that"
    )


@caution.register
def _(c: orientations.NotFlush) -> str:
    return (
        f"{_with_up(c.face, c.began.start_s)} differ by {c.angle_rad:.2g} rad, far more than on the other faces: did "
        "the fixture stand flush?"
    )


@caution.register
def _(c: standing.SeatingsDiffer) -> str:
    return (
        "the seatings of the fixture, or the table from place to place, differ by more than the noise: "
        f"{c.seating_rad:.2g} rad each, from {c.dof} degrees of freedom; the uncertainties contain that"
    )


@caution.register
def _(_: standing.NoSecondOrientation) -> str:
    return (
        "no face stood in two orientations: the tilt of the table enters the rotation in full, with the size that was "
        "given"
    )


@caution.register
def _(c: standing.SingleOrientation) -> str:
    whence = "as given" if c.given else "as on the other faces"
    return (
        f"with {', '.join(c.faces)} up the fixture stood one way only: the tilt of the table enters there, with a size "
        f"of {c.tilt_rad:.2g} rad {whence} and an unknown direction"
    )


@caution.register
def _(_: standing.OrientationsAlike) -> str:
    return (
        "the two orientations on each face differ by no more than noise: the table is level to that, or the fixture "
        "was not turned between them, and nothing shows which"
    )


@caution.register
def _(c: standing.TableTilts) -> str:
    return f"the table tilts by {c.tilt_rad:.2g} rad: were these poses on the faces of one fixture?"


def excess(value: float) -> str:
    """The excess standard deviation of every pose, in the reference."""
    return f"{micro_g(value)} beside the noise of each pose"


def _outliers(poses: Iterable[of_fit.ExcludedPose]) -> str:
    return ", ".join(f"{the_poses([p.began])} ({p.studentized:+.0f} standard errors)" for p in poses)


def _row(row: attitude.Row) -> str:
    return f"{row.name} ({the_poses([row.began])})"


def _with_up(face: str, first_s: float) -> str:
    return f"the poses with {face} up (the first at {first_s:.1f} s)"
