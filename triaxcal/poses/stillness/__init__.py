"""Where a unit stood still: windows of the stream, the noise at every scale,
the detector, the ends of its spans."""

from triaxcal.poses.stillness.detector import Span, StillnessDetector, find_spans
from triaxcal.poses.stillness.windows import Windows

__all__ = ["Span", "StillnessDetector", "Windows", "find_spans"]
