"""The measured array as a small fleet: eight sensors, five runs.

    python -m benchmarks.measured_fleet [--write]

Runs 1 to 5 of eight sensors on one board, one after the other, in ../shared/datasets/mimu4444. Each run of each sensor
is calibrated by the linear model. The coefficients are then those of a fleet: how they are distributed over sensors, a
gauge study of sensors by runs, how they move from run to run, and how long a calibration lasts. The recordings have no
date: time is counted in runs, and so is the interval. ``--write`` puts the section into docs/measured.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

import triaxcal as tc
from benchmarks.next_recording import FOLDER, RUNS, SENSORS, SIGNS, error_g, poses_of
from benchmarks.pages import DOCS, write
from benchmarks.processes import one_thread
from triaxcal.arrays import Floats
from triaxcal.estimate.pose_fit import fit
from triaxcal.population import (
    Drift,
    GaugeStudy,
    Moving,
    Part,
    RecalibrationInterval,
    distribution,
    drift_of,
    gauge_study,
    recalibration_interval,
)

NAMES = [f"{kind} {axis}" for kind in ("scale factor", "misalignment", "bias") for axis in "xyz"]
SMALL = 1e6
"""Of all figures: scale factors in ppm of their mean, angles in µrad, biases in µg."""
UNITS = ["ppm", "µrad", "µg"]
LIMIT_G = 5e-3
"""Of |a|: some twice what calibrations of run 1 are off by in run 5."""
PARTS = [
    *((Part.SCALE_FACTOR, (i,)) for i in range(3)),
    *((Part.MISALIGNMENT, axes) for axes in ((1, 2), (0, 2), (0, 1))),
    *((Part.BIAS, (i,)) for i in range(3)),
]


def of_run(run: int, sensor: int) -> tuple[Floats, Floats, list[float]]:
    """The nine coefficients and their standard errors, and the rms of |a| − 1 g in g in each run under them."""
    calibration = fit(poses_of(run, sensor), signs=SIGNS)
    document = tc.Calibration(calibration).to_dict()
    kinds = ("scale_factor", "misalignment", "bias")
    values, errors = ([of[kind] for kind in kinds] for of in (document, document["standard_error"]))
    misses = [error_g(calibration, poses_of(other, sensor)) for other in RUNS]
    return np.concatenate(values), np.concatenate(errors), misses


def measured(jobs: int) -> tuple[Floats, Floats, Floats]:
    """Values and errors (run, sensor, 9), scale factors as shares of their mean; and errors of |a| (run of the
    calibration, sensor, run) in g."""
    asked = [(run, sensor) for run in RUNS for sensor in SENSORS]
    with ProcessPoolExecutor(jobs, initializer=one_thread) as pool:
        found = list(pool.map(partial(of_run), *zip(*asked, strict=True)))
    shape = (len(RUNS), len(SENSORS))
    values, errors, misses = (np.array([one[i] for one in found]).reshape(*shape, -1) for i in range(3))
    scale = values[:, :, :3].mean(axis=(0, 1))
    values[:, :, :3] = values[:, :, :3] / scale - 1
    errors[:, :, :3] = errors[:, :, :3] / np.abs(scale)
    return values, errors, misses


def studies(values: Floats, errors: Floats) -> list[tuple[GaugeStudy, Drift | None]]:
    """Of each coefficient: sensors by runs, and the movement with a run as the unit of time."""
    run, sensor = (i.ravel() for i in np.indices(values.shape[:2]))
    return [
        (
            gauge_study(values[:, :, k].ravel(), sensor, run),
            drift_of(sensor, run.astype(float), values[:, :, k].ravel(), errors[:, :, k].ravel()),
        )
        for k in range(len(NAMES))
    ]


def interval(values: Floats, errors: Floats, found: Sequence[tuple[GaugeStudy, Drift | None]]) -> RecalibrationInterval:
    moving = [
        Moving(*PARTS[k], drift, float(np.median(errors[:, :, k])))
        for k, (_, drift) in enumerate(found)
        if drift is not None
    ]
    return recalibration_interval(moving, LIMIT_G, 0.05)


def table(values: Floats, found: Sequence[tuple[GaugeStudy, Drift | None]]) -> str:
    head = [
        "coefficient", "sensors: mean", "sd", "repetition and runs: sd", "%GRR (95 %)", "ndc", "movement a run (95 %)",
    ]  # fmt: skip
    rows = []
    for k, (study, drift) in enumerate(found):
        of = distribution(values[-1, :, k] * SMALL)
        low, high = study.grr_interval
        moved = "—"
        if drift is not None:
            ends = [_small(end) for end in drift.rate_interval]
            moved = f"{_small(drift.rate)} ({ends[0]} to {ends[1]}), {drift.movement.value.replace('_', ' ')}"
        rows.append(
            [
                f"{NAMES[k]} [{UNITS[k // 3]}]", f"{of.mean:.0f}", f"{of.sd:.0f}",
                _small(study.components["gauge"].sd), f"{100 * study.grr:.1f} ({100 * low:.1f} to {100 * high:.1f})",
                str(study.categories), moved,
            ]
        )  # fmt: skip
    lines = [head, ["---", *["--:"] * (len(head) - 2), "---"], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _small(value: float) -> str:
    return f"{value * SMALL:.0f}" if np.isfinite(value) else "∞"


def said(of: RecalibrationInterval, misses: Floats) -> str:
    """The interval, and what a calibration of run 1 does in the later ones."""
    low, high = of.interval
    lasts = "longer than these runs can tell" if of.time is None else f"{of.time:.1f} runs"
    ends = f"{low:.1f} to {'∞' if high is None else f'{high:.1f}'}"
    later = ", ".join(f"{1e3 * np.sqrt(np.mean(misses[0, :, run] ** 2)):.1f}" for run in range(1, len(RUNS)))
    return (
        f"The error of |a| is beyond {1e3 * of.limit:.0f} mg with probability {of.probability:.2f} after {lasts} "
        f"(95 % interval: {ends}). "
        f"Calibrations of run 1 are off by {later} mg rms in runs 2 to {len(RUNS)}, over all sensors."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--write", action="store_true", help="the section into docs/measured.md")
    options = parser.parse_args(arguments)
    if not FOLDER.is_dir():
        sys.stderr.write(f"{FOLDER}: no recordings there\n")
        return 2
    values, errors, misses = measured(options.jobs)
    found = studies(values, errors)
    parts = {"fleet": table(values, found), "fleet-interval": said(interval(values, errors, found), misses)}
    print("\n\n".join(parts.values()))
    return write(DOCS / "measured.md", parts) if options.write else 0


if __name__ == "__main__":
    sys.exit(main())
