"""The poses that a search does not see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.conditions import of_unknown_history
from triaxcal.effects.contract import Effect
from triaxcal.effects.plugins import EffectFault
from triaxcal.errors import Refused
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.start import begun
from triaxcal.trends import left_by_means


@dataclass(frozen=True)
class LeftOut:
    """All ``poses``, of which a search has those but the ``rows`` left out."""

    poses: Sequence[Pose]
    rows: tuple[int, ...]
    signs: Sequence[float]
    reference: float

    def unknown(self, effects: Sequence[Effect]) -> set[int]:
        """Those left out because the effects need what was before them, which is not known."""
        return set(self.rows) & set(of_unknown_history(self.poses, effects))

    def spoiled(self, effects: Sequence[Effect]) -> set[int]:
        """Those left out for being off."""
        return set(self.rows) - self.unknown(effects)

    def chi2(self, effects: Sequence[Effect], but: set[int]) -> float:
        """What effects leave of all poses ``but`` some; zero where these cannot carry them."""
        poses = [p for i, p in enumerate(self.poses) if i not in but]
        try:
            problem, begin = begun(poses, signs=self.signs, reference=self.reference, effects=effects)
            chi2 = left_by_means(problem, solve(problem, begin, tuple(effects)))
        except (Refused, EffectFault):
            return 0.0
        return chi2 if np.isfinite(chi2) else 0.0
