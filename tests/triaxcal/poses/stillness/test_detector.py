"""The detector finds every pose of a tumble whose timing is known, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from benchmarks.noise import first_order
from triaxcal.errors import InvalidData, TooShort
from triaxcal.model.samples import Samples
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.poses.stillness.detector import Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows
from triaxcal.synthetic import SyntheticUnit, Tumble

Detect = Callable[..., tuple[Windows, list[Span], list[Pose]]]


@dataclass(frozen=True)
class Tumbled:
    """A stream, and when it was still."""

    t_s: np.ndarray
    u: np.ndarray
    path: Tumble

    def pose_of(self, pose: Pose) -> int:
        return int((pose.start_s + pose.end_s) / 2 // self.path.step_s)


def tumbled(
    sensor: Sensor,
    directions: np.ndarray,
    *,
    rate_hz: float = 100.0,
    hold_s: float = 5.0,
    move_s: float = 1.5,
    noise_g: float = 2e-4,
    seed: int = 0,
) -> Tumbled:
    path = Tumble(directions, hold_s, move_s)
    t_s = np.arange(int(rate_hz * path.round_s)) / rate_hz
    return Tumbled(t_s, SyntheticUnit(sensor, path, np.full(3, noise_g), seed=seed).sample(t_s)[0], path)


def shuffled(directions: np.ndarray, seed: int) -> np.ndarray:
    return directions[np.random.default_rng(seed).permutation(len(directions))]


def assert_each_once(stream: Tumbled, poses: list[Pose], *, inside: bool = True) -> None:
    assert [stream.pose_of(p) for p in poses] == list(range(len(stream.path.directions)))
    if inside:
        for i, p in enumerate(poses):
            assert p.start_s >= i * stream.path.step_s - 1e-6
            assert p.end_s <= i * stream.path.step_s + stream.path.hold_s + 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("hold_s", [2.0, 5.0, 10.0])
@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 62.5, 100.0, 400.0, 2000.0])
def test_every_pose_is_found_once_and_inside_its_hold_at_any_rate(
    rate_hz: float, hold_s: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    directions = shuffled(twenty_six, 0)[: 26 if rate_hz < 2000 else 9]
    stream = tumbled(paper_unit, directions, rate_hz=rate_hz, hold_s=hold_s, move_s=1.0)
    assert_each_once(stream, detect(stream.t_s, stream.u)[2])


@pytest.mark.slow
@pytest.mark.parametrize("noise_g", [1e-6, 2e-3, 1e-2])
def test_every_pose_is_found_whatever_the_noise(
    noise_g: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    for seed in range(2):
        stream = tumbled(paper_unit, shuffled(twenty_six, seed), noise_g=noise_g, seed=seed)
        assert_each_once(stream, detect(stream.t_s, stream.u)[2])


@pytest.fixture(scope="module")
def plain(paper_unit: Sensor, twenty_six: np.ndarray) -> Tumbled:
    """Not to be changed."""
    stream = tumbled(paper_unit, twenty_six)
    stream.u.flags.writeable = False
    return stream


@pytest.fixture(scope="module")
def plain_poses(plain: Tumbled, detect: Detect) -> list[Pose]:
    return detect(plain.t_s, plain.u)[2]


def test_most_of_every_hold_is_used(plain_poses: list[Pose]) -> None:
    for pose in plain_poses:
        assert pose.end_s - pose.start_s > 4.0
        assert pose.samples > 400


@pytest.mark.parametrize("apart_deg", [5.0, 2.0])
@pytest.mark.parametrize("move_s", [0.2, 1.5])
def test_poses_a_few_degrees_apart_are_told_apart(
    apart_deg: float, move_s: float, paper_unit: Sensor, detect: Detect
) -> None:
    angle = np.radians(apart_deg) * np.arange(8)
    directions = np.stack([np.cos(angle), np.sin(angle) * 0.8, np.sin(angle) * 0.6], axis=1)
    stream = tumbled(paper_unit, directions, move_s=move_s)
    assert_each_once(stream, detect(stream.t_s, stream.u)[2])


@pytest.mark.parametrize(("width_s", "height_g"), [(0.02, 1.0), (0.1, 1.0), (0.1, 0.01), (0.2, 0.01)])
def test_a_bump_inside_a_pose_does_not_split_it(
    width_s: float, height_g: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, twenty_six, hold_s=8.0)
    u = stream.u.copy()
    knocked = (3, 9, 15)
    for i in knocked:
        t = stream.t_s - (i * stream.path.step_s + 4.0)
        u += (height_g * np.exp(-0.5 * (t / width_s) ** 2) * np.sin(40 * t))[:, None] * paper_unit.scale_factor
    poses = detect(stream.t_s, u)[2]
    assert_each_once(stream, poses)
    truth = paper_unit.output(twenty_six, {})
    for i in knocked:
        assert np.max(np.abs((poses[i].mean - truth[i]) / poses[i].standard_error)) < 5


@pytest.mark.slow
@pytest.mark.parametrize("noise_g", [2e-4, 1e-2])
def test_slow_moves_whose_onset_the_noise_hides_put_no_bias_into_a_mean(
    noise_g: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    for seed in range(2):
        stream = tumbled(paper_unit, shuffled(twenty_six, seed), noise_g=noise_g, move_s=3.5, seed=seed)
        windows, spans, poses = detect(stream.t_s, stream.u)
        assert_each_once(stream, poses, inside=False)
        clean = paper_unit.output(stream.path.specific_force(stream.t_s), {})
        truth = paper_unit.output(stream.path.directions, {})
        first = [np.searchsorted(stream.t_s, windows.start_ns[s.used] * 1e-9 - 1e-6) for s in spans]
        rows = [clean[(f[:, None] + np.arange(windows.size)).ravel()] for f in first]
        bias = [(r.mean(axis=0) - v) / p.standard_error for r, v, p in zip(rows, truth, poses, strict=True)]
        assert np.max(np.abs(bias)) < 0.1


def test_poses_of_one_second_are_found_at_20_hz(paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect) -> None:
    for seed in range(4):
        stream = tumbled(paper_unit, shuffled(twenty_six, seed), rate_hz=20.0, hold_s=1.0, move_s=1.2, seed=seed)
        assert_each_once(stream, detect(stream.t_s, stream.u)[2])


@pytest.mark.parametrize("time_constant", [10.0, 50.0])
@pytest.mark.parametrize("hold_s", [5.0, 20.0])
def test_coloured_noise_neither_splits_a_pose_nor_hides_it(
    time_constant: float, hold_s: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, twenty_six, hold_s=hold_s, noise_g=1e-7)
    noise = first_order(len(stream.t_s), time_constant, np.random.default_rng(1)) * 2e-4
    assert_each_once(stream, detect(stream.t_s, stream.u + noise * paper_unit.scale_factor)[2])


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_poses_are_found_while_a_machine_beside_them_goes_on_and_off(
    rate_hz: float, paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, fourteen, rate_hz=rate_hz)
    running = np.floor(stream.t_s / 17.3) % 2 == 1
    shaking = np.where(running, 5e-3 * np.sin(2 * np.pi * 29.7 * stream.t_s), 0.0)
    poses = detect(stream.t_s, stream.u + shaking[:, None] * np.array([1.0, 0.7, 0.4]) * 2.4)[2]
    assert_each_once(stream, poses)


@pytest.mark.parametrize("vibration_hz", [4.3, 29.7, 61.0])
def test_steady_vibration_hides_no_pose(
    vibration_hz: float, paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, fourteen, rate_hz=200.0)
    shaking = 5e-3 * np.sin(2 * np.pi * vibration_hz * stream.t_s + np.arange(3)[:, None])
    assert_each_once(stream, detect(stream.t_s, stream.u + shaking.T * 2.4)[2])


def test_shaking_by_hand_between_poses_is_no_pose(paper_unit: Sensor, fourteen: np.ndarray, detect: Detect) -> None:
    stream = tumbled(paper_unit, fourteen, move_s=12.0)
    into = stream.t_s % stream.path.step_s - stream.path.hold_s
    way = np.random.default_rng(0).standard_normal((2, 3))
    shaken = np.sin(2 * np.pi * 3.1 * stream.t_s)[:, None] * way[0] + np.sin(17 * stream.t_s)[:, None] * way[1]
    u = stream.u + np.where(((into > 1) & (into < 11))[:, None], shaken * 5, 0.0)
    assert_each_once(stream, detect(stream.t_s, u)[2])


@pytest.mark.parametrize("creep_g", [2e-3, 2e-2])
def test_a_pose_that_creeps_is_found_whole_and_reported(
    creep_g: float, paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, fourteen)
    into = stream.t_s - 5 * stream.path.step_s
    creep = np.where((into >= 0) & (into < 5), (into / 5 - 0.5) * creep_g, 0.0)
    poses = detect(stream.t_s, stream.u + creep[:, None] * np.array([2.0, -2.0, 0.5]))[2]
    assert_each_once(stream, poses)
    assert [bool(np.any(p.creep)) for p in poses] == [i == 5 for i in range(14)]
    assert poses[5].end_s - poses[5].start_s > 3.5


def test_a_burst_at_the_start_does_not_mislead_about_the_sample_rate(
    paper_unit: Sensor, fourteen: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, fourteen)
    t_s = stream.t_s.copy()
    t_s[:40] = t_s[40] - 1e-5 * np.arange(40, 0, -1)
    windows, _, poses = detect(t_s, stream.u)
    assert windows.size == 10
    assert len(poses) == 14


def test_a_stream_that_only_stands_still_is_one_pose(detect: Detect) -> None:
    t_s = np.arange(3000) / 100
    _, _, poses = detect(t_s, 1e-4 * np.random.default_rng(0).standard_normal((3000, 3)) + [0.1, 0.2, 0.9])
    assert len(poses) == 1
    assert poses[0].end_s - poses[0].start_s > 29


@pytest.mark.parametrize("turns_hz", [0.05, 0.2, 0.5, 1.0, 2.0])
def test_a_steady_rotation_has_no_pose(turns_hz: float, detect: Detect) -> None:
    t_s = np.arange(3000) / 100
    noise = 1e-3 * np.random.default_rng(0).standard_normal((3000, 3))
    turn = 2 * np.pi * turns_hz * t_s
    assert detect(t_s, np.stack([np.sin(turn), np.cos(turn), 0 * turn], axis=1) + noise)[2] == []


@pytest.mark.parametrize("seed", range(10))
def test_tumbling_without_a_stop_has_no_pose(seed: int, detect: Detect) -> None:
    rng = np.random.default_rng(seed)
    v = gaussian_filter1d(rng.standard_normal((6000, 3)), 30, axis=0)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    assert detect(np.arange(6000) / 100, v + 1e-3 * rng.standard_normal((6000, 3)))[2] == []


@pytest.mark.parametrize("steps_per_sigma", [0.05, 0.2, 1.0, 10.0])
def test_quantised_outputs_show_every_pose_with_honest_errors(
    steps_per_sigma: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    noise_g = 2e-4
    stream = tumbled(paper_unit, twenty_six, noise_g=noise_g)
    step = noise_g / steps_per_sigma * 2.4
    poses = detect(stream.t_s, np.round(stream.u / step) * step)[2]
    assert_each_once(stream, poses, inside=steps_per_sigma >= 1)
    truth = paper_unit.output(twenty_six, {})
    pulls = np.array([(p.mean - v) / p.standard_error for p, v in zip(poses, truth, strict=True)])
    # Rounding errors are uniform, not normal: at most √3 standard errors where there is no noise to speak of.
    assert np.max(np.abs(pulls)) < 4.5
    assert np.mean(pulls**2) < 1.5


@pytest.mark.slow
def test_outputs_far_from_zero_give_the_same_poses(plain: Tumbled, detect: Detect) -> None:
    counts = np.round(plain.u * 1e6)
    _, spans, poses = detect(plain.t_s, counts)
    for offset in (32768.0, 2.0**23, -(2.0**31)):
        _, moved_spans, moved = detect(plain.t_s, counts + offset)
        assert [s.used.tolist() for s in moved_spans] == [s.used.tolist() for s in spans]
        for here, there in zip(poses, moved, strict=True):
            assert there.mean - offset == pytest.approx(here.mean, abs=1e-5)
            assert there.standard_error == pytest.approx(here.standard_error, rel=1e-3)


def test_constant_readings_are_one_still_span_without_a_warning(detect: Detect) -> None:
    t_s = np.arange(3000) / 100
    for readings in (np.ones((3000, 3)), np.zeros((3000, 3)), np.full((3000, 3), 2.0**23)):
        _, _, poses = detect(t_s, readings)
        assert len(poses) == 1
        assert poses[0].mean == pytest.approx(readings[0])
        assert np.isfinite(poses[0].covariance).all()


@pytest.mark.slow
def test_one_stuck_axis_hides_no_pose_of_the_others(plain: Tumbled, detect: Detect) -> None:
    u = plain.u.copy()
    u[:, 2] = 1.25
    poses = detect(plain.t_s, u)[2]
    assert len(poses) >= 20
    assert all(p.mean[2] == pytest.approx(1.25) and np.isfinite(p.covariance).all() for p in poses)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("share", "axes"), [*((share, [0]) for share in (0.1, 0.17, 0.22, 0.4, 0.7)), (0.17, [0, 1, 2]), (0.7, [0, 1, 2])]
)
def test_a_frozen_output_hides_no_pose_elsewhere(
    share: float, axes: list[int], plain: Tumbled, plain_poses: list[Pose], detect: Detect
) -> None:
    n = len(plain.u)
    begin, end = n // 5, n // 5 + int(share * n)
    u = plain.u.copy()
    u[begin:end, axes] = u[begin, axes]
    found = detect(plain.t_s, u)[2]
    # A window may begin in a pose and end in what is frozen.
    away = [p for p in plain_poses if p.end_s < begin / 100 - 0.1 or p.start_s > end / 100 + 0.1]
    assert len(away) >= 26 * (1 - share) - 2
    for p in away:
        (same,) = [f for f in found if p.start_s - 0.3 < f.start_s and f.end_s < p.end_s + 0.3]
        assert same.end_s - same.start_s > 3.0


@pytest.mark.parametrize("every_s", [3.0, 7.1])
def test_an_output_that_freezes_again_and_again_is_no_pose_and_splits_none(
    every_s: float, paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, twenty_six)
    u = stream.u.copy()
    for begin in np.arange(0.0, stream.path.round_s, every_s):
        at = np.flatnonzero((stream.t_s >= begin) & (stream.t_s < begin + 1.0))
        u[at] = u[at[0]]
    poses = detect(stream.t_s, u)[2]
    assert_each_once(stream, poses)
    truth = paper_unit.output(twenty_six, {})
    for i, p in enumerate(poses):
        assert np.max(np.abs((p.mean - truth[i]) / p.standard_error)) < 6


@pytest.mark.parametrize("count", [0, 1, 5, 11])
def test_too_few_samples_for_a_window_are_an_error(count: int, detect: Detect) -> None:
    with pytest.raises(TooShort, match=f"too short: a still pose takes at least .*, and it has {count}( |$)"):
        detect(np.arange(count) / 100, np.zeros((count, 3)))


def test_many_samples_in_bursts_shorter_than_a_window_are_told_as_such(detect: Detect) -> None:
    bursts = (np.arange(500) * 17.0)[:, None] + np.arange(6)
    with pytest.raises(TooShort, match=r", and the longest stretch without a gap has 6 in 0\.0\d+ s$"):
        detect(bursts.ravel() / 1000, np.zeros((3000, 3)))


@pytest.mark.parametrize("count", [12, 30, 63, 64, 65])
def test_few_samples_are_too_short_for_a_pose(count: int, detect: Detect) -> None:
    windows, spans, poses = detect(np.arange(count) / 100, np.random.default_rng(0).standard_normal((count, 3)))
    assert len(windows) == count // 10
    assert (spans, poses) == ([], [])


def noise_of(t_s: np.ndarray, seed: int = 0) -> StillnessDetector:
    detector = StillnessDetector()
    detector.feed(np.rint(t_s * 1e9).astype(np.int64), np.random.default_rng(seed).standard_normal((len(t_s), 3)))
    detector.finish()
    return detector


@pytest.mark.parametrize(
    ("rate_hz", "least"), [(1, 15), (10, 15), (25, 18), (30, 21), (50, 35), (100, 70), (333, 231), (1000, 700)]
)
def test_the_least_samples_are_those_of_the_shortest_pose_that_is_found(rate_hz: int, least: int) -> None:
    enough = [noise_of(np.arange(least) / rate_hz, seed) for seed in range(5)]
    assert [d.too_short() for d in enough] == [None] * 5
    assert any(d.spans() for d in enough)  # of 15 samples one in ten scatters too unevenly
    for short in (noise_of(np.arange(least - 1) / rate_hz, seed) for seed in range(5)):
        assert f"at least {least} samples" in str(short.too_short())
        assert f"and it has {least - 1} in " in str(short.too_short())
        assert short.spans() == []


def test_a_stream_of_short_pieces_is_too_short_by_the_longest() -> None:
    starts_s = 3.0 * np.arange(20)
    pieces = noise_of((starts_s[:, None] + np.arange(50) / 100).ravel())
    assert str(pieces.too_short()) == (
        "too short: a still pose takes at least 70 samples (0.69 s at this rate), and the longest stretch without a gap"
        " has 50 in 0.49 s"
    )
    assert pieces.spans() == []


def test_one_reading_that_is_no_number_is_refused() -> None:
    readings = np.zeros((100, 3))
    readings[41, 1] = np.nan
    time_ns = np.arange(100) * 10_000_000
    with pytest.raises(InvalidData, match="reading 41: y is not a finite number; leave such rows out first"):
        Samples(time_ns, readings)
    with pytest.raises(InvalidData, match="at 410000000 ns is not a finite number"):
        StillnessDetector().feed(time_ns, readings)


@pytest.mark.parametrize(
    ("time_ns", "shape", "why"),
    [([0, 10, 10], (3, 3), "does not increase at sample 2"), ([0, 10, 20], (2, 3), "expected shape")],
)
def test_samples_that_cannot_be_are_refused(time_ns: list[int], shape: tuple[int, int], why: str) -> None:
    with pytest.raises(InvalidData, match=why):
        Samples(np.array(time_ns), np.zeros(shape))


def test_a_short_silence_inside_a_pose_leaves_it_one(
    paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, twenty_six)
    into = stream.t_s % stream.path.step_s
    kept = ~((into > 2.0) & (into < 2.4))
    windows, _, poses = detect(stream.t_s[kept], stream.u[kept])
    assert_each_once(stream, poses)
    assert np.all(windows.end_ns - windows.start_ns < 0.11e9)


def test_a_long_silence_ends_a_pose(paper_unit: Sensor, fourteen: np.ndarray, detect: Detect) -> None:
    stream = tumbled(paper_unit, fourteen, hold_s=9.0)
    kept = ~((stream.t_s > 3.0) & (stream.t_s < 6.0))
    poses = detect(stream.t_s[kept], stream.u[kept])[2]
    assert [stream.pose_of(p) for p in poses] == [0, 0, *range(1, 14)]


def test_a_recorder_that_pauses_while_the_unit_moves_does_not_merge_poses(
    paper_unit: Sensor, twenty_six: np.ndarray, detect: Detect
) -> None:
    stream = tumbled(paper_unit, twenty_six, move_s=1.0)
    kept = stream.t_s % stream.path.step_s <= stream.path.hold_s
    assert_each_once(stream, detect(stream.t_s[kept], stream.u[kept])[2])


def holey_stream() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    rng = np.random.default_rng(5)
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0.6, 0.8], [-1, 0, 0]], dtype=float)
    sensor = Sensor(np.full(3, 2.0), np.zeros(3), np.zeros(3))
    path = Tumble(corners, 2.0, 0.7)
    t_s = np.arange(1080) / 100 + 1e-4 * rng.uniform(size=1080)
    u = SyntheticUnit(sensor, path, np.full(3, 1e-3), seed=5).sample(t_s)[0]
    kept = np.ones(1080, dtype=bool)
    for start, length in ((37, 9), (300, 1), (455, 5), (700, 60), (761, 8)):
        kept[start : start + length] = False
    return np.round(t_s[kept] * 1e9).astype(np.int64), u[kept], {"temp_c": 20 + t_s[kept]}


HOLEY = holey_stream()


@pytest.fixture(scope="module")
def holey() -> tuple[Windows, list[list[int]]]:
    """Windows and spans of the whole of it at once."""
    whole = StillnessDetector()
    whole.feed(*HOLEY)
    whole.finish()
    return whole.windows(), [s.used.tolist() for s in whole.spans()]


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(cuts=st.lists(st.integers(0, len(HOLEY[0])), max_size=40), ask=st.booleans())
def test_blocks_of_any_size_give_exactly_the_same_windows_and_spans(
    cuts: list[int], ask: bool, holey: tuple[Windows, list[list[int]]]
) -> None:
    time_ns, u, channels = HOLEY
    pieces = StillnessDetector()
    for start, stop in zip([0, *sorted(cuts)], [*sorted(cuts), len(time_ns)], strict=True):
        pieces.feed(time_ns[start:stop], u[start:stop], {n: v[start:stop] for n, v in channels.items()})
        if ask and stop > 200:
            pieces.spans()
    pieces.finish()
    (expected, spans), got = holey, pieces.windows()
    for name in ("start_ns", "end_ns", "mean", "variance", "cross", "joined"):
        assert np.array_equal(getattr(got, name), getattr(expected, name)), name
    assert np.array_equal(got.channels["temp_c"], expected.channels["temp_c"])
    assert [s.used.tolist() for s in pieces.spans()] == spans
    assert len(spans) == 4


def test_one_sample_at_a_time_gives_the_same_as_all_at_once() -> None:
    time_ns, u, _ = HOLEY
    whole, single = StillnessDetector(), StillnessDetector()
    whole.feed(time_ns, u)
    for i in range(len(time_ns)):
        single.feed(time_ns[i : i + 1], u[i : i + 1])
    assert np.array_equal(single.windows().mean, whole.windows().mean)
    assert [s.used.tolist() for s in single.spans()] == [s.used.tolist() for s in whole.spans()]


def test_memory_grows_by_the_window_not_by_the_sample() -> None:
    detector = StillnessDetector()
    for i in range(200):
        time_ns = (np.arange(2000) + 2000 * i) * 500_000
        detector.feed(time_ns, np.zeros((2000, 3)))
    windows = detector.windows()
    assert len(windows) == 2000
    kept = sum(getattr(windows, n).nbytes for n in ("start_ns", "end_ns", "mean", "variance", "cross", "joined"))
    assert kept / len(windows) < 120
    assert sum(len(block[0]) for block in detector._pending) < windows.size


@pytest.mark.parametrize("noise_g", [0.0, 1e-7, 1e-4, 1e-2])
def test_poses_with_nothing_between_them_are_found_with_or_without_noise(
    noise_g: float, twenty_six: np.ndarray, detect: Callable[..., Any]
) -> None:
    """Made-up streams step from pose to pose, and may have no noise whose size could be learned."""
    t_s = np.arange(26 * 300) / 100
    step = np.arange(len(t_s)) // 300
    noise = noise_g * np.random.default_rng(1).standard_normal((len(t_s), 3))
    _, _, poses = detect(t_s, 2.4 * (twenty_six[step] + noise) + 0.01)
    assert [int(p.t_s // 3) for p in poses] == list(range(26))
    assert all(3 * i <= p.start_s and p.end_s < 3 * (i + 1) for i, p in enumerate(poses))
    # Nothing of a pose is given away where no move sets out.
    assert all(p.end_s - p.start_s > 2.3 for p in poses)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e150])
def test_readings_that_cannot_be_reckoned_with_are_refused(value: float, detect: Callable[..., Any]) -> None:
    u = np.zeros((500, 3))
    u[77, 1] = value
    with pytest.raises(InvalidData, match="770000000 ns is not a finite number"):
        detect(np.arange(500) / 100, u)
