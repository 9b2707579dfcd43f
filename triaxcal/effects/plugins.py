"""Effects of other packages: entry points of the group ``triaxcal.effects``, each an `Effect` or a class that makes one
without arguments.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np

from triaxcal.effects.contract import DERIVED, Effect

GROUP = "triaxcal.effects"


@cache
def plugins() -> tuple[tuple[Effect, ...], tuple[tuple[str, str], ...]]:
    """The effects found, and (name, reason) of those that are broken."""
    found, broken = [], []
    for point in sorted(entry_points(group=GROUP), key=lambda p: p.name):
        effect, why = _loaded(point)
        if effect is None:
            broken.append((point.name, why))
        else:
            found.append(effect)
    return tuple(found), tuple(broken)


def _loaded(point: EntryPoint) -> tuple[Effect | None, str]:
    try:
        thing = point.load()
        effect: Any = thing() if isinstance(thing, type) else thing
        _try(effect)
    except Exception as e:  # noqa: BLE001 - whatever somebody else's code raises is the reason that is told
        return None, f"{type(e).__name__}: {e}"
    return effect, ""


def _try(effect: Any) -> None:
    """Raises whatever keeps an effect from being used."""
    n, p = 4, len(effect.coefficients)
    if not (isinstance(effect.name, str) and effect.name and p and isinstance(effect.remedy, str)):
        raise TypeError("an effect has a name, coefficients and a remedy")
    conditions = {name: np.linspace(0.5, 1.5, n) for name in (*DERIVED, *effect.needs)}
    s = np.linspace(-0.5, 0.5, 3 * n).reshape(n, 3)
    for got, shape in ((effect.basis(s, conditions), (n, 3, p)), (effect.slope(s, conditions), (n, 3, 3, p))):
        if np.shape(got) != shape or not np.isfinite(got).all():
            raise TypeError(f"expected finite numbers of shape {shape}, not {np.shape(got)}")
    tuple(effect.variants(conditions))
