"""One shaken pose, or a move that shaking hides, costs the other poses nothing, and is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from benchmarks.noise import first_order, flicker, white
from benchmarks.streams import COVARIATES
from benchmarks.streams import made as stream_of
from triaxcal import find_poses
from triaxcal.api import Poses

SIGMA_G = 1e-4
HOLD_S, MOVE_S = 6.0, 2.0


@dataclass(frozen=True)
class Recording:
    """In g; ``pose`` (n,) which direction (k,3) is held, −1 on the way."""

    t_s: np.ndarray
    a: np.ndarray
    pose: np.ndarray
    directions: np.ndarray
    rate_hz: float

    def shaken(
        self, pose: int, seconds: float, by: np.ndarray | float, seed: int, band: tuple[float, float] | None, at: float
    ) -> Recording:
        """For so long of a pose, 0 ≤ ``at`` ≤ 1 of the way through it."""
        inside = np.flatnonzero(self.pose == pose)
        n = min(int(seconds * self.rate_hz), len(inside))
        first = int((len(inside) - n) * at)
        a = self.a.copy()
        a[inside[first : first + n]] += by * shaking(n, self.rate_hz, seed, band)
        return Recording(self.t_s, a, self.pose, self.directions, self.rate_hz)

    def poses(self) -> Poses:
        return find_poses(self.t_s, self.a)


def shaking(n: int, rate_hz: float, seed: int, band: tuple[float, float] | None) -> np.ndarray:
    """(n,3) of unit variance: white, or in a band."""
    rng = np.random.default_rng([seed, 99])
    if band is None:
        return rng.standard_normal((n, 3))
    settled = int(5 * rate_hz)
    sections = butter(2, [band[0], min(band[1], 0.49 * rate_hz)], "band", fs=rate_hz, output="sos")
    out = sosfilt(sections, rng.standard_normal((n + settled, 3)), axis=0)[settled:]
    return np.asarray(out / out.std())


FLOOR_HZ, HAND_HZ = (5.0, 20.0), (0.3, 11.0)


def made(
    directions: np.ndarray,
    seed: int,
    rate_hz: float = 50.0,
    hold_s: float = HOLD_S,
    noise: Callable[..., np.ndarray] = white,
    sigma_g: float = SIGMA_G,
    moves: Sequence[np.ndarray | None] = (),
) -> Recording:
    """``moves`` are what a hand adds to the way after each pose, where it does."""
    hold, move = int(hold_s * rate_hz), int(MOVE_S * rate_hz)
    x = ((np.arange(move) + 0.5) / move)[:, None]
    smooth = 10 * x**3 - 15 * x**4 + 6 * x**5
    parts, pose = [], []
    for i, here in enumerate(directions):
        there = directions[(i + 1) % len(directions)]
        way = here + smooth * (there - here)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        if i < len(moves) and (by_hand := moves[i]) is not None:
            way += np.sqrt(np.sin(np.pi * x)) * by_hand
        parts += [np.repeat(here[None], hold, axis=0), way]
        pose += [i] * hold + [-1] * move
    a = np.concatenate(parts)
    a = a + sigma_g * noise(len(a), np.random.default_rng(seed))
    return Recording(np.arange(len(a)) / rate_hz, a, np.array(pose), directions, rate_hz)


def typical_error(poses: Poses) -> float:
    return float(np.median([p.standard_error for p in poses]))


def named(poses: Poses, code: str) -> list[str]:
    return [line for line in poses.data_quality if line.startswith(f"{code}:")]


def pulls(poses: Poses, directions: np.ndarray) -> np.ndarray:
    """(k,3) of each pose, by the direction next to it."""
    nearest = [directions[int(np.argmax(directions @ p.mean))] for p in poses]
    return np.array([(p.mean - d) / p.standard_error for p, d in zip(poses, nearest, strict=True)])


SHAKEN = 11


def assert_the_others_do_not_notice(clean: Poses, shaken: Poses, directions: np.ndarray) -> None:
    assert typical_error(shaken) == pytest.approx(typical_error(clean), rel=0.2)
    assert len(shaken) == len(clean)
    assert len(named(shaken, "disturbed_pose")) == 1
    (disturbed,) = [p for p in shaken if p.shaken or p.restless > 1]
    assert disturbed.mean @ directions[SHAKEN] > 0.99
    assert np.abs(pulls(shaken, directions)).max() < 5


@pytest.mark.parametrize("seconds", [0.5, 2.0, HOLD_S])
@pytest.mark.parametrize("band", [None, FLOOR_HZ])
def test_a_shaken_pose_leaves_the_standard_errors_of_the_others(
    seconds: float, band: tuple[float, float] | None, fourteen: np.ndarray
) -> None:
    directions = np.random.default_rng(7).permutation(fourteen)
    clean = made(directions, 1)
    found = clean.shaken(SHAKEN, seconds, 0.02, 2, band, 0.5).poses()
    assert_the_others_do_not_notice(clean.poses(), found, directions)


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize("band", [None, FLOOR_HZ])
@pytest.mark.parametrize("mg", [10, 30])
def test_shaking_of_any_length_and_place_costs_the_others_nothing(
    rate_hz: float, band: tuple[float, float] | None, mg: int, twenty_six: np.ndarray
) -> None:
    directions = np.random.default_rng(7).permutation(twenty_six)
    for seed in range(5 if rate_hz < 100 else 2):
        clean = made(directions, seed, rate_hz)
        before = clean.poses()
        for seconds, at in [(0.5, 0.5), (2.0, 0.5), (2.0, 0.0), (2.0, 1.0), (HOLD_S, 0.0)]:
            found = clean.shaken(SHAKEN, seconds, mg * 1e-3, seed, band, at).poses()
            assert_the_others_do_not_notice(before, found, directions)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [white, lambda n, rng: first_order(n, 15, rng), lambda n, rng: flicker(n, 0.1, rng)])
@pytest.mark.parametrize("seconds", [2.0, HOLD_S])
@pytest.mark.parametrize("count", [14, 26])
def test_several_shaken_poses_in_noise_of_any_colour(
    noise: Callable[..., np.ndarray], seconds: float, count: int, twenty_six: np.ndarray
) -> None:
    directions = np.random.default_rng(7).permutation(twenty_six)[:count]
    ratios = []
    for seed in range(4):
        clean = made(directions, seed, noise=noise)
        shaken = clean
        for i in (1, 5, 9, 13):
            shaken = shaken.shaken(i, seconds, (0.01, 0.03)[i % 4 // 2], seed + i, (None, FLOOR_HZ)[seed % 2], 0.5)
        found = shaken.poses()
        ratios.append(typical_error(found) / typical_error(clean.poses()))
        assert sum(bool(p.shaken) or p.restless > 1 for p in found) == 4
    assert 1 / 1.5 < min(ratios) < max(ratios) < 1.5


def hidden_turn(directions: np.ndarray, seed: int, mg: float, band: tuple[float, float] | None) -> Recording:
    """One degree from a pose to the next by a hand that shakes; else as planned."""
    across = np.cross(directions[SHAKEN], [0.3, 0.5, 0.8])
    turned = directions[SHAKEN] + np.radians(1.0) * across / np.linalg.norm(across)
    held = np.insert(directions, SHAKEN + 1, turned / np.linalg.norm(turned), axis=0)
    by_hand: list[np.ndarray | None] = [None] * SHAKEN
    return made(held, seed, moves=[*by_hand, mg * 1e-3 * shaking(int(MOVE_S * 50.0), 50.0, seed, band)])


@pytest.mark.slow
@pytest.mark.parametrize("band", [None, FLOOR_HZ, HAND_HZ])
def test_a_turn_that_shaking_hides_makes_two_poses(band: tuple[float, float] | None, twenty_six: np.ndarray) -> None:
    directions = np.random.default_rng(7).permutation(twenty_six)
    usual, parted = typical_error(made(directions, 0).poses()), []
    for seed in range(10):
        found = hidden_turn(directions, seed, 30.0, band).poses()
        assert len(found) == 27
        assert typical_error(found) == pytest.approx(usual, rel=0.2)
        assert any(p.parted for p in found) == bool(named(found, "merged_poses"))
        parted += [p.t_s for p in found if p.parted]
    # By a hand's slow shaking some are seen as the moves that they are.
    assert len(parted) == 10 or band == HAND_HZ
    assert all(round((t - HOLD_S / 2) / (HOLD_S + MOVE_S)) == SHAKEN + 1 for t in parted)


def test_shaking_that_moves_nothing_parts_no_pose_though_it_creeps(fourteen: np.ndarray) -> None:
    directions = np.random.default_rng(7).permutation(fourteen)
    recording = made(directions, 3, hold_s=10.0)
    recording.a[:] += 2e-4 * recording.t_s[:, None]  # 2 mg along each pose
    found = recording.shaken(SHAKEN, 3.0, 0.02, 4, None, 0.5).poses()
    assert len(found) == 14
    assert not any(p.parted for p in found)
    assert sum(bool(p.shaken) for p in found) == 1


@pytest.mark.slow
@pytest.mark.parametrize("step_g", [0.0, 1e-4, 1e-3])
@pytest.mark.parametrize("dead_band", [False, True])
def test_nothing_undisturbed_is_called_disturbed(step_g: float, dead_band: bool, twenty_six: np.ndarray) -> None:
    directions = np.random.default_rng(7).permutation(twenty_six)
    for seed in range(3):
        recording = made(directions, seed, sigma_g=2e-4)
        a = recording.a
        if step_g:
            a = np.round(a / step_g) * step_g
        if dead_band:
            a = logged(a, 3 * (step_g or 2e-4))
        found = find_poses(recording.t_s, a)
        assert not named(found, "disturbed_pose") + named(found, "merged_poses")


def logged(a: np.ndarray, band: float) -> np.ndarray:
    """A logger that writes a reading once it differs by more than its dead band from the last one written."""
    out = a.copy()
    for i in range(1, len(a)):
        out[i] = np.where(np.abs(a[i] - out[i - 1]) > band, a[i], out[i - 1])
    return out


def test_a_move_that_shaking_hides_is_named_with_its_size(fourteen: np.ndarray) -> None:
    directions = np.random.default_rng(7).permutation(fourteen)
    found = hidden_turn(directions, 0, 30.0, None).poses()
    (moved,) = [i for i, p in enumerate(found) if p.parted]
    apart = np.abs(found[moved].mean - found[moved - 1].mean).max()
    (line,) = named(found, "merged_poses")
    assert f"by {apart:.2g}:" in line
    assert np.linalg.norm(found[moved].mean - found[moved - 1].mean) == pytest.approx(np.radians(1.0), rel=0.01)


@pytest.mark.slow
def test_hundreds_of_clean_recordings_show_no_disturbance() -> None:
    kinds = [
        c for c in COVARIATES if not (c.vibration_g or c.jitter_g or c.bump_g or c.rate_hz > 100 or c.hold_s[0] > 60)
    ]
    for c in kinds:
        for seed in range(300 // len(kinds)):
            stream = stream_of(c, seed)
            found = find_poses(stream.t_s, stream.readings)
            assert not named(found, "disturbed_pose") + named(found, "merged_poses"), (c.name, seed)
