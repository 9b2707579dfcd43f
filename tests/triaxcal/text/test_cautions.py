"""The sentences of cautions: one for each kind, and all figures in it."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import triaxcal
from triaxcal.estimate.calibration import (
    BirgeRatio,
    Caution,
    ExcessVariance,
    ExcludedPose,
    FaultyPosesExcluded,
    FewPoses,
    HighLeverage,
    OutlierSetsTied,
    OutliersExcluded,
    PoorSpread,
    PosesExcludedByCaller,
    UnknownHistoryExcluded,
)
from triaxcal.frames.orientations import NotFlush
from triaxcal.frames.standing import SingleOrientation
from triaxcal.inputs.attitude import (
    AttitudeExcluded,
    AttitudesTied,
    DeclaredErrorContradicted,
    MagnitudeContradicts,
    Row,
)
from triaxcal.inputs.bias_update import BiasMoved
from triaxcal.inputs.datasheet import DatasheetContradicted, StillOfDatasheet
from triaxcal.inputs.rotation import StretchesDiffer
from triaxcal.poses.pose import PoseStart
from triaxcal.text import caution

FIRST, SECOND = PoseStart(10.0), PoseStart(70.04, recording=1)
SENTENCES: list[tuple[Caution, str]] = [
    (FewPoses(9, 9), "9 poses for 9 parameters: the residual proves little"),
    (
        FaultyPosesExcluded(((FIRST, "saturation"), (SECOND, "stuck_output"))),
        "excluded, because the outputs did not follow the acceleration: the pose at 10.0 s (saturation), the pose at "
        "70.0 s of recording 2 (stuck_output)",
    ),
    (
        UnknownHistoryExcluded((ExcludedPose(FIRST, -12.3),)),
        "excluded, because the pose before is not known: the pose at 10.0 s (-12 standard errors)",
    ),
    (
        PosesExcludedByCaller((ExcludedPose(FIRST, 2.0),)),
        "excluded, as asked for: the pose at 10.0 s (+2 standard errors)",
    ),
    (
        OutliersExcluded((ExcludedPose(SECOND, 50.2),), doubtful=False, excess=0.0),
        "excluded as outliers: the pose at 70.0 s of recording 2 (+50 standard errors)",
    ),
    (
        OutliersExcluded((ExcludedPose(FIRST, 8.0),), doubtful=True, excess=1.5e-5),
        "excluded as outliers: the pose at 10.0 s (+8 standard errors); by the noise inside the poses they are, by the "
        "other residuals all poses may repeat less well than their noise, and the standard errors allow for both "
        "(15.0 µg beside the noise of each pose)",
    ),
    (
        OutlierSetsTied(((FIRST, SECOND), (PoseStart(20.0),))),
        "some poses may be outliers (10.0 s and 70.0 s of recording 2 or 20.0 s: the residuals do not tell these sets "
        "apart), or something else acts; none is excluded",
    ),
    (
        PoorSpread(23.456, ("-Z", "+X+Y")),
        "the poses are poorly spread: some combination of parameters is 23.5 times as uncertain as one pose; add "
        "-Z, +X+Y",
    ),
    (HighLeverage(FIRST, 0.987), "the pose at 10.0 s alone determines a parameter (leverage 0.99)"),
    (
        ExcessVariance(2.5e-4),
        "residuals show 250 µg beside the noise of each pose; the standard errors allow for it",
    ),
    (
        BirgeRatio(1.84),
        "residuals are 1.8 times what the noise explains; the standard errors are raised by that",
    ),
    (
        BirgeRatio(1.84, attitudes=True),
        "residuals are 1.8 times what noise and the error of the attitudes explain; the standard errors are raised by "
        "that",
    ),
    (
        AttitudeExcluded(Row("line 4", FIRST), 0.0349, (0.0, -1.0, 0.01)),
        "excluded as wrong: line 4 (the pose at 10.0 s), whose attitude is 2 degrees off; the readings show up at "
        "(+0.000, -1.000, +0.010)",
    ),
    (
        AttitudesTied((Row("line 4", FIRST), Row("line 5", SECOND))),
        "one attitude is wrong, and the data do not tell which; none is excluded: line 4 (the pose at 10.0 s) or "
        "line 5 (the pose at 70.0 s of recording 2)",
    ),
    (
        DeclaredErrorContradicted(2e-5, 9.23e-4, 1.02e-4, 33.2),
        "the residuals contradict the declared error of the attitudes, 2e-05 rad, and say 0.00092 ± 0.0001 rad by "
        "axis; what was declared still weighs the readings, and makes the standard errors up to 33 times as large as "
        "--attitude-error 0.00092 would",
    ),
    (
        MagnitudeContradicts(4.44, Row("line 4", FIRST)),
        "attitudes disagree with |a|: under this fit the magnitude is off by 4.4 times its noise, most in line 4 (the "
        "pose at 10.0 s)",
    ),
    (
        DatasheetContradicted(1.2e-9, ("bias.y",), (20.04,), alone=True, raised=3.21),
        "datasheet and poses contradict each other (p 1.2e-09), most in bias.y, which moved by +20.0 standard errors: "
        "the unit has changed, the datasheet's standard errors are too small, or a pose was not still; the standard "
        "errors are raised by 3.2",
    ),
    (
        DatasheetContradicted(1.2e-9, ("bias.x", "scale_factor.x"), (20.04, 19.96), alone=False, raised=3.21),
        "datasheet and poses contradict each other (p 1.2e-09), most in bias.x (+20.0 standard errors) or "
        "scale_factor.x (+20.0 standard errors), which these poses do not tell apart; a change of one value does not "
        "explain all of it: the unit has changed, the datasheet's standard errors are too small, or a pose was not "
        "still; the standard errors are raised by 3.2",
    ),
    (
        StillOfDatasheet(("bias.x", "bias.y")),
        "these poses say next to nothing of bias.x, bias.y: the values are still the datasheet's",
    ),
    (
        StretchesDiffer(2.04, 3.96),
        "stretches of the recording differ 2.0 times as much as white noise explains (coloured or filtered noise, "
        "drift, acceleration besides gravity, or an effect that the model lacks); the standard errors are raised by "
        "up to 4.0, which does not cover a drift as long as the recording",
    ),
    (
        NotFlush("+Z", FIRST, 0.0123),
        "the poses with +Z up (the first at 10.0 s) differ by 0.012 rad, far more than on the other faces: did the "
        "fixture stand flush?",
    ),
    (
        SingleOrientation(("+Z",), 1.5e-3, given=False),
        "with +Z up the fixture stood one way only: the tilt of the table enters there, with a size of 0.0015 rad as "
        "on the other faces and an unknown direction",
    ),
    (
        BiasMoved(6e-3, 2e-3, 3e-7),
        "the biases moved by 3 times what they do from recording to recording by the calibration (probability 3e-07)",
    ),
]


@pytest.mark.parametrize(("value", "sentence"), SENTENCES, ids=lambda v: type(v).__name__)
def test_a_caution_is_said_with_its_figures(value: Caution, sentence: str) -> None:
    assert caution(value) == sentence


def test_every_kind_of_caution_has_a_sentence() -> None:
    for module in pkgutil.walk_packages(triaxcal.__path__, "triaxcal."):
        importlib.import_module(module.name)
    kinds = _below(Caution)
    assert len(kinds) > 30
    assert [kind for kind in kinds if caution.dispatch(kind) is caution.dispatch(Caution)] == []
    with pytest.raises(TypeError, match="no sentence for Caution"):
        caution(Caution())


def _below(kind: type[Caution]) -> list[type[Caution]]:
    return [below for one in kind.__subclasses__() for below in (one, *_below(one))]
