"""Poses of a stream that comes in bursts, against those of the same samples delivered
evenly."""

from __future__ import annotations

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.arrays import Floats

SIGMA = 2e-3
HOLD_S, MOVE_S, POSES = 4.0, 1.0, 12


def tumbled(seed: int, rate_hz: float) -> tuple[Floats, Floats, Floats]:
    """Times, readings in g, and the direction of each pose."""
    rng = np.random.default_rng(seed)
    true = rng.standard_normal((POSES + 1, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    t = np.arange(int(POSES * (HOLD_S + MOVE_S) * rate_hz)) / rate_hz
    pose, into = np.divmod(t, HOLD_S + MOVE_S)
    x = np.clip((into - HOLD_S) / MOVE_S, 0, 1)[:, None]
    share, here = 10 * x**3 - 15 * x**4 + 6 * x**5, pose.astype(int)
    a = true[here] * (1 - share) + true[here + 1] * share
    u = a / np.linalg.norm(a, axis=1, keepdims=True) + SIGMA * rng.standard_normal((len(t), 3))
    return t, u, true[:POSES]


def in_bursts(t: Floats, every_s: float, jitter: float, seed: int) -> Floats:
    burst = np.floor(t / every_s + 1e-9).astype(int)
    at = (np.arange(burst[-1] + 1) + 1 + np.random.default_rng(seed).uniform(-jitter, jitter, burst[-1] + 1)) * every_s
    return np.asarray(at[burst] + (np.arange(len(t)) - np.searchsorted(burst, burst)) * 2e-5)


@pytest.mark.parametrize("jitter", [0.0, 0.25])
@pytest.mark.parametrize(
    ("rate_hz", "every_s"), [(100.0, 0.05), (100.0, 0.17), (100.0, 0.25), (400.0, 0.03), (400.0, 0.25)]
)
def test_bursts_give_the_poses_of_an_even_stream(rate_hz: float, every_s: float, jitter: float) -> None:
    z = []
    for seed in range(3):
        t, u, true = tumbled(seed, rate_hz)
        even, found = tc.find_poses(t, u), tc.find_poses(in_bursts(t, every_s, jitter, seed), u)
        assert len(found) == len(even) == POSES
        for ours, theirs in zip(found, even, strict=True):
            assert np.abs(ours.mean - theirs.mean).max() < 0.1 * theirs.standard_error.min()
            assert ours.standard_error == pytest.approx(theirs.standard_error, rel=0.1)
            assert abs(ours.start_s - theirs.start_s) < every_s
        assert [line.split(":")[0] for line in found.data_quality] == ["bursts"]
        z += [(p.mean - d) / p.standard_error for p, d in zip(found, true, strict=True)]
    # χ² of three seeds, twelve poses, three axes: √(2/108) wide.
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=5 * np.sqrt(2 / 108))


def test_bursts_with_lost_samples_give_the_same_poses_and_say_both() -> None:
    for seed in range(3):
        t, u, _ = tumbled(seed, 100.0)
        lost = np.isin(t // 0.25, np.random.default_rng(seed).choice(np.arange(20, 200, 5), 5, replace=False))
        even, found = tc.find_poses(t[~lost], u[~lost]), tc.find_poses(in_bursts(t, 0.25, 0.1, seed)[~lost], u[~lost])
        assert len(found) == len(even) == POSES
        assert {line.split(":")[0] for line in found.data_quality} == {"bursts", "missing_samples"}
        for ours, theirs in zip(found, even, strict=True):
            assert np.abs(ours.mean - theirs.mean).max() < theirs.standard_error.min()
