"""What the poses themselves are to be blamed for: shaking, and moves that it
hid."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from triaxcal.poses.pose import Pose
from triaxcal.poses.quality.finding import AXES, Disturbance, DisturbedPoses, Finding, MergedPoses, Move


def disturbances(poses: Sequence[Pose]) -> list[Finding]:
    """Of the poses of one recording, in order of time: those that are shaken,
    in a part or all through, and those that a move parts which shaking hid."""
    found: list[Finding] = []
    by_pose = [_of(p) for p in poses]
    if all_of_them := tuple(itertools.chain.from_iterable(by_pose)):
        disturbed = tuple(i for i, own in enumerate(by_pose) if own)
        found.append(DisturbedPoses(all_of_them, disturbed, len(poses)))
    if moves := tuple(_move(here, there) for here, there in itertools.pairwise(poses) if there.parted):
        found.append(MergedPoses(moves))
    return found


def _of(pose: Pose) -> list[Disturbance]:
    out = [Disturbance(pose.start_s, (s.start_s, s.end_s), s.times, s.scatter) for s in pose.shaken]
    if pose.restless > 1:
        out.append(Disturbance(pose.start_s, None, pose.restless, None))
    return out


def _move(here: Pose, there: Pose) -> Move:
    apart = np.abs(there.mean - here.mean)
    axis = int(np.argmax(apart))
    return Move(here.end_s, there.start_s, AXES[axis], float(apart[axis]))
