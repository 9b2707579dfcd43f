"""The words and formulas of the effects, against the effects themselves."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from triaxcal.effects import CATALOGUE, effect_named
from triaxcal.effects.contract import BEFORE, CHANGE, DURATION, LAGS_S, RUN, SCATTER, SINCE_START, Effect, lag_of
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.memory import Hysteresis
from triaxcal.effects.runs import InRuns, RunBias, RunScaleFactor
from triaxcal.effects.time import BiasDrift
from triaxcald.report.figures import factor, in_plain, told

FORMS = [form for effect in (*CATALOGUE, effect_named("channel_bias:fan rpm")) for form in effect.forms]
FORMS += [effect_named("channel_scale_factor:supply_v"), *(BiasDrift(d) for d in (1, 2, 3))]
FORMS += [Hysteresis("memory"), Hysteresis("reversal")]
RNG = np.random.default_rng(11)
S = RNG.uniform(-1, 1, (5, 3))
COVARIATES = {
    name: RNG.uniform(0.5, 2.0, 5)
    for name in {*(n for e in FORMS for n in e.needs), *BEFORE, *CHANGE, *SCATTER, SINCE_START, DURATION}
}
COVARIATES |= {lag_of("temp_c", constant_s): RNG.uniform(-1, 1, 5) for constant_s in LAGS_S}
COVARIATES[DURATION] = np.zeros(5)
COVARIATES[SINCE_START] = np.arange(5.0)


def hinge(s: np.ndarray, effect: Effect) -> np.ndarray:
    """s − κ beyond the knee, with a bend as wide as κ/10."""
    knee = effect.shape.get("knee", (1.0, ""))[0]
    return np.asarray(knee / 10 * (np.log1p(np.exp(10 * (s / knee - 1))) - np.log1p(np.exp(-10))))


def by_hand(text: str, effect: Effect, axis: int) -> np.ndarray:
    """What a factor on the page says, reckoned without the effect's own code."""
    s, c = S[:, axis], COVARIATES
    need = c[effect.needs[0]] if effect.needs else np.zeros(5)
    if product := re.fullmatch(r"s_([xyz]) s_([xyz])", text):
        return np.asarray(S[:, "xyz".index(product[1])] * S[:, "xyz".index(product[2])])
    if power := re.fullmatch(r"s([²³⁴⁵⁶⁷⁸⁹])", text):
        return s ** ("⁰¹²³⁴⁵⁶⁷⁸⁹".index(power[1]))
    tau, at = (effect.shape.get(n, (1.0, ""))[0] for n in ("time_constant", "at"))
    known = {
        "h(−s) − h(s)": hinge(-s, effect) - hinge(s, effect),
        "−h(s) − h(−s)": -hinge(-s, effect) - hinge(s, effect),
        "θ − T₀": need + (c[effect.needs[1]] if effect.name == "temperature_lag" else 0.0),
        "(t − t₀) s": need * s,
        "sign(s′)": np.sign(c[BEFORE[axis]]),
        "|s|": np.abs(s),
        "T − T₀": need,
        "(T − T₀)²": need**2,
        "(T − T₀) s": need * s,
        "dT/dt": need,
        "c − c₀": need,
        "(c − c₀) s": need * s,
        "t − t₀": need,
        "(t − t₀)²": need**2,
        "(t − t₀)³": need**3,
        "exp(−t / τ)": np.exp(-c[SINCE_START] / tau),
        "−1 before t₁, 0 after": -(c[SINCE_START] < at).astype(float),
        "s′": c[BEFORE[axis]],
        "sign(s − s′)": np.sign(c[CHANGE[axis]]),
        "v": c[SCATTER[axis]],
        "product of the two other components, on each axis": S[:, axis - 1] * S[:, axis - 2],
    }
    return np.asarray(known[text])


@pytest.mark.parametrize("effect", FORMS, ids=lambda e: f"{e.name}-{len(e.coefficients)}-{e.coefficients[0].name}")
def test_what_the_page_says_a_coefficient_is_multiplied_by_is_what_the_effect_does(effect: Effect) -> None:
    shaped = effect.shaped(dict.fromkeys(effect.shape, 2.5)) if effect.shape else effect
    basis = shaped.basis(S, COVARIATES)
    for i, coefficient in enumerate(shaped.coefficients):
        axis, text = factor(effect.name, coefficient.name)
        for k, name in enumerate("xyz"):
            expected = by_hand(text, shaped, k) if axis in ("", name) else np.zeros(5)
            np.testing.assert_allclose(basis[:, k, i], expected, atol=1e-12)
    assert all(factor(effect.name, name)[1] for name in effect.shape)
    assert told(effect.name, {}).formula


@pytest.mark.parametrize("effect", [Empirical(), *CATALOGUE], ids=lambda e: e.name)
def test_every_effect_of_the_catalogue_is_told_in_words(effect: Effect) -> None:
    known = told(effect.name, {})
    assert known.because
    assert known.clause != known.title.lower()
    for c in itertools.chain.from_iterable(form.coefficients for form in effect.forms):
        assert factor(effect.name, c.name)[1], c.name


@pytest.mark.parametrize("effect", [RunBias(3), RunBias(3, alone=2), RunScaleFactor(3), RunScaleFactor(3, alone=0)])
def test_what_differs_between_recordings_is_multiplied_by_what_the_page_says(effect: RunBias) -> None:
    run = np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    basis = effect.basis(S, {RUN: run})
    size = S if effect.name == "run_scale_factor" else np.ones((5, 3))
    for i, coefficient in enumerate(effect.coefficients):
        axis, text = factor(effect.name, coefficient.name)
        k = "xyz".index(axis)
        alone = re.fullmatch(r"(1|s), in recording (\d) alone", text)
        against = re.fullmatch(r"(1|s) in recording (\d), −\1 in recording 1", text)
        said = alone or against
        assert said is not None
        assert (said[1] == "s") == (effect.name == "run_scale_factor")
        share = (run == int(said[2]) - 1).astype(float) - ((run == 0) if against else 0.0)
        np.testing.assert_allclose(basis[:, k, i], share * size[:, k])
    known = told(effect.name, {})
    assert known.because
    assert known.clause != known.title.lower()


def test_an_effect_of_the_clocks_in_one_recording_says_in_which() -> None:
    effect = InRuns(BiasDrift(2), (2,))
    said = {c.name: factor("bias_drift", c.name) for c in effect.coefficients}
    assert said["x_run3"] == ("x", "t − t₀, in recording 3 alone")
    assert said["y2_run3"] == ("y", "(t − t₀)², in recording 3 alone")
    several = told("bias_drift", {"t_s": 0.0, RUN: 0.0}).symbols
    assert several.endswith("t₀: the middle of each recording's poses")
    assert "t₀ = " not in several


def test_references_and_channels_are_put_into_the_formula() -> None:
    assert told("temperature_bias", {"temp_c": 23.4}).symbols == "T: temp_c; T₀ = 23.4"
    channel = told("channel_bias:fan rpm", {"fan rpm": 1200.0})
    assert channel.clause == "the bias goes with fan rpm"
    assert channel.symbols == "c: fan rpm, as logged; c₀ = 1200"


def test_an_effect_of_somebody_else_is_shown_by_its_name() -> None:
    known = told("magnetic_pull", {})
    assert (known.title, known.clause, known.formula) == ("Magnetic pull", "magnetic pull", "")
    assert factor("magnetic_pull", "x") == ("", "")


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("channel_bias:supply_v: hold it", "Channel bias: supply_v: hold it"),
        ("warm_up cannot be told from bias_drift here", "Warm up cannot be told from bias drift here"),
        ("record while temp_c moves", "Record while temp_c moves"),
        ("from 1.53e+04 µg, p below 1e-12", "From 15300 µg, p below 10⁻¹²"),
        ("from 15300 1e-6 µT to 3e-6 µT", "From 15300 × 10⁻⁶ µT to 3 × 10⁻⁶ µT"),
        ("from 15300e-6 µT to 27.6e-6 µT", "From 15300 × 10⁻⁶ µT to 27.6 × 10⁻⁶ µT"),
        ("temperature_bias_quadratic with warm_upper", "Temperature bias quadratic with warm_upper"),
    ],
)  # fmt: skip
def test_sentences_lose_the_names_of_programs(text: str, plain: str) -> None:
    assert in_plain(text) == plain
