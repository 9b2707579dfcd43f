"""What the tests of the search share: poses of the paper's unit, and the model linearised by numerical differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from triaxcal.effects import CATALOGUE, TIME, Effect
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.search import LeftOut, Search
from triaxcal.search.candidates import Ground
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start, with_history
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
HOLD_S = 10.0


@pytest.fixture(scope="session")
def directions(twenty_six: np.ndarray) -> np.ndarray:
    """The 26 directions, each off by a few degrees, as on a real fixture, and in a random order."""
    rng = np.random.default_rng(5)
    v = twenty_six[rng.permutation(26)] + 0.06 * rng.standard_normal((26, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.fixture(scope="session")
def recorded(directions: np.ndarray) -> Callable[..., list[Pose]]:
    """Poses of a sensor in these directions; temperature counts from 25 °C, time from the middle of the recording."""

    def make(
        sensor: Sensor,
        seed: int,
        channels: Mapping[str, np.ndarray] | None = None,
        where: np.ndarray = directions,
        sigma_g: float = SIGMA_G,
    ) -> list[Pose]:
        rng = np.random.default_rng(seed)
        n = len(where)
        if channels is None:
            channels = {"temp_c": 25 + 4 * np.sin(0.9 * np.arange(n) + 1.0) + rng.standard_normal(n)}
        reference = {"temp_c": 25.0, TIME: n * HOLD_S / 2}
        return noisy_poses(sensor, where, sigma_g, rng, channels=channels, channel_reference=reference, hold_s=HOLD_S)

    return make


@pytest.fixture(scope="session")
def ground_of() -> Callable[[list[Pose]], Ground]:
    """The linear model, fitted, as the search stands on it."""

    def make(poses: list[Pose]) -> Ground:
        problem = problem_of(poses, signs=MINUS)
        state = start(problem, poses, MINUS)
        problem = with_history(problem, poses, state.sensor(problem))
        return Ground.at(problem, solve(problem, state, ()))

    return make


def magnitude(u: np.ndarray, nine: np.ndarray, reading_off_g: np.ndarray | float = 0.0) -> np.ndarray:
    """|a| (n,) of outputs (n,3) under k, ax, ay, az, b (9,), of which so much in g is an effect's."""
    ax, ay, az = nine[3:6]
    R = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])
    s = u / nine[:3] - nine[6:] - reading_off_g
    return np.asarray(np.linalg.norm(np.linalg.solve(R, s.T), axis=0))


@pytest.fixture(scope="session")
def weighted() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of poses, the nine parameters they were fitted with and an effect's basis (n,3,p): weighted residuals (n,), and
    derivatives by the nine (n,9) and by the coefficients (n,p); by differences, and no line of it the package's."""

    def make(poses: list[Pose], sensor: Sensor, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nine = np.concatenate([sensor.scale_factor, sensor.misalignment, sensor.bias])
        u = np.array([p.mean for p in poses])
        sigma = np.array([np.sqrt(np.diag(p.covariance)) for p in poses])
        by_u = np.stack([(magnitude(u + h, nine) - magnitude(u - h, nine)) / 2e-5 for h in 1e-5 * np.eye(3)], axis=1)
        error = np.sqrt(np.sum(by_u**2 * sigma**2, axis=1))
        J = np.stack([(magnitude(u, nine + h) - magnitude(u, nine - h)) / 2e-6 for h in 1e-6 * np.eye(9)], axis=1)
        Z = np.stack(
            [
                (magnitude(u, nine, 1e-6 * basis[..., k]) - magnitude(u, nine, -1e-6 * basis[..., k])) / 2e-6
                for k in range(basis.shape[2])
            ],
            axis=1,
        )
        y = magnitude(u, nine) - 1.0
        return y / error, J / error[:, None], Z / error[:, None]

    return make


@pytest.fixture(scope="session")
def searched() -> Callable[..., Search]:
    """The search on poses, before its first step."""

    def make(poses: list[Pose], catalogue: Sequence[Effect] = CATALOGUE) -> Search:
        problem = problem_of(poses, signs=MINUS)
        linear = solve(problem, start(problem, poses, MINUS), ())
        problem = with_history(problem, poses, linear.sensor(problem))
        return Search(
            problem,
            poses,
            MINUS,
            1.0,
            catalogue,
            fit(poses, signs=MINUS, aside=()),
            linear,
            LeftOut(poses, (), MINUS, 1.0),
        )

    return make


@pytest.fixture(scope="module")
def poses(with_effects: Callable[..., Sensor], recorded: Callable[..., list[Pose]]) -> list[Pose]:
    """With a square term on every axis inside."""
    return recorded(with_effects(second_order_nonlinearity=[4e-4, -5e-4, 6e-4]), 0)


@pytest.fixture(scope="module")
def search(poses: list[Pose], searched: Callable[..., Search]) -> Search:
    """Of these poses, before its first step."""
    return searched(poses)
