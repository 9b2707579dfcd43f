"""The frame of the mounting faces: from faces in two orientations each to a
rotation, with the fixture's own errors."""

from triaxcal.frames.faces import LABELS, TURNS, Labelling, Miscounted, axis_of, labelled, opposite, recognise
from triaxcal.frames.orientations import Assumed, Verticals, verticals, verticals_under
from triaxcal.frames.standing import Standing, stand
from triaxcal.frames.unit_frames import Datum, Fixture, Frames, Quantity, UnitFrame, frames

__all__ = [
    "LABELS",
    "TURNS",
    "Assumed",
    "Datum",
    "Fixture",
    "Frames",
    "Labelling",
    "Miscounted",
    "Quantity",
    "Standing",
    "UnitFrame",
    "Verticals",
    "axis_of",
    "frames",
    "labelled",
    "opposite",
    "recognise",
    "stand",
    "verticals",
    "verticals_under",
]
