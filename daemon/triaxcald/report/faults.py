"""What spoils poses, told apart from what is merely worth knowing about a
recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import triaxcal as tc
from triaxcald.report.document import Pose
from triaxcald.report.figures import micro_g
from triaxcald.report.meanings import QUALITY

_TAKE_AGAIN = "take again"
_NAMED = re.compile(rf"(.+?: )?({'|'.join(QUALITY)}): (.*)", re.DOTALL)
"""A fault, behind the recording's name where there are several."""


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
        named = _NAMED.fullmatch(line)
        title, text = (QUALITY[named[2]], (named[1] or "") + named[3]) if named else ("", line)
        found.append(Fault(title, text, _TAKE_AGAIN in line))
    return tuple(sorted(found, key=lambda fault: not fault.spoils))


def left_out(poses: Sequence[Pose], unit: tc.units.ErrorUnit) -> tuple[str, ...]:
    """The poses that the fit did not use and that are to be taken again, with
    where they are and by how much they are off."""
    return tuple(
        f"Pose {pose.number}"
        + ("" if pose.start_s is None else f", at {pose.start_s:.1f} s")
        + (f" of {pose.recording}" if pose.recording else "")
        + ("" if pose.residual_g is None else f": off by {micro_g(pose.residual_g, unit)}")
        for pose in poses
        if pose.again
    )
