"""What a candidate gains is what an explicit least-squares fit gains by its columns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.effects.part import Part
from triaxcal.poses.pose import Pose
from triaxcal.search.candidates import Candidate, Ground, candidates_of, still_conditions
from triaxcal.search.gains import Gains
from triaxcal.sensor import Sensor

Make = Callable[..., Sensor]
Recorded = Callable[..., list[Pose]]
NAMES = ("second_order_nonlinearity", "third_order_nonlinearity", "temperature_bias", "bias_drift")


def left(J: np.ndarray, y: np.ndarray) -> float:
    """Sum of squares that no combination of the columns (n,k) explains."""
    scaled = J / np.linalg.norm(J, axis=0)
    q = np.linalg.lstsq(scaled, y, rcond=None)[0]
    return float(np.sum((y - scaled @ q) ** 2))


@pytest.fixture(scope="module")
def poses(with_effects: Make, recorded: Recorded) -> list[Pose]:
    return recorded(with_effects(second_order_nonlinearity=[1e-4, -1e-4, 5e-5]), 3)


@pytest.fixture(scope="module")
def ground(poses: list[Pose], ground_of: Callable[[list[Pose]], Ground]) -> Ground:
    return ground_of(poses)


@pytest.fixture(scope="module")
def candidates(poses: list[Pose], ground: Ground) -> list[Candidate]:
    found, _ = candidates_of(ground, [effect_named(n) for n in NAMES], still_conditions(poses))
    return found


def basis_of(name: str, poses: list[Pose], sensor: Sensor) -> np.ndarray:
    """What a unit of each coefficient adds (n,3,3), from the definitions."""
    s = np.array([p.mean for p in poses]) / sensor.scale_factor - sensor.bias
    t = np.array([p.t_s for p in poses])
    temp = np.array([p.channels["temp_c"] for p in poses])
    values = {
        "second_order_nonlinearity": s**2,
        "third_order_nonlinearity": s**3,
        "temperature_bias": np.repeat((temp - temp.mean())[:, None], 3, axis=1),
        "bias_drift": np.repeat((t - t.mean())[:, None], 3, axis=1),
    }[name]
    return np.asarray(values[:, :, None] * np.eye(3))


Weighted = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]


def columns(
    c: Candidate, poses: list[Pose], ground: Ground, weighted: Weighted
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sensor = ground.state.sensor(ground.problem)
    y, J, Z = weighted(poses, sensor, basis_of(c.name, poses, sensor))
    return y, J, Z @ c.effect.mix if isinstance(c.effect, Part) else Z


def straight(candidates: list[Candidate]) -> list[Candidate]:
    """On all axes and on one, without drift that bends."""
    return [c for c in candidates if c.rank in (1, 3) and all(k.name in "xyz" for k in c.effect.coefficients)]


def test_a_single_gain_is_that_of_a_least_squares_fit(
    poses: list[Pose], ground: Ground, candidates: list[Candidate], weighted: Weighted
) -> None:
    some = straight(candidates)
    assert {(c.name, c.rank) for c in some} == {(n, r) for n in NAMES for r in (1, 3)}
    gains = Gains.of(some, ground.y).single()
    for c, gain in zip(some, gains, strict=True):
        y, J, Z = columns(c, poses, ground, weighted)
        expected = left(J, y) - left(np.concatenate([J, Z], axis=1), y)
        # The second derivative of |a| by the effect is left out: the reading is off by less than 1e-3.
        assert gain == pytest.approx(expected, rel=5e-3, abs=1e-3)


def test_a_pair_s_gain_is_that_of_a_least_squares_fit(
    poses: list[Pose], ground: Ground, candidates: list[Candidate], weighted: Weighted
) -> None:
    some = straight(candidates)
    rows = np.arange(len(some))
    pairs = Gains.of(some, ground.y).pairs(rows)
    compared = 0
    for i, a in enumerate(some):
        for j, b in enumerate(some):
            if a.name == b.name:
                continue
            y, J, Za = columns(a, poses, ground, weighted)
            _, _, Zb = columns(b, poses, ground, weighted)
            expected = left(J, y) - left(np.concatenate([J, Za, Zb], axis=1), y)
            assert pairs[i, j] == pytest.approx(expected, rel=5e-3, abs=5e-3)
            compared += 1
    assert compared == 16 * 12


def test_a_pair_of_the_same_thing_gains_no_more_than_one(ground: Ground, candidates: list[Candidate]) -> None:
    gains = Gains.of(candidates, ground.y)
    rows = np.arange(len(candidates))
    assert np.diag(gains.pairs(rows)) == pytest.approx(gains.single(), rel=1e-9)


def test_a_pair_gains_no_less_than_either_and_no_more_than_all_there_is(
    ground: Ground, candidates: list[Candidate]
) -> None:
    gains = Gains.of(candidates, ground.y)
    single, pairs = gains.single(), gains.pairs(np.arange(len(candidates)))
    # Where one contains the other, what is less than 2 % of a direction counts by its square, and costs as little.
    assert np.all(pairs >= np.maximum(single[:, None], single) * (1 - 1e-3))
    assert np.all(pairs <= ground.y @ ground.y * (1 + 1e-9))


def test_gains_of_many_vectors_of_noise_are_those_of_each(ground: Ground, candidates: list[Candidate]) -> None:
    noise = np.random.default_rng(0).standard_normal((len(ground.y), 5))
    together = Gains.of(candidates, ground.y).of_noise(noise)
    for k in range(5):
        assert together[:, k] == pytest.approx(Gains.of(candidates, noise[:, k]).single())
