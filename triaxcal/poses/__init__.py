"""Still spans as poses: their means, and the spectrum of the noise that tells how far these may be trusted."""

from triaxcal.poses.pose import Held, Pose, Run, held_of, poses_of

__all__ = ["Held", "Pose", "Run", "held_of", "poses_of"]
