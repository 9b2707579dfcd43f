"""What no effect explains: its size, and a lead that says where to look; patterns made by hand along the measured
vector, in a fit of nine parameters."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from triaxcal.calibration import Calibration
from triaxcal.effects import Effect
from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.effects.empirical import Empirical
from triaxcal.leads import Lead
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Began
from triaxcal.search import Nearest
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.unexplained import Unexplained, lead, or_named, spoiled_or, unexplained_of

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
N = 40
HOLD_S = 10.0
CHANNEL = np.random.default_rng(77).standard_normal(N)
Fitted = Callable[..., Calibration]


@pytest.fixture(scope="module")
def ups() -> np.ndarray:
    v = np.random.default_rng(4).standard_normal((N, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def fitted(paper_unit: Sensor, ups: np.ndarray) -> Fitted:
    """The fit of the linear model, or one with effects, to poses whose outputs are off by ``off_g`` (n,3)."""

    def make(off_g: np.ndarray, seed: int = 0, effects: Sequence[Effect] = ()) -> Calibration:
        rng = np.random.default_rng(seed)
        poses = noisy_poses(paper_unit, ups, SIGMA_G, rng, channels={"supply_v": 5 + 0.1 * CHANNEL}, hold_s=HOLD_S)
        moved = [replace(p, mean=p.mean + paper_unit.scale_factor * e) for p, e in zip(poses, off_g, strict=True)]
        return fit(moved, signs=MINUS, aside=(), effects=effects)

    return make


def told(*given: Any) -> str:
    return lead(*given).text


def radial(ups: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.asarray(ups * (size * SIGMA_G / np.std(size))[:, None])


TIME = (np.arange(N) + 0.5) * HOLD_S


def test_noise_alone_is_nothing_left(fitted: Fitted) -> None:
    c = fitted(np.zeros((N, 3)))
    left = unexplained_of(c, {})
    assert left == Unexplained(False, c.residual.lack_of_fit_p, left.rms_g, "")
    assert left.rms_g < SIGMA_G


def test_the_size_is_what_is_there_beyond_noise(fitted: Fitted, ups: np.ndarray) -> None:
    """Twelve standard errors of a harmonic of degree 4, of which the nine parameters absorb nothing."""
    x, y, z = ups.T
    size = x * y * (6 * z**2 - x**2 - y**2)
    left = unexplained_of(fitted(12 * radial(ups, size)), {})
    assert left.significant
    assert left.p_value is not None
    assert left.p_value < 1e-12
    assert left.rms_g == pytest.approx(12 * SIGMA_G, rel=0.2)


def test_poses_left_out_or_an_effect_are_what_is_left_unless_the_others_leave_more(
    fitted: Fitted, ups: np.ndarray
) -> None:
    one = np.zeros(N)
    one[7] = 1.0
    whole = fitted(radial(ups, one) * 20)
    off, names = [whole.poses[7]], ["bias_step", "hysteresis"]
    clean, more = (unexplained_of(fitted(size * radial(ups, np.sin(TIME / 7))), {}) for size in (0.0, 12.0))
    doubt = "spoiled, or it is bias_step or hysteresis, which would explain as much"
    open_ = spoiled_or(whole, 1e-9, off, names, clean)
    assert open_.or_spoiled
    assert open_.p_value == 1e-9
    assert open_.lead.startswith("most of it is the pose at 70.0 s (+")
    assert open_.lead.endswith(f": {doubt}")
    besides = spoiled_or(whole, 1e-9, off, names, more)
    assert not besides.or_spoiled
    assert besides.lead.startswith(f"{more.lead}; besides, left out is the pose at 70.0 s (+")
    assert besides.lead.endswith(f": {doubt}")
    assert (besides.p_value, besides.rms_g) == (more.p_value, more.rms_g)


def test_what_is_named_may_be_none_of_it_where_others_would_do_as_well(fitted: Fitted, ups: np.ndarray) -> None:
    """The size is that of what the effects were found for."""
    before = fitted(12 * radial(ups, np.sin(TIME / 7)))
    moving = Unexplained(True, 1e-5, SIGMA_G, "inside the poses |a| moves", only_inside=True)
    chance = or_named(before, 1e-9, {"warm_up": 0.08, "bias_step": 0.02}, [], moving)
    poses = or_named(before, 1e-9, {}, [Began(70.0), Began(80.0)])
    assert (chance.significant, chance.or_named, chance.p_value) == (True, True, 1e-9)
    assert chance.rms_g == unexplained_of(before, {}).rms_g
    assert chance.lead.startswith("it need not be warm_up or bias_step: of random errors as large as these ")
    assert chance.lead.endswith(" with a probability of 0.08 and 0.02 (limit 0.01); inside the poses |a| moves")
    assert (
        poses.lead == "that something spoiled the pose at 70.0 s and the pose at 80.0 s would do as well as any effect"
    )


def odd(ups: np.ndarray) -> np.ndarray:
    x, y, z = ups.T
    return radial(ups, x * y * z + 0.3 * x * (5 * z**2 - 1))


def even(ups: np.ndarray) -> np.ndarray:
    x, y, z = ups.T
    return radial(ups, x**4 + y**4 + z**4 - 0.6)


def swing(ups: np.ndarray) -> np.ndarray:
    return radial(ups, np.sin(2 * np.pi * TIME / 95.0 + 0.4))


def bias_swing(ups: np.ndarray) -> np.ndarray:
    """On each axis with a phase of its own."""
    angle = 2 * np.pi * TIME[:, None] / 95.0 + np.array([0.4, 2.0, 4.0])
    return np.asarray(1.5 * SIGMA_G * np.sin(angle) * np.array([1.0, -1.2, 0.8]))


def by_channel(ups: np.ndarray) -> np.ndarray:
    return radial(ups, CHANNEL)


def bias_by_channel(ups: np.ndarray) -> np.ndarray:
    return np.asarray(1.5 * SIGMA_G * CHANNEL[:, None] * np.array([1.0, -1.0, 0.5]))


def wave(ups: np.ndarray) -> np.ndarray:
    """The error of a converter along one output."""
    return np.asarray(1.5 * SIGMA_G * np.sin(2 * np.pi * ups[:, 1:2] / 0.33 + 0.7) * [0.0, 1.0, 0.0])


def waves(ups: np.ndarray) -> np.ndarray:
    """The same of all three."""
    return np.asarray(1.5 * SIGMA_G * np.sin(2 * np.pi * ups / 0.43 + np.array([0.7, 1.5, 3.0])))


@pytest.mark.parametrize(
    ("pattern", "words", "towards"),
    [
        (odd, "an odd pattern on the sphere", "take some directions again at another azimuth"),
        (even, "an even pattern on the sphere", "take some directions again at another azimuth"),
        (swing, "a swing in time with a period of ", "log what may go up and down about every "),
        (bias_swing, " s, as a bias", "log what may go up and down about every "),
        (waves, "a wave along the output of every axis, 0.4", "or tilt an axis in steps of much less than 0.4"),
        (by_channel, "supply_v", "take the same poses again while supply_v goes another way"),
        (bias_by_channel, "supply_v, as a bias", "take the same poses again while supply_v goes another way"),
        (wave, "a wave along the output of axis y, ", "or tilt axis y in steps of much less than 0.3"),
    ],
)
def test_the_lead_is_the_pattern_that_is_there_and_points_to_what_would_tell_more(
    pattern: Callable[[np.ndarray], np.ndarray], words: str, towards: str, fitted: Fitted, ups: np.ndarray
) -> None:
    for seed in range(2):
        left = unexplained_of(fitted(12 * pattern(ups), seed), {})
        assert left.significant
        first = left.lead.split("; ")[0]
        assert words in first, left.lead
        assert int(first.split("%")[0]) > 60
        assert towards in left.towards


def test_the_period_of_a_swing_and_the_length_of_a_wave_are_near_those_that_are_there(
    fitted: Fitted, ups: np.ndarray
) -> None:
    period = float(told(fitted(12 * swing(ups)), {}).split("a period of ")[1].split()[0])
    assert period == pytest.approx(95.0, rel=0.1)
    length = float(told(fitted(12 * wave(ups)), {}).split("axis y, ")[1].split()[0])
    assert length == pytest.approx(0.33, rel=0.1)


def test_one_pose_that_was_not_still_is_named_by_its_time(fitted: Fitted, ups: np.ndarray) -> None:
    for i in (0, 17, 39):
        off = np.zeros((N, 3))
        off[i] = 40 * SIGMA_G * ups[i]
        found = lead(fitted(off), {})
        text = found.text
        assert f"take the pose at {i * HOLD_S:.1f} s again" in found.towards
        assert text.startswith(f"most of it is one pose, at {i * HOLD_S:.1f} s (+")
        assert "was it still?" in text


def test_where_nothing_stands_out_nothing_is_made_up(fitted: Fitted, ups: np.ndarray) -> None:
    """Every pose off by an amount of its own: of 100 a lead is declared for one, by chance."""
    runs, leads = 24, 0
    for seed in range(runs):
        rng = np.random.default_rng(1000 + seed)
        text = told(fitted(8 * SIGMA_G * ups * rng.standard_normal((N, 1)), seed), {})
        leads += text != "no candidate comes near, and no pose, pattern or channel stands out"
    # binom.isf(2e-3, 24, 0.01)
    assert leads <= 2


MANY: list[Sequence[Effect]] = [[BiasDrift(3)], [Empirical("even")], [BiasDrift(3), Empirical("even")]]


@pytest.mark.parametrize("effects", MANY, ids=lambda e: len(e))
@pytest.mark.parametrize(
    ("pattern", "words"),
    [(odd, "an odd pattern"), (by_channel, "supply_v"), (wave, "a wave along the output of axis y")],
)
def test_beside_effects_in_the_model_the_lead_is_what_they_leave(
    pattern: Callable[[np.ndarray], np.ndarray],
    words: str,
    effects: Sequence[Effect],
    fitted: Fitted,
    ups: np.ndarray,
) -> None:
    """They absorb a part of every pattern, as the nine parameters do."""
    first = told(fitted(12 * pattern(ups), 0, effects), {}).split("; ")[0]
    assert words in first
    assert int(first.split("%")[0]) > 95


def test_beside_effects_in_the_model_nothing_is_made_up(fitted: Fitted, ups: np.ndarray) -> None:
    effects = [BiasDrift(3), Empirical("even")]
    runs, leads = 20, 0
    for seed in range(runs):
        off = 8 * SIGMA_G * ups * np.random.default_rng(1000 + seed).standard_normal((N, 1))
        leads += "goes with" in told(fitted(off, seed, effects), {})
    # binom.isf(1e-3, 20, 0.01)
    assert leads <= 3


def test_effects_that_came_near_are_told_with_their_reasons(fitted: Fitted, ups: np.ndarray) -> None:
    rng = np.random.default_rng(1000)
    c = fitted(8 * SIGMA_G * ups * rng.standard_normal((N, 1)))
    text = told(c, {"warm_up": "p 0.02", "hysteresis": "the poses cannot carry it", "bias_step": "p 0.03"})
    assert "the nearest effect is warm_up, not adopted: p 0.02" in text
    assert "hysteresis, not adopted: the poses cannot carry it" in text
    assert "bias_step" not in text


def test_what_chance_may_well_have_done_is_no_lead(fitted: Fitted, ups: np.ndarray) -> None:
    rng = np.random.default_rng(1000)
    c = fitted(8 * SIGMA_G * ups * rng.standard_normal((N, 1)))
    text = told(c, {"warm_up": "p 1", "hysteresis": "p 0.2", "bias_step": "p 0.04"})
    assert text == "the nearest effect is bias_step, not adopted: p 0.04"
    assert told(c, {"warm_up": "p 1"}) == "no candidate comes near, and no pose, pattern or channel stands out"


def test_numbers_of_a_lead_have_no_exponent(fitted: Fitted, ups: np.ndarray) -> None:
    off = np.zeros((N, 3))
    off[3] = 4e-3 * ups[3]
    text = told(fitted(off), {}, Nearest("warm_up", 0.0))
    found = re.match(r"most of it is one pose, at 30.0 s \(\+(\d{4})\.\d µg\)", text)
    assert found, text
    assert 3000 < int(found[1]) < 4000
    assert "warm_up, not adopted: p < 1e-12, but" in text


def test_a_channel_that_stands_still_is_no_lead(paper_unit: Sensor, ups: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    poses = noisy_poses(paper_unit, ups, SIGMA_G, rng, channels={"supply_v": np.full(N, 5.0)})
    x, y, z = ups.T
    off = 12 * radial(ups, x * y * z)
    moved = [replace(p, mean=p.mean + paper_unit.scale_factor * e) for p, e in zip(poses, off, strict=True)]
    text = told(fit(moved, signs=MINUS, aside=()), {})
    assert "an odd pattern" in text
    assert "supply_v" not in text


def test_the_rate_of_a_channel_is_told_in_words_and_the_length_of_a_wave_in_the_references_unit(
    paper_unit: Sensor, ups: np.ndarray
) -> None:
    rng, rate = np.random.default_rng(0), np.random.default_rng(3).standard_normal(N)

    def off(e: np.ndarray, reference: float = 1.0) -> Lead:
        poses = noisy_poses(paper_unit, ups, SIGMA_G, rng, channels={"temp_c": 20 + CHANNEL}, hold_s=HOLD_S)
        moved = [
            replace(p, mean=p.mean + paper_unit.scale_factor * v, rates={"temp_c": float(r)})
            for p, v, r in zip(poses, e, rate, strict=True)
        ]
        return lead(fit(moved, signs=MINUS, aside=(), reference=reference), {})

    found = off(12 * radial(ups, rate))
    assert "goes with how fast temp_c changes" in found.text
    assert "take the same poses again while temp_c changes at another rate" in found.towards
    of_field = off(12 * wave(ups), reference=50.0)
    assert re.search(r"a wave along the output of axis y, 0\.3\d of the reference long", of_field.text)
    assert re.search(r"in steps of much less than 0\.3\d of the reference: ", of_field.towards)
