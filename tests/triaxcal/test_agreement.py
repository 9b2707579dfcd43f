"""Units side by side: whether what each shows by itself is one effect, and what it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy import stats

from triaxcal.agreement import Agreement, agreement
from triaxcal.arrays import Floats
from triaxcal.effects import Effect, effect_named
from triaxcal.effects.bias_drift import BiasDrift
from triaxcal.effects.bias_step import BiasStep
from triaxcal.effects.warm_up import WarmUp
from triaxcal.errors import InvalidData
from triaxcal.loop import Loop, diagnose
from triaxcal.planning.directions import directions
from triaxcal.poses.pose import Pose

SIGMA_G, HOLD_S, COUNT = 1e-5, 10.0, 26
GAP_S = 1.0
FEW: tuple[Effect, ...] = (effect_named("second_order_nonlinearity"), BiasDrift(), WarmUp())
UP = np.array([v for _, v in directions(COUNT)])
Added = Callable[[Floats, Floats], Floats]


def unit(rng: np.random.Generator, added: Added, catalogue: Sequence[Effect] = FEW) -> Loop:
    """A unit of its own scale factors, misalignments and biases, diagnosed; ``added`` in g, of time and attitude.

    Physics of its own: u = K (R a + b + added).
    """
    k, b = 1 + 0.05 * rng.standard_normal(3), 5e-3 * rng.standard_normal(3)
    up = UP[rng.permutation(COUNT)]
    s = up + 3e-3 * rng.standard_normal(3) * up[:, [1, 2, 2]] * [1, 1, 0]
    t_s = (np.arange(COUNT) + 0.5) * HOLD_S
    u = k * (s + b + added(t_s, s) + SIGMA_G * rng.standard_normal(s.shape))
    covariance = np.diag((k * SIGMA_G) ** 2)
    start_s = np.arange(COUNT) * HOLD_S + GAP_S / 2
    poses = [Pose(t, t + HOLD_S - GAP_S, 1000, u[i], covariance, 1e6) for i, t in enumerate(start_s.tolist())]
    return diagnose(poses, catalogue=catalogue)


def warming(rng: np.random.Generator, time_constant_s: float, size_g: float = 1e-4) -> Added:
    size = size_g * np.sign(rng.standard_normal(3)) * rng.uniform(0.7, 1.3, 3)
    return lambda t_s, s: size * np.exp(-t_s / time_constant_s)[:, None]


def squared(rng: np.random.Generator) -> Added:
    size = 3e-4 * np.sign(rng.standard_normal(3))
    return lambda t_s, s: size * s**2


def nothing(rng: np.random.Generator) -> Added:
    return lambda t_s, s: np.zeros_like(s)


def units(seed: int, *made: Callable[[np.random.Generator], Added]) -> tuple[list[Loop], Agreement]:
    rng = np.random.default_rng(seed)
    loops = [unit(rng, make(rng)) for make in made]
    return loops, agreement(loops)


def alike(time_constants_s: Sequence[float], size_g: float = 1e-4) -> list[Callable[[np.random.Generator], Added]]:
    return [lambda rng, tau=tau: warming(rng, tau, size_g) for tau in time_constants_s]  # type: ignore[misc]


@pytest.fixture(scope="module")
def slow() -> tuple[list[Loop], Agreement]:
    """Six units that warm up so slowly that one alone is hardly told from a drift."""
    return units(2, *alike([250.0] * 6, 2e-4))


def test_what_single_units_cannot_tell_apart_all_together_do(slow: tuple[list[Loop], Agreement]) -> None:
    loops, found = slow
    assert any(f.verdict == "confounded" for loop in loops for f in loop.findings)
    assert found.agreed == ("warm_up",)
    assert found.verdict == "agree on warm_up"
    best, second = found.effects[:2]
    assert (best.effect, best.worse) == ("warm_up", 0.0)
    assert second.effect == "bias_drift"
    assert best.gain - second.gain == pytest.approx(second.worse, abs=10)  # but for the choice of the variant


def test_who_names_it_and_who_lists_it_is_counted(slow: tuple[list[Loop], Agreement]) -> None:
    loops, found = slow
    best = found.effects[0]
    for i, loop in enumerate(loops):
        said = {f.effect: f.verdict for f in loop.findings}
        others = {name for f in loop.findings for name in f.alternatives}
        assert (i in best.named) == (said.get("warm_up") == "adopted")
        assert (i in best.listed) == (said.get("warm_up") == "confounded" or "warm_up" in others)
    assert best.shown == tuple(range(6))


def test_the_shared_time_constant_is_better_known_than_the_units_own(slow: tuple[list[Loop], Agreement]) -> None:
    shared = slow[1].effects[0].shapes["time_constant"]
    assert shared.unit == "s"
    assert shared.standard_error is not None
    assert abs(shared.value - 250.0) < 4 * shared.standard_error
    assert np.median([np.inf if error is None else error for _, error in shared.own]) > 1.5 * shared.standard_error
    assert shared.p_value is not None
    assert shared.p_value > 0.01


def test_over_many_seeds_the_time_constant_is_as_far_off_as_its_standard_error_says() -> None:
    pulls = []
    for seed in range(8):
        shared = units(100 + seed, *alike([60.0] * 2))[1].effects[0].shapes["time_constant"]
        assert shared.standard_error is not None
        pulls.append((shared.value - 60.0) / shared.standard_error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], len(pulls))
    assert low < float(np.sum(np.square(pulls))) < high


def test_a_step_that_units_share_lies_between_two_poses_as_far_as_its_standard_error_says() -> None:
    """Where the poses of one unit hide it, its own moment may be poses away."""
    off, own = [], []
    for seed in range(3):
        rng = np.random.default_rng(50 + seed)
        at_s = HOLD_S * int(rng.integers(6, 20))
        size = 3e-4 * np.sign(rng.standard_normal(3))
        loops = [unit(rng, lambda t, s: np.where(t[:, None] < at_s, -size, 0.0), [BiasStep()]) for _ in range(2)]  # noqa: B023
        shared = agreement(loops).effects[0].shapes["at"]
        assert shared.standard_error is not None
        off.append((shared.value - at_s) / shared.standard_error)
        own += [(value - at_s) / error for value, error in shared.own if error is not None]
    assert len(own) == 6
    assert np.max(np.abs(off)) < 1  # the middle of the gap, or near it
    assert np.sqrt(np.mean(np.square(own))) < 2


def test_units_whose_time_constants_differ_are_seen_not_to_share_one() -> None:
    _, found = units(7, *alike([30.0, 30.0, 60.0, 60.0], 4e-4))
    shared = next(c for c in found.effects if c.effect == "warm_up").shapes["time_constant"]
    assert shared.p_value is not None
    assert shared.p_value < 1e-4
    assert [value > 45 for value, _ in shared.own] == [False, False, True, True]


def test_units_with_different_effects_do_not_agree() -> None:
    _, found = units(7, squared, lambda rng: warming(rng, 60.0))
    assert found.verdict == "do not agree"
    assert found.agreed == ()


@pytest.mark.parametrize("seed", range(3))
def test_an_effect_that_one_unit_alone_shows_is_not_agreed_on(seed: int) -> None:
    _, found = units(20 + seed, squared, nothing, nothing)
    assert found.verdict == "do not agree"


def test_an_effect_of_one_unit_beside_the_common_one_is_its_own() -> None:
    def both(rng: np.random.Generator) -> Added:
        first, second = warming(rng, 60.0), squared(rng)
        return lambda t_s, s: first(t_s, s) + second(t_s, s)

    _, found = units(9, *alike([60.0] * 2), both)
    assert found.agreed == ("warm_up",)
    assert found.effects[0].shown == (0, 1, 2)


def test_units_that_show_nothing_agree_on_nothing() -> None:
    _, found = units(11, *[nothing] * 3)
    assert found.verdict == "no unit shows an effect"
    assert found.agreed == ()


def test_one_unit_alone_has_nobody_to_agree_with() -> None:
    loops, _ = units(13, *alike([60.0] * 2))
    with pytest.raises(InvalidData, match="takes two"):
        agreement(loops[:1])
