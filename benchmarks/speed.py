"""Speed of a fit, from 14 poses to a million points, beside a peer in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.peers import scipy_magnitude
from benchmarks.raw_rotation import adjusted, paper, turning
from benchmarks.table import Table, chosen
from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.estimate.pose_fit import fit


def seconds(work: Callable[[], object], budget_s: float) -> float:
    """The least of as many runs as fit, at least one."""
    best, begin = np.inf, time.perf_counter()
    while True:
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
        if time.perf_counter() - begin > budget_s:
            return best


def _duration(value: float) -> str:
    return f"{1e3 * value:.3g} ms" if value < 1 else f"{value:.3g} s"


def fits(quick: bool) -> Table:
    budget = 0.1 if quick else 0.5
    rows = []
    for count in (14, 26, 100, 1000) if quick else (14, 26, 100, 1000, 10_000):
        c = Condition("", PAPER_UNIT, plan(count), np.array(1.5e-5))
        poses, _ = c.draw(0)
        ours = seconds(partial(fit, poses, signs=c.signs), budget)
        bare = seconds(partial(fit, poses, signs=c.signs, excluded=()), budget)
        plain = seconds(partial(scipy_magnitude, c, poses), budget)
        rows.append([f"{count} poses", _duration(ours), f"{bare / ours:.2g}", f"{plain / ours:.2g}"])
    for count in (10_000, 100_000) if quick else (10_000, 100_000, 1_000_000):
        u, _ = turning(count, 0.02, 0)
        ours = seconds(partial(adjusted, u), budget)
        plain = seconds(partial(paper, u), budget)
        rows.append([f"{count} points of a turning unit", _duration(ours), "", f"{plain / ours:.2g}"])
    head = ["what", "triaxcal", "without the search for spoiled poses", "poses: scipy on |a| − 1; points: closed form"]
    return Table("Speed of a fit; other columns are times over ours", head, rows)


def main(arguments: list[str] | None = None) -> int:
    quick = chosen(__doc__, arguments)
    print(fits(quick))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
