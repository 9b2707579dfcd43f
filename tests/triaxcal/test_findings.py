"""What findings and advice say: the numbers are those of the document, and every reason is the one that applies."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.creep import with_creep_left
from triaxcal.effects import effect_named
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.second_order_nonlinearity import SecondOrderNonlinearity
from triaxcal.effects.temperature_bias import TemperatureBias
from triaxcal.effects.warm_up import WarmUp
from triaxcal.findings import description_of
from triaxcal.loop import Loop, diagnose
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
HOLD_S = 10.0
TAU_S = 60.0
SETTLING = WarmUp(TAU_S), np.array([3e-3, -2e-3, 2.5e-3])
BENT = SecondOrderNonlinearity(), np.array([5e-4, -6e-4, 7e-4])
WARM = TemperatureBias(), np.array([2e-4, -1e-4, 1.5e-4])


def creeping(poses: list[Pose], sensor: Sensor) -> list[Pose]:
    """With the change along each pose that a warm-up makes, in its mean's covariance too, as poses of a stream have."""
    out = []
    for p in poses:
        ends = np.exp(-np.array([p.start_s, p.end_s]) / TAU_S)
        creep = sensor.scale_factor * SETTLING[1] * (ends[1] - ends[0])
        out.append(replace(p, creep=creep, covariance=p.covariance + np.outer(creep, creep) / 12))
    return out


@pytest.fixture(scope="module")
def settling(paper_unit: Sensor, twenty_six: np.ndarray) -> Loop:
    rng = np.random.default_rng(0)
    sensor = replace(paper_unit, effects=(SETTLING,))
    poses = noisy_poses(sensor, twenty_six[rng.permutation(26)], SIGMA_G, rng, hold_s=HOLD_S)
    return diagnose(creeping(poses, sensor), signs=MINUS)


@pytest.fixture(scope="module")
def two(paper_unit: Sensor, twenty_six: np.ndarray) -> tuple[list[Pose], Loop]:
    rng = np.random.default_rng(0)
    sensor = replace(paper_unit, effects=(BENT, WARM))
    temp_c = rng.uniform(20, 30, 26)
    where = twenty_six[rng.permutation(26)]
    channels, reference = {"temp_c": temp_c}, {"temp_c": 25.0}
    poses = noisy_poses(sensor, where, SIGMA_G, rng, channels=channels, channel_reference=reference, hold_s=HOLD_S)
    return poses, diagnose(poses, signs=MINUS)


def micro(value: float | None) -> str:
    assert value is not None
    return f"{value * 1e6:.1f} µg"


def told(reason: str) -> list[str]:
    """The errors that a reason names."""
    return re.findall(r"[\d.]+ µg", reason)


def test_the_reason_of_one_effect_has_the_errors_before_and_after_though_poses_creep(settling: Loop) -> None:
    (finding,) = settling.findings
    before, after = settling.before.residual, settling.after.residual
    assert before.noise_floor_g > 2 * after.noise_floor_g  # their creep
    shown = [before.cross_validated_rms_g, after.cross_validated_rms_g, after.noise_floor_g]
    assert told(finding.reason) == [micro(v) for v in shown]
    assert finding.reason.startswith("with it the cross-validated error falls from ")
    assert finding.reason.endswith("familywise p < 1e-12")


def test_the_reason_of_each_of_two_is_what_it_does_beside_the_other(two: tuple[list[Pose], Loop]) -> None:
    poses, loop = two
    assert {f.effect for f in loop.findings} == {BENT[0].name, WARM[0].name}
    after = loop.after.residual
    left = with_creep_left(poses, loop.after)
    for finding in loop.findings:
        others = [e for e, _ in loop.after.sensor.effects if e.name != finding.effect]
        without = fit(left, signs=MINUS, effects=others, aside=()).residual.cross_validated_rms_g
        shown = [without, after.cross_validated_rms_g, after.noise_floor_g]
        assert told(finding.reason) == [micro(v) for v in shown]
        assert finding.reason.startswith("with it, beside the other effect, the cross-validated error falls from ")
    # What the last one begins with is the model with all before it, whose residual is that of the finding before.
    first, last = loop.findings
    assert told(last.reason)[0] == micro(first.step.residual.cross_validated_rms_g)


def test_a_warm_up_says_from_when_on_it_is_below_the_noise(settling: Loop) -> None:
    (finding,) = settling.findings
    minutes = re.search(r"below the noise floor from (\d+) minutes after the first sample on", finding.remedy)
    assert minutes
    # 3 mg that fall by e every 60 s to the 15 µg or so of a pose.
    assert int(minutes[1]) == np.ceil(TAU_S * np.log(3e-3 / settling.after.residual.noise_floor_g) / 60)
    assert settling.advice[0] == f"warm_up: {finding.remedy}"


def test_a_warm_up_below_the_noise_floor_says_no_time() -> None:
    assert WarmUp(60.0).advice(1e-5, 2e-5) == WarmUp().remedy
    assert WarmUp(60.0).advice(1e-5, 0.0) == WarmUp().remedy
    assert "from 97 s after" in WarmUp(60.0).advice(-1e-4, 2e-5)  # 60 ln 5 = 96.6


@pytest.mark.parametrize(
    ("name", "steady"),
    [
        ("temperature_bias", "±0.2 K"),
        ("temperature_scale_factor", "±0.2 K"),
        ("thermal_gradient", "±0.2 K/s"),
        ("channel_bias:supply_v", "±0.2 [supply_v]"),
        ("channel_scale_factor:supply_v", "±0.2 [supply_v]"),
    ],
)
def test_what_goes_with_a_channel_says_how_steady_is_steady_enough(name: str, steady: str) -> None:
    effect = effect_named(name)
    advice = effect.advice(-1e-4, 2e-5)
    assert advice == f"{effect.remedy} Within {steady} what it does is below the noise floor."
    assert effect.advice(-1e-4, 0.0) == effect.advice(0.0, 2e-5) == effect.remedy


@pytest.mark.parametrize("reference", [1.0, 48.0])
def test_how_steady_a_temperature_must_be_does_not_hang_on_the_units_of_the_reference(
    paper_unit: Sensor, twenty_six: np.ndarray, reference: float
) -> None:
    effect, coefficients = effect_named("temperature_scale_factor"), np.array([1e-3, -5e-4, 2e-4])
    unit = replace(paper_unit, bias=paper_unit.bias * reference, effects=((effect, coefficients),))
    temp_c = 25 + 3 * np.sin(0.9 * np.arange(26))
    rng = np.random.default_rng(0)
    poses = noisy_poses(
        unit,
        reference * twenty_six,
        1.5e-5 * reference,
        rng,
        channels={"temp_c": temp_c},
        channel_reference={"temp_c": 25.0},
    )
    (finding,) = diagnose(poses, signs=MINUS, reference=reference).findings
    assert finding.effect == effect.name
    assert "Within ±0.015 K " in finding.remedy  # 15 µg of 1 g by 1e-3 / K


BLIND = "these poses cannot show in full "


def blind(poses: list[Pose]) -> dict[str, str]:
    """Reason by effect."""
    lines = [line.removeprefix(BLIND) for line in diagnose(poses, signs=MINUS).advice if line.startswith(BLIND)]
    split = [line.split(": ", 1) for line in lines]
    return {name: why for names, why in split for name in names.split(", ")}


def test_every_effect_that_poses_are_blind_to_has_its_own_reason(
    paper_unit: Sensor, fourteen: np.ndarray, twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(1)
    few, many = (noisy_poses(paper_unit, up, SIGMA_G, rng, hold_s=HOLD_S) for up in (fourteen, twenty_six))
    directions = "the poses point in too few directions"
    unlogged = "channel temp_c is not logged"
    seen = blind(few)
    assert seen["third_order_nonlinearity"] == seen["cross_coupling"] == directions
    assert seen["temperature_bias"] == seen["temperature_scale_factor"] == seen["thermal_gradient"] == unlogged
    assert seen["vibration_rectification"] == "the readings scatter alike in all poses"
    assert directions not in blind(many).values()
    at_rest = [replace(p, channels={"temp_c": 25.0}, rates={"temp_c": 0.0}) for p in many]
    seen = blind(at_rest)
    assert seen["temperature_bias"] == seen["temperature_bias_quadratic"] == "temp_c stood still"
    assert seen["thermal_gradient"] == "temp_c changes no faster in one pose than in another"
    with_one_less = [at_rest[0], *(replace(p, channels={}, rates={}) for p in at_rest[1:])]
    assert blind(with_one_less)["temperature_bias"] == f"{unlogged} in every pose"


def test_what_moves_with_the_directions_alone_is_not_called_still(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """A temperature that is one thing in one pose, and another in all others."""
    poses = noisy_poses(paper_unit, fourteen, SIGMA_G, np.random.default_rng(2), hold_s=HOLD_S)
    moved = [replace(p, channels={"temp_c": 30.0 if i == 3 else 25.0}) for i, p in enumerate(poses)]
    assert blind(moved)["temperature_bias"] == "too few poses, or what it goes with moved along with their directions"


def test_blind_to_has_the_same_names_as_the_advice(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, fourteen, SIGMA_G, np.random.default_rng(3), hold_s=HOLD_S)
    assert set(blind(poses)) == set(diagnose(poses, signs=MINUS).after.blind_to)


def test_the_p_of_the_empirical_term_is_that_of_the_test_that_let_it_in(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, SIGMA_G, np.random.default_rng(4), hold_s=HOLD_S)
    without, smooth = (fit(poses, signs=MINUS, effects=effects) for effects in ([], Empirical().forms[:1]))
    assert description_of(smooth, without, 0.0042).p_value == 0.0042
