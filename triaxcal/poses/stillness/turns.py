"""A unit that turns in place: what a turn about the vertical shows between the
poses about it.

On a level table such a turn leaves the reading where it was. On its way the
reading may stand still, or seem to: where the hand changes its grip, where a
slow turn is steady and so is the pull towards its axis, where the hand shakes
the unit about one mean as a machine would. None of that is a pose. All of it
lies in place: as near to the poses before and after as the tilt of a table and
that pull make it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.poses.stillness.windows import Windows

TURN_S = 1.0
"""Turning a fixture by half a circle and putting it down takes as long; some
knocks that ring do. What noise makes of the longest averages, which are over
0.8 s, is shorter, but for rare chance."""
IN_PLACE = 0.01
"""Of the range of the outputs. Where poses cover the sphere this is 20 mrad:
two orientations on a table that tilts by 10 mrad, or the pull 8 cm off the axis
of half a turn in 2 s, on average."""
PAUSE = 1 / 2
"""What stands still on the way is shorter than this share of poses before and
after it. A pose that is lost so costs its data; a piece of a turn that is taken
for one puts its pull into the face."""


def without_turns(w: Windows, quiet: list[Ints], shaken: list[Ints]) -> list[Ints]:
    """Still pieces in order of time, but those that turns in place show between
    quiet ones."""
    known = {int(piece[0]) for piece in quiet}
    pieces = sorted([*quiet, *shaken], key=lambda p: int(p[0]))
    kept: list[Ints] = []
    for place in _places(w, pieces):
        at = [k for k, piece in enumerate(place) if int(piece[0]) in known]
        hand = set(range(at[0], at[-1])).difference(at) if at else ()
        kept += _without_pauses([piece for k, piece in enumerate(place) if k not in hand])
    return kept


def _places(w: Windows, pieces: list[Ints]) -> Iterator[list[Ints]]:
    """Pieces that follow one another in place."""
    if not pieces:
        return
    level: Floats = np.array([w.mean[piece].mean(axis=0) for piece in pieces])
    apart = np.abs(np.diff(level, axis=0)).max(axis=1)
    moved = np.flatnonzero(apart > IN_PLACE * np.ptp(level, axis=0).max()) + 1
    for begin, end in itertools.pairwise([0, *moved.tolist(), len(pieces)]):
        yield pieces[begin:end]


def _without_pauses(place: list[Ints]) -> list[Ints]:
    """Without those that have far longer ones before them and after them."""
    length = np.array([len(piece) for piece in place])
    before = np.maximum.accumulate(length)
    after = np.maximum.accumulate(length[::-1])[::-1]
    stays = length >= PAUSE * np.minimum(before, after)
    return [piece for piece, kept in zip(place, stays, strict=True) if kept]
