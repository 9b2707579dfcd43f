"""What a raw stream is blamed for: truly, in any unit and at any rate, and nothing where there is nothing."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from benchmarks.noise import first_order, flicker, white
from triaxcal.arrays import Floats, Ints
from triaxcal.poses.quality import QualityDetector, QualityFinding, mains
from triaxcal.poses.quality.faults import Gaps, coarse_quantization
from triaxcal.poses.quality.finding import (
    AtRail,
    CoarseQuantization,
    DuplicateSamples,
    MainsPickup,
    MissingSamples,
    Saturation,
    SlowUpdate,
    StillIntervals,
    StuckOutput,
    Touched,
)
from triaxcal.poses.quality.mains import bands
from triaxcal.poses.stillness.detector import StillnessDetector

NOISE = 3e-4
HOLD_S, MOVE_S = 4.0, 1.0
POSES = 12
Noise = Callable[[int, np.random.Generator], Floats]


def stream(
    seed: int, rate_hz: float = 100.0, *, noise: Noise = white, sigma: float = NOISE, step: float = 0.0
) -> tuple[Ints, Floats]:
    """A unit that goes from pose to pose, in g; ``step`` rounds the outputs."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((POSES + 1, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    t = np.arange(int(POSES * (HOLD_S + MOVE_S) * rate_hz)) / rate_hz
    pose, into = np.divmod(t, HOLD_S + MOVE_S)
    x = np.clip((into - HOLD_S) / MOVE_S, 0, 1)
    share = (10 * x**3 - 15 * x**4 + 6 * x**5)[:, None]
    here = pose.astype(int)
    a = directions[here] * (1 - share) + directions[here + 1] * share
    u = a / np.linalg.norm(a, axis=1, keepdims=True) + sigma * noise(len(t), rng)
    return np.round(t * 1e9).astype(np.int64), np.round(u / step) * step if step else u


def judged(time_ns: Ints, u: Floats, block: int = 10**9) -> list[QualityFinding]:
    still, quality = StillnessDetector(), QualityDetector()
    still.feed(time_ns, u)
    still.finish()
    for at in range(0, len(time_ns), block):
        quality.feed(time_ns[at : at + block], u[at : at + block])
    quality.finish()
    return quality.findings(still.windows(), still.spans())


def names(found: list[QualityFinding]) -> list[str]:
    return [f.name for f in found]


def hum(time_ns: Ints, hz: float, amplitude: float) -> Floats:
    return amplitude * np.sin(2 * np.pi * hz * time_ns * 1e-9 + 1.0)[:, None] * np.array([1.0, 0.5, 0.0])


def spoiled(rate_hz: float = 100.0, step: float = 1e-4) -> tuple[Ints, Floats]:
    """A stream with a fault of nearly every kind."""
    time_ns, u = stream(1, rate_hz, step=step)
    u = np.round((u + hum(time_ns, 60.0, 4 * NOISE)) / step) * step
    u[:, 0] = np.minimum(u[:, 0], np.round(0.9 / step) * step)
    n = int(rate_hz)
    u[20 * n : 21 * n, 1] = u[20 * n, 1]
    kept = np.ones(len(u), dtype=bool)
    kept[[30 * n, 31 * n, 31 * n + 1]] = False
    return time_ns[kept], u[kept]


@pytest.mark.parametrize("block", [1, 97, 4096])
def test_what_is_found_does_not_depend_on_the_blocks(block: int) -> None:
    time_ns, u = spoiled()
    found = judged(time_ns, u)
    assert names(found) == ["saturation", "stuck_output", "missing_samples", "mains_pickup"]
    assert judged(time_ns, u, block) == found


@pytest.mark.parametrize("scale", [1e-5, 1.0, 9.80665, 2.0**20])
def test_what_is_found_does_not_depend_on_the_unit(scale: float) -> None:
    time_ns, u = spoiled()
    one, other = judged(time_ns, u), judged(time_ns, u * scale)
    assert names(one) == names(other)
    assert [f.poses for f in one] == [f.poses for f in other]


NOISES: dict[str, Noise] = {
    "white": white,
    "first order": lambda n, rng: first_order(n, 10.0, rng),
    "1/f": lambda n, rng: flicker(n, 0.05, rng),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("step", "rate_hz", "kind"),
    [
        *itertools.product([0.0, NOISE / 10, NOISE], [100.0], NOISES),
        *itertools.product([0.0, NOISE], [20.0, 500.0], ["white", "1/f"]),
    ],
)
def test_a_clean_stream_is_blamed_for_nothing(step: float, rate_hz: float, kind: str) -> None:
    seeds = 5
    blamed = sum(bool(judged(*stream(s, rate_hz, noise=NOISES[kind], step=step))) for s in range(seeds))
    # One percent of five streams: two of them are blamed less than once in a thousand times.
    assert stats.binom.sf(blamed - 1, seeds, 0.01) > 1e-3


def test_a_stream_without_noise_is_blamed_for_nothing() -> None:
    assert judged(*stream(2, sigma=0.0)) == []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(4))
def test_quiet_poses_beside_a_machine_are_not_frozen(seed: int) -> None:
    time_ns, u = stream(seed, sigma=0.2 * NOISE)
    shaken = ((time_ns * 1e-9 // (HOLD_S + MOVE_S)) % 2 == 0)[:, None]
    machine = 20 * np.sin(2 * np.pi * 31.3 * time_ns * 1e-9)[:, None] + np.random.default_rng(seed).normal(
        0, 6, u.shape
    )
    u = np.round((u + shaken * NOISE * machine) / NOISE) * NOISE
    assert not {"stuck_output", "saturation", "duplicate_samples"} & set(names(judged(time_ns, u)))


@pytest.mark.parametrize("kind", ["noisy", "rounded", "smooth"])
def test_a_unit_that_turns_all_the_time_is_blamed_for_nothing(kind: str) -> None:
    rng = np.random.default_rng(20)
    t = np.arange(12_000) * 0.01
    u = np.stack([np.sin(2 * t) * np.cos(0.7 * t), np.cos(2 * t) * np.cos(0.7 * t), np.sin(0.7 * t)], axis=1)
    if kind == "noisy":
        u = u + NOISE * rng.standard_normal(u.shape)
    if kind != "smooth":
        u = np.round(u / NOISE) * NOISE
    assert judged(np.round(t * 1e9).astype(np.int64), u) == []


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_a_rail_is_named_with_the_pose_that_it_touches(rate_hz: float) -> None:
    time_ns, u = stream(3, rate_hz)
    middles = ((np.arange(POSES) + 0.4) * (HOLD_S + MOVE_S) * rate_hz).astype(int)
    pose = int(np.argmax(u[middles, 0]))
    rail = round(float(u[middles[pose], 0]) - 10 * NOISE, 4)
    clipped = np.minimum(u, [rail, 9.0, 9.0])
    (found,) = judged(time_ns, clipped)
    assert found.poses == (pose,)
    count = int((clipped[:, 0] == rail).sum())
    assert isinstance(found, Saturation)
    (at_rail,) = found.rails
    assert (at_rail.axis, at_rail.rail) == ("x", rail)
    assert abs(at_rail.samples - count) <= 0.1 * rate_hz  # the last stretch may be cut
    assert at_rail.touched.starts_s == (pytest.approx(pose * (HOLD_S + MOVE_S), abs=0.4),)


@pytest.mark.parametrize("place", [-1.0, 0.0, 1.0])
def test_noise_that_a_rail_cuts_on_one_side_is_found(place: float) -> None:
    time_ns, u = stream(4, step=NOISE / 8)
    top = np.argmax([np.median(u[i * 500 : i * 500 + 400, 2]) for i in range(POSES)])
    rail = np.round((np.median(u[top * 500 : top * 500 + 400, 2]) / NOISE + place) * 8) * NOISE / 8
    found = judged(time_ns, np.minimum(u, [9.0, 9.0, rail]))
    assert names(found) == ["saturation"]
    assert found[0].poses == (top,)


def test_counts_that_end_where_an_integer_ends_are_a_rail_even_once() -> None:
    time_ns, u = stream(5)
    counts = np.round(u * 2048 + 4 * np.random.default_rng(0).standard_normal(u.shape))
    counts[450] = [32767, -32768, 9000]
    (found,) = judged(time_ns, counts)
    first_s = pytest.approx(4.5, abs=0.1)
    assert found == Saturation((AtRail("x", 32767, 1, first_s, Touched()), AtRail("y", -32768, 1, first_s, Touched())))


@pytest.mark.parametrize("rate_hz", [20.0, 100.0, 1000.0])
def test_a_frozen_axis_is_named_with_its_value_and_length(rate_hz: float) -> None:
    time_ns, u = stream(6, rate_hz)
    n = int(rate_hz)
    u[21 * n : 23 * n, 1] = u[21 * n, 1]
    (found,) = judged(time_ns, u)
    assert isinstance(found, StuckOutput)
    (freeze,) = found.freezes
    assert (freeze.axis, freeze.value, freeze.times, freeze.longest) == ("y", u[21 * n, 1], 1, 2 * n)
    assert freeze.first_s == pytest.approx(21.0, abs=0.1)
    assert found.poses


def test_all_axes_frozen_are_said_once() -> None:
    time_ns, u = stream(7)
    u[2100:2300] = u[2100]
    (found,) = judged(time_ns, u)
    assert isinstance(found, StuckOutput)
    (freeze,) = found.freezes
    assert (freeze.axis, freeze.times, freeze.longest) == (None, 1, 200)
    assert freeze.first_s == pytest.approx(21.0, abs=0.1)


def test_an_axis_that_never_changes_is_stuck() -> None:
    time_ns, u = stream(8)
    u[:, 2] = 0.25
    assert judged(time_ns, u) == [StuckOutput(("z",), None, ())]


@pytest.mark.parametrize("every", [1.25, 2.0, 5.0])
def test_a_sensor_read_faster_than_it_updates_is_told_its_rate(every: float) -> None:
    time_ns, u = stream(9)
    fresh = np.floor(np.floor(np.arange(len(u)) / every + 1e-9) * every + 1e-9).astype(int)
    (found,) = judged(time_ns, u[fresh])
    slow = SlowUpdate(pytest.approx(every, rel=0.005), pytest.approx(100, rel=1e-3))
    assert found == StuckOutput((), slow, ())


def test_single_samples_that_come_twice_are_duplicates() -> None:
    time_ns, u = stream(10)
    again = np.arange(50, 5000, 100)
    u[again] = u[again - 1]
    (found,) = judged(time_ns, u)
    assert found == DuplicateSamples(50, 5999)


def test_gaps_are_counted_by_the_times() -> None:
    time_ns, u = stream(11)
    kept = np.ones(len(u), dtype=bool)
    kept[[1000, 2000, 2001, 2002]] = False
    (found,) = judged(time_ns[kept], u[kept])
    assert found == MissingSamples(missing=4, of=6000, gaps=2, longest=3, first_s=pytest.approx(10.0, abs=0.02))


def _gaps(times: Floats) -> tuple[int, int, int]:
    gaps = Gaps()
    time_ns = np.maximum.accumulate(np.round(np.sort(times) * 1e9).astype(np.int64) + np.arange(len(times)))
    for at in range(0, len(time_ns), 4100):
        gaps.feed(time_ns[at : at + 4100])
    gaps.feed(time_ns[:0], last=True)
    return gaps.missing, gaps.gaps, gaps.longest


def _times() -> dict[str, Floats]:
    rng = np.random.default_rng(12)
    n = np.arange(15_000)
    stalled = n + rng.exponential(0.2, len(n))
    for at in (3000, 8000, 12000):
        stalled[at : at + 20] = np.maximum(stalled[at : at + 20], stalled[at] + 20)
    return {
        "even": n * 0.01,
        "a clock that wanders by a percent": 0.01 * n * (1 + 0.01 * np.sin(n / 5e3)),
        "times that scatter": 0.01 * (n + rng.normal(0, 0.2, len(n))),
        "late by chance": 0.01 * (n + rng.exponential(1.0, len(n))),
        "bursts of ten": 0.01 * (n // 10 * 10 + 9) + 1e-5 * (n % 10),
        "a receiver that stalls": 0.01 * stalled,
    }


@pytest.mark.parametrize("kind", _times())
def test_late_time_stamps_are_no_gaps_and_gaps_among_them_are(kind: str) -> None:
    times = _times()[kind]
    assert _gaps(times) == (0, 0, 0)
    kept = np.ones(len(times), dtype=bool)
    kept[5000:5030] = kept[10_001:10_007] = False
    assert _gaps(times[kept]) == (36, 2, 30)


@pytest.mark.parametrize(
    ("hz", "rate_hz", "shown"),
    [
        (50.0, 1000.0, "50.0 Hz"),
        (49.5, 500.0, "49.5 Hz"),
        (50.9, 500.0, "50.9 Hz"),
        (60.0, 200.0, "60.0 Hz"),
        (100.0, 500.0, "100.0 Hz"),
        (150.0, 500.0, "150.0 Hz"),
        (180.0, 1000.0, "180.0 Hz"),
    ],
)
def test_a_line_of_the_mains_is_named_with_its_frequency_and_amplitude(hz: float, rate_hz: float, shown: str) -> None:
    time_ns, u = stream(13, rate_hz)
    (found,) = judged(time_ns, u + hum(time_ns, hz, 3 * NOISE))
    assert isinstance(found, MainsPickup)
    (tone,) = found.tones
    assert (f"{tone.frequency_hz:.1f} Hz", tone.alias_of_hz) == (shown, None)
    x, y, _ = tone.amplitude
    # Amplitudes of lines in noise: a standard deviation of √(2/n) σ for n samples; a twentieth for the window.
    limit = 4 * NOISE * np.sqrt(2 / (POSES * HOLD_S * rate_hz)) + 0.05 * 3 * NOISE
    assert abs(x - 3 * NOISE) < limit
    assert abs(y - 1.5 * NOISE) < limit


def test_a_line_is_found_in_a_long_stream_of_which_few_segments_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mains, "SEGMENTS_MOST", 32)
    time_ns, u = stream(13, 500.0)
    spectra = mains.Spectra(2e6)
    spectra.feed(time_ns, u.T)
    assert spectra.every == 4, "of about 120 segments a quarter, of 60 a half would be too many"
    kept = np.array(spectra._start_ns) / 0.5e9
    assert kept == pytest.approx(np.arange(0, 4 * len(kept), 4))
    (found,) = judged(time_ns, u + hum(time_ns, 50.0, 3 * NOISE))
    assert isinstance(found, MainsPickup)
    (tone,) = found.tones
    assert tone.frequency_hz == pytest.approx(50.0, abs=0.1)
    assert tone.amplitude[0] == pytest.approx(3 * NOISE, rel=0.1)


@pytest.mark.parametrize(("hz", "rate_hz", "at"), [(60.0, 100.0, 40.0), (50.0, 62.5, 12.5), (50.0, 70.0, 20.0)])
def test_a_folded_line_is_said_to_be_an_alias_or_a_vibration(hz: float, rate_hz: float, at: float) -> None:
    time_ns, u = stream(14, rate_hz)
    (found,) = judged(time_ns, u + hum(time_ns, hz, 3 * NOISE))
    assert isinstance(found, MainsPickup)
    assert found.rate_hz == pytest.approx(rate_hz, rel=1e-3)
    (tone,) = found.tones
    assert (round(tone.frequency_hz, 1), tone.alias_of_hz) == (at, hz)


@pytest.mark.parametrize("hz", [24.7, 47.0, 53.0, 57.0, 97.0])
@pytest.mark.parametrize("amplitude", [1.0, 100.0])
def test_a_motor_is_not_the_mains(hz: float, amplitude: float) -> None:
    time_ns, u = stream(15, 500.0)
    assert "mains_pickup" not in names(judged(time_ns, u + hum(time_ns, hz, amplitude * NOISE)))


@pytest.mark.parametrize("rate_hz", [20.0, 62.5, 100.0, 200.0, 1000.0, 10_000.0])
def test_every_band_lies_about_the_alias_of_its_source(rate_hz: float) -> None:
    size = 2 * round(rate_hz / 2)
    t = np.arange(size) / rate_hz
    for band in bands(rate_hz, size):
        seen = np.abs(np.fft.rfft(np.cos(2 * np.pi * band.source_hz * t + 0.7)))
        assert abs(int(np.argmax(seen)) * rate_hz / size - band.at_hz) <= rate_hz / size
        assert not (band.inside & band.flank).any()


def test_knocks_in_a_pose_are_no_line() -> None:
    time_ns, u = stream(16, 500.0)
    t = time_ns * 1e-9
    for at in (2.0, 12.0, 17.0):
        ringing = np.exp(-np.maximum(t - at, 0) / 0.1) * np.sin(2 * np.pi * 50 * (t - at)) * (t > at)
        u[:, 0] += 20 * NOISE * ringing
    assert "mains_pickup" not in names(judged(time_ns, u))


@pytest.mark.parametrize("step", [4.0, 10.0])
def test_steps_wider_than_the_noise_are_coarse(step: float) -> None:
    (found,) = judged(*stream(17, step=step * NOISE))
    assert found.name == "coarse_quantization"
    assert isinstance(found, CoarseQuantization)
    assert (found.axes[0].axis, found.axes[0].step) == ("x", pytest.approx(step * NOISE))


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.35, 0.4])
def test_the_error_stated_for_coarse_steps_is_that_of_rounded_means(sigma: float) -> None:
    # The largest error of the mean of rounded Gaussian noise over all places between two steps, by the exact sum.
    place = np.linspace(-0.5, 0.5, 401)[:, None]
    codes = np.arange(-6, 7)[None, :]
    p = stats.norm.cdf((codes + 0.5 - place) / sigma) - stats.norm.cdf((codes - 0.5 - place) / sigma)
    mean = (codes * p).sum(axis=1)
    worst = float(np.abs(mean - place[:, 0]).max())
    variance = float((((codes - mean[:, None]) ** 2) * p).sum(axis=1).mean())
    holds = StillIntervals(0, np.arange(20), np.arange(20), np.full((20, 3), variance))
    found = coarse_quantization(holds, [set(), set(), set()], np.ones(3))
    assert isinstance(found, CoarseQuantization)
    assert found.axes[0].mean_error == pytest.approx(worst, rel=0.15)


def test_decimals_that_jitter_about_the_steps_hide_no_coarse_steps() -> None:
    time_ns, u = stream(18, step=10 * 2.3945e-4)
    (found,) = judged(time_ns, np.round(u, 5))
    assert found.name == "coarse_quantization"
    assert isinstance(found, CoarseQuantization)
    assert found.axes[0].step == pytest.approx(10 * 2.3945e-4, rel=0.01)


@pytest.mark.parametrize("count", [0, 1, 11, 30])
def test_too_few_samples_are_judged_as_far_as_they_go(count: int) -> None:
    quality = QualityDetector()
    time_ns, u = stream(19)
    quality.feed(time_ns[:count], u[:count])
    quality.finish()
    assert quality.findings(None, []) == []


ALL_AXES = [(axes, value) for axes in ([0], [1, 2], [0, 1, 2]) for value in (0.0, 0.25, -3.0, None)]


@pytest.mark.parametrize(("axes", "value"), ALL_AXES)
@pytest.mark.parametrize("since", [0.0, 0.05, 0.6])
@pytest.mark.parametrize("step", [0.0, 1.0])
def test_outputs_that_are_constant_from_some_time_on_are_stuck_and_nothing_else(
    axes: list[int], value: float | None, since: float, step: float
) -> None:
    time_ns, u = stream(20, step=step * NOISE)
    at = int(since * len(u))
    u[at:, axes] = u[at, axes] if value is None else value
    (found,) = judged(time_ns, u)
    assert isinstance(found, StuckOutput)
    if not since:
        assert found.dead == tuple("xyz"[axis] for axis in axes)
    else:
        assert {f.axis for f in found.freezes} == ({"xyz"[axis] for axis in axes} if len(axes) < 3 else {None})
        assert max(f.longest for f in found.freezes) == pytest.approx(len(u) - at, abs=20)
