"""Several units or recordings side by side, in words."""

from __future__ import annotations

from triaxcal.estimate.recordings import Shape, difference_of_shapes
from triaxcal.number_format import plain
from triaxcal.pooled_units import Answer, PooledAnalysis
from triaxcal.text.advice import chance


def verdict(found: PooledAnalysis) -> str:
    """Which effects act in all units, or that none does."""
    match found.answer:
        case Answer.AGREE:
            return f"agree on {_effects(found)}"
        case Answer.PERHAPS:
            return f"may agree on {_effects(found)} (probability {chance(found.probability)})"
        case Answer.DISAGREE:
            return "do not agree"
        case Answer.NOTHING:
            return "no unit shows an effect"


def _effects(found: PooledAnalysis) -> str:
    return " and on ".join(_one_of(group) for group in found.agreed)


def _one_of(group: tuple[str, ...]) -> str:
    *most, last = group
    return f"{', '.join(most)} or {last}" if most else last


def other_unit(name: str, other: str, one: Shape | None, another: Shape | None) -> list[str]:
    """A line where ``name`` and ``other`` are hardly of one unit; else none."""
    found = difference_of_shapes(one, another)
    if found is None:
        return []
    return [
        f"{name} and {other}: misalignment differs by up to {plain(1e3 * found.angle_rad, 2)} mrad and the ratio of "
        f"scale factors by up to {plain(100 * found.ratio, 2)} %, more than age and 20 K make of one unit: the same "
        "unit?"
    ]
