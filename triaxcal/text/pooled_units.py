"""What several units show together, in words."""

from __future__ import annotations

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
