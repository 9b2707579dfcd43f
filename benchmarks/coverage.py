"""Honest uncertainty: how often stated 95 % intervals hold the truth, at 5, 17 and 100 degrees of freedom.

The pose means scatter by ``excess`` times what the scatter inside the poses tells (a stand that does not come back
to the same place, say). How well that scatter itself is known is the other thing that an interval must mind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.table import Table, run
from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.estimate.pose_fit import fit
from triaxcal.poses.pose import Pose

SEEDS, QUICK = 600, 60
SIGMA = 1.5e-5
EXCESS = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0)
POSES = (14, 109)

Knowledge = Callable[[list[Pose], np.random.Generator], list[Pose]]


def known(poses: list[Pose], rng: np.random.Generator) -> list[Pose]:
    """The noise of every pose is known."""
    return poses


def own(dof: int) -> Knowledge:
    """Every pose's noise is estimated from ``dof`` + 1 windows of its own, and from nothing else."""

    def estimated(poses: list[Pose], rng: np.random.Generator) -> list[Pose]:
        return [replace(p, covariance=p.covariance * rng.chisquare(dof) / dof, dof=float(dof)) for p in poses]

    return estimated


def pooled(dof: int) -> Knowledge:
    """Every pose has ``dof`` + 1 windows, and all poses share one estimate of the noise."""

    def estimated(poses: list[Pose], rng: np.random.Generator) -> list[Pose]:
        total = dof * len(poses)
        ratio = rng.chisquare(total) / total
        return [replace(p, covariance=p.covariance * ratio, dof=float(total), shared_dof=float(total)) for p in poses]

    return estimated


def unknown(poses: list[Pose], rng: np.random.Generator) -> list[Pose]:
    """The noise is known up to an unknown factor: only the residuals tell its size."""
    factor = 10 ** rng.uniform(-2, 2)
    return [replace(p, covariance=p.covariance * factor, dof=0.0) for p in poses]


SEARCHED = "known, spoiled poses sought"
KNOWLEDGE: dict[str, Knowledge] = {
    "known": known,
    SEARCHED: known,
    "3 windows a pose, one noise": pooled(2),
    "21 windows a pose, each its own": own(20),
    "unknown": unknown,
}


def covered(
    count: int, excess: float, knowledge: Knowledge, seeds: int, level: float = 0.95, search: bool = False
) -> np.ndarray:
    """(s,9) whether each interval holds its truth; ``search`` for spoiled poses as a user's fit does."""
    c = Condition("", PAPER_UNIT, plan(count), np.array(SIGMA))
    out = np.empty((seeds, 9), dtype=bool)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, count, 21])
        poses = c.poses(excess * rng.standard_normal(c.ups.shape) * c.error)
        low, high = fit(knowledge(poses, rng), signs=c.signs, excluded=None if search else ()).interval(level)
        out[seed] = (low <= c.truth) & (c.truth <= high)
    return out


def table(seeds: int) -> Table:
    rows = []
    for count in POSES:
        for name, knowledge in KNOWLEDGE.items():
            shares = [covered(count, e, knowledge, seeds, search=name == SEARCHED).mean(axis=1) for e in EXCESS]
            worst = max(s.std(ddof=1) for s in shares) / np.sqrt(seeds)
            rows.append([str(count - 9), name, *(f"{100 * s.mean():.1f}" for s in shares), f"{100 * worst:.1f}"])
    return Table(
        f"Coverage of 95 % intervals in %, nine parameters, {seeds} seeds, by the factor on the noise inside the poses",
        ["dof left", "noise of a pose mean", *(f"× {e:g}" for e in EXCESS), "±"],
        rows,
    )


def main(arguments: list[str] | None = None) -> int:
    return run(__doc__, arguments, table, quick=QUICK, full=SEEDS)


if __name__ == "__main__":
    raise SystemExit(main())
