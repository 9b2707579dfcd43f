"""Still spans as poses: their means, and the spectrum of the noise that tells
how far these may be trusted."""

from typing import TYPE_CHECKING

from triaxcal.arrays import READING_MOST
from triaxcal.lazy import lazily

if TYPE_CHECKING:
    from triaxcal.poses.arrivals import SampleTimes
    from triaxcal.poses.covariates import InStream, channels_of, with_scale
    from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT, SIGNIFICANT
    from triaxcal.poses.finder import PoseFinder
    from triaxcal.poses.pose import Pose, Run, StillSpan, poses_of, still_spans_of
    from triaxcal.poses.quality import QualityFinding, disturbances
    from triaxcal.poses.quality.finding import Bursts, StuckOutput
    from triaxcal.poses.stillness.detector import TURN_S, find_spans
    from triaxcal.poses.stillness.windows import Windows

_NAMES = {
    "arrivals": ("SampleTimes",),
    "covariates": (
        "InStream",
        "channels_of",
        "with_scale",
    ),
    "degrees_of_freedom": (
        "LACK_OF_FIT",
        "SIGNIFICANT",
    ),
    "finder": ("PoseFinder",),
    "pose": (
        "Pose",
        "Run",
        "StillSpan",
        "poses_of",
        "still_spans_of",
    ),
    "quality": (
        "QualityFinding",
        "disturbances",
    ),
    "quality.finding": (
        "Bursts",
        "StuckOutput",
    ),
    "stillness.detector": (
        "TURN_S",
        "find_spans",
    ),
    "stillness.windows": ("Windows",),
}
"""Names by their modules: a recorder needs `SampleTimes` alone, and no scipy."""

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
    "SampleTimes",
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


if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
