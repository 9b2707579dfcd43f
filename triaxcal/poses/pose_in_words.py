"""Names of poses in sentences: the time at which they began."""

from __future__ import annotations

from collections.abc import Iterable

from triaxcal.poses.pose import PoseStart


def moment(began: PoseStart) -> str:
    """When a pose began, and in which of several recordings, counted from 1."""
    of = "" if began.recording is None else f" of recording {began.recording + 1}"
    return f"{began.start_s:.1f} s{of}"


def the_poses(began: Iterable[PoseStart]) -> str:
    """The poses, by the times at which they began."""
    return " and ".join(f"the pose at {moment(b)}" for b in began)
