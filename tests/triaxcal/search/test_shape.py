"""Shapes between those tried: at the minimum of chi-square, with standard errors that are those of their scatter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.calibration import Calibration
from triaxcal.effects.bias_step import BiasStep
from triaxcal.effects.contract import Effect
from triaxcal.effects.part import Part
from triaxcal.effects.warm_up import WarmUp
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.search.candidates import Ground
from triaxcal.search.shape import refined
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start

MINUS = (-1, -1, -1)
HOLD_S = 10.0
Recorded = Callable[..., list[Pose]]
HEIGHT = np.array([8e-4, -6e-4, 7e-4])


def chi2(c: Calibration) -> float:
    return sum((p.residual_g / p.standard_error_g) ** 2 for p in c.poses)


def with_shape(poses: list[Pose], effect: Effect, truth: float) -> tuple[Effect, Calibration]:
    """The variant of the grid nearest to the truth, refined by whole fits, and the fit with it."""
    problem = problem_of(poses, signs=MINUS)
    start(problem, poses, MINUS)
    whole = effect.whole if isinstance(effect, Part) else effect

    def cost(effects: list[Effect]) -> float:
        return chi2(fit(poses, signs=MINUS, effects=effects, aside=()))

    grid = [effect.shaped({n: v for n, (v, _) in w.shape.items()}) for w in whole.variants(problem.conditions)]
    nearest = min(grid, key=lambda e: abs(next(iter(e.shape.values()))[0] - truth))
    (best,) = refined([nearest], problem, cost)  # type: ignore[arg-type]
    return best, fit(poses, signs=MINUS, effects=[best], aside=())


def test_a_time_constant_is_found_with_the_standard_error_that_is_its_scatter(
    paper_unit: Sensor, recorded: Recorded
) -> None:
    truth, runs = 65.0, 20
    pulls, steps = [], []
    for seed in range(runs):
        sensor = replace(paper_unit, effects=((WarmUp(truth), HEIGHT),))
        effect, c = with_shape(recorded(sensor, seed), WarmUp(), truth)
        value, error, unit = c.coefficients_of("warm_up")["time_constant"]
        assert unit == "s"
        assert error is not None
        assert value == effect.shape["time_constant"][0]
        pulls.append((value - truth) / (error / c.inflation))
        steps += ((c.values[9:12] - HEIGHT) / (c.standard_errors[9:12] / c.inflation)).tolist()
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], runs)
    assert low < np.sum(np.square(pulls)) < high
    # The heights are correlated with the time constant, whose error is in theirs.
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], runs)
    assert low < np.sum(np.square(steps)) / 3 < high
    assert abs(np.mean(pulls)) < 3.3 / np.sqrt(runs)


def test_the_minimum_is_no_higher_than_any_shape_near_it(paper_unit: Sensor, recorded: Recorded) -> None:
    poses = recorded(replace(paper_unit, effects=((WarmUp(65.0), HEIGHT),)), 0)
    best, c = with_shape(poses, WarmUp(), 65.0)
    tau = best.shape["time_constant"][0]
    for factor in (0.97, 1.03):
        other = fit(poses, signs=MINUS, effects=[WarmUp(tau * factor)], aside=())
        assert chi2(other) > chi2(c) - 0.1


def test_the_shape_of_a_part_is_refined_as_that_of_the_whole(paper_unit: Sensor, recorded: Recorded) -> None:
    sensor = replace(paper_unit, effects=((WarmUp(65.0), np.array([0.0, 1.5e-3, 0.0])),))
    best, c = with_shape(recorded(sensor, 1), Part.of(WarmUp(), "y"), 65.0)
    assert isinstance(best, Part)
    value, error, _ = c.coefficients_of("warm_up")["time_constant"]
    assert error is not None
    assert abs(value - 65.0) < 4 * error


@pytest.mark.parametrize("gap_s", [0.2, 1.0, 2.0, 5.0])
def test_a_step_between_two_poses_is_put_between_them_and_may_have_been_at_any_moment_there(
    gap_s: float, paper_unit: Sensor, recorded: Recorded
) -> None:
    """A rectangular distribution (JCGM 100, 4.3.7)."""
    # Poses are ten seconds each without a gap: 120 s is the end of the twelfth.
    size = np.array([1e-2, -2e-2, 3e-2])
    poses = apart(recorded(replace(paper_unit, effects=((BiasStep(120.0), size),)), 0), gap_s / 2)
    _, c = with_shape(poses, BiasStep(), 120.0)
    value, error, unit = c.coefficients_of("bias_step")["at"]
    assert poses[11].end_s <= value <= poses[12].start_s
    # A thousandth of a pose does not show.
    assert error == pytest.approx(gap_s / np.sqrt(12), abs=0.01)
    assert unit == "s"
    assert c.values[9:12] == pytest.approx(size, abs=8e-5)


@pytest.mark.parametrize("hold_s", [7.3, 9.7, 10.0])
def test_the_moment_of_a_step_on_one_axis_is_as_uncertain_without_gaps_whatever_the_clock(
    hold_s: float, paper_unit: Sensor, recorded: Recorded
) -> None:
    """The likelihood has kinks there, which no derivative tells: 0.25 of a pose by that."""
    poses = [
        replace(p, start_s=i * hold_s, end_s=(i + 1) * hold_s)
        for i, p in enumerate(recorded(replace(paper_unit, effects=((BiasStep(120.0), np.array([1e-4, 0, 0])),)), 0))
    ]
    c = fit(poses, signs=MINUS, effects=[Part.of(BiasStep(12 * hold_s), "x")], aside=())
    error = c.coefficients_of("bias_step")["at"][1]
    assert error is not None
    assert error / hold_s == pytest.approx(0.62, abs=0.03)


def test_a_late_step_between_two_poses_is_as_uncertain_as_an_early_one(paper_unit: Sensor, recorded: Recorded) -> None:
    """Hours into a recording a thousandth of the moment is longer than a gap."""
    late = 20000.0
    poses = [
        replace(p, start_s=p.start_s + late, end_s=p.end_s + late)
        for p in apart(recorded(replace(paper_unit, effects=((BiasStep(120.0), 4e-4 * np.ones(3)),)), 0))
    ]
    c = fit(poses, signs=MINUS, effects=[BiasStep(late + 120.0)], aside=())
    near = fit(apart(recorded(replace(paper_unit, effects=((BiasStep(120.0), 4e-4 * np.ones(3)),)), 0)),
               signs=MINUS, effects=[BiasStep(120.0)], aside=())  # fmt: skip
    assert c.standard_errors == pytest.approx(near.standard_errors, rel=1e-6)
    error, same = (f.coefficients_of("bias_step")["at"][1] for f in (c, near))
    assert error == pytest.approx(same, rel=1e-3)


def test_the_moment_of_a_step_anywhere_is_off_by_its_standard_error_in_the_rms(
    paper_unit: Sensor, recorded: Recorded, ground_of: Callable[[list[Pose]], Ground]
) -> None:
    """In gaps, at the edge of a pose and inside one, of sizes of which the direction of a pose hides some: the best
    place may be some poses away, and the standard error has to know."""
    runs, pulls, away = 80, [], 0
    for seed in range(runs):
        rng = np.random.default_rng([7, seed])
        truth, size = float(rng.uniform(50, 200)), rng.choice([-1, 1], 3) * rng.uniform(3e-5, 3e-4, 3)
        poses = apart(recorded(replace(paper_unit, effects=((BiasStep(truth), size),)), seed), each_s=1.5)
        ground = ground_of(poses)
        shown = {e: ground.shown(ground.columns(e))[0] for e in BiasStep().variants(ground.problem.conditions)}
        best = max(shown, key=lambda e: float(np.sum((shown[e].T @ ground.y) ** 2)))
        value, error, _ = fit(poses, signs=MINUS, effects=[best], aside=()).coefficients_of("bias_step")["at"]
        assert error is not None
        pulls.append((value - truth) / error)
        away += abs(value - truth) > HOLD_S
    assert away > 1
    # Of 1200 runs the mean square is 0.93; that of 80 scatters by 0.18.
    assert 0.93 - 3.3 * 0.18 < np.mean(np.square(pulls)) < 0.93 + 3.3 * 0.18


def apart(poses: list[Pose], each_s: float = 0.5) -> list[Pose]:
    """The same, each so much shorter at both ends."""
    return [replace(p, start_s=p.start_s + each_s, end_s=p.end_s - each_s) for p in poses]


def test_a_step_within_a_pose_is_timed_with_the_standard_error_that_is_its_scatter(
    paper_unit: Sensor, recorded: Recorded
) -> None:
    truth, runs = 123.5, 12
    pulls = []
    for seed in range(runs):
        sensor = replace(paper_unit, effects=((BiasStep(truth), np.array([6e-4, -7e-4, 8e-4])),))
        _, c = with_shape(recorded(sensor, seed), BiasStep(), truth)
        value, error, _ = c.coefficients_of("bias_step")["at"]
        assert error is not None
        assert 120 < value < 130
        pulls.append((value - truth) / (error / c.inflation))
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], runs)
    assert low < np.sum(np.square(pulls)) < high


def test_effects_without_a_shape_stay_as_they_are(paper_unit: Sensor, recorded: Recorded) -> None:
    problem = problem_of(recorded(paper_unit, 0), signs=MINUS)
    one = Part.of(WarmUp(), "x").whole
    assert refined([], problem, lambda effects: 0.0) == ()
    # A flat cost moves nothing.
    assert refined([one], problem, lambda effects: 1.0) == (one,)
