"""Poses on demand: the decision by known covariances, and what is wanted meanwhile."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from benchmarks.truth import PAPER_UNIT
from triaxcal.effects import effect_named
from triaxcal.model.directions import Direction, directions
from triaxcal.model.sensor import Sensor
from triaxcal.planning import best_first, magnitude_error
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcald.station.config import Stop
from triaxcald.station.on_demand import CONFIRMING, LEFT_LEAST, Judge, OnDemand

STOP = Stop(uncertainty_g=3e-5)
JUDGE = Judge(STOP, (-1, -1, -1))
FEWEST = 9 + LEFT_LEAST


def sequence() -> np.ndarray:
    left, taken = directions(26), list[Direction]()
    while left:
        ups = np.array([v for _, v in taken]).reshape(-1, 3)
        taken.append(best_first(ups, left)[0])
        left = [d for d in left if d[0] != taken[-1][0]]
    return np.array([v for _, v in taken])


UPS = sequence()


def poses(count: int, noise_g: float = 1.5e-5, unit: Sensor = PAPER_UNIT, seed: int = 1) -> list[Pose]:
    return noisy_poses(unit, UPS[:count], noise_g, np.random.default_rng(seed))


@pytest.mark.parametrize("count", [10, 14])
@pytest.mark.parametrize("noise_g", [1e-5, 1e-4])
def test_the_prediction_follows_from_directions_and_noise_alone(count: int, noise_g: float) -> None:
    predicted_g = JUDGE.predicted_g(poses(count, noise_g))
    assert predicted_g == pytest.approx(noise_g * magnitude_error(UPS[:count]), rel=0.01)
    assert predicted_g == pytest.approx(JUDGE.predicted_g(poses(count, noise_g, seed=2)), rel=1e-3)


def test_nothing_is_predicted_of_too_few_poses() -> None:
    assert JUDGE.predicted_g(poses(8)) is None


def test_known_noise_decides() -> None:
    quiet, noisy = JUDGE(poses(14, 1.5e-5)), JUDGE(poses(14, 6e-5))
    assert quiet.enough
    assert quiet.settled
    assert quiet.uncertainty_g == pytest.approx(1.5e-5 * magnitude_error(UPS[:14]), rel=0.2)
    assert not noisy.enough
    assert noisy.uncertainty_g is not None
    assert noisy.uncertainty_g > STOP.uncertainty_g


def test_too_few_degrees_of_freedom_decide_nothing() -> None:
    """The uncertainty is low enough already, and nothing unexplained can show yet."""
    found = JUDGE(poses(FEWEST - 1, 2e-6))
    assert found.uncertainty_g is not None
    assert found.uncertainty_g < STOP.uncertainty_g
    assert not found.enough
    assert JUDGE(poses(FEWEST, 2e-6)).enough


def test_an_effect_that_is_open_keeps_the_acquisition_going() -> None:
    effect = effect_named("second_order_nonlinearity")
    unit = Sensor(
        PAPER_UNIT.scale_factor, PAPER_UNIT.misalignment, PAPER_UNIT.bias, ((effect, np.array([3e-4, -2e-4, 2e-4])),)
    )
    assert not JUDGE(poses(14, 1.5e-5, unit)).enough


def test_the_same_poses_have_the_same_judgement() -> None:
    assert JUDGE(poses(14)) == JUDGE(poses(14))


async def _judged(demand: OnDemand, count: int, noise_g: float = 1.5e-5) -> int:
    """Turns of the event loop while the poses are judged."""
    demand.begin(count, count, poses(count, noise_g))
    turns = 0
    while demand.deciding():
        turns += 1
        await asyncio.sleep(0)
    return turns


async def test_the_most_are_wanted_until_fewer_suffice_and_then_the_confirming_ones() -> None:
    told: list[tuple[int, bool]] = []
    demand = OnDemand(JUDGE, repeat=True, tell=lambda found, judgement: told.append((found, judgement.enough)))
    assert demand.wanted == 26
    assert await _judged(demand, FEWEST, 6e-5) == 0  # the noise alone is above it
    assert demand.wanted == 26
    assert await _judged(demand, FEWEST + 1) > 1  # on a thread: the loop goes on
    assert demand.wanted == FEWEST + 1 + CONFIRMING - 1
    assert not demand.is_due(demand.wanted, demand.wanted, complete=False)
    assert demand.is_due(demand.wanted, demand.wanted + 1, complete=True)
    assert told == [(FEWEST + 1, True)]


async def test_confirming_poses_that_show_something_unexplained_want_all_again() -> None:
    demand = OnDemand(JUDGE, repeat=False)
    await _judged(demand, FEWEST)
    assert demand.wanted == FEWEST + CONFIRMING
    scattered = poses(FEWEST + CONFIRMING)
    rng = np.random.default_rng(0)
    off = [
        Pose(p.start_s, p.end_s, p.samples, p.mean + 1e-2 * rng.standard_normal(3), p.covariance, p.dof)
        for p in scattered
    ]
    demand.begin(len(off), len(off), off)
    while demand.deciding():
        await asyncio.sleep(0)
    assert demand.wanted == 26


async def test_each_pose_is_judged_once_between_the_least_and_the_most() -> None:
    demand = OnDemand(Judge(Stop(uncertainty_g=3e-5, poses_least=13, poses_most=20), (-1, -1, -1)), repeat=True)
    assert [found for found in range(9, 22) if demand.is_due(found, found, complete=False)] == list(range(13, 20))
    await _judged(demand, 13, 6e-5)
    assert not demand.is_due(13, 13, complete=False)
    assert demand.is_due(13, 14, complete=False)
