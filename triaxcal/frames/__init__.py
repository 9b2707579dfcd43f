"""The frame of the mounting faces: from faces in two orientations each to a
rotation, with the fixture's own errors."""

from triaxcal.frames.unit_frames import Frames, UnitFrame

__all__ = ["Frames", "UnitFrame"]
