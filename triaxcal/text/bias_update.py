"""Biases anew, in a few lines."""

from __future__ import annotations

import numpy as np

from triaxcal.estimate.calibration import BiasUpdate, Calibration
from triaxcal.number_format import number_of
from triaxcal.units import ErrorUnit


def lines(c: Calibration, update: BiasUpdate, small: ErrorUnit) -> tuple[str, ...]:
    """Of how many poses, by how much the biases moved, and the error before and
    after."""
    by_axis = zip("xyz", update.shift, c.standard_errors[6:9], strict=True)
    moved = ", ".join(f"{axis} {small.count(s):+.1f} ± {small.count(e):.1f}" for axis, s, e in by_axis)
    before, after, floor = (small.in_full(v) for v in (update.before.rms_g, c.residual.rms_g, c.residual.noise_floor_g))
    left = int(np.sum([p.used for p in c.poses])) - 3
    proves = "" if left > 0 else ", which three poses make small whatever fits"
    return (
        f"three biases anew by {number_of(len(c.poses), 'pose')}; scale factors, misalignments and effects kept",
        f"the biases moved by {moved} (unit: {small})",
        f"error of |a| in these poses {before} rms before, {after} after{proves}; noise floor {floor}",
    )
