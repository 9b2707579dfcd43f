"""What a closed loop says in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.triaxcal.evidence.conftest import MINUS
from triaxcal.diagnosis import Candidate, Finding, Recommendation, Verdict, diagnose
from triaxcal.estimate.calibration import Residual
from triaxcal.estimate.hold_out import HoldOut
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.posterior import ChangePoint, Findings, Unexplained
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose, PoseStart
from triaxcal.text import diagnosis
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import NextRecording, Scopes, Source, next_recording
from triaxcal.units import ErrorUnit

SMALL = ErrorUnit.of("g", 1.0)
SCOPES = Scopes(12e-6, 40e-6, 4.1e-3)
NOTHING = Findings((), {}, {}, Unexplained(0.04, UnmodelledKind.TIME, 1e-5, False), None, 0.91)
KNOWN = Finding("hysteresis", Verdict.ADOPTED, 0.99995, {}, {}, "Let it rest.", 0.99995)
GROUP = Finding("warm_up", Verdict.CONFOUNDED, None, {"bias_drift": 0.275}, {}, "Let it warm up.", 0.995)
BEGAN = {4: PoseStart(132.0, None), 9: PoseStart(301.5, None)}


def cause(found: Findings, findings: tuple[Finding, ...] = (), candidates: tuple[Candidate, ...] = ()) -> str:
    likely = {"warm_up": 0.46, "bias_drift": 0.41, "hysteresis": 0.1, "remanence": 0.01}
    return diagnosis.cause(found, findings, candidates, BEGAN, SMALL, likely)


@pytest.mark.parametrize(
    ("p", "said"),
    [(0.9999, "more than 0.999"), (0.9961, "0.996"), (0.8449, "0.84"), (0.0512, "0.051"), (1e-7, "less than 0.001")],
)
def test_a_probability_is_told_as_exactly_as_it_is_known(p: float, said: str) -> None:
    assert diagnosis.chance(p) == said


def test_the_cause_is_told_with_its_probability() -> None:
    assert cause(NOTHING) == "no effect shows (nothing acts with probability 0.91)"
    assert cause(replace(NOTHING, nothing=0.02)).startswith(
        "something acts, and these poses do not tell what; the likeliest are warm_up (0.46), bias_drift (0.41), "
        "hysteresis (0.1); or something that no known effect describes ("
    )
    assert cause(NOTHING, (KNOWN,)) == "hysteresis (more than 0.999) acts"
    assert cause(NOTHING, (GROUP,)) == "one of warm_up (likeliest), bias_drift (0.28) acts"
    likely = Candidate("third_order_nonlinearity", None, {})
    assert "; third_order_nonlinearity probably acts" in cause(NOTHING, (KNOWN,), (likely,))
    hangs = Candidate("hysteresis", None, {}, hangs_on_one_pose=True)
    assert cause(NOTHING, (), (hangs,)).endswith("and a single pose decides it")


def test_what_has_no_name_is_told_with_its_size_and_what_it_goes_with() -> None:
    found = replace(NOTHING, unexplained=Unexplained(0.97, UnmodelledKind.POSE_BEFORE, 240e-6, True))
    said = "something acts that no known effect describes (probability 0.97), 240 µg rms; it goes with the pose before"
    assert cause(found) == said


def test_another_unit_is_told_with_the_pose_it_begins_at() -> None:
    said = cause(replace(NOTHING, change_point=ChangePoint(4, 0.998)))
    assert said.startswith("from the pose at 132.0 s on one calibration does not hold")
    assert "probability 0.998" in said


def test_outliers_are_told_each_with_its_moment() -> None:
    assert cause(replace(NOTHING, outliers={9: 0.98})) == "an outlier: the pose at 301.5 s (0.98)"


def test_a_reason_says_why_a_known_effect_is_not_corrected() -> None:
    assert diagnosis.reason(KNOWN, None) == "it acts with probability more than 0.999"
    refused = replace(KNOWN, verdict=Verdict.CONFOUNDED)
    assert diagnosis.reason(refused, Refusal.ONE_POSE).endswith("not adopted, because a single pose decides the result")
    assert "or else bias_drift (0.28): one of them with 0.995" in diagnosis.reason(GROUP, None)


def test_errors_say_what_is_assumed_of_the_next_recording() -> None:
    assumed = NextRecording(2.1e-3, 4.1e-3, 2e-3, Source.ASSUMED)
    before = Residual(601e-6, 9e-4, 812e-6, 20e-6, 1e-9, 28.1, 902.0)
    after = Residual(18e-6, 4e-5, 24e-6, 2e-5, 0.4, 0.83, 0.97)
    assert diagnosis.errors(before, after, None, SCOPES, assumed, SMALL) == (
        "cross-validated rms 812 µg before, 24.0 µg after; residuals in standard errors, rms, 28 before, 0.83 after; "
        "χ² per degree of freedom 902 before, 0.97 after; residual rms 601 µg before, 18.0 µg after; "
        "expanded uncertainty: this fit 12.0 µg, this session's poses 40.0 µg, another day 4100 µg "
        "(2000 µg from start to start, assumed)"
    )
    held = HoldOut(131e-6, 16.2e-6, 15e-6, 9)
    said = diagnosis.errors(before, after, held, SCOPES, assumed, SMALL)
    assert said.startswith("held-out rms 131 µg before, 16.2 µg after; ")


def test_an_error_that_nothing_corrects_is_told_once() -> None:
    one = Residual(601e-6, 9e-4, None, 20e-6, None)
    assumed = NextRecording(2.1e-3, 4.1e-3, 2e-3, Source.ASSUMED)
    said = diagnosis.errors(one, one, None, SCOPES, assumed, SMALL)
    assert said.startswith("residual rms 601 µg; expanded")


def test_an_average_over_what_may_act_is_no_absence_of_effects() -> None:
    said = diagnosis.cause(NOTHING, (), (), BEGAN, SMALL, {"warm_up": 0.3}, {"warm_up": 0.3})
    assert "no effect shows" not in said
    assert said.endswith("the correction averages over what may act, each by its probability: warm_up (0.3)")


@pytest.mark.parametrize("refused", Refusal)
def test_every_refusal_has_words(refused: Refusal) -> None:
    assert diagnosis.reason(replace(KNOWN, verdict=Verdict.CONFOUNDED), refused).count(";") == 1


@pytest.mark.parametrize("found", Recommendation)
def test_every_call_has_words(found: Recommendation) -> None:
    assert diagnosis.call(found)


def test_what_a_check_recording_contradicts_comes_first(
    poses_with: Callable[..., list[Pose]], with_effects: Callable[..., Sensor]
) -> None:
    poses, same = poses_with(1), poses_with(2)
    other = [replace(p, mean=p.mean + with_effects().scale_factor * 2e-2) for p in same]
    for check, contradicted in ((same, False), (other, True)):
        loop = diagnose(poses, signs=MINUS, check=check, catalogue=())
        assert diagnosis.lines(loop, SMALL)[0].startswith("the check recording contradicts") is contradicted


def test_poses_that_are_excluded_are_told_beside_the_residuals(
    poses_with: Callable[..., list[Pose]], knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    loop = diagnose(knocked(poses_with(4), 9, 1e-3), signs=MINUS, catalogue=())
    assert list(loop.found.outliers) == [9]
    assert "; 1 pose excluded from both, off by up to 9" in diagnosis.lines(loop, SMALL)[2]
    assert not diagnosis.excluded(diagnose(poses_with(4), signs=MINUS, catalogue=()), SMALL)


def test_each_uncertainty_is_of_more_than_the_one_before(poses_with: Callable[..., list[Pose]]) -> None:
    c = diagnose(poses_with(4), signs=MINUS, catalogue=()).after
    found = budget(c)
    told = list(Scopes.of(c, found, next_recording(c, found)).named.values())
    assert told[0] == float(found.magnitude.expanded)
    assert told == sorted(told)
