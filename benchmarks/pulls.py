"""How true the standard errors of pose means are where the spans are known: the table of docs/explanation/stillness.md.

    python benchmarks/pulls.py [--seeds 60]

One line a noise: variance of the pulls (error over standard error; 1 is right) of 26 pose means at 100 Hz, by axis
and along the measured vector, with the standard deviation of the former over the seeds. Then what no method can know:
between which limits, in units of the true one, the variance of the mean lies for spectra that such poses cannot tell
from the true one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np
from scipy import linalg, optimize

from benchmarks.noise import first_order, flicker, moving_average, white
from triaxcal.arrays import Floats
from triaxcal.poses.noise_spectrum import Components, first_order_windows, moving_average_windows
from triaxcal.poses.pose import poses_of
from triaxcal.poses.stillness.detector import Span
from triaxcal.poses.stillness.windows import WindowCutter

RATE_HZ, POSES, MOVE_S, NOISE_G = 100, 26, 1.5, 1e-3
NEAR = 0.5
"""Nats."""
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


def indistinguishable(kind: Callable[..., Floats], parameter: tuple[float, ...], seconds: int) -> tuple[float, float]:
    """Least and largest variance of a pose's mean, in units of the true one, among the mixtures of white, 1/f,
    first-order and moving-average noise that are within `NEAR` of the true noise.

    The distance is Kullback and Leibler's, of what 26 poses show in three axes: the deviations from each mean. By
    Bretagnolle and Huber's inequality (1979) any test between two noises that near is wrong with probability of at
    least exp(−`NEAR`)/2 under one or the other, added up.
    """
    size = windows_size(seconds)
    n = seconds * RATE_HZ // size
    components = Components.of(n, n, POSES * (seconds + MOVE_S) * RATE_HZ / size)
    basis = components.autocovariance[:-1]
    if kind is first_order:
        true = first_order_windows(parameter[0] / size, n)
    elif kind is moving_average:
        true = moving_average_windows(parameter[0] / size, n)
    else:  # over windows the white part is less by their size, 1/f noise the same; its two-sided density is corner/f
        true = basis[0] / size + (2 * parameter[0] * basis[1] if parameter else 0.0)
    basis = np.vstack([basis, true])
    contrast = linalg.null_space(np.ones((1, n)))
    shown = np.array([contrast.T @ linalg.toeplitz(a) @ contrast for a in basis])
    at_mean = basis @ np.r_[n, 2.0 * np.arange(n - 1, 0, -1)]
    scale = np.trace(shown[-1]) / np.trace(shown, axis1=1, axis2=2)
    shown, at_mean = shown * scale[:, None, None], at_mean * scale / at_mean[-1]
    size_of_true = np.linalg.slogdet(shown[-1])[1]

    def distance(x: Floats) -> tuple[float, Floats]:
        other = np.tensordot(np.exp(x), shown, 1)
        inverse = np.linalg.inv(other)
        ratio = inverse @ shown[-1]
        value = np.trace(ratio) - (n - 1) + np.linalg.slogdet(other)[1] - size_of_true
        slope = np.einsum("kij,ji->k", shown, inverse - ratio @ inverse) * np.exp(x)
        return 1.5 * POSES * float(value), 1.5 * POSES * slope

    def variance(x: Floats, sign: float) -> tuple[float, Floats]:
        part = at_mean * np.exp(x)
        return sign * float(np.log(part.sum())), sign * part / part.sum()

    found = []
    for sign in (1.0, -1.0):
        start = np.r_[np.full(len(basis) - 1, -4.0), -0.1]
        near = {"type": "ineq", "fun": lambda x: NEAR - distance(x)[0], "jac": lambda x: -distance(x)[1]}
        best = optimize.minimize(
            variance,
            start,
            (sign,),
            "SLSQP",
            jac=True,
            bounds=[(-25, 3)] * len(start),
            constraints=[near],
            options={"maxiter": 400},
        )
        inside = distance(best.x)[0] <= 1.01 * NEAR
        found.append(float(np.exp(sign * best.fun)) if inside else np.nan)
    return found[0], found[1]


def windows_size(seconds: int) -> int:
    """Samples a window in a recording of such poses."""
    cutter = WindowCutter()
    n = int(RATE_HZ * (seconds + MOVE_S)) * POSES
    cutter.feed(np.arange(n) * (1_000_000_000 // RATE_HZ), np.random.default_rng(0).standard_normal((n, 3)))
    cutter.finish()
    return cutter.windows().size


def report(seeds: int = 60) -> str:
    lines = [f"{'noise':26} {'poses of':>8} {'pulls²':>7} {'±':>6} {'along':>6}   {'cannot be told from':>19}"]
    for name, kind, parameter, seconds in CASES:
        found = [pulls(kind, parameter, seconds, seed) for seed in range(seeds)]
        by_run = np.array([(f[0] ** 2).mean() for f in found])
        along = np.mean([f[1] ** 2 for f in found])
        low, high = indistinguishable(kind, parameter, seconds)
        scatter = by_run.std(ddof=1) / np.sqrt(seeds)
        lines.append(
            f"{name:26} {seconds:6} s {by_run.mean():7.3f} {scatter:6.3f} {along:6.3f}   {low:9.2f} … {high:7.2f}"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="Standard errors of pose means against the truth.")
    parser.add_argument("--seeds", type=int, default=60)
    print(report(parser.parse_args().seeds))
    return 0


if __name__ == "__main__":
    sys.exit(main())
