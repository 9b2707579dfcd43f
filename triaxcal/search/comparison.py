"""Two models compared by their errors in poses that were left out of the fit."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.calibration import Calibration, PoseResult

CARRIES = 0.05
"""A pose of which the model leaves less than this share carries a parameter, and cannot be left out."""
ALMOST_ALL = 0.9
NO_LOWER = "it does not lower the cross-validated error"


@dataclass(frozen=True)
class Comparison:
    """Cross-validated rms errors in g: of a model, of the one it is compared with, None where they are not known, and
    what noise makes of that of the first. ``but`` are poses that have no part in it."""

    new_g: float | None
    old_g: float | None
    noise_g: float
    but: tuple[PoseResult, ...] = ()

    @property
    def lower(self) -> bool:
        """Whether it speaks for the model."""
        return self.new_g is not None and (self.old_g is None or self.new_g < self.old_g)


def compared(new: Calibration, old: Calibration) -> Comparison:
    """Two models of the same poses. Of a pose that alone carries a coefficient the others say nothing, be the model
    right or not: it has no part in the comparison, if there are no more than one of ten."""
    used, before = ([p for p in c.poses if p.used] for c in (new, old))
    told = [p.carries < 1 - CARRIES for p in used]
    if all(told) or sum(told) < ALMOST_ALL * len(told):
        return Comparison(new.residual.cross_validated_rms_g, old.residual.cross_validated_rms_g, _by_noise(used))
    kept = list(itertools.compress(used, told))
    return Comparison(
        new_g=_crossed(kept),
        old_g=_crossed(list(itertools.compress(before, told))),
        noise_g=_by_noise(kept),
        but=tuple(p for p, known in zip(used, told, strict=True) if not known),
    )


def _crossed(poses: Sequence[PoseResult]) -> float:
    """In linear reckoning."""
    return float(np.sqrt(np.mean([(p.residual_g / max(1 - p.leverage, 1e-9)) ** 2 for p in poses])))


def _by_noise(poses: Sequence[PoseResult]) -> float:
    return float(np.sqrt(np.mean([p.standard_error_g**2 / max(1 - p.leverage, 1e-9) for p in poses])))
