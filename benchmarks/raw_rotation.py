"""Raw samples of a unit that turns and never rests: rms error of nine parameters over the Cramér–Rao bound.

Ordinary fits of the ellipsoid are biased by the square of the noise, which more samples do not cure.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from benchmarks.table import Table, run
from benchmarks.truth import information
from triaxcal.estimate.initial_estimate import closed_form, coefficients
from triaxcal.inputs.moments import Moments
from triaxcal.inputs.rotation import fit_rotation
from triaxcal.model.sensor import Sensor

SEEDS, QUICK = 12, 3
UNIT = Sensor(np.array([2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))
TRUTH = np.concatenate([UNIT.scale_factor, UNIT.misalignment, UNIT.bias])
CASES = ((10_000, 0.005), (10_000, 0.02), (100_000, 0.005), (100_000, 0.02))


def turning(count: int, noise_g: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Outputs (n,3) in directions all over the sphere, and these directions."""
    rng = np.random.default_rng([seed, count, 25])
    a = rng.standard_normal((count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    return UNIT.output(a, {}) + rng.standard_normal((count, 3)) * noise_g * UNIT.scale_factor, a


def adjusted(u: np.ndarray) -> np.ndarray:
    moments = Moments()
    moments.feed(u)
    return fit_rotation(moments).calibration.values


def paper(u: np.ndarray) -> np.ndarray:
    return np.concatenate(coefficients(*closed_form(u)))


def _least_squares(power: int) -> Callable[[np.ndarray], np.ndarray]:
    def fitted(u: np.ndarray) -> np.ndarray:
        def miss(p: np.ndarray) -> np.ndarray:
            s = u / p[:3] - p[6:]
            y = s[:, 1] - p[3] * s[:, 2]
            square = (s[:, 0] - p[5] * y - p[4] * s[:, 2]) ** 2 + y**2 + s[:, 2] ** 2
            return np.asarray(np.sqrt(square) - 1 if power == 1 else square - 1)

        return np.asarray(least_squares(miss, TRUTH, x_scale="jac").x)

    return fitted


METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "triaxcal": adjusted,
    "scipy, |a| − 1": _least_squares(1),
    "scipy, |a|² − 1": _least_squares(2),
    "closed form": paper,
}


def table(seeds: int) -> Table:
    rows = []
    for count, noise_g in CASES:
        squares: dict[str, list[float]] = {name: [] for name in METHODS}
        spent = dict.fromkeys(METHODS, 0.0)
        for seed in range(seeds):
            u, a = turning(count, noise_g, seed)
            error = noise_g * np.abs(UNIT.scale_factor)
            bound = np.sqrt(np.diag(np.linalg.inv(information(UNIT, a, error))))
            for name, method in METHODS.items():
                begin = time.perf_counter()
                found = method(u)
                spent[name] += time.perf_counter() - begin
                squares[name].append(float(np.mean(((found - TRUTH) / bound) ** 2)))
        errors = [f"{np.sqrt(np.mean(s)):.2f}" for s in squares.values()]
        times = [f"{spent[name] / spent['triaxcal']:.2g}" for name in list(METHODS)[1:]]
        rows.append([f"{count}", f"{noise_g:g} g", *errors, *times])
    chance = 100 / np.sqrt(18 * seeds)
    return Table(
        f"Raw rotation: rms error over the bound, {seeds} seeds (± {chance:.0f} %); then the time of each over ours",
        ["samples", "noise", *METHODS, *(f"{name}, time" for name in list(METHODS)[1:])],
        rows,
    )


def main(arguments: list[str] | None = None) -> int:
    return run(__doc__, arguments, table, quick=QUICK, full=SEEDS)


if __name__ == "__main__":
    raise SystemExit(main())
