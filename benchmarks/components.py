"""The error of |a| and of each component in another recording, where an effect acts that no catalogue has.

    python -m benchmarks.components [--seeds 3] [--kinds tuned held-back catalogue none] [--poses 26 14] [--jobs 2]

The recordings are those of `tests/undeclared`, with the kinds of `tests/undeclared/further.py`: methods are made on the
tuned ones, and judged by the others with other seeds. The other recording is of the same unit hours later: another
temperature history, other poses; effects of time and of the poses before are not in it. It is asked without noise.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.processes import one_thread
from benchmarks.table import Table
from benchmarks.undeclared import LARGE, NOISES
from tests.undeclared import further, physics
from tests.undeclared.examine import Case, still_poses
from tests.undeclared.generator import CannotShow, Recording
from tests.undeclared.told import biases
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.distributions import t_ppf
from triaxcal.poses.covariates import covariates_elsewhere
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.propagation import uncertainty_of_magnitude, uncertainty_of_readings

KINDS = {"tuned": further.TUNED, "held-back": further.HELD_BACK, "catalogue": physics.KINDS, "none": ("none",)}
FIRST = {"tuned": 0, "held-back": 705_000, "catalogue": 710_000, "none": 720_000}
"""First seeds: those that judge are others than those that were looked at."""
WORSE = 1.05
LEVEL = 0.95
LEVELS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Judged:
    """Errors in the other recording, in g: rms of |a| and of the vector under the linear calibration and the one that
    is handed on; shares of |a| and of the components within the stated interval of ``LEVEL``. ``names`` are the
    probabilities of the posterior, whether each name is true, and whether it is told as calibrated."""

    case: Case
    magnitude: tuple[float, float] = (np.nan, np.nan)
    vector: tuple[float, float] = (np.nan, np.nan)
    covered: tuple[float, float] = (np.nan, np.nan)
    wrong: bool = False
    right: bool = False
    corrected: bool = False
    names: tuple[tuple[float, bool, bool], ...] = ()
    error: str = ""


def judged(case: Case) -> Judged:
    """Whatever goes wrong is an outcome too."""
    try:
        r = case.make()
        loop = diagnose(still_poses(r.samples()), signs=r.signs)
        return against_truth(case, r, loop)
    except CannotShow as e:
        return Judged(case, error=f"not drawn: {e}")
    except Exception as e:  # noqa: BLE001 -- a benchmark goes on
        return Judged(case, error=f"{type(e).__name__}: {e}")


def against_truth(case: Case, r: Recording, loop: Loop) -> Judged:
    there = r.held_out.scene
    poses = quiet_poses(r)
    truth = there.up  # R has the axes of the sensor's own frame
    magnitude, vector = [], []
    for c in (loop.before, loop.after):
        u = np.array([p.mean for p in poses])
        held = covariates_elsewhere(poses, c.channel_reference, c.sensor.scale_factor, c.sensor.bias, c.moment)
        a = c.sensor.specific_force(u, held)
        off = _less_bias(r, np.linalg.norm(a, axis=1) - 1)
        magnitude.append(np.linalg.norm(a, axis=1) - 1 - biases(r.triad, r.held_out) @ off)
        vector.append(a - truth - np.linalg.inv(r.triad.axes) @ off)
    c, found = loop.after, budget(loop.after)
    of_readings = uncertainty_of_readings(c.sensor, c.covariance, u, held, c.unmodelled)
    of_magnitude = uncertainty_of_magnitude(c.sensor, c.covariance, u, held, c.unmodelled)
    k = float(t_ppf((1 + LEVEL) / 2, np.asarray(found.magnitude.dof)))
    unique = {f.effect for f in loop.findings if f.verdict.value == "adopted"}
    return Judged(
        case,
        (rms(magnitude[0]), rms(magnitude[1])),
        (rms(vector[0]), rms(vector[1])),
        (
            float(np.mean(np.abs(magnitude[1]) <= k * of_magnitude)),
            float(np.mean(np.abs(vector[1]) <= k * of_readings)),
        ),
        bool(unique - set(r.names)),
        bool(unique & set(r.names)),
        bool(loop.after.sensor.effects),
        tuple((p, name in r.names, loop.stated[name] is not None) for name, p in loop.probabilities.items()),
    )


def _less_bias(r: Recording, miss: np.ndarray) -> np.ndarray:
    """(3,) the biases that a recording begins with where the effect is one of the recording (`told.rms_g`)."""
    if not any(e.of_recording for e in r.effects):
        return np.zeros(3)
    return np.linalg.lstsq(biases(r.triad, r.held_out), miss, rcond=None)[0]


def quiet_poses(r: Recording) -> list[Pose]:
    """Of the other recording, as made, without noise."""
    there = r.held_out.scene
    means = r.triad.outputs(there.pose_force + there.by_pose(r.held_out.added_g))
    found = still_poses(r.held_out_samples())
    if len(found) != there.poses:
        raise RuntimeError("other poses found than made")
    return [replace(pose, mean=mean) for pose, mean in zip(found, means, strict=True)]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def cases(group: str, poses: int, seeds: int) -> list[Case]:
    kinds = KINDS[group]
    size = (1.0, 1.0) if group == "none" else LARGE
    many = seeds * (10 if group == "none" else 1)
    return [
        Case(kind, FIRST[group] + i, size, poses, NOISES[(i + k) % len(NOISES)])
        for i in range(many)
        for k, kind in enumerate(kinds)
    ]


def row(name: str, found: Sequence[Judged]) -> list[str]:
    magnitude = np.array([o.magnitude for o in found])
    vector = np.array([o.vector for o in found])
    ratio, of_vector = magnitude[:, 1] / magnitude[:, 0], vector[:, 1] / vector[:, 0]
    covered = np.array([o.covered for o in found])
    worse = ratio > WORSE
    return [
        name, str(len(found)), str(sum(o.corrected for o in found)), f"{np.exp(np.mean(np.log(ratio))):.3f}",
        f"{int(worse.sum())} ({ratio.max():.2f})", f"{np.exp(np.mean(np.log(of_vector))):.3f}",
        f"{int((of_vector > WORSE).sum())} ({of_vector.max():.2f})",
        f"{covered[:, 0].mean():.2f}", f"{covered[:, 1].mean():.2f}", str(sum(o.right for o in found)),
        str(sum(o.wrong for o in found)),
    ]  # fmt: skip


HEAD = [
    "truth", "n", "corrected", "|a| after / before", "worse (worst)", "vector after / before", "worse (worst)",
    "|a| covered", "components covered", "unique right", "unique wrong",
]  # fmt: skip


def tables(group: str, poses: int, found: Sequence[Judged]) -> list[Table]:
    sound = [o for o in found if not o.error]
    kinds = [k for k in KINDS[group] if any(o.case.kind == k for o in sound)]
    rows = [row(k, [o for o in sound if o.case.kind == k]) for k in kinds]
    if not sound:
        return []
    return [Table(f"{group}, {poses} poses", HEAD, [*rows, row("all", sound)])]


def reliability(found: Sequence[Judged]) -> Table:
    """Of the probabilities of names the share that is true: of all that the posterior has, and of those that are told
    as calibrated."""
    p, true, told = np.array([one for o in found for one in o.names] or np.empty((0, 3))).T
    rows = []
    for low, high in itertools.pairwise(LEVELS):
        inside = (p >= low) & ((p < high) | (high == LEVELS[-1]))
        cells = [f"{low:g} to {high:g}"]
        for which in (inside, inside & (told > 0)):
            n = int(which.sum())
            cells += [str(n), f"{p[which].mean():.3f}" if n else "-", f"{true[which].mean():.3f}" if n else "-"]
        rows.append(cells)
    return Table("Reliability of names", ["posterior", "n", "mean", "true", "told: n", "mean", "true"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--poses", nargs="+", type=int, choices=(14, 26), default=[26, 14])
    parser.add_argument("--seeds", type=int, default=3, help="of each kind")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    every: list[Judged] = []
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        for group in options.kinds:
            for poses in options.poses:
                found = list(pool.map(judged, cases(group, poses, options.seeds), chunksize=2))
                every += found
                for table in tables(group, poses, found):
                    print(table, flush=True)
                for o in found:
                    if o.error:
                        print(f"{o.case}: {o.error}")
    print(reliability(every))
    return 0


if __name__ == "__main__":
    sys.exit(main())
