"""What the tests of the posterior share: poses of one unit, with whatever effects it has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.planning.directions import directions
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.posterior.rows import Rows
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses

SIGMA_G = 2e-5
MINUS = (-1.0, -1.0, -1.0)
"""Signs of the paper's unit."""


def rows_of(poses: Sequence[Pose], signs: Sequence[float]) -> Rows:
    return Rows.of(poses, fit(poses, signs=signs), signs)


@pytest.fixture
def poses_with(with_effects: Callable[..., Sensor]) -> Callable[..., list[Pose]]:
    """Thirty poses all over the sphere, in an order of their own, and a temperature that goes up and down, as (seed,
    name=coefficients). On faces, vertices and edges of a cube an axis reads four values alone, and odd functions of
    that reading look alike."""
    spread = np.array([up for _, up in directions(30)])

    def make(seed: int, noise_g: float = SIGMA_G, **effects: list[float]) -> list[Pose]:
        rng = np.random.default_rng(seed)
        ups = rng.permutation(spread)
        warm = {"temp_c": 25 + 2 * np.sin(np.arange(len(ups)) / 3 + seed)}
        reference = {"temp_c": 25.0}
        return noisy_poses(with_effects(**effects), ups, noise_g, rng, channels=warm, channel_reference=reference)

    return make


@pytest.fixture
def knocked() -> Callable[[list[Pose], int, float], list[Pose]]:
    """The poses, one of them off by so much along its own direction, in g of the paper's unit."""

    def make(poses: list[Pose], which: int, by_g: float) -> list[Pose]:
        pose = poses[which]
        off = replace(pose, mean=pose.mean * (1 + by_g))
        return [*poses[:which], off, *poses[which + 1 :]]

    return make
