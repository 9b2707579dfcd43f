"""What the tests of the metrology share: the paper's unit, the cube's directions, and a way from stream to poses."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.stillness.detector import Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows
from triaxcal.synthetic import noisy_poses

POSE_NOISE_G = 2e-5
"""Of the poses that have whatever effects a test asks for."""


@pytest.fixture(scope="session")
def paper_unit() -> Sensor:
    """The unit of the paper's table 1; outputs in volts."""
    return Sensor(
        np.array([-2.410618, -2.403823, -2.371761]),
        np.array([625.454406e-5, 404.734018e-5, -65.046441e-5]),
        np.array([564.518583e-5, -288.4559e-5, 463.952349e-5]),
    )


def _cube(*nonzero: int) -> np.ndarray:
    corners = [c for k in nonzero for c in itertools.product((1, 0, -1), repeat=3) if sum(map(abs, c)) == k]
    return np.array([np.array(c) / np.linalg.norm(c) for c in corners])


@pytest.fixture(scope="session")
def fourteen() -> np.ndarray:
    """The paper's poses: up along the six faces and the eight vertices of a cube."""
    return _cube(1, 3)


@pytest.fixture(scope="session")
def twenty_six() -> np.ndarray:
    """The same and the twelve edges."""
    return _cube(1, 3, 2)


@pytest.fixture(scope="session")
def with_effects(paper_unit: Sensor) -> Callable[..., Sensor]:
    """The paper's unit with effects, as name=coefficients."""

    def make(**effects: list[float]) -> Sensor:
        pairs = tuple((effect_named(name), np.array(q, dtype=float)) for name, q in effects.items())
        return Sensor(paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias, pairs)

    return make


@pytest.fixture(scope="session")
def detect() -> Callable[..., tuple[Windows, list[Span], list[Pose]]]:
    """Windows, spans and poses of a stream with times in seconds."""

    def run(
        t_s: np.ndarray, readings: np.ndarray, channels: Mapping[str, np.ndarray] | None = None
    ) -> tuple[Windows, list[Span], list[Pose]]:
        detector = StillnessDetector()
        detector.feed(np.round(t_s * 1e9).astype(np.int64), readings, channels)
        detector.finish()
        windows, spans = detector.windows(), detector.spans()
        return windows, spans, poses_of(windows, spans)

    return run


@pytest.fixture
def poses_with(with_effects: Callable[..., Sensor]) -> Callable[..., list[Pose]]:
    """Thirty poses all over the sphere, in an order of their own, and a temperature that goes up and down, as (seed,
    name=coefficients). On faces, vertices and edges of a cube an axis reads four values alone, and odd functions of
    that reading look alike."""
    spread = np.array([up for _, up in directions(30)])

    def make(seed: int, noise_g: float = POSE_NOISE_G, **effects: list[float]) -> list[Pose]:
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
