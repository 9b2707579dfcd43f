"""Poses on demand: whether the poses so far suffice.

The decision is made by the figures that the certificate will state, in two steps. The
noise inside the poses and their directions predict the uncertainty without a look at a
residual. Only where that is low enough the poses are diagnosed, as for a certificate.

Such a decision favours residuals that are small by luck, and intervals that follow
from them are too short. So it waits for some degrees of freedom, and further poses
follow that it has not seen (`benchmarks.poses_on_demand`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import triaxcal as tc
from triaxcald.computer import compute_with_one_thread
from triaxcald.station.config import Place, StationFile, Stop

LEFT_LEAST = 3
"""Residual degrees of freedom that a decision needs: with fewer hardly anything
unexplained could show."""
CONFIRMING = 3
"""Poses after the decision, the first one once more among them. On a stand that
scatters by twice the noise 95 % intervals hold 87 % without both rules and 93 % with
them, as after any 14 poses."""


@dataclass(frozen=True)
class Judgement:
    """``uncertainty_g``: combined standard uncertainty of the magnitude in the budget,
    as it is printed; None where it is not known. ``settled``: nothing unexplained is
    open; ``unexplained``: something acts that no effect explains. ``enough``: the poses
    suffice but for the confirming ones."""

    uncertainty_g: float | None
    settled: bool
    unexplained: bool
    enough: bool


NOT_KNOWN = Judgement(None, settled=False, unexplained=False, enough=False)


@dataclass(frozen=True)
class Judge:
    """Judges the poses of a unit as its certificate will. Arguments as in
    `tc.diagnosis.diagnose` and `tc.uncertainty.budget`. The same poses always have the
    same judgement."""

    stop: Stop
    signs: Sequence[float]
    reference: float = 1.0
    moment: tc.Moment | float = tc.Moment.END
    stated: tc.Stated | None = None
    odds: tc.evidence.Odds | None = None

    @classmethod
    def of(cls, stop: Stop, place: Place, file: StationFile, odds: tc.evidence.Odds | None = None) -> Judge:
        return cls(stop, place.signs, file.reference, file.moment, file.stated(place.bundle.profile), odds)

    def predicted_g(self, poses: Sequence[tc.Pose]) -> float | None:
        """Standard uncertainty of the magnitude from the noise inside the poses and
        their directions alone, which is most of the stated one; None where they do not
        determine the nine parameters. Takes some milliseconds."""
        try:
            linear = tc.estimate.fit(poses, signs=self.signs, reference=self.reference)
        except tc.Refused:
            return None
        lines = tc.uncertainty.budget(linear, self.stated).components
        return next((line.magnitude for line in lines if line.source == "noise"), None)

    def __call__(self, poses: Sequence[tc.Pose]) -> Judgement:
        """Diagnose the poses: about a second."""
        compute_with_one_thread()
        try:
            loop = tc.diagnosis.diagnose(
                poses, signs=self.signs, reference=self.reference, at=self.moment, odds=self.odds
            )
        except tc.Refused:
            return NOT_KNOWN
        budget = tc.uncertainty.budget(loop.after, self.stated)
        uncertainty_g = tc.rounding.uncertainty(float(budget.magnitude.standard))
        low = uncertainty_g is not None and uncertainty_g <= self.stop.uncertainty_g
        left = sum(p.used for p in loop.after.poses) - tc.planning.LEAST
        return Judgement(
            uncertainty_g,
            loop.settled,
            loop.found.unexplained.significant or loop.found.change_point is not None,
            enough=low and loop.settled and left >= LEFT_LEAST,
        )


def apart(work: Callable[[], Judgement]) -> Awaitable[Judgement]:
    """The work on a thread, so that records are read meanwhile."""
    return asyncio.to_thread(work)


class OnDemand:
    """Ends the pose acquisition of a unit. ``wanted`` are its distinct poses: the most
    that are allowed, until fewer suffice.

    Each pose is judged once, in the background. Where the poses suffice, confirming
    ones follow, of which ``repeat`` of the first is one. They are judged together with
    the others: only what is unexplained then keeps the acquisition going. ``tell``
    receives each judgement with the number of distinct poses.
    """

    def __init__(self, judge: Judge, *, repeat: bool, tell: Callable[[int, Judgement], None] = lambda *_: None) -> None:
        self.judge, self._tell, self._further = judge, tell, CONFIRMING - repeat
        self.wanted = judge.stop.poses_most
        self._confirming = False
        self._judged, self._found = 0, 0
        self._work: asyncio.Future[Judgement] | None = None

    @property
    def targets(self) -> list[tc.planning.Direction]:
        return tc.planning.directions(self.judge.stop.poses_most)

    def deciding(self) -> bool:
        """Whether a judgement is under way. Raises what it raised."""
        if self._work is None:
            return False
        if not self._work.done():
            return True
        judgement, self._work = self._work.result(), None
        most = self.judge.stop.poses_most
        if not self._confirming and judgement.enough:
            self._confirming, self.wanted = True, min(self._found + self._further, most)
        elif self._confirming and judgement.unexplained:
            self._confirming, self.wanted = False, most
        self._tell(self._found, judgement)
        return False

    def is_due(self, found: int, poses: int, *, complete: bool) -> bool:
        """Whether a judgement is due for ``found`` distinct poses of ``poses`` in all;
        ``complete``: all wanted ones are there."""
        stop = self.judge.stop
        if not stop.poses_least <= found < stop.poses_most or poses == self._judged:
            return False
        return complete or not self._confirming

    def begin(self, found: int, poses: int, all_poses: Sequence[tc.Pose]) -> None:
        """Judge ``all_poses``, if their number and the noise inside them allow it."""
        self._found, self._judged = found, poses
        if not self._confirming:
            predicted_g = self.judge.predicted_g(all_poses)
            few = len(all_poses) < tc.planning.LEAST + LEFT_LEAST
            if few or predicted_g is None or predicted_g > self.judge.stop.uncertainty_g:
                return
        self._work = asyncio.ensure_future(apart(lambda: self.judge(all_poses)))
