"""At the bound: the rms error of every parameter over the Cramér–Rao bound, for every condition of the claim.

The error of the linear estimator that attains the bound is known for each seed. What the fit's mean square differs
from that estimator's scatters far less than either, so a thousand seeds tell the ratio to a part in a thousand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.table import Table, run
from benchmarks.truth import PARAMETERS, Condition, bound_and_best, covariates
from triaxcal.estimate.pose_fit import fit

SEEDS, QUICK = 1000, 100


@dataclass(frozen=True)
class Efficiency:
    """``errors`` (s,9) of the fit; ``ratio`` (9,) of the rms error to the bound and its own ``uncertainty`` (9,)."""

    errors: np.ndarray
    bound: np.ndarray
    ratio: np.ndarray
    uncertainty: np.ndarray

    @property
    def plain(self) -> np.ndarray:
        """The ratio (9,) from the errors alone."""
        return np.sqrt(np.mean(self.errors**2, axis=0)) / self.bound


def measure(c: Condition, seeds: int) -> Efficiency:
    covariance, best = bound_and_best(c)
    errors, ideal = np.empty((seeds, 9)), np.empty((seeds, 9))
    for seed in range(seeds):
        poses, noise = c.draw(seed)
        errors[seed] = fit(poses, signs=c.signs, excluded=()).values - c.truth
        ideal[seed] = best @ noise.ravel()
    bound = np.sqrt(np.diag(covariance))
    excess = (errors**2 - ideal**2) / bound**2
    return Efficiency(
        errors,
        bound,
        np.sqrt(1 + excess.mean(axis=0)),
        excess.std(axis=0, ddof=1) / np.sqrt(seeds) / 2,
    )


def table(seeds: int) -> Table:
    rows = []
    for c in covariates():
        e = measure(c, seeds)
        worst = int(np.argmax(np.abs(e.ratio - 1)))
        rows.append(
            [
                c.name,
                f"{e.ratio.min():.4f}",
                f"{e.ratio.max():.4f}",
                f"{PARAMETERS[worst]} {e.ratio[worst]:.4f} ± {e.uncertainty[worst]:.4f}",
                f"{e.plain.min():.3f} … {e.plain.max():.3f}",
            ]
        )
    return Table(
        f"RMSE / Cramér–Rao bound over {seeds} seeds, nine parameters",
        ["condition", "least", "most", "farthest from 1", "without control variate"],
        rows,
    )


def main(arguments: list[str] | None = None) -> int:
    return run(__doc__, arguments, table, quick=QUICK, full=SEEDS)


if __name__ == "__main__":
    raise SystemExit(main())
