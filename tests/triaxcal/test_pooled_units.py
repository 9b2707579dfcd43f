"""Units side by side: which effects act in all of them, and what they share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from triaxcal.arrays import Floats
from triaxcal.diagnosis import Loop, Verdict, diagnose
from triaxcal.effects import Effect, effect_named
from triaxcal.effects.time import BiasDrift, BiasStep, WarmUp
from triaxcal.errors import InvalidData
from triaxcal.model.directions import directions
from triaxcal.pooled_units import Answer, PooledAnalysis, PooledEffect, pooled_analysis
from triaxcal.poses.pose import Pose

pytestmark = pytest.mark.slow

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


def squared(rng: np.random.Generator, size_g: float = 3e-4) -> Added:
    size = size_g * np.sign(rng.standard_normal(3))
    return lambda t_s, s: size * s**2


def nothing(rng: np.random.Generator) -> Added:
    return lambda t_s, s: np.zeros_like(s)


def units(seed: int, *made: Callable[[np.random.Generator], Added]) -> tuple[list[Loop], PooledAnalysis]:
    rng = np.random.default_rng(seed)
    loops = [unit(rng, make(rng)) for make in made]
    return loops, pooled_analysis(loops)


def alike(time_constants_s: Sequence[float], size_g: float = 1e-4) -> list[Callable[[np.random.Generator], Added]]:
    return [lambda rng, tau=tau: warming(rng, tau, size_g) for tau in time_constants_s]  # type: ignore[misc]


def named(found: PooledAnalysis, name: str) -> PooledEffect:
    return next(c for c in found.effects if c.effect == name)


@pytest.fixture(scope="module")
def slow() -> tuple[list[Loop], PooledAnalysis]:
    """Six units that warm up so slowly that one alone is hardly told from a drift."""
    return units(2, *alike([250.0] * 6, 2e-4))


def test_what_single_units_cannot_tell_apart_all_together_do(slow: tuple[list[Loop], PooledAnalysis]) -> None:
    loops, found = slow
    assert not any(f.verdict is Verdict.ADOPTED for loop in loops for f in loop.findings)
    assert found.answer is Answer.AGREE
    assert found.agreed == (("warm_up",),)
    assert found.effects[0].effect == "warm_up"
    assert found.effects[0].probability == found.probability > 0.99
    assert named(found, "bias_drift").probability < 0.05


def test_who_names_it_and_who_lists_it_is_told(slow: tuple[list[Loop], PooledAnalysis]) -> None:
    loops, found = slow
    best = found.effects[0]
    for i, loop in enumerate(loops):
        alone = {f.effect for f in loop.findings if not f.alternatives}
        among = {name for f in loop.findings if f.alternatives for name in (f.effect, *f.alternatives)}
        assert (i in best.named) == ("warm_up" in alone)
        assert (i in best.listed) == ("warm_up" in among)
        assert best.units[i] == pytest.approx(loop.probabilities["warm_up"], abs=0.05)  # another grid of sizes


def test_values_of_their_own_are_not_called_common(slow: tuple[list[Loop], PooledAnalysis]) -> None:
    assert slow[1].effects[0].common < 0.01


def test_the_shared_time_constant_is_better_known_than_the_units_own(slow: tuple[list[Loop], PooledAnalysis]) -> None:
    shape = slow[1].effects[0].shapes["time_constant"]
    assert shape.shared.unit == "s"
    assert shape.shared.standard_error is not None
    assert abs(shape.shared.value - 250.0) < 4 * shape.shared.standard_error
    own = [s.standard_error for s in shape.own.values() if s.standard_error is not None]
    assert np.median(own) > 1.5 * shape.shared.standard_error


def test_a_step_that_units_share_lies_between_two_poses_as_far_as_its_standard_error_says() -> None:
    off = []
    for seed in range(3):
        rng = np.random.default_rng(50 + seed)
        at_s = HOLD_S * int(rng.integers(6, 20))
        size = 3e-4 * np.sign(rng.standard_normal(3))
        loops = [unit(rng, lambda t, s: np.where(t[:, None] < at_s, -size, 0.0), [BiasStep()]) for _ in range(2)]  # noqa: B023
        shared = pooled_analysis(loops).effects[0].shapes["at"].shared
        assert shared.standard_error is not None
        off.append((shared.value - at_s) / shared.standard_error)
    assert np.max(np.abs(off)) < 2


def test_units_with_different_effects_do_not_agree() -> None:
    _, found = units(7, squared, lambda rng: warming(rng, 60.0))
    assert found.answer is Answer.DISAGREE
    assert found.agreed == ()


@pytest.mark.parametrize("seed", range(3))
def test_an_effect_that_one_unit_alone_shows_does_not_act_in_all(seed: int) -> None:
    _, found = units(20 + seed, squared, nothing, nothing)
    assert found.answer in (Answer.DISAGREE, Answer.NOTHING)
    shown = named(found, "second_order_nonlinearity")
    assert shown.units[0] > 0.9
    assert shown.probability < 0.01


def test_an_effect_of_one_unit_beside_the_common_one_is_its_own() -> None:
    def both(rng: np.random.Generator) -> Added:
        first, second = warming(rng, 60.0), squared(rng)
        return lambda t_s, s: first(t_s, s) + second(t_s, s)

    _, found = units(9, *alike([60.0] * 2), both)
    assert found.agreed == (("warm_up",),)
    assert named(found, "second_order_nonlinearity").units[2] > 0.9


def test_two_effects_that_all_units_have_are_both_agreed_on() -> None:
    def both(rng: np.random.Generator) -> Added:
        first, second = warming(rng, 60.0, 6e-4), squared(rng, 2e-3)
        return lambda t_s, s: first(t_s, s) + second(t_s, s)

    _, found = units(31, both, both)
    assert set(found.agreed) == {("warm_up",), ("second_order_nonlinearity",)}


def test_units_that_show_nothing_agree_on_nothing() -> None:
    _, found = units(11, *[nothing] * 3)
    assert found.answer is Answer.NOTHING
    assert found.agreed == ()
    assert found.nothing > 0.5


def test_one_unit_alone_has_nobody_to_agree_with() -> None:
    loops, _ = units(13, *alike([60.0] * 2))
    with pytest.raises(InvalidData, match="takes two"):
        pooled_analysis(loops[:1])
