"""What the operator is told follows from the poses so far and from nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import directions, elsewhere
from triaxcal.planning import magnitude_error
from triaxcal.poses.pose import Pose
from triaxcald.station.faces import described
from triaxcald.station.guidance import Guide, guide

PLAN = directions(14)
UP = [v for _, v in PLAN]
LABELS = [label for label, _ in PLAN]


def _pose(up: Any, start_s: float = 0.0, seconds: float = 4.0, scale: Any = (1.0, 1.0, 1.0)) -> Pose:
    mean = np.asarray(up) * np.asarray(scale)
    return Pose(start_s, start_s + seconds, 400, mean, np.eye(3) * 1e-10, 30.0)


def _guide(poses: Sequence[Pose], now_s: float = 1000.0, **more: Any) -> Guide:
    settings = {"wanted": 14, "hold_s": 3.0, "apart_deg": 10.0, "nominal_scale_factor": (1, 1, 1), **more}
    return guide(poses, now_s=now_s, **settings)


def test_at_first_the_first_pose_of_the_plan_is_next() -> None:
    state = _guide([], now_s=0.0)
    assert (state.found, state.wanted, state.held_s, state.complete) == (0, 14, 0.0, False)
    assert state.text == "next: +X up"
    assert list(state.missing) == LABELS


def test_a_direction_that_only_a_number_names_is_told_by_the_axes_near_it() -> None:
    label, up = directions(20)[0]
    assert label.startswith("N")
    assert _guide([], wanted=20).text == f"next: {label} ({described(up)})"


def test_a_pose_that_is_there_is_not_asked_for_again() -> None:
    state = _guide([_pose(UP[0])])
    assert state.found == 1
    assert state.text == f"next: {LABELS[1]} up"
    assert list(state.missing) == LABELS[1:]


def test_a_pose_is_told_to_be_held_until_it_is_long_enough() -> None:
    state = _guide([_pose(UP[0], seconds=1.25)], now_s=1.4)
    assert state.found == 0
    assert state.held_s == 1.25
    assert state.text.startswith("hold still, 1.2 of 3.0 s")


def test_a_short_pose_that_is_over_does_not_count() -> None:
    state = _guide([_pose(UP[0], seconds=1.25)], now_s=5.0)
    assert (state.found, state.held_s) == (0, 0.0)
    assert state.text == f"next: {LABELS[0]} up"


def test_poses_near_to_each_other_count_once() -> None:
    near = UP[0] + np.array([0, np.sin(np.radians(6)), 0])
    apart = UP[0] + np.array([0, np.tan(np.radians(14)), 0])
    assert _guide([_pose(UP[0]), _pose(near, 5)]).found == 1
    assert _guide([_pose(UP[0]), _pose(apart, 5)]).found == 2
    assert _guide([_pose(UP[0]), _pose(apart, 5)], apart_deg=20.0).found == 1


def test_the_signs_of_the_scale_factor_turn_the_unit_round() -> None:
    """With negative scale factors a negative output means up."""
    state = _guide([_pose(UP[0], scale=(-2.4, -2.4, -2.4))], nominal_scale_factor=(-2.4, -2.4, -2.4))
    assert LABELS[0] not in state.missing
    assert "-X" in state.missing
    mixed = _guide([_pose(UP[0], scale=(-2.4, 2.4, 2.4))], nominal_scale_factor=(-2.4, 2.4, 2.4))
    assert mixed.missing == state.missing


def test_enough_distinct_poses_are_done_and_more_do_not_count() -> None:
    state = _guide([_pose(u, 5.0 * i) for i, u in enumerate(UP)])
    assert (state.found, state.text, state.complete) == (14, "done", True)
    more = _guide([_pose(u, 5.0 * i) for i, (_, u) in enumerate(directions(26))])
    assert (more.found, more.complete) == (14, True)


def test_the_first_pose_is_wanted_again_when_all_others_are_there_and_not_before() -> None:
    taken = [_pose(u, 5.0 * i) for i, u in enumerate(UP)]
    almost = _guide([*taken[:13], _pose(UP[0], 100.0)], repeat=True)
    assert (almost.found, almost.repeat_due, almost.missing) == (13, False, (LABELS[13],))
    due = _guide(taken, repeat=True)
    assert (due.found, due.repeat_due, due.complete) == (14, True, False)
    assert due.text == f"next: {LABELS[0]} up once more: the first pose again shows drift"
    near = UP[0] + np.array([0, np.sin(np.radians(6)), 0])
    done = _guide([*taken, _pose(near, 100.0)], repeat=True)
    assert (done.repeat_due, done.complete, done.text) == (False, True, "done")
    assert _guide([*taken, _pose(UP[1], 100.0)], repeat=True).repeat_due
    assert _guide([*taken, _pose(UP[0], 100.0, seconds=1.0)], repeat=True).repeat_due


def test_the_pose_to_repeat_is_the_first_that_was_taken_in_whatever_order() -> None:
    other = [UP[3], *UP[:3], *UP[4:]]
    due = _guide([_pose(u, 5.0 * i) for i, u in enumerate(other)], repeat=True)
    assert due.text == f"next: {LABELS[3]} up once more: the first pose again shows drift"
    assert _guide([_pose(u, 5.0 * i) for i, u in enumerate([*other, UP[3]])], repeat=True).complete


def test_poses_in_any_order_leave_the_rest_of_the_plan_in_its_order() -> None:
    state = _guide([_pose(UP[i], 5.0 * i) for i in (7, 2, 11)])
    assert list(state.missing) == [label for i, label in enumerate(LABELS) if i not in (2, 7, 11)]
    assert state.text == f"next: {LABELS[0]} up"


@pytest.mark.slow
def test_in_a_dense_plan_a_pose_covers_the_direction_that_it_is_nearest_to_alone() -> None:
    plan = directions(60)
    state = _guide([_pose(plan[10][1])], wanted=60)
    assert [label for label, _ in plan if label not in state.missing] == [plan[10][0]]


def test_a_direction_that_only_uncounted_poses_cover_is_wanted_at_last() -> None:
    """The fixture still stands in an attitude of the fit, near a direction to check in."""
    fitted = np.array([v for _, v in directions(26)])
    targets = elsewhere(fitted, 3)
    labels = [label for label, _ in targets]
    standing = _pose(fitted[np.argmax(fitted @ targets[0][1])])
    settings = {"plan": False, "wanted": 3, "apart_from": fitted, "targets": targets}
    assert _guide([standing], **settings).missing == tuple(labels[1:])
    rest = [_pose(v, 10.0 + 5 * i) for i, (_, v) in enumerate(targets[1:])]
    state = _guide([standing, *rest], **settings)
    assert (state.found, state.missing, state.complete) == (2, (labels[0],), False)
    assert _guide([standing, *rest, _pose(targets[0][1], 50.0)], **settings).complete


def _turned(a: Any, b: Any, degrees: float) -> np.ndarray:
    """From one axis towards another."""
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * a + np.sin(angle) * b)


def test_the_place_of_the_present_pose_and_of_the_repeat_are_told_by_their_labels() -> None:
    taken = [_pose(u, 5.0 * i) for i, u in enumerate([UP[3], *UP[:3], *UP[4:]])]
    due = _guide(taken, repeat=True, now_s=69.2)
    assert due.next is not None
    assert (due.next.label, due.next.once_more, due.at) == (LABELS[3], True, LABELS[-1])
    moving = _guide(taken[:-1], repeat=True, now_s=68.0)
    assert moving.next is not None
    assert (moving.next.once_more, moving.at) == (False, None)
    off = _guide([_pose(_turned(UP[LABELS.index("+X")], UP[LABELS.index("+Y")], 27))], now_s=4.1)
    assert (off.found, off.at) == (1, None)


def test_without_a_plan_any_pose_will_do() -> None:
    state = _guide([_pose(UP[0])], plan=False, wanted=3)
    assert state.missing == ()
    assert state.text == "turn the unit to a pose not taken yet"


def test_without_a_nominal_scale_factor_the_range_of_the_outputs_serves() -> None:
    """Poses by an offset of half the range and an unknown scale are still told apart."""
    offset = np.array([300.0, -200.0, 100.0])
    poses = [_pose(u * 700.0 + offset, 5.0 * i) for i, u in enumerate(UP)]
    assert _guide(poses, nominal_scale_factor=None).complete
    assert _guide(poses[:8], nominal_scale_factor=None).found == 8


def test_a_pose_that_was_long_enough_once_stays_counted_when_its_ends_move() -> None:
    """The ends of a still span are known better as more of the noise is seen."""
    before = _guide([_pose(UP[0], 0.1, 3.2), _pose(UP[1], 10.0)])
    shorter = [_pose(UP[0], 0.9, 2.4), _pose(UP[1], 10.0)]
    assert (before.found, before.missing) == (2, tuple(LABELS[2:]))
    after = _guide(shorter, counted_s=before.counted_s)
    assert (after.found, after.missing) == (before.found, before.missing)
    assert _guide(shorter, counted_s=after.counted_s).found == 2
    assert _guide(shorter).found == 1
    assert _guide([_pose(UP[1], 10.0)], counted_s=before.counted_s).found == 1


ELSEWHERE = elsewhere(np.array(UP), 3)
CHECK = {"plan": False, "wanted": 3, "apart_from": np.array(UP)}


def test_check_poses_are_asked_for_in_other_attitudes_than_the_fits() -> None:
    assert _guide([], **CHECK).text == f"next: {ELSEWHERE[0][0]} up"
    state = _guide([_pose(ELSEWHERE[0][1])], **CHECK)
    assert (state.found, state.text) == (1, f"next: {ELSEWHERE[1][0]} up")
    near = UP[3] + np.array([0.0, np.sin(np.radians(6)), 0.0])
    assert _guide([_pose(near)], **CHECK).found == 0
    assert _guide([_pose(v, 5.0 * i) for i, (_, v) in enumerate(ELSEWHERE)], **CHECK).complete


def test_who_offers_the_fits_attitudes_alone_is_not_waited_for() -> None:
    offered = [_pose(v, 5.0 * i) for i, v in enumerate(UP)]
    assert not _guide(offered[:5], **CHECK).complete
    assert not _guide([offered[0]] * 20, **CHECK).complete
    state = _guide(offered[:6], **CHECK)
    assert (state.found, state.only_near, state.complete) == (0, True, True)


def test_as_many_other_poses_as_the_fit_had_are_enough_where_these_are_few() -> None:
    settings = {**CHECK, "wanted": 9, "apart_from": np.array(UP[:10])}
    offered = [_pose(v, 5.0 * i) for i, v in enumerate(UP[:10])]
    assert not _guide(offered[:9], **settings).complete
    assert _guide(offered, **settings).complete


def test_with_the_best_first_the_next_pose_is_the_one_that_lowers_the_uncertainty_most() -> None:
    plan = directions(26)
    state = _guide([_pose(v) for _, v in plan[:9]], wanted=26, targets=plan, best_first=True)
    up = np.array([v for _, v in plan[:9]])
    errors = [magnitude_error(np.concatenate([up, v[None]])) for label, v in plan[9:]]
    assert state.next is not None
    assert state.next.label == state.missing[0] == plan[9 + int(np.argmin(np.round(errors, 9)))][0]
    assert sorted(state.missing) == sorted(label for label, _ in plan[9:])


@pytest.mark.parametrize("seed", range(5))
def test_the_best_next_pose_does_not_change_with_the_noise_of_those_taken(seed: int) -> None:
    plan, rng = directions(26), np.random.default_rng(seed)
    off = [v + 0.03 * rng.standard_normal(3) for _, v in plan[:11]]
    settings: dict[str, Any] = {"wanted": 26, "targets": plan, "best_first": True}
    exact = _guide([_pose(v) for _, v in plan[:11]], **settings)
    assert _guide([_pose(v / np.linalg.norm(v)) for v in off], **settings).missing == exact.missing


def test_fewer_poses_than_the_plan_has_may_be_wanted() -> None:
    poses = [_pose(v, start_s=10.0 * i) for i, (_, v) in enumerate(directions(26)[:12])]
    settings: dict[str, Any] = {"targets": directions(26), "best_first": True}
    assert not _guide(poses, wanted=26, **settings).complete
    assert _guide(poses, wanted=12, **settings).complete
    assert _guide(poses, wanted=12, repeat=True, **settings).repeat_due
