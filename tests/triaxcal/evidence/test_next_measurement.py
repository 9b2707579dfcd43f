"""What to do next, where the truth is known: the actions are taken, and the posterior asked again."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import FEW, MINUS, SIGMA_G
from tests.undeclared.examine import Case, still_poses
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, SINCE_START, TIME
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Action, ActionKind, Advice, Posterior, advice, posterior_of
from triaxcal.evidence.next_measurement import LEAST
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

pytestmark = pytest.mark.slow

Poses = Callable[..., list[Pose]]
TRUTHS: list[tuple[int, str, list[float]]] = [
    (26, "second_order_nonlinearity", [6e-4, -4e-4, 5e-4]),  # as `scale_factor_asymmetry` on the cube's directions
    (14, "bias_drift", [2e-6, -1.5e-6, 1e-6]),  # as `warm_up`
    (14, "hysteresis", [8e-5, -6e-5, 7e-5]),  # as whatever moves the bias from pose to pose
]
SEEDS = range(3)
HOLD_S = 10.0


def seen_in(poses: list[Pose]) -> Posterior:
    return posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS, catalogue=FEW)


def gone_on(unit: Sensor, poses: list[Pose], last: np.ndarray, actions: Sequence[Action], seed: int) -> list[Pose]:
    """The poses, and those of the actions, of a unit whose ``last`` direction is known."""
    rng, out = np.random.default_rng(seed), list(poses)
    for action in actions:
        if action.up is None:
            continue
        start_s = out[-1].end_s + action.pause_s
        temp_c = out[-1].channels["temp_c"] + (action.by if action.channel == "temp_c" else 0.0)
        s, before = unit.axes @ action.up, unit.axes @ last
        held = {TIME: start_s + HOLD_S / 2, SINCE_START: start_s + HOLD_S / 2, DURATION: HOLD_S, "temp_c": temp_c - 25}
        held |= dict(zip((*BEFORE, *CHANGE), (*before, *(s - before)), strict=True))
        error = SIGMA_G * np.abs(unit.scale_factor)
        mean = unit.output(action.up[None], {name: np.array([v]) for name, v in held.items()})[0]
        mean = mean + rng.standard_normal(3) * error
        end_s, channels = start_s + HOLD_S, {"temp_c": temp_c}
        out.append(replace(out[-1], start_s=start_s, end_s=end_s, mean=mean, channels=channels, before=out[-1].mean))
        last = action.up
    return out


def in_directions_at_random(count: int, seed: int) -> list[Action]:
    up = np.random.default_rng(seed).standard_normal((count, 3))
    return [Action(ActionKind.POSE, v / np.linalg.norm(v)) for v in up]


@dataclass(frozen=True)
class Followed:
    """The probability of the truth before, as it was expected to become, after the actions and after as many poses at
    random."""

    made: Advice
    before: float
    expected: float
    after: float
    at_random: float


def taken(unit: Sensor, count: int, seed: int) -> tuple[list[Pose], np.ndarray]:
    """A plan of so many poses, the first repeated at the end, and the direction of the last."""
    ups = np.array([v for _, v in directions(count)])
    ups = np.concatenate([ups, ups[:1]])
    warm = {"temp_c": 25 + 2 * np.sin(np.arange(len(ups)) / 3 + seed)}
    rng, reference = np.random.default_rng(seed), {"temp_c": 25.0}
    return noisy_poses(unit, ups, SIGMA_G, rng, channels=warm, channel_reference=reference), ups[-1]


@pytest.fixture(scope="module")
def followed(with_effects: Callable[..., Sensor]) -> list[Followed]:
    """Of units whose effect is confounded with another, in plans of 14 and of 26 poses."""
    out = []
    for count, name, coefficients in TRUTHS:
        unit = with_effects(**{name: coefficients})
        for seed in SEEDS:
            poses, last = taken(unit, count, seed)
            posterior = seen_in(poses)
            made = advice(posterior)
            count_made = sum(action.up is not None for action in made.actions)
            if name not in made.expected or not count_made:
                continue
            ways = made.actions, in_directions_at_random(count_made, seed + 70)
            after, at_random = (
                seen_in(gone_on(unit, poses, last, way, seed + 5)).effect_probabilities.get(name, 1e-4) for way in ways
            )
            out.append(
                Followed(made, posterior.effect_probabilities[name], made.expected[name].if_it_acts, after, at_random)
            )
    assert len(out) >= 2 * len(SEEDS)
    return out


def test_the_truth_becomes_likelier_than_by_poses_at_random(followed: list[Followed]) -> None:
    after, at_random, before = (
        np.log(np.maximum([getattr(f, which) for f in followed], 1e-4)) for which in ("after", "at_random", "before")
    )
    assert np.mean(after - before) > 0.6
    assert np.mean(after - at_random) > 0.2


def test_the_truth_becomes_as_likely_as_was_expected(followed: list[Followed]) -> None:
    expected, after = (np.array([getattr(f, which) for f in followed]) for which in ("expected", "after"))
    assert np.mean(after) == pytest.approx(np.mean(expected), abs=0.15)
    assert np.corrcoef(expected, after)[0, 1] > 0.0


def test_each_action_is_worth_its_price_and_their_information_is_the_entropy_that_goes(
    followed: list[Followed],
) -> None:
    for made in (f.made for f in followed):
        poses = [action for action in made.actions if action.up is not None]
        assert all(action.information >= LEAST * action.cost for action in poses)
        gone = sum(action.information for action in poses)
        assert made.entropy - made.entropy_after == pytest.approx(gone)
        assert len(poses) <= 3
        for expected in made.expected.values():
            assert expected.if_it_acts > expected.now - 0.02


def test_a_unit_is_turned_from_each_pose_to_the_next(followed: list[Followed]) -> None:
    for made in (f.made for f in followed):
        ups = [action.up for action in made.actions if action.up is not None]
        assert all(one @ other < 0.99 for one, other in itertools.pairwise(ups))


def test_functions_that_agree_on_the_cube_are_told_apart_in_directions_between(followed: list[Followed]) -> None:
    for made in (f.made for f in followed[: len(SEEDS)]):
        assert made.actions[0].kind is ActionKind.POSE
        assert "2" in made.actions[0].label


@pytest.mark.parametrize("effects", [{}, {"temperature_bias": [5e-4, -4e-4, 6e-4]}], ids=["nothing", "a name"])
def test_where_all_is_decided_nothing_is_to_be_done(poses_with: Poses, effects: dict[str, list[float]]) -> None:
    assert advice(seen_in(poses_with(11, **effects))).actions == ()


@pytest.mark.parametrize(("seed", "by_g"), [(1, 4e-4), (2, 1.5e-4)])
def test_a_pose_that_may_be_an_outlier_is_taken_again_and_then_is_one(
    paper_unit: Sensor, knocked: Callable[[list[Pose], int, float], list[Pose]], seed: int, by_g: float
) -> None:
    """Among 14 a knock may be a function of direction, too."""
    poses, last = taken(paper_unit, 14, seed)
    poses = knocked(poses, 5, by_g)
    posterior = seen_in(poses)
    assert 0.1 < posterior.outlier_probabilities[5] < 0.99
    made = advice(posterior)
    assert (made.actions[0].kind, made.actions[0].repeat_of, made.actions[0].label) == (ActionKind.REPEAT, 5, "+X+Y+Z")
    after = seen_in(gone_on(paper_unit, poses, last, made.actions, seed))
    assert after.outlier_probabilities[5] > posterior.outlier_probabilities[5]
    # Counted among all that were given.
    faulty = [replace(poses[0], fault="saturation"), *poses]
    assert advice(seen_in(faulty)).actions[0].repeat_of == 6


def test_a_pose_on_which_a_certain_name_hangs_is_taken_again(
    monkeypatch: pytest.MonkeyPatch, poses_with: Poses
) -> None:
    posterior = seen_in(poses_with(11, temperature_bias=[5e-4, -4e-4, 6e-4]))
    without = np.full(30, 0.999)
    without[4] = 0.5
    monkeypatch.setattr(type(posterior), "leave_one_out", lambda self, name: without)
    made = advice(posterior)
    assert [(action.kind, action.repeat_of) for action in made.actions] == [(ActionKind.REPEAT, 4)]


def swinging(poses: list[Pose], unit: Sensor) -> list[Pose]:
    """With a bias that swings twice in the recording."""
    way = np.array([6e-4, -4e-4, 5e-4])
    return [replace(p, mean=p.mean + unit.scale_factor * np.sin(2 * np.pi * p.t_s / 140) * way) for p in poses]


def test_what_goes_with_time_goes_with_something_to_be_logged(poses_with: Poses, paper_unit: Sensor) -> None:
    poses = swinging(poses_with(3), paper_unit)
    for logged, channel in ((True, ""), (False, "temp_c")):
        posterior = seen_in([replace(p, channels=p.channels if logged else {}) for p in poses])
        first = advice(posterior).actions[0]
        assert (first.kind, first.channel) == (ActionKind.LOG, channel)


def test_poses_with_an_error_of_their_own_are_held_longer(poses_with: Poses) -> None:
    off_g = 20 * SIGMA_G * np.random.default_rng(6).standard_normal(30)
    poses = [replace(p, mean=p.mean * (1 + d)) for p, d in zip(poses_with(6), off_g, strict=True)]
    first = advice(seen_in(poses)).actions[0]
    assert (first.kind, first.hold_s) == (ActionKind.HOLD, 4 * HOLD_S)


def test_a_temperature_that_went_with_time_is_moved_or_time_goes_without_it(
    poses_with: Poses, paper_unit: Sensor
) -> None:
    poses = [replace(p, channels={"temp_c": 20 + p.t_s / 60}) for p in poses_with(4)]
    drift = np.array([4e-7, -3e-7, 5e-7])
    moved_along = [replace(p, mean=p.mean + paper_unit.scale_factor * drift * p.t_s) for p in poses]
    made = advice(posterior_of(moved_along, fit(moved_along, signs=MINUS), signs=MINUS, catalogue=FEW))
    moved = [action for action in made.actions if action.kind is ActionKind.CHANNEL]
    paused = [action for action in made.actions if action.kind is ActionKind.PAUSE]
    assert moved or paused
    for action in moved:
        assert action.channel == "temp_c"
        assert abs(action.by) == pytest.approx(np.ptp([p.channels["temp_c"] for p in poses]))
    for action in paused:
        assert action.pause_s == pytest.approx(poses[-1].end_s)
    assert made.expected["temperature_bias"].if_it_acts > 0.8 > 0.5 > made.expected["temperature_bias"].now


def test_no_more_poses_are_advised_than_were_asked_for(poses_with: Poses) -> None:
    posterior = seen_in(poses_with(4, warm_up=[4e-4, 3e-4, -5e-4])[:16])
    assert len(advice(posterior, most=1).actions) == 1
    assert len(advice(posterior, most=6).actions) > 3


def test_poses_are_advised_where_nobody_knows_when_they_were_taken(with_effects: Callable[..., Sensor]) -> None:
    poses, _ = taken(with_effects(second_order_nonlinearity=[6e-4, -4e-4, 5e-4]), 26, 0)
    made = advice(seen_in([replace(p, start_s=0.0, end_s=0.0, channels={}) for p in poses]))
    assert made.actions
    assert {action.kind for action in made.actions} <= {ActionKind.POSE, ActionKind.REPEAT}


def test_slopes_inside_the_poses_count_in_what_is_to_come() -> None:
    recording = Case("warm_up", 1, (5.0, 10.0), 14, "white").make()
    poses = still_poses(recording.samples())
    posterior = posterior_of(poses, fit(poses, signs=recording.signs), signs=recording.signs)
    assert posterior.evidence.rows.slopes
    made = advice(posterior)
    assert made.entropy_after < made.entropy - 3 * LEAST
    assert made.expected["warm_up"].if_it_acts > 1.5 * made.expected["warm_up"].now
