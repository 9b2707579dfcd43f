"""Still spans as poses: their means, and the spectrum of the noise that tells
how far these may be trusted."""

from triaxcal.arrays import READING_MOST
from triaxcal.poses.covariates import InStream, channels_of, with_scale
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, SIGNIFICANT
from triaxcal.poses.finder import PoseFinder
from triaxcal.poses.pose import Pose, Run, StillSpan, poses_of, still_spans_of
from triaxcal.poses.quality import QualityFinding, disturbances
from triaxcal.poses.quality.finding import Bursts, StuckOutput
from triaxcal.poses.stillness.detector import TURN_S, find_spans
from triaxcal.poses.stillness.windows import Windows

__all__ = [
    "LACK_OF_FIT",
    "READING_MOST",
    "SIGNIFICANT",
    "TURN_S",
    "Bursts",
    "InStream",
    "Pose",
    "PoseFinder",
    "QualityFinding",
    "Run",
    "StillSpan",
    "StuckOutput",
    "Windows",
    "channels_of",
    "disturbances",
    "find_spans",
    "poses_of",
    "still_spans_of",
    "with_scale",
]
