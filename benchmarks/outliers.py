"""Bad poses: how often one or two spoiled poses are named, what the rest is then worth, and how often a clean set
loses a pose; beside it what could be reached at all, and what a robust loss makes of the same poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from benchmarks.table import Table, chosen
from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.estimate.calibration import Calibration, OutlierSetsTied
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import linear_design
from triaxcal.poses.pose import Pose

SEEDS, QUICK = 300, 30
SIGMA = 1.5e-5
CLEAN = 4
NEAR = 12


def spoil(c: Condition, poses: Sequence[Pose], rows: Sequence[int], sigmas: Sequence[float]) -> list[Pose]:
    """The poses with the means of ``rows`` moved along the measured vector by so many standard errors."""
    out = list(poses)
    for i, size in zip(rows, sigmas, strict=True):
        out[i] = replace(out[i], mean=out[i].mean + c.unit.scale_factor * c.ups[i] * size * SIGMA)
    return out


def told_the_number(c: Condition, poses: Sequence[Pose], miss: np.ndarray, number: int) -> tuple[int, ...]:
    """The most likely set of ``number`` spoiled poses, for who knows the noise and how many poses are spoiled.

    ``miss`` (n,) are |a| − 1 under the true unit, in standard errors. Where several sets come near each other by linear
    reckoning, those are fitted in full. No rule that does not know where to look names the right poses more often,
    where every set and every size of a spoil are as likely.
    """
    q, _ = np.linalg.qr(linear_design(c.ups, c.ups))
    free = np.eye(len(c.ups)) - q @ q.T
    rest = free @ miss
    sets = list(itertools.combinations(range(len(c.ups)), number))
    blocks = np.array([free[np.ix_(s, s)] for s in sets])
    left = np.array([rest[list(s)] for s in sets])
    taken = np.einsum("ki,ki->k", left, np.linalg.solve(blocks, left[..., None])[..., 0])
    # Curvature shows in the residuals of poses that are off by much.
    near = [k for k in np.argsort(-taken)[:NEAR] if taken[k] > taken.max() - 20 - 0.01 * np.abs(miss).max() ** 1.5]
    if len(near) == 1:
        return sets[near[0]]
    return min((sets[k] for k in near), key=lambda s: _chi2(c, poses, s))


def _chi2(c: Condition, poses: Sequence[Pose], excluded: tuple[int, ...]) -> float:
    used = [p for p in fit(poses, signs=c.signs, excluded=excluded).poses if p.used]
    return sum((p.residual_g / p.standard_error_g) ** 2 for p in used)


def huber(c: Condition, poses: Sequence[Pose]) -> np.ndarray:
    """(9,) by scipy's least squares with Huber's loss on the same residual, from the truth."""
    u = np.array([p.mean for p in poses])

    def miss(p: np.ndarray) -> np.ndarray:
        ax, ay, az = p[3:6]
        s = u / (p[:3] * c.unit.scale_factor) - p[6:]
        y = s[:, 1] - ax * s[:, 2]
        return (np.sqrt((s[:, 0] - az * y - ay * s[:, 2]) ** 2 + y**2 + s[:, 2] ** 2) - 1) / SIGMA

    first = np.concatenate([np.ones(3), c.truth[3:]])
    p = least_squares(miss, first, loss="huber", f_scale=1.345, x_scale="jac").x
    return np.concatenate([p[:3] * c.unit.scale_factor, p[3:]])


@dataclass(frozen=True)
class Outcome:
    """Shares of the runs, and rms errors of the nine parameters over those of a fit that was told the answer."""

    named: float
    ambiguous: float
    wrong: float
    optimum: float
    error: float
    error_named: float
    huber_error: float


def left_out(c: Calibration) -> tuple[int, ...]:
    return tuple(i for i, p in enumerate(c.poses) if not p.used)


def measure(count: int, number: int, sigmas: float | None, seeds: int, *, peer: bool = True) -> Outcome:
    """``sigmas`` of each spoil; None draws each from 10 to 1000, evenly in its logarithm. ``peer`` runs Huber too."""
    c = Condition("", PAPER_UNIT, plan(count), np.array(SIGMA))
    named, ambiguous, wrong, optimum = [], [], [], []
    squares = np.empty((seeds, 3))
    for seed in range(seeds):
        rng = np.random.default_rng([seed, count, number, 22])
        noise = rng.standard_normal(c.ups.shape) * c.error
        bad = tuple(sorted(int(i) for i in rng.choice(count, number, replace=False)))
        sizes = np.full(number, sigmas) if sigmas else 10 ** rng.uniform(1, 3, number)
        sizes = sizes * rng.choice([-1, 1], number)
        poses = spoil(c, c.poses(noise), bad, sizes.tolist())
        found = fit(poses, signs=c.signs)
        told = fit(poses, signs=c.signs, excluded=bad)
        miss = np.einsum("ni,ni->n", noise / c.unit.scale_factor, c.ups) / SIGMA
        miss[list(bad)] += sizes
        named.append(left_out(found) == bad)
        ambiguous.append(any(isinstance(caution, OutlierSetsTied) for caution in found.cautions))
        wrong.append(not set(left_out(found)) <= set(bad))
        optimum.append(told_the_number(c, poses, miss, number) == bad)
        error = told.standard_errors / told.birge_ratio
        squares[seed] = [
            np.mean(((v - c.truth) / error) ** 2)
            for v in (found.values, told.values, huber(c, poses) if peer else c.truth)
        ]
    right = np.array(named)
    of = np.sqrt(squares.mean(axis=0))
    of_named = np.sqrt(squares[right].mean(axis=0)) if right.any() else np.full(3, np.nan)
    return Outcome(
        *(float(np.mean(x)) for x in (named, ambiguous, wrong, optimum)),
        error=float(of[0] / of[1]),
        error_named=float(of_named[0] / of_named[1]),
        huber_error=float(of[2] / of[1]),
    )


def clean_loses(count: int, seeds: int, excess: float = 1.0, dof: float = 1e6) -> float:
    """Share of clean sets that lose a pose; ``excess`` of the noise over what the poses tell, ``dof`` behind that,
    zero where only the residuals tell.
    """
    c = Condition("", PAPER_UNIT, plan(count), np.array(SIGMA))
    lost = 0
    for seed in range(seeds):
        rng = np.random.default_rng([seed, count, 23])
        poses = c.poses(excess * rng.standard_normal(c.ups.shape) * c.error)
        if dof == 0:
            poses = [replace(p, dof=0.0) for p in poses]
        elif dof < 1e6:
            poses = [replace(p, covariance=p.covariance * rng.chisquare(dof) / dof, dof=dof) for p in poses]
        lost += bool(left_out(fit(poses, signs=c.signs)))
    return lost / seeds


def tables(seeds: int) -> list[Table]:
    rows = []
    for count, number in ((26, 1), (26, 2), (14, 1), (14, 2)):
        for sigmas in (10.0, 15.0, 30.0, 100.0, 1000.0, None):
            o = measure(count, number, sigmas, seeds)
            rows.append(
                [
                    f"{number} of {count}",
                    f"{sigmas:g} σ" if sigmas else "10 to 1000 σ",
                    f"{100 * o.named:.1f}",
                    f"{100 * o.ambiguous:.1f}",
                    f"{100 * o.wrong:.1f}",
                    f"{100 * o.optimum:.1f}",
                    f"{o.error:.3f}",
                    f"{o.error_named:.3f}",
                    f"{o.huber_error:.1f}",
                ]
            )
    head = ["spoiled", "by", "named %", "ambiguous %", "wrong %", "optimum %", "error", "if named", "Huber"]
    named = Table(
        f"Spoiled poses, {seeds} runs; optimum: told the number; errors over those of a fit told the poses", head, rows
    )
    lost = [
        [
            f"{count}",
            *(f"{100 * clean_loses(count, CLEAN * seeds, *how):.2f}" for how in ((), (1.5,), (3.0,), (1.0, 20.0))),
        ]
        for count in (14, 26, 50)
    ]
    clean = Table(
        f"Clean sets that lose a pose, in %, {CLEAN * seeds} runs",
        ["poses", "noise as told", "noise × 1.5", "noise × 3", "each pose's noise from 21 windows"],
        lost,
    )
    return [named, clean]


def main(arguments: list[str] | None = None) -> int:
    quick = chosen(__doc__, arguments)
    for table in tables(QUICK if quick else SEEDS):
        print(table)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
