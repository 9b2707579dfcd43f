"""Poses during which a machine shakes the stand are found whole, and moves that look like them are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from benchmarks.noise import first_order, white
from triaxcal.poses.pose import Pose
from triaxcal.poses.stillness.detector import Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows

Detect = Callable[..., tuple[Windows, list[Span], list[Pose]]]
NOISE_G = 2e-4
WINDOW_S = 0.1


@dataclass(frozen=True)
class Made:
    """A stream in g, when it was still (k,2) in s, and where to (k,3)."""

    t_s: np.ndarray
    a: np.ndarray
    holds: np.ndarray
    up: np.ndarray


def made(
    rng: np.random.Generator, up: np.ndarray, rate_hz: float, move_s: float, jitter_g: float = 0.03, hold_s: float = 5.0
) -> Made:
    """Moves by a hand that is not steady: arcs whose speed is smooth, and jitter that scatters as shaking does."""
    hold, move = int(hold_s * rate_hz), int(move_s * rate_hz)
    x = ((np.arange(move) + 0.5) / move)[:, None]
    smooth, parts = 10 * x**3 - 15 * x**4 + 6 * x**5, []
    for here, there in zip(up, [*up[1:], up[-1]], strict=True):
        arc = here + smooth * (there - here) + smooth * (1 - smooth) * np.cross(here, rng.standard_normal(3))
        jitter = jitter_g * np.sqrt(np.sin(np.pi * x)) * rng.standard_normal((move, 3))
        parts += [np.repeat(here[None], hold, axis=0), arc / np.linalg.norm(arc, axis=1, keepdims=True) + jitter]
    a = np.concatenate(parts[:-1])
    begin = np.arange(len(up)) * (hold + move) / rate_hz
    return Made(np.arange(len(a)) / rate_hz, a, np.stack([begin, begin + hold / rate_hz], axis=1), up)


def hum(rng: np.random.Generator, t_s: np.ndarray, hz: float) -> np.ndarray:
    """A tone and its harmonic, of about unit amplitude."""
    tones = [np.sin(2 * np.pi * k * hz * t_s[:, None] + rng.uniform(0, 6, 3)) / k for k in (1, 2)]
    return np.asarray(np.sum(tones, axis=0) * rng.uniform(0.5, 1.0, 3))


def hiss(rng: np.random.Generator, t_s: np.ndarray, hz: float) -> np.ndarray:
    """Noise in the octave above ``hz``, of unit variance."""
    sections = butter(2, [hz, 2 * hz], "band", fs=1 / t_s[1], output="sos")
    out = sosfilt(sections, rng.standard_normal((len(t_s), 3)), axis=0)
    return np.asarray(out / out.std())


def assert_each_hold_is_one_span(stream: Made, poses: list[Pose], *, covered: float) -> None:
    assert len(poses) == len(stream.holds)
    for (begin, end), p in zip(stream.holds, poses, strict=True):
        # What is shaken may be no part of the mean, but belongs to the hold.
        first = min([p.start_s, *(s.start_s for s in p.shaken)])
        last = max([p.end_s, *(s.end_s for s in p.shaken)])
        # Of a move that begins and ends smoothly the outermost window is still.
        assert first > begin - 1.5 * WINDOW_S
        assert last < end + 1.5 * WINDOW_S
        assert last - first > covered * (end - begin)


@pytest.mark.slow
@pytest.mark.parametrize("machine", [hum, hiss])
@pytest.mark.parametrize(("rate_hz", "hz"), [(100.0, 5.0), (50.0, 11.3), (200.0, 19.7), (100.0, 24.0), (1000.0, 190.0)])
@pytest.mark.parametrize("loud", [5, 50])
def test_poses_that_a_machine_shakes_are_found_over_their_whole_hold(
    machine: Callable[..., np.ndarray], rate_hz: float, hz: float, loud: int, fourteen: np.ndarray, detect: Detect
) -> None:
    rng = np.random.default_rng([int(hz), loud])
    stream = made(rng, rng.permutation(fourteen), rate_hz, 1.5)
    runs = np.arange(14) % 2 == 1
    on = runs[np.minimum((stream.t_s // 6.5).astype(int), 13)][:, None]
    u = stream.a + NOISE_G * (rng.standard_normal(stream.a.shape) + loud * on * machine(rng, stream.t_s, hz))
    poses = detect(stream.t_s, u)[2]
    assert_each_hold_is_one_span(stream, poses, covered=0.6)
    assert np.mean([p.end_s - p.start_s for p in poses]) > 0.8 * 5.0
    # The shaking is in the scatter that a pose states, and in its standard error; the mean is good all the same.
    pulls = np.array([(p.mean - v) / p.standard_error for p, v in zip(poses, stream.up, strict=True)])
    assert np.abs(pulls).max() < 5
    assert np.mean([p.scatter.sum() for p, r in zip(poses, runs, strict=True) if r]) > 3 * poses[0].scatter.sum()


@pytest.mark.parametrize("machine", [hum, hiss])
def test_a_machine_that_goes_on_and_off_inside_poses_splits_none(
    machine: Callable[..., np.ndarray], fourteen: np.ndarray, detect: Detect
) -> None:
    rng = np.random.default_rng(3)
    stream = made(rng, rng.permutation(fourteen), 100.0, 1.5, hold_s=8.0)
    on = (np.searchsorted(np.cumsum(rng.uniform(2.5, 6.0, 60)), stream.t_s) % 2)[:, None]
    u = stream.a + NOISE_G * (rng.standard_normal(stream.a.shape) + 30 * on * machine(rng, stream.t_s, 17.0))
    poses = detect(stream.t_s, u)[2]
    assert_each_hold_is_one_span(stream, poses, covered=0.6)
    # The machine costs a pose no more than the time that it runs.
    quiet = NOISE_G / np.sqrt(800)
    assert np.median([p.standard_error for p in poses]) < 2 * quiet
    pulls = np.array([(p.mean - v) / p.standard_error for p, v in zip(poses, stream.up, strict=True)])
    assert np.abs(pulls).max() < 5


@pytest.mark.parametrize("memory_s", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("move_s", [1.5, 3.0])
def test_moves_that_jitter_as_if_shaken_are_no_poses_nor_part_of_one_in_noise_of_any_memory(
    memory_s: float, move_s: float, twenty_six: np.ndarray, detect: Detect
) -> None:
    for seed in range(2):
        rng = np.random.default_rng([seed, int(10 * memory_s)])
        stream = made(rng, rng.permutation(twenty_six), 200.0, move_s)
        n = len(stream.t_s)
        noise = first_order(n, memory_s * 200, rng) if memory_s else white(n, rng)
        assert_each_hold_is_one_span(stream, detect(stream.t_s, stream.a + NOISE_G * noise)[2], covered=0.4)


def test_slow_turns_by_a_hand_that_jitters_are_no_poses(detect: Detect) -> None:
    """Ten degrees in seven seconds; a machine shakes every other pose as much as the hand does."""
    angle = np.radians(10.0) * np.arange(10)
    up = np.stack([np.cos(angle), np.sin(angle) * 0.8, np.sin(angle) * 0.6], axis=1)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stream = made(rng, up, 100.0, 7.0, jitter_g=0.01)
        on = (np.arange(10) % 2 == 1)[np.minimum((stream.t_s // 12).astype(int), 9)]
        still = (stream.t_s % 12 < 5) & on
        shaking = 0.01 * still[:, None] * hum(rng, stream.t_s, 23.0)
        poses = detect(stream.t_s, stream.a + NOISE_G * rng.standard_normal(stream.a.shape) + shaking)[2]
        assert len(poses) == 10
        for (begin, end), p in zip(stream.holds, poses, strict=True):
            # A smooth turn of 10° is within 0.2° of its end for the first 1.0 s and the last.
            assert begin - 1.0 < p.start_s < p.end_s < end + 1.0


def test_shaken_poses_are_the_same_in_blocks_of_any_size(fourteen: np.ndarray) -> None:
    rng = np.random.default_rng(8)
    stream = made(rng, fourteen, 100.0, 1.0, hold_s=4.0)
    on = (np.floor(stream.t_s / 7) % 2)[:, None]
    u = stream.a + NOISE_G * (rng.standard_normal(stream.a.shape) + 20 * on * hum(rng, stream.t_s, 31.0))
    time_ns = np.round(stream.t_s * 1e9).astype(np.int64)
    whole, pieces = StillnessDetector(), StillnessDetector()
    whole.feed(time_ns, u)
    for at in range(0, len(time_ns), 37):
        pieces.feed(time_ns[at : at + 37], u[at : at + 37])
        if at % 3700 == 1850:
            pieces.spans()
    for d in (whole, pieces):
        d.finish()
    found, expected = pieces.spans(), whole.spans()
    assert [(s.used.tolist(), s.vibrating.tolist(), s.parted) for s in found] == [
        (s.used.tolist(), s.vibrating.tolist(), s.parted) for s in expected
    ]
    assert len(whole.spans()) == 14
