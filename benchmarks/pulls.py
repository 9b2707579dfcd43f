"""How true the standard errors of pose means are where the spans are known: the table of docs/explanation/stillness.md.

    python benchmarks/pulls.py [--seeds 60]

One line a noise: variance of the pulls (error over standard error; 1 is right) of 26 pose means at 100 Hz, by axis
and along the measured vector, with the standard deviation of the former over the seeds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.coloured_noise import first_order, flicker, moving_average, white
from triaxcal.poses.pose import poses_of
from triaxcal.stillness.detector import Span
from triaxcal.stillness.windows import WindowCutter

RATE_HZ, POSES, MOVE_S, NOISE_G = 100, 26, 1.5, 1e-3
CASES: list[tuple[str, Callable[..., Floats], tuple[float, ...], int]] = [
    *(("white", white, (), seconds) for seconds in (1, 5, 30)),
    ("moving average of 0.1 s", moving_average, (10,), 5),
    ("moving average of 0.3 s", moving_average, (30,), 5),
    *((f"first order, {t:g} s", first_order, (RATE_HZ * t,), 5) for t in (0.1, 0.3, 0.5)),
    ("first order, 0.5 s", first_order, (50.0,), 20),
    ("first order, 0.1 s", first_order, (10.0,), 1),
    *((f"1/f below {f:g} Hz", flicker, (f / RATE_HZ,), 5) for f in (0.01, 0.1, 0.3, 1.0, 10.0)),
    ("1/f below 0.1 Hz", flicker, (0.001,), 30),
]


def pulls(kind: Callable[..., Floats], parameter: tuple[float, ...], seconds: int, seed: int) -> tuple[Floats, Floats]:
    """(26,3) by axis and (26,) along the measured vector, of one recording."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((POSES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    step = int(RATE_HZ * (seconds + MOVE_S))
    noise = kind(step * POSES, *parameter, rng) * NOISE_G
    cutter = WindowCutter()
    cutter.feed(np.arange(step * POSES) * (1_000_000_000 // RATE_HZ), np.repeat(directions, step, axis=0) + noise)
    cutter.finish()
    w = cutter.windows()
    ends = [(-(-i * step // w.size), (i * step + seconds * RATE_HZ) // w.size) for i in range(POSES)]
    poses = poses_of(w, [Span(np.arange(*e)) for e in ends])
    miss = np.array([p.mean - a for p, a in zip(poses, directions, strict=True)])
    along = [m @ a / np.sqrt(a @ p.covariance @ a) for m, a, p in zip(miss, directions, poses, strict=True)]
    return miss / np.array([p.standard_error for p in poses]), np.array(along)


def report(seeds: int = 60) -> str:
    lines = [f"{'noise':26} {'poses of':>8} {'pulls²':>7} {'±':>6} {'along':>6}"]
    for name, kind, parameter, seconds in CASES:
        found = [pulls(kind, parameter, seconds, seed) for seed in range(seeds)]
        by_run = np.array([(f[0] ** 2).mean() for f in found])
        along = np.mean([f[1] ** 2 for f in found])
        scatter = by_run.std(ddof=1) / np.sqrt(seeds)
        lines.append(f"{name:26} {seconds:6} s {by_run.mean():7.3f} {scatter:6.3f} {along:6.3f}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Standard errors of pose means against the truth.")
    parser.add_argument("--seeds", type=int, default=60)
    print(report(parser.parse_args().seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
