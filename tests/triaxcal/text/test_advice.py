"""What is to be done after a diagnosis, in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.diagnosis import Recommendation, diagnose
from triaxcal.poses.pose import Pose
from triaxcal.text.advice import of_creep, to_do
from triaxcal.units import ErrorUnit


def test_after_record_more_what_to_do_is_optional_where_the_limits_are_kept(
    poses_with: Callable[..., list[Pose]], knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    loop = diagnose(knocked(poses_with(1), 7, 1e-3), signs=(-1, -1, -1), catalogue=())
    assert loop.call is Recommendation.RECORD_MORE
    said = to_do(loop, ErrorUnit.of("g", 1.0))
    assert said.startswith("optional where the limits are kept: take again the pose at 70.0 s: outliers")


@pytest.mark.parametrize(
    ("creeping", "words"),
    [
        (0, ""),
        (1, "their standard errors contain it, nothing to do"),
        (16, "their standard errors contain it; as most poses creep, let the unit settle for longer before each, or "
             "keep its temperature steadier"),
    ],
)  # fmt: skip
def test_creeping_poses_need_no_action_unless_most_creep(
    poses_with: Callable[..., list[Pose]], creeping: int, words: str
) -> None:
    poses = poses_with(1)
    creep = np.array([1e-4, 0.0, 0.0])
    assert of_creep([*(replace(p, creep=creep) for p in poses[:creeping]), *poses[creeping:]]) == words
