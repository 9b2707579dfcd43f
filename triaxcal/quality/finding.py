"""One kind of fault of a raw stream, and the still spans as the judges of it need them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.stillness.detector import Span
from triaxcal.stillness.windows import Windows

AXES = "xyz"
POSES_NAMED = 8
UNTRUSTED = ("saturation", "stuck_output")
"""Faults for which a mean is not that of the acceleration."""


@dataclass(frozen=True)
class Finding:
    """``name`` as in data-quality lines, ``text`` what, which axis, how much and where. ``poses`` are indices of the
    spans that it touches, which have to be taken again.
    """

    name: str
    text: str
    poses: tuple[int, ...] = ()

    @property
    def line(self) -> str:
        return f"{self.name}: {self.text}"


def untrusted_poses(findings: Iterable[Finding]) -> dict[int, str]:
    """By index, the still spans in which the outputs do not follow the acceleration, with the name of the fault."""
    return {i: f.name for f in findings if f.name in UNTRUSTED for i in f.poses}


@dataclass(frozen=True)
class Holds:
    """The still spans of a stream: ``start_ns``, ``end_ns`` (k,); ``begin_ns`` is where its seconds begin. ``variance``
    (k,3) of the readings in each, slow noise included.
    """

    begin_ns: int
    start_ns: Ints
    end_ns: Ints
    variance: Floats

    @classmethod
    def of(cls, begin_ns: int, w: Windows | None, spans: Sequence[Span]) -> Holds:
        if w is None or not spans:
            none = np.zeros(0, dtype=np.int64)
            return cls(begin_ns, none, none, np.zeros((0, 3)))
        start = np.array([w.start_ns[s.first] for s in spans])
        end = np.array([w.end_ns[s.last] for s in spans])
        variance = [w.variance[s.used].mean(axis=0) + w.mean[s.used].var(axis=0) for s in spans]
        return cls(int(w.start_ns[0]), start, end, np.array(variance))

    def __len__(self) -> int:
        return len(self.start_ns)

    def seconds(self, time_ns: int) -> float:
        return (time_ns - self.begin_ns) * 1e-9

    def within(self, start_ns: Ints, end_ns: Ints) -> Ints:
        """(n,) index of the span in which each stretch of time lies whole, else -1."""
        if not len(self):
            return np.full(len(start_ns), -1, dtype=np.int64)
        at = np.searchsorted(self.start_ns, start_ns, side="right") - 1
        whole = (at >= 0) & (end_ns <= self.end_ns[np.maximum(at, 0)])
        return np.where(whole, at, -1)

    def touched(self, start_ns: int, end_ns: int) -> tuple[int, ...]:
        """Spans that share time with a stretch."""
        shared: Bools = (self.start_ns <= end_ns) & (self.end_ns >= start_ns)
        return tuple(int(i) for i in np.flatnonzero(shared))

    def named(self, poses: Sequence[int]) -> str:
        """ ", in N poses, which begin at …" so that they can be taken again."""
        if not poses:
            return ", in no pose"
        times = [f"{self.seconds(int(self.start_ns[i])):.1f}" for i in poses[:POSES_NAMED]]
        more = "" if len(poses) <= POSES_NAMED else f" and {len(poses) - POSES_NAMED} more"
        which = "pose that begins" if len(poses) == 1 else "poses that begin"
        return f", in the {which} at {', '.join(times)} s{more}: take again"


def counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
