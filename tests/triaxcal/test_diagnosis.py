"""The closed loop on the posterior: what is told, and what is handed on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.triaxcal.evidence.conftest import MINUS, SIGMA_G
from tests.undeclared.examine import Case, still_poses
from triaxcal.diagnosis import Loop, Recommendation, Verdict, diagnose
from triaxcal.estimate.calibration import Exclusion
from triaxcal.estimate.pose_fit import fit
from triaxcal.estimate.recordings import gather
from triaxcal.evidence import Refusal, posterior_of
from triaxcal.evidence.posterior import Why
from triaxcal.model.samples import Moment
from triaxcal.poses.pose import Pose

Poses = Callable[..., list[Pose]]
Knocked = Callable[[list[Pose], int, float], list[Pose]]


def closed(poses: list[Pose], **options: object) -> Loop:
    return diagnose(poses, signs=MINUS, **options)  # type: ignore[arg-type]


@pytest.mark.slow
def test_an_effect_that_is_certain_is_adopted_with_its_coefficients(poses_with: Poses) -> None:
    loop = closed(poses_with(3, temperature_bias=[5e-4, -4e-4, 6e-4]))
    (found,) = loop.findings
    assert (found.effect, found.verdict, dict(found.alternatives)) == ("temperature_bias", Verdict.ADOPTED, {})
    assert found.probability > 0.99
    for axis, true in zip("xyz", (5e-4, -4e-4, 6e-4), strict=True):
        value, error, unit = found.coefficients[axis]
        assert unit == "g/K"
        assert error is not None
        assert abs(value - true) < 4 * error < 0.2 * abs(true)
    assert "temperature" in found.remedy
    assert loop.after.terms == ("linear", "temperature_bias")
    assert loop.probabilities["temperature_bias"] == found.probability


@pytest.mark.slow
def test_one_of_several_is_told_with_the_probability_of_each(poses_with: Poses) -> None:
    """A drift, which on poses without slopes inside looks like a warm-up too."""
    loops = [closed(poses_with(seed, warm_up=[4e-4, 3e-4, -5e-4])) for seed in range(4)]
    groups = [f for loop in loops for f in loop.findings if f.alternatives]
    for group in groups:
        assert group.verdict is Verdict.CONFOUNDED
        assert group.probability + sum(group.alternatives.values()) >= 0.99
        assert group.probability >= max(group.alternatives.values())
    assert all(sum(loop.probabilities.values()) > 0.05 for loop in loops)


@pytest.mark.slow
def test_a_likely_name_is_a_candidate_with_what_it_would_be(poses_with: Poses) -> None:
    for seed in range(2):
        loop = closed(poses_with(seed, second_order_nonlinearity=[3e-4, -3e-4, 2.4e-4]))
        (candidate,) = loop.candidates
        assert candidate.effect == "second_order_nonlinearity"
        # Where no pose is expected to tell more, there is none to record.
        assert loop.call is (Recommendation.RECORD_MORE if loop.advice.actions else Recommendation.USABLE)
        probability = loop.probabilities[candidate.effect]
        assert loop.advice.expected["second_order_nonlinearity"].if_it_acts > probability
        assert 0.5 <= probability < 0.99
        assert candidate.probability is None  # such probabilities are not calibrated
        value, error, _ = candidate.coefficients["x"]
        assert error is not None
        assert abs(value - 3e-4) < 4 * error


@pytest.mark.slow
def test_where_nothing_acts_nothing_is_told(poses_with: Poses) -> None:
    for seed in range(3):
        loop = closed(poses_with(seed))
        assert loop.findings == loop.candidates == ()
        assert loop.after.terms == ("linear",)
        assert loop.refusal is None
        assert loop.call is Recommendation.USABLE
        assert loop.settled
        assert loop.advice.actions == ()


@pytest.mark.slow
def test_where_something_has_no_name_nothing_is_corrected() -> None:
    recording = Case("dead_zone", 1, (100.0, 200.0), 26, "white").make()
    loop = diagnose(still_poses(recording.samples()), signs=recording.signs)
    assert loop.refusal is Refusal.UNMODELLED
    assert loop.call is Recommendation.INVESTIGATE
    assert not loop.settled
    assert loop.found.unexplained.probability > 0.5
    assert loop.after.terms == ("linear",)
    assert all(f.verdict is Verdict.CONFOUNDED for f in loop.findings)


@pytest.mark.slow
def test_an_outlier_is_left_out_before_and_after(poses_with: Poses, knocked: Knocked) -> None:
    loop = closed(knocked(poses_with(2, temperature_bias=[5e-4, -4e-4, 6e-4]), 7, 2e-3))
    for calibration in (loop.before, loop.after):
        assert [i for i, p in enumerate(calibration.poses) if p.excluded] == [7]
        assert calibration.poses[7].excluded is Exclusion.OUTLIER
        assert (calibration.poses[7].outlier_probability or 0) > 0.99
    assert abs(loop.after.poses[7].residual_g) == pytest.approx(2e-3, rel=0.1)
    assert loop.after.residual.rms_g < 1.3 * SIGMA_G


@pytest.mark.slow
def test_poses_that_an_effect_explains_are_no_outliers(poses_with: Poses) -> None:
    loop = closed(poses_with(8, bias_step=[3e-3, -2e-3, 3e-3]))
    assert all(p.used for p in loop.before.poses)
    assert max(loop.posterior.outlier_probabilities) < 0.5


@pytest.mark.slow
def test_a_faulty_pose_has_no_part_and_stays_in_the_list(poses_with: Poses) -> None:
    poses = poses_with(3, hysteresis=[8e-4, -7e-4, 9e-4])
    poses[4] = replace(poses[4], fault="stuck_output", mean=poses[4].mean * 1.1)
    loop = closed(poses)
    assert loop.after.poses[4].excluded is Exclusion.FAULT
    assert loop.after.poses[4].outlier_probability is None
    assert len(loop.after.poses) == len(poses)
    assert [f.effect for f in loop.findings] == ["hysteresis"]


@pytest.mark.slow
def test_an_effect_of_time_holds_at_the_moment_asked_for(poses_with: Poses) -> None:
    poses = poses_with(3, bias_drift=[9e-7, -8e-7, 9e-7])
    for at in (Moment.END, Moment.MEAN, 30.0):
        loop = closed(poses, at=at)
        assert loop.after.holds_at == loop.before.holds_at
        assert loop.after.holds_at is not None
        assert at in (loop.after.holds_at.moment, loop.after.holds_at.t_s)


@pytest.mark.slow
def test_poses_of_another_recording_judge_before_and_after(poses_with: Poses) -> None:
    effects = {"second_order_nonlinearity": [5e-4, -4e-4, 5e-4]}
    loop = closed(poses_with(3, **effects), check=poses_with(99, **effects))
    assert loop.held_out is not None
    assert loop.held_out.after_rms_g < 0.3 * loop.held_out.before_rms_g


@pytest.mark.slow
def test_what_poses_cannot_show_is_told_with_the_reason(poses_with: Poses) -> None:
    still = [replace(p, channels={"temp_c": 25.0}) for p in poses_with(3)]
    loop = closed(still)
    assert loop.not_identifiable["temperature_bias"].why is Why.STOOD_STILL
    assert loop.not_identifiable["temperature_bias"].channel == "temp_c"
    bare = closed([replace(p, channels={}) for p in still])
    assert bare.not_identifiable["temperature_bias"].why is Why.NOT_LOGGED
    assert "second_order_nonlinearity" not in bare.not_identifiable
    assert loop.after.blind_to == tuple(loop.not_identifiable)


@pytest.mark.slow
@pytest.mark.parametrize("count", [10, 12])
def test_poses_with_hardly_anything_to_spare_correct_nothing_that_nobody_knows(poses_with: Poses, count: int) -> None:
    loop = closed(poses_with(6)[:count])
    assert loop.after.terms == ("linear",)
    assert loop.findings == ()


@pytest.mark.slow
def test_effects_of_several_runs_are_looked_for_once(poses_with: Poses) -> None:
    poses = gather([poses_with(1), poses_with(2)])
    terms = posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS).evidence.terms
    assert [t.name for t in closed(poses).posterior.evidence.terms] == [t.name for t in terms]
