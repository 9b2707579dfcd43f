"""What several units show together, in words."""

from __future__ import annotations

from triaxcal.pooled_units import Answer, PooledAnalysis
from triaxcal.text.pooled_units import verdict


def found(answer: Answer, *agreed: tuple[str, ...], probability: float = 0.0) -> PooledAnalysis:
    return PooledAnalysis(answer, agreed, probability, (), 0.1)


def test_effects_that_act_in_all_units_are_named() -> None:
    assert verdict(found(Answer.AGREE, ("warm_up",))) == "agree on warm_up"
    assert verdict(found(Answer.AGREE, ("warm_up",), ("a", "b", "c"))) == "agree on warm_up and on a, b or c"


def test_a_likely_effect_has_its_probability() -> None:
    assert verdict(found(Answer.PERHAPS, ("warm_up",), probability=0.8)) == "may agree on warm_up (probability 0.8)"


def test_units_without_an_effect_in_common_are_told_apart_from_units_without_any() -> None:
    assert verdict(found(Answer.DISAGREE)) == "do not agree"
    assert verdict(found(Answer.NOTHING)) == "no unit shows an effect"
