"""The words of a budget."""

from __future__ import annotations

import pytest

from triaxcal.text import basis, not_evaluated, remedy
from triaxcal.uncertainty import statements as of

THERMAL = ("temperature_bias", "temperature_scale_factor")
BASES: list[tuple[of.Basis, str]] = [
    (of.WithinPoseScatter(26, 4.02), "scatter inside 26 poses of 4.02 s, with its autocorrelation"),
    (of.Creep(3), "3 poses creep; rectangular over the change in each"),
    (of.BirgeFactor(1.234), "residuals are 1.23 times what noise explains"),
    (of.Excess(2e-5), "residuals show 20.0 µg beside the noise of each pose"),
    (of.StatedReference(), "as stated"),
    (
        of.StatedReference(52.5, 34.0, stated=False),
        "normal gravity at latitude 52.5°, height 34 m; its uncertainty that of gravity anomalies over the Earth",
    ),
    (of.StatedReference(0.0, 34.0), "normal gravity at latitude 0°, height 34 m; its uncertainty as stated"),
    (of.RegisterSteps(12), "steps of 12 registers; rectangular"),
    (
        of.NotHeld(),
        "effects that the registers do not have: the other coefficients take their place, as nearly as they can",
    ),
    (
        of.NoParameter(),
        "what acts in some direction and no parameter describes, as probable and as large as the poses leave it",
    ),
    (of.AveragedModels(()), "the spread over all that may act, each by its probability"),
    (
        of.AveragedModels(("hysteresis",)),
        "the spread over all that may act, each by its probability; hysteresis may act or not",
    ),
    (
        of.ProbableTemperature(THERMAL, 14.1),
        "temperature_bias and temperature_scale_factor, which are not in the model, by the probability and the size "
        "that the poses leave them; the temperature moved by 14 K from pose to pose",
    ),
    (
        of.UnmodelledTemperature(THERMAL, 14.1, identifiable=False),
        "temperature_bias and temperature_scale_factor not in the model; the temperature moved by 14 K from pose to "
        "pose, but these poses cannot tell what that did",
    ),
    (of.ThermometerAt(25.0), "thermal effects, counted from 25 °C"),
    (
        of.KeptParameters(),
        "scale factors, misalignments and effects are those of the earlier calibration, with its uncertainty",
    ),
    (
        of.ChangedSince(measured=True),
        "what changes from recording to recording, as measured between recordings of this unit: scale factors in full, "
        "biases as the poses leave it",
    ),
    (
        of.ChangedSince(measured=False),
        "what changes from recording to recording, assumed as usual for such units: scale factors in full, biases as "
        "the poses leave it",
    ),
]
REMEDIES: list[tuple[of.Remedy, str]] = [
    (of.LongerOrMorePoses(0.0, 104), "record 104 poses"),
    (of.LongerOrMorePoses(16.0, 104), "hold each pose for 16 s, or record 104 poses (against 1/f noise the latter)"),
    (of.CreepHalved(), "wait before each pose until the outputs creep by half as much"),
    (
        of.CompleteModel(),
        "find what the model lacks (diagnose, and what it advises); more poses, some of them repeated",
    ),
    (of.FittedAnew(), "record a whole set of poses (triaxcal plan) and fit all parameters anew"),
    (of.ReferenceKnown(5e-5), "know the reference to 50.0 µg"),
    (of.FinerRegisters(), "registers with one bit more"),
    (of.HostCorrects(), "correct in the host what the registers cannot hold"),
    (of.ModelsDistinguished(), "record what tells them apart, as advised"),
    (
        of.TemperatureModelled(THERMAL[:1]),
        "take into the model what the residuals come from: temperature_bias, or another effect",
    ),
    (
        of.PosesAtOtherTemperatures(THERMAL[:1]),
        "record more poses, or the same ones again in another order, while the temperature differs, until "
        "temperature_bias can be fitted",
    ),
    (
        of.SteadierTemperature(THERMAL[:1]),
        "hold the temperature twice as steady, or let it swing until temperature_bias can be fitted",
    ),
    (of.TemperatureKnown(0.25), "know the temperature to 0.25 K"),
]
LACKING: list[tuple[of.NotEvaluated, str]] = [
    (of.ReferenceTakenAsExact(), "reference: taken as exact; state its uncertainty, or a latitude and height"),
    (of.TemperatureNotLogged("temp_c"), "temperature: there is no channel temp_c"),
    (of.ThermometerNotStated(), "thermometer: its uncertainty was not stated"),
    (
        of.SingleReading(4.2e-5),
        "lack of fit of a single reading: 42.0 µg cross-validated, of which the budget contains only its effect on the "
        "parameters",
    ),
    (of.PosesWithoutScatter(), "noise: some poses have no scatter inside to tell it from"),
]


@pytest.mark.parametrize(("value", "said"), BASES)
def test_how_a_component_was_found(value: of.Basis, said: str) -> None:
    assert basis(value) == said


@pytest.mark.parametrize(("value", "said"), REMEDIES)
def test_what_would_halve_it(value: of.Remedy, said: str) -> None:
    assert remedy(value) == said


@pytest.mark.parametrize(("value", "said"), LACKING)
def test_what_the_budget_does_not_contain(value: of.NotEvaluated, said: str) -> None:
    assert not_evaluated(value) == said


@pytest.mark.parametrize(("cases", "kinds"), [(BASES, of.Basis), (REMEDIES, of.Remedy), (LACKING, of.NotEvaluated)])
def test_every_kind_has_words(cases: list[tuple[object, str]], kinds: type) -> None:
    assert {type(value) for value, _ in cases} == set(kinds.__subclasses__())


def test_errors_are_told_in_the_unit_of_the_reference() -> None:
    assert remedy(of.ReferenceKnown(0.02), lambda value: f"{value:g} µT") == "know the reference to 0.02 µT"
