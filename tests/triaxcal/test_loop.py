"""A hidden effect is named, first and alone; nothing is named where nothing is hidden or the truth is not listed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import CATALOGUE, TIME, Coefficient, effect_named
from triaxcal.errors import InvalidData, Refused
from triaxcal.fit import fit
from triaxcal.loop import Loop, diagnose
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
SEEDS = 20
HOLD_S = 10.0
# Each coefficient at least eight standard errors, on the 26 poses.
SIZES = {
    "second_order_nonlinearity": 2e-4,
    "third_order_nonlinearity": 3e-4,
    "temperature_bias": 5e-5,
    "temperature_bias_quadratic": 4e-5,
    "temperature_scale_factor": 5e-5,
    "bias_drift": 1e-6,
}
Make = Callable[..., Sensor]


def temperature(rng: np.random.Generator, n: int = 26) -> np.ndarray:
    """Wanders by a few kelvin, not along with time."""
    t = np.arange(n)
    return 25 + 4 * np.sin(0.9 * t + rng.uniform(0, 6)) + rng.standard_normal(n)


def poses_of(
    sensor: Sensor, directions: np.ndarray, rng: np.random.Generator, temp_c: np.ndarray | None = None
) -> list[Pose]:
    """Shuffled poses; time counts from the middle of the recording, temperature from 25 °C."""
    n = len(directions)
    return noisy_poses(
        sensor,
        directions[rng.permutation(n)],
        SIGMA_G,
        rng,
        channels={"temp_c": temperature(rng, n) if temp_c is None else temp_c},
        channel_reference={"temp_c": 25.0, TIME: n * HOLD_S / 2},
        hold_s=HOLD_S,
    )


def names(loop: Loop) -> list[str]:
    return [f.effect for f in loop.findings]


def hidden(name: str, rng: np.random.Generator) -> list[float]:
    count = len(effect_named(name).coefficients)
    return (SIZES[name] * rng.choice([-1, 1], count) * rng.uniform(1.0, 1.5, count)).tolist()


def referred(name: str, q: list[float], loop: Loop) -> np.ndarray:
    """The hidden coefficients as they are about the reference that the loop took."""
    out = np.array(q)
    if name == "temperature_bias_quadratic":
        out[:3] += 2 * out[3:] * (loop.after.channel_reference["temp_c"] - 25.0)
    return out


@pytest.mark.parametrize("name", SIZES)
def test_a_hidden_effect_is_named_first_and_alone_and_measured_within_its_errors(
    name: str, with_effects: Make, twenty_six: np.ndarray
) -> None:
    alone, pulls = 0, []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        q = hidden(name, rng)
        loop = diagnose(poses_of(with_effects(**{name: q}), twenty_six, rng), signs=MINUS)
        assert names(loop)[0] == name
        first = loop.findings[0]
        assert (first.verdict, first.alternatives) == ("adopted", ())
        assert first.p_value < 1e-4
        alone += names(loop) == [name]
        found = np.array([(value, error) for value, error, _ in first.coefficients.values()])
        pulls += ((found[:, 0] - referred(name, q, loop)) / found[:, 1]).tolist()
        assert np.all(np.abs(found[:, 0]) > 5 * found[:, 1]) or name == "temperature_bias_quadratic"
        assert loop.after.terms == ("linear", *names(loop))
        assert loop.after.residual.rms_g < loop.before.residual.rms_g / 2
        assert any(name in a for a in loop.advice)
    # A second, false name comes with a probability of about 1 %: more than two of 20 would be 1 in 1000.
    assert alone >= SEEDS - 2
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], len(pulls))
    assert low < np.sum(np.square(pulls)) < high


def test_nothing_hidden_is_nothing_found_in_98_of_100_recordings(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    runs, false, unexplained = 200, 0, 0
    for seed in range(runs):
        loop = diagnose(poses_of(paper_unit, twenty_six, np.random.default_rng(seed)), signs=MINUS)
        false += bool(loop.findings)
        unexplained += loop.unexplained.significant
        if not loop.findings:
            assert loop.after.terms == ("linear",)
    # Both are declared at 1 %.
    assert false <= 0.02 * runs
    assert unexplained <= stats.binom.isf(1e-3, runs, 0.01)


@pytest.mark.parametrize("truth", ["temperature_bias", "bias_drift"])
def test_temperature_that_rises_steadily_with_time_cannot_be_told_from_drift(
    truth: str, with_effects: Make, twenty_six: np.ndarray
) -> None:
    both = {"temperature_bias", "bias_drift"}
    t_s = (np.arange(26) + 0.5) * HOLD_S
    for seed in range(10):
        rng = np.random.default_rng(seed)
        sensor = with_effects(**{truth: hidden(truth, rng)})
        loop = diagnose(poses_of(sensor, twenty_six, rng, temp_c=20 + 0.02 * t_s), signs=MINUS)
        (finding,) = loop.findings
        assert finding.effect in both
        assert finding.verdict == "confounded"
        assert both - {finding.effect} <= set(finding.alternatives)
        assert any("cannot be told from" in a for a in loop.advice)


def test_fourteen_poses_are_blind_to_the_third_order(with_effects: Make, fourteen: np.ndarray) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        sensor = with_effects(third_order_nonlinearity=hidden("third_order_nonlinearity", rng))
        loop = diagnose(poses_of(sensor, fourteen, rng), signs=MINUS)
        assert "third_order_nonlinearity" in loop.before.blind_to
        assert "third_order_nonlinearity" in loop.after.blind_to
        assert "third_order_nonlinearity" not in names(loop)
        assert any("cannot show" in a and "third_order_nonlinearity" in a for a in loop.advice)


def test_fourteen_poses_show_the_second_order(with_effects: Make, fourteen: np.ndarray) -> None:
    sensor = with_effects(second_order_nonlinearity=[2e-4, -3e-4, 2.5e-4])
    found = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        poses = noisy_poses(sensor, fourteen[rng.permutation(14)], SIGMA_G, rng)
        loop = diagnose(poses, signs=MINUS)
        found += [(f.effect, f.verdict) for f in loop.findings] == [("second_order_nonlinearity", "adopted")]
        assert "temperature_bias" in loop.after.blind_to
    # Two degrees of freedom are left: now and then leaving one pose out does not confirm it.
    assert found >= SEEDS - 2


def test_poses_taken_faces_first_cannot_tell_the_second_order_from_drift_and_say_so(
    with_effects: Make, fourteen: np.ndarray
) -> None:
    sensor = with_effects(second_order_nonlinearity=[2e-4, -3e-4, 2.5e-4])
    both = {"second_order_nonlinearity", "bias_drift"}
    for seed in range(6):
        loop = diagnose(noisy_poses(sensor, fourteen, SIGMA_G, np.random.default_rng(seed)), signs=MINUS)
        (finding,) = loop.findings
        if finding.verdict == "adopted":
            assert finding.effect == "second_order_nonlinearity"
        else:
            assert {finding.effect, *finding.alternatives} == both


@pytest.mark.parametrize("order", ["shuffled", "from top to bottom", "face by face"])
def test_drift_does_not_pass_as_nonlinearity(order: str, with_effects: Make, twenty_six: np.ndarray) -> None:
    found = 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        sensor = with_effects(bias_drift=hidden("bias_drift", rng))
        where = {
            "shuffled": twenty_six[rng.permutation(26)],
            "from top to bottom": twenty_six[np.argsort(-twenty_six[:, 2], kind="stable")],
            "face by face": twenty_six,
        }[order]
        loop = diagnose(noisy_poses(sensor, where, SIGMA_G, rng, channel_reference={TIME: 130.0}), signs=MINUS)
        assert not [f for f in loop.findings if f.verdict == "adopted" and f.effect != "bias_drift"]
        found += any("bias_drift" in (f.effect, *f.alternatives) for f in loop.findings)
    # Poses that go from top to bottom hide much of a drift in scale factor and bias.
    assert found >= (SEEDS if order == "shuffled" else SEEDS // 2)


@dataclass(frozen=True)
class Wave:
    """An effect that the catalogue does not know: a ripple along the range."""

    name: str = "ripple"
    coefficients: tuple[Coefficient, ...] = (Coefficient("height", "g"),)
    needs: tuple[str, ...] = ()
    remedy: str = ""

    def basis(self, s: np.ndarray, conditions: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.sin(25 * s)[..., None]

    def slope(self, s: np.ndarray, conditions: Mapping[str, np.ndarray]) -> np.ndarray:
        return (25 * np.cos(25 * s)[..., None] * np.eye(3))[..., None]


@pytest.mark.parametrize("count", [26, 60])
def test_an_effect_outside_the_catalogue_is_left_unexplained_and_gets_no_wrong_name(
    count: int, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    sensor = replace(paper_unit, effects=((Wave(), np.array([2e-4])),))
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        v = rng.standard_normal((count, 3))
        where = twenty_six if count == 26 else v / np.linalg.norm(v, axis=1, keepdims=True)
        loop = diagnose(poses_of(sensor, where, rng), signs=MINUS)
        assert loop.unexplained.significant
        assert loop.unexplained.p_value is not None
        assert loop.unexplained.p_value < 0.01
        assert loop.unexplained.rms_g > SIGMA_G
        assert loop.unexplained.lead
        assert not [f.effect for f in loop.findings if f.verdict == "adopted"]


def test_an_effect_added_to_the_catalogue_is_found_like_any_other(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    sensor = replace(paper_unit, effects=((Wave(), np.array([2e-4])),))
    rng = np.random.default_rng(0)
    loop = diagnose(poses_of(sensor, twenty_six, rng), signs=MINUS, catalogue=(*CATALOGUE, Wave()))
    assert names(loop) == ["ripple"]
    value, error, unit = loop.findings[0].coefficients["height"]
    assert value == pytest.approx(2e-4, abs=4 * error)
    assert unit == "g"
    assert not loop.unexplained.significant


PAIRS = [
    ("second_order_nonlinearity", "temperature_bias"),
    ("third_order_nonlinearity", "bias_drift"),
    ("second_order_nonlinearity", "temperature_scale_factor"),
]


@pytest.mark.parametrize("pair", PAIRS, ids=" and ".join)
def test_two_effects_at_once_are_both_found(pair: tuple[str, str], with_effects: Make, twenty_six: np.ndarray) -> None:
    exactly, runs = 0, 10
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        sensor = with_effects(**{name: hidden(name, rng) for name in pair})
        loop = diagnose(poses_of(sensor, twenty_six, rng), signs=MINUS)
        exactly += set(names(loop)) == set(pair) and all(f.verdict == "adopted" for f in loop.findings)
        assert not loop.unexplained.significant
    assert exactly >= runs - 2


def test_held_out_poses_of_another_recording_come_out_near_the_noise_floor(
    with_effects: Make, twenty_six: np.ndarray
) -> None:
    sensor = with_effects(second_order_nonlinearity=[4e-4, -5e-4, 6e-4])
    after, before = [], []
    for seed in range(10):
        rng, other = np.random.default_rng(seed), np.random.default_rng(1000 + seed)
        v = other.standard_normal((40, 3))
        check = poses_of(sensor, v / np.linalg.norm(v, axis=1, keepdims=True), other)
        held_out = diagnose(poses_of(sensor, twenty_six, rng), signs=MINUS, check=check).held_out
        assert held_out is not None
        assert held_out.poses == 40
        assert held_out.noise_floor_g == pytest.approx(SIGMA_G, rel=0.02)
        after.append(held_out.after_rms_g)
        before.append(held_out.before_rms_g)
    # The noise of the check poses, and that of twelve parameters from 26 poses on top.
    assert SIGMA_G < np.mean(after) < SIGMA_G * np.sqrt(1 + 12 / 26) * 1.15
    assert np.mean(before) > 3 * np.mean(after)


def test_check_poses_without_the_channel_that_was_needed_are_refused_by_name(
    with_effects: Make, twenty_six: np.ndarray
) -> None:
    sensor = with_effects(temperature_bias=[1e-4, -1e-4, 1e-4])
    poses = poses_of(sensor, twenty_six, np.random.default_rng(0))
    with pytest.raises(InvalidData, match="temp_c"):
        diagnose(poses, signs=MINUS, check=[replace(p, channels={}) for p in poses])
    with pytest.raises(InvalidData, match="no still pose"):
        diagnose(poses, signs=MINUS, check=[])


def test_a_single_bad_pose_is_left_out_and_no_effect_is_made_of_it(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    for seed in range(10):
        poses = noisy_poses(paper_unit, twenty_six, SIGMA_G, np.random.default_rng(seed))
        bad = 4 + seed
        along = 40 * SIGMA_G * twenty_six[bad] * paper_unit.scale_factor
        poses[bad] = replace(poses[bad], mean=poses[bad].mean + along)
        loop = diagnose(poses, signs=MINUS)
        assert [i for i, p in enumerate(loop.after.poses) if not p.used] == [bad]
        assert f"at {poses[bad].start_s:.1f} s" in loop.after.warnings[0]
        assert not loop.findings
        assert not loop.unexplained.significant


def test_the_linear_result_of_the_loop_is_the_fit_s(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = poses_of(paper_unit, twenty_six, np.random.default_rng(1))
    loop = diagnose(poses, signs=MINUS)
    assert np.array_equal(loop.before.values, fit(poses, signs=MINUS).values)
    assert loop.held_out is None


def test_the_loop_refuses_as_the_fit_does(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, np.tile(fourteen[:6], (4, 1)), SIGMA_G, np.random.default_rng(0))
    with pytest.raises(Refused, match="6 distinct directions"):
        diagnose(poses, signs=MINUS)
