"""What the raw stream is to be blamed for, found before any fit: rails, frozen
outputs, gaps, mains, coarse steps."""

from triaxcal.poses.quality.detector import QualityDetector, disturbances
from triaxcal.poses.quality.finding import QualityFinding, faulty_poses

__all__ = ["QualityDetector", "QualityFinding", "disturbances", "faulty_poses"]
