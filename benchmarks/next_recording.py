"""What a calibration of one measured recording does on the next one of the same sensor.

    python -m benchmarks.next_recording [--list]

The recordings are runs 1 to 5 of eight sensors on one board, one after the other, in ../shared/datasets/mimu4444. The
error of |a| in the poses of a run under the calibration of the run before, which holds at the end of that run, over
that of its linear fit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.frozen import WORSE, judged
from benchmarks.processes import one_thread
from benchmarks.table import Table
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.hold_out import magnitude_errors
from triaxcal.poses.pose import Pose
from triaxcald.inputs import measure

FOLDER = Path(__file__).parents[2] / "shared" / "datasets" / "mimu4444"
RUNS, SENSORS = range(1, 6), range(1, 9)
SIGNS = (1, 1, 1)


def poses_of(run: int, sensor: int) -> list[Pose]:
    return measure(str(FOLDER / f"run{run}_sensor{sensor}.csv.gz")).poses


def error_g(c: Calibration, poses: Sequence[Pose]) -> float:
    sound = [p for p in poses if not p.fault]
    miss, _ = magnitude_errors(
        c.sensor, sound, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
    )
    return float(np.sqrt(np.mean(miss**2)))


def of_sensor(sensor: int) -> list[tuple[int, float, float, str]]:
    """(run, error of the linear fit on the next run, error after, what was found) each."""
    runs = {run: poses_of(run, sensor) for run in RUNS}
    out = []
    for run in RUNS[:-1]:
        said = judged(runs[run], SIGNS)
        found = ", ".join(f"{name} {verdict}" for name, verdict, _ in said.found)
        found += "; unexplained" if said.unexplained else ""
        out.append((run, error_g(said.before, runs[run + 1]), error_g(said.after, runs[run + 1]), found))
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="a line for each pair")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    if not FOLDER.is_dir():
        sys.stderr.write(f"{FOLDER}: no recordings there\n")
        return 2
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        found = list(pool.map(of_sensor, SENSORS))
    ratios = np.array([[after / before for _, before, after, _ in of_one] for of_one in found])
    rows = []
    for run, of_run in zip([*map(str, RUNS[:-1]), "all"], [*ratios.T, ratios.ravel()], strict=True):
        pair = f"{run} → {int(run) + 1}" if run.isdecimal() else run
        better, worse = np.mean(of_run < 1 / WORSE), np.mean(of_run > WORSE)
        figures = [f"{np.exp(np.mean(np.log(of_run))):.3f}", f"{of_run.min():.2f}", f"{of_run.max():.2f}"]
        rows.append([pair, *figures, f"{100 * better:.0f}", f"{100 * worse:.0f}"])
    for sensor, of_one in zip(SENSORS, found, strict=True) if options.list else ():
        for run, before, after, said in of_one:
            print(f"{sensor} {run}: {before * 1e6:.0f} -> {after * 1e6:.0f} µg  {said}")
    head = ["runs", "after / before", "best", "worst", "better by 5 %, %", "worse by 5 %, %"]
    print(Table("Error on the next recording over that of the linear fit, eight sensors", head, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
