"""Still spans as poses: their means, and the spectrum of the noise that tells
how far these may be trusted."""

from triaxcal.poses.pose import Pose, Run, StillSpan, poses_of, still_spans_of

__all__ = ["Pose", "Run", "StillSpan", "poses_of", "still_spans_of"]
