"""The generator is itself judged: by hand-computed forces, by Monte Carlo, and by a fit of scipy's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from tests.undeclared import invented_later, physics, uncatalogued
from tests.undeclared.generator import KINDS, LARGEST_G, Recording, recording
from tests.undeclared.imitation import best_imitation
from tests.undeclared.noise import Noise, Shaking
from tests.undeclared.physics import Effect
from tests.undeclared.scene import Scene, Triad, as_mounted, attitudes, cube, scene
from tests.undeclared.told import told_errors_g
from tests.undeclared.visible import Linear, magnitude, nine_of, told_power

SQUARE = Triad(np.array([2.0, -3.0, 4.0]), np.zeros(3), np.array([0.01, -0.02, 0.03]))
UPS = np.array([[1.0, 0, 0], [0, 0, -1.0], [0.6, 0.8, 0], [0, -0.6, 0.8], [0.0, 1.0, 0]])
CERTAIN = 4.5
"""Standard deviations that chance does not reach."""


def by_hand(seed: int = 0, shaken: bool = False) -> Scene:
    """Five poses; temperature 20 °C and 0.1 °C/s more, a supply that stays at 5.1 V."""
    histories = {
        "temp_c": lambda t: (20 + 0.1 * t, np.full(len(t), 0.1)),
        "supply_v": lambda t: (np.full(len(t), 5.1), np.zeros(len(t))),
    }
    return scene(np.random.default_rng(seed), SQUARE, UPS, 100.0, histories, shaken=shaken)


def with_all_axes(kind: str, here: Scene, **told: str) -> Effect:
    """The first draw that has a coefficient on each axis, one each; ``told`` is a word that its text has."""
    for seed in range(200):
        e = physics.drawn(np.random.default_rng(seed), kind, here, "supply_v")
        if len(e.coefficients) == 3 and told.get("text", "") in e.text:
            return replace(e, coefficients=np.ones(3))
    raise AssertionError(kind)


def pose_means(e: Effect, here: Scene) -> np.ndarray:
    return here.by_pose(e.added(here))


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("second_order_nonlinearity", [0.36, 0.64, 0]),
        ("third_order_nonlinearity", [0.216, 0.512, 0]),
        ("scale_factor_asymmetry", [0.3, 0.4, 0]),
    ],
)
def test_nonlinearity_is_that_of_the_force_along_each_axis(kind: str, expected: list[float]) -> None:
    here = by_hand()
    assert pose_means(with_all_axes(kind, here), here)[2] == pytest.approx(expected)


def test_asymmetry_adds_half_the_difference_on_either_side() -> None:
    here = by_hand()
    added = pose_means(with_all_axes("scale_factor_asymmetry", here), here)
    assert added[0] == pytest.approx([0.5, 0, 0])
    assert added[1] == pytest.approx([0, 0, 0.5])


def test_cross_coupling_is_the_product_of_two_axes() -> None:
    here = by_hand()
    for text, pose, expected in [("Kip,", 2, [0.48, 0, 0]), ("Kio,", 2, [0, 0.48, 0]), ("Kpo,", 2, [0, 0, 0.48])]:
        assert pose_means(with_all_axes("cross_coupling", here, text=text), here)[pose] == pytest.approx(expected)


def test_temperature_counts_at_the_time_of_the_sample() -> None:
    here = by_hand()
    middle = (here.begin + here.end - 1) / 2 / here.rate_hz
    bias = pose_means(with_all_axes("temperature_bias", here), here)
    assert bias == pytest.approx(0.1 * middle[:, None] * np.ones(3))
    assert pose_means(with_all_axes("thermal_gradient", here), here) == pytest.approx(0.1)
    scale = with_all_axes("temperature_scale_factor", here)
    vertex = float(scale.text.split("− ")[1].split(" °C")[0])
    assert pose_means(scale, here)[2] == pytest.approx((20 + 0.1 * middle[2] - vertex) * UPS[2], abs=0.01)


def test_a_channel_counts_from_its_usual_value() -> None:
    here = by_hand()
    assert pose_means(with_all_axes("channel_bias", here), here) == pytest.approx(0.1)


def test_drift_warm_up_and_step_go_with_time_alone() -> None:
    here = by_hand()
    end = here.t_s[-1]
    straight = with_all_axes("bias_drift", here, text="straight").added(here)
    assert straight[-1] == pytest.approx(1.0)
    assert straight[len(straight) // 2] == pytest.approx(0.5, abs=1e-3)
    warm = with_all_axes("warm_up", here)
    tau = float(warm.text.split("/ ")[1].split(" s")[0])
    assert warm.added(here)[-1] == pytest.approx(np.exp(-end / tau), rel=0.1)
    for where in ("inside", "before"):
        step = with_all_axes("bias_step", here, text=where).added(here)[:, 0]
        at = int(np.argmax(step))
        assert set(step) == {0.0, 1.0}
        assert bool(here.still[at]) is (where == "inside")
        assert np.sum(here.end <= at) >= 2
        assert np.sum(here.begin > at) >= 2


def test_hysteresis_remembers_the_pose_before() -> None:
    here = by_hand()
    sign = pose_means(with_all_axes("hysteresis", here, text="sign"), here)
    assert sign == pytest.approx(np.array([[0, 0, 0], [-1, 0, -1], [1, 1, 1], [-1, -1, 1], [0, 1, -1]]))
    force = pose_means(with_all_axes("hysteresis", here, text="force"), here)
    assert force == pytest.approx(np.concatenate([UPS[:1], UPS[:-1]]))


def test_rectification_is_the_variance_of_what_the_machine_shakes() -> None:
    here = by_hand(shaken=True)
    added = pose_means(with_all_axes("vibration_rectification", here), here)
    shaken = here.shaking.at(here.pose)
    measured = np.array([shaken[b:e].var(axis=0) for b, e in zip(here.begin, here.end, strict=True)])
    assert np.any(measured > 0)
    assert added == pytest.approx(measured, rel=0.05, abs=1e-12)


def test_the_body_turns_about_the_vertical_and_up_stays_up() -> None:
    rng = np.random.default_rng(1)
    up, azimuth = cube(26), rng.uniform(0, 2 * np.pi, 26)
    turned = attitudes(up, azimuth)
    assert turned @ [0, 0, 1] == pytest.approx(up)
    assert np.einsum("kij,klj->kil", turned, turned) == pytest.approx(np.broadcast_to(np.eye(3), (26, 3, 3)))
    assert np.linalg.det(turned) == pytest.approx(1.0)


def test_a_fixture_is_off_by_degrees_and_no_more() -> None:
    for seed in range(30):
        up = as_mounted(np.random.default_rng(seed), 26)
        assert np.linalg.norm(up, axis=1) == pytest.approx(1.0)
        nearest = np.degrees(np.arccos(np.clip(up @ cube(26).T, -1, 1).max(axis=1)))
        assert nearest.max() < 6.01
        assert nearest.max() > 0.1


@pytest.mark.parametrize("kind", ["white", "first_order", "mixed"])
def test_the_variance_of_a_mean_is_known(kind: str) -> None:
    rng = np.random.default_rng(2)
    noise = Noise.drawn(rng, kind, 100.0)
    means = np.array([noise.draw(rng, 300).mean(axis=0) for _ in range(400)])
    squares = np.sum(means**2 / noise.variance_of_mean(300))
    assert stats.chi2(1200).cdf(squares) == pytest.approx(0.5, abs=0.4999)


def test_the_mean_of_shaking_is_known_over_its_phases() -> None:
    rng = np.random.default_rng(3)
    shaking = Shaking.drawn(rng, 400, 100.0)
    on = np.flatnonzero(shaking.variance[:, 0] > 0)
    means = np.array([shaking.at(np.full(250, i)).mean(axis=0) for i in on])
    expected = np.array([shaking.variance_of_mean(int(i), 250) for i in on])
    # A sine of random phase has a square of mean ½ and variance 1/8; two tones share it.
    assert np.mean(means**2 / expected) == pytest.approx(1.0, abs=CERTAIN * np.sqrt(2 / means.size))


def chi_square(r: Recording, *, effect: bool) -> float:
    """Of a nine-parameter fit by scipy to the means over the true spans, with the true standard errors."""
    u, nine = r.take.scene.by_pose(r.samples(effect=effect).readings), nine_of(r.triad)
    unit = np.r_[np.abs(r.triad.scale), np.ones(6)]
    found = least_squares(
        lambda p: (magnitude(u, nine + p * unit) - 1) / r.errors_g, np.zeros(9), x_scale=1e-3, xtol=1e-13, ftol=1e-13
    )
    return float(2 * found.cost)


@pytest.mark.slow
@pytest.mark.parametrize("poses", [26, 14])
def test_the_size_is_what_a_fit_of_nine_parameters_leaves(poses: int) -> None:
    """χ² is noncentral by s² with the effect, and central without: over many kinds of effect together."""
    left = {True: 0.0, False: 0.0}
    dof, sizes = 0, 0.0
    for i, kind in enumerate(KINDS[:: 1 if poses == 26 else 3]):
        r = recording(100 + i, kind, 20.0, poses, ("white", "first_order", "mixed")[i % 3])
        assert r.sizes[0] == pytest.approx(20.0, rel=0.01)
        assert np.abs(r.take.scene.by_pose(r.take.added_g)).max() <= LARGEST_G
        dof, sizes = dof + len(r.errors_g) - 9, sizes + r.sizes[0] ** 2
        for effect in left:
            left[effect] += chi_square(r, effect=effect)
    assert stats.norm.sf(abs(left[False] - dof) / np.sqrt(2 * dof)) > 1e-4
    assert stats.norm.sf(abs(left[True] - dof - sizes) / np.sqrt(2 * (dof + 2 * sizes))) > 1e-4


@pytest.mark.parametrize("kind", invented_later.KINDS)
@pytest.mark.parametrize("poses", [26, 14])
def test_what_was_invented_later_shows_with_the_size_asked_for(kind: str, poses: int) -> None:
    """Without a name, small, and in the next recording of the unit only if it is the unit's own."""
    r = recording(11, kind, (20.0, 200.0), poses)
    assert r.names == ()
    assert 19.8 <= r.sizes[0] <= 202.0
    assert r.ranks[0] >= 1
    assert np.abs(r.take.scene.by_pose(r.take.added_g)).max() <= LARGEST_G
    assert r.held_out.added_g.any() != r.effects[0].of_recording


def later_on_all_axes(kind: str, here: Scene) -> Effect:
    """The first draw of what was invented later that has a coefficient on each axis, one each."""
    draws = (invented_later.drawn(np.random.default_rng(seed), kind, here, SQUARE) for seed in range(200))
    return replace(next(e for e in draws if len(e.coefficients) == 3), coefficients=np.ones(3))


def test_what_was_invented_later_is_what_its_words_say() -> None:
    here = by_hand()
    supply = later_on_all_axes("shared_supply", here)
    assert pose_means(supply, here)[2] == pytest.approx([0.84, 1.12, 0])
    coil = later_on_all_axes("self_heating", here)
    tau, heated = float(coil.text.split("heat, ")[1].split(" s")[0]), coil.added(here)
    assert heated[: here.end[0]] == pytest.approx(np.tile([1.0, 0, 0], (here.end[0], 1)))
    first, last = here.begin[3], here.end[3] - 1
    to_go = heated[[first, last]] - UPS[3] ** 3
    assert to_go[1] == pytest.approx(to_go[0] * np.exp(-(last - first) / 100 / tau), rel=0.01)
    hands = later_on_all_axes("hand_heat", here).added(here)
    for begin, end in zip(here.begin, here.end, strict=True):
        assert np.all(np.diff(hands[begin:end], axis=0) < 0)
    cracked = later_on_all_axes("gain_step", here).added(here)
    at = int(np.argmax(cracked.any(axis=1)))
    assert cracked[at:] == pytest.approx(here.force[at:])
    turned = later_on_all_axes("angle_by_temperature", here).added(here)
    warmer = np.ptp(turned[here.begin[3] : here.end[3]], axis=0) / (0.1 * (here.held_s[3] - 0.01))
    assert warmer == pytest.approx([0.2, 0.8, 0])  # of (0, −0.6, 0.8) g: x by y and z, y by z
    zeroed = np.diff(later_on_all_axes("auto_zero", here).added(here)[:, 0])
    assert 2 <= np.sum(zeroed < 0) <= 8


def test_a_chip_lies_under_one_pose_and_an_adapter_under_many() -> None:
    here, rng = by_hand(), np.random.default_rng(12)
    chip = pose_means(invented_later.drawn(rng, "chip_under_case", here, SQUARE), here)
    assert np.sum(chip.any(axis=1)) == 1
    adapter = pose_means(invented_later.drawn(rng, "adapters", here, SQUARE), here)
    faces, edges = adapter[[0, 1, 4]], adapter[[2, 3]]
    assert faces == pytest.approx(np.tile(faces[0], (3, 1)))
    assert edges == pytest.approx(np.tile(edges[0], (2, 1)))
    assert np.abs(faces[0] - edges[0]).min() > 1e-3


def test_what_nine_parameters_can_do_has_no_size() -> None:
    r = recording(4, "none", poses=14)
    u = r.take.scene.pose_force
    linear = Linear.of(r.triad, r.triad.outputs(u), r.errors_g)
    nine = nine_of(r.triad)
    for step in np.diag(1e-7 * np.r_[np.abs(r.triad.scale), np.ones(6)]):
        miss = magnitude(r.triad.outputs(u), nine + step) - 1
        assert linear.size(miss) < 1e-4 * np.linalg.norm(miss / r.errors_g)


def test_told_power_is_that_of_the_normal_and_of_the_chi_square_test() -> None:
    assert told_power(3.0, 1) == pytest.approx(stats.norm.sf(2.5758 - 3.0) + stats.norm.cdf(-2.5758 - 3.0), abs=1e-4)
    rng = np.random.default_rng(5)
    draws = np.sum(rng.normal([4.0, 0, 0], 1.0, (4000, 3)) ** 2, axis=1)
    seen = int(np.sum(draws > 11.345))
    assert stats.binomtest(seen, 4000, told_power(4.0, 3)).pvalue > 1e-4
    assert told_power(0.0, 2) == pytest.approx(0.01)


@pytest.mark.parametrize("kind", ["hysteresis", "two", "adc_wave", "none"])
def test_the_same_arguments_give_the_same_recording(kind: str) -> None:
    one, other = (recording(6, kind, (20.0, 40.0)) for _ in range(2))
    assert np.array_equal(one.samples().readings, other.samples().readings)
    assert str(one) == str(other)
    assert not np.array_equal(one.samples().readings, recording(7, kind, (20.0, 40.0)).samples().readings)


def test_the_next_recording_begins_anew_what_is_the_recordings_own() -> None:
    drift, nonlinear = recording(8, "bias_drift"), recording(8, "third_order_nonlinearity")
    assert not drift.held_out.added_g.any()
    assert drift.take.added_g.any()
    assert nonlinear.held_out.added_g.any()


@pytest.mark.slow
def test_effects_are_drawn_at_random_and_two_are_two() -> None:
    seen = {e.kind for seed in range(6) for e in recording(seed).effects}
    assert len(seen) >= 3
    assert seen <= set(physics.KINDS)
    assert all(e.kind in uncatalogued.KINDS for e in recording(0, "outside").effects)
    assert all(len({e.kind for e in recording(seed, "two").effects}) == 2 for seed in range(4))


def test_who_is_told_the_effect_loses_little_by_it() -> None:
    """With 26 poses one coefficient more costs a held-out error of a few per cent."""
    ratios = [np.divide(*told_errors_g(recording(s, "third_order_nonlinearity"))[::-1]) for s in range(4)]
    assert 0.95 < np.median(ratios) < 1.15


@pytest.mark.parametrize("kind", ["third_order_nonlinearity", "hysteresis", "channel_scale_factor"])
def test_an_effect_passes_for_itself_and_a_converters_wave_for_nothing(kind: str) -> None:
    assert best_imitation(recording(9, kind, 100.0))[1] < 1.0
    assert best_imitation(recording(9, "adc_wave", 100.0))[1] > 10.0
