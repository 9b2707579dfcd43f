"""What spoils poses, told apart from what is merely worth knowing about a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from triaxcald.report.document import Pose
from triaxcald.report.figures import micro
from triaxcald.report.meanings import QUALITY

_TAKE_AGAIN = "take again"


@dataclass(frozen=True)
class Fault:
    """A line of `data_quality`. ``spoils``: poses that have to be taken again."""

    title: str
    text: str
    spoils: bool


def faults_of(lines: Iterable[str]) -> tuple[Fault, ...]:
    """Those that spoil poses first."""
    found = []
    for line in lines:
        name, colon, text = line.partition(": ")
        known = QUALITY.get(name) if colon else None
        found.append(Fault(known or "", text if known else line, _TAKE_AGAIN in line))
    return tuple(sorted(found, key=lambda fault: not fault.spoils))


def left_out(poses: Sequence[Pose]) -> tuple[str, ...]:
    """The poses that the fit did not use, with where they are and by how much they are off."""
    return tuple(
        f"Pose {pose.number}"
        + ("" if pose.start_s is None else f", at {pose.start_s:.1f} s")
        + ("" if pose.residual_g is None else f": off by {micro(pose.residual_g)} µg")
        for pose in poses
        if not pose.used
    )
