"""Data quality: how often a clean stream is blamed, how often a fault is found and rightly named, and the speed.

    python benchmarks/quality.py            # some minutes
    python benchmarks/quality.py --quick    # fewer seeds

Clean streams are those of `streams.py`, and steps of many widths against the noise. One line a condition: streams,
and how many of them got which name. A fault is counted as found where its name is given, and nothing but its name.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from benchmarks.streams import COVARIATES, Condition, Stream, made
from triaxcal.arrays import Floats, Ints
from triaxcal.poses.quality import QualityDetector, QualityFinding
from triaxcal.poses.stillness.detector import StillnessDetector

Fault = Callable[[Ints, Floats, Stream, np.random.Generator], tuple[Ints, Floats]]
SCALE = 2.4  # volts per g


def judged(time_ns: Ints, readings: Floats) -> list[QualityFinding]:
    still, quality = StillnessDetector(), QualityDetector()
    still.feed(time_ns, readings)
    still.finish()
    quality.feed(time_ns, readings)
    quality.finish()
    return quality.findings(still.windows(), still.spans())


def clean() -> Iterator[tuple[Condition, str]]:
    """Conditions, and what may truly be said of them."""
    for c in COVARIATES:
        if c.rate_hz <= 1000 and c.hold_s[1] <= 60:
            yield c, "coarse_quantization" if c.step_g > 2.5 * np.min(c.noise_g) else ""
    base = Condition("steps", noise_g=2e-4)
    for share in (0.1, 0.3, 0.6, 1.0, 1.5, 2.0, 3.0, 3.5, 5.0, 8.0):
        name = f"steps of {share:g} σ"
        truth = "coarse_quantization" if share > 2.5 else ""
        yield replace(base, name=name, step_g=share * 2e-4), truth
        yield replace(base, name=f"{name}, 1 kHz", step_g=share * 2e-4, rate_hz=1000.0, hold_s=(2.0, 2.0)), truth
    yield replace(base, name="no noise", noise_g=0.0), ""
    yield replace(base, name="no noise, by hand", noise_g=0.0, by_hand=True), ""


def line_of(hz: float, amplitude: float) -> Fault:
    """``amplitude`` in standard deviations of the noise; the mains wander by 0.2 Hz, slowly."""

    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        t = s.t_s
        phase = 2 * np.pi * hz * (t + 0.004 * 20 / (2 * np.pi) * np.sin(2 * np.pi * t / 20 + rng.uniform(0, 6)))
        return time_ns, u + amplitude * 2e-4 * SCALE * np.sin(phase)[:, None] * np.array([1.0, 0.5, 0.0])

    return fault


def rail(share: float) -> Fault:
    """Clips the highest ``share`` of the range of x."""

    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        top = u[:, 0].max() - share * np.ptp(u[:, 0])
        return time_ns, np.minimum(u, [top, np.inf, np.inf])

    return fault


def frozen(seconds: float) -> Fault:
    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        v, start = u.copy(), rng.uniform(5, s.t_s[-1] - 15)
        at = (s.t_s >= start) & (s.t_s < start + seconds)
        axis = int(rng.integers(3))
        v[at, axis] = v[at, axis][0]
        return time_ns, v

    return fault


def slower(share: float) -> Fault:
    """A sensor that updates at ``share`` of the rate it is read at."""

    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        return time_ns, u[np.ceil(np.floor(np.arange(len(u)) * share) / share).astype(int).clip(max=len(u) - 1)]

    return fault


def stale(share: float) -> Fault:
    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        at = np.arange(len(u))
        at[1:] -= rng.random(len(u) - 1) < share
        return time_ns, u[at]

    return fault


def lost(count: int) -> Fault:
    def fault(time_ns: Ints, u: Floats, s: Stream, rng: np.random.Generator) -> tuple[Ints, Floats]:
        kept = np.ones(len(u), dtype=bool)
        kept[rng.integers(10, len(u) - 10, count)] = False
        return time_ns[kept], u[kept]

    return fault


FAULTS: list[tuple[str, float, Fault, str]] = [
    *((f"50 Hz of {a:g} σ at 1 kHz", 1000.0, line_of(50.0, a), "mains_pickup") for a in (0.1, 0.2, 0.5, 2.0)),
    *((f"60 Hz of {a:g} σ at 100 Hz", 100.0, line_of(60.0, a), "mains_pickup") for a in (0.2, 0.5, 2.0)),
    *((f"150 Hz of {a:g} σ at 500 Hz", 500.0, line_of(150.0, a), "mains_pickup") for a in (0.2, 0.5)),
    ("50.9 Hz of 0.5 σ at 500 Hz", 500.0, line_of(50.9, 0.5), "mains_pickup"),
    *((f"motor {hz:g} Hz of 5 σ at 500 Hz", 500.0, line_of(hz, 5.0), "") for hz in (24.7, 47.0, 53.0, 57.5, 97.0)),
    ("motor 24.7 Hz of 5 σ at 100 Hz", 100.0, line_of(24.7, 5.0), ""),
    *((f"rail over {100 * s:g} % of the range", 100.0, rail(s), "saturation") for s in (0.001, 0.02, 0.1)),
    *((f"frozen for {s:g} s", 100.0, frozen(s), "stuck_output") for s in (0.2, 0.5, 3.0)),
    *((f"updates at {s:g} of the rate", 100.0, slower(s), "stuck_output") for s in (0.25, 0.5, 0.8)),
    *((f"{100 * s:g} % stale", 100.0, stale(s), "duplicate_samples") for s in (0.005, 0.02)),
    *((f"{n} samples lost", 100.0, lost(n), "missing_samples") for n in (1, 10, 1000)),
]


def blamed(seeds: range, only: str) -> Iterator[str]:
    total, wrong = 0, 0
    for c, truth in clean():
        if only not in c.name:
            continue
        names: Counter[str] = Counter()
        for seed in seeds:
            s = made(c, seed)
            found = {f.name for f in judged(np.round(s.t_s * 1e9).astype(np.int64), s.readings)}
            names.update(found)
            total, wrong = total + 1, wrong + bool(found - {truth})
        told = ", ".join(f"{n} {k}" for n, k in names.items()) or "nothing"
        yield f"{c.name:40} {len(seeds):4} streams: {told}"
    yield f"clean streams blamed for what is not in them: {wrong} of {total}"


def found(seeds: range, only: str) -> Iterator[str]:
    for name, rate, fault, truth in FAULTS:
        if only not in name:
            continue
        right, names = 0, Counter[str]()
        for seed in seeds:
            s = made(Condition("faults", rate), seed)
            seen = {
                f.name
                for f in judged(
                    *fault(np.round(s.t_s * 1e9).astype(np.int64), s.readings, s, np.random.default_rng(seed))
                )
            }
            right += seen == ({truth} if truth else set())
            names.update(seen)
        told = ", ".join(f"{n} {k}" for n, k in names.items()) or "nothing"
        yield f"{name:40} right in {right} of {len(seeds)}: {told}"


def speed(rate_hz: float) -> str:
    s = made(Condition("speed", rate_hz, poses=92 if rate_hz < 2000 else 9), 0)
    time_ns = np.round(s.t_s * 1e9).astype(np.int64)
    still = StillnessDetector()
    still.feed(time_ns, s.readings)
    w, spans = still.windows(), still.spans()
    begin = time.process_time()
    quality = QualityDetector()
    for at in range(0, len(time_ns), 4096):
        quality.feed(time_ns[at : at + 4096], s.readings[at : at + 4096])
    quality.finish()
    fed = time.process_time()
    quality.findings(w, spans)
    done = time.process_time()
    return (
        f"{rate_hz:6g} Hz, {s.t_s[-1]:.0f} s: {len(time_ns) / (fed - begin) / 1e6:.2f} M samples/s of processor time, "
        f"blocks of 4096; judged in {(done - fed) * 1e3:.0f} ms; {done - begin:.3f} s together"
    )


def report(*, quick: bool = False, only: str = "") -> Iterator[str]:
    """The tables and the speeds, line by line."""
    seeds = range(4 if quick else 20)
    yield from blamed(seeds, only)
    yield from found(seeds, only)
    if not only:
        yield from (speed(rate) for rate in (100.0, 1000.0, 10_000.0))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Data quality: false alarms, faults found, speed.")
    parser.add_argument("--quick", action="store_true", help="fewer seeds")
    parser.add_argument("--only", default="", help="conditions whose name contains this")
    chosen = parser.parse_args(arguments)
    for text in report(quick=chosen.quick, only=chosen.only):
        print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
