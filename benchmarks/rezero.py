"""Three biases anew by a few poses: what that does on the next day, and whether its uncertainty is honest.

    python -m benchmarks.rezero [--quick] [--list]

Real: runs 1 to 5 of eight sensors on one board, one after the other, in ../shared/datasets/mimu4444. The linear fit of
a run is brought up to date by the first distinct poses of the next run; the error of |a| in all poses of that run, over
that of the old fit. Simulated: units whose biases and scale factors change by chance from recording to recording, as
much as the calibration says that they do; how often the stated 95 % intervals hold the truth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from benchmarks.next_recording import FOLDER, RUNS, SENSORS, SIGNS, error_g, poses_of
from benchmarks.processes import one_thread
from benchmarks.table import Table
from benchmarks.truth import plan
from triaxcal.documents import Calibration, earlier_of
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration as Fitted
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.bias_update import SCALE_FACTOR_SHARE, updated_biases
from triaxcal.model.directions import bias_directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import START_TO_START

COUNTS: tuple[int | None, ...] = (3, 4, 6, None)
SEEDS, QUICK = 2000, 200
UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-3, -6e-3]), np.array([5e-3, -3e-3, 4e-3]))
NOISE_G = 5e-5


@dataclass(frozen=True)
class OfPair:
    """A run and the next: errors on the next of the old linear fit, of a new one, and with biases anew by so many
    poses, NaN where that was refused."""

    sensor: int
    run: int
    before_g: float
    anew_g: float
    after_g: tuple[float, ...]


def of_sensor(sensor: int) -> list[OfPair]:
    runs = {run: poses_of(run, sensor) for run in RUNS}
    fits = {run: fit(poses, signs=SIGNS) for run, poses in runs.items()}
    found = []
    for run in RUNS[:-1]:
        earlier, following = earlier_of(Calibration(fits[run])), runs[run + 1]
        after = []
        for count in COUNTS:
            try:
                after.append(error_g(updated_biases(following, earlier, first=count), following))
            except Refused as e:
                sys.stderr.write(f"sensor {sensor}, run {run + 1}, {count} poses: refused: {e}\n")
                after.append(float("nan"))
        before, anew = error_g(fits[run], following), error_g(fits[run + 1], following)
        found.append(OfPair(sensor, run, before, anew, tuple(after)))
    return found


def real(jobs: int) -> list[OfPair]:
    with ProcessPoolExecutor(jobs, initializer=one_thread) as pool:
        return [pair for pairs in pool.map(of_sensor, SENSORS) for pair in pairs]


def ratios(pairs: Sequence[OfPair]) -> np.ndarray:
    """(pairs, counts) of the error with biases anew to that of the old linear fit."""
    return np.array([[after / p.before_g for after in p.after_g] for p in pairs])


def real_table(pairs: Sequence[OfPair]) -> Table:
    head = ["by", "after / before", "best", "worst", "worse", "refused"]
    rows = []
    for count, of_count in zip(COUNTS, ratios(pairs).T, strict=True):
        known = of_count[np.isfinite(of_count)]
        mean, worse = np.exp(np.mean(np.log(known))), int(np.sum(known > 1))
        by = "all poses" if count is None else f"{count} poses"
        figures = [f"{mean:.3f}", f"{known.min():.2f}", f"{known.max():.2f}"]
        rows.append([by, *figures, str(worse), str(len(of_count) - len(known))])
    full = np.array([p.anew_g / p.before_g for p in pairs])
    rows.append(["a new fit", f"{np.exp(np.mean(np.log(full))):.3f}", f"{full.min():.2f}", f"{full.max():.2f}", "", ""])
    return Table(f"Biases anew on the next run, {len(pairs)} pairs of real runs", head, rows)


@dataclass(frozen=True)
class Trial:
    """A unit on two days: its truth on the second, and its calibration brought up to date."""

    truth: Sensor
    found: Fitted

    @property
    def held(self) -> np.ndarray:
        """(9,) whether the expanded uncertainties hold the truth."""
        truth = np.concatenate([self.truth.scale_factor, self.truth.misalignment, self.truth.bias])
        return np.abs(self.found.values - truth) <= budget(self.found).parameters.expanded

    @property
    def magnitude(self) -> tuple[float, float]:
        """Error of |a| in a random attitude, and its stated standard uncertainty."""
        up = np.random.default_rng(int(1e9 * abs(self.truth.bias[0]))).standard_normal((1, 3))
        u = self.truth.output(up / np.linalg.norm(up), {})
        row = self.found.sensor.radius_by_parameters(u, {})[0]
        error = float(self.found.sensor.magnitude(u, {})[0][0]) - 1.0
        return error, float(np.sqrt(row @ self.found.covariance @ row))


def trial(seed: int, count: int, start_to_start: float = START_TO_START) -> Trial:
    rng = np.random.default_rng([seed, count])
    earlier = Calibration(fit(noisy_poses(UNIT, plan(14), NOISE_G, rng), signs=np.sign(UNIT.scale_factor).tolist()))
    k = UNIT.scale_factor * (1 + SCALE_FACTOR_SHARE * start_to_start * rng.standard_normal(3))
    today = Sensor(k, UNIT.misalignment, UNIT.bias + start_to_start * rng.standard_normal(3))
    ups = np.array([v for _, v in bias_directions(count)])
    return Trial(today, updated_biases(noisy_poses(today, ups, NOISE_G, rng), earlier_of(earlier)))


def coverage(seeds: int, count: int) -> np.ndarray:
    """(10,) the share of the stated 95 % intervals that hold the truth: of the nine parameters, and of |a|."""
    held, of_magnitude, refused = [], [], 0
    for seed in range(seeds):
        try:
            found = trial(seed, count)
        except Refused:
            refused += 1
            continue
        error, standard = found.magnitude
        held.append(found.held)
        of_magnitude.append(abs(error) <= 1.96 * standard)
    assert refused <= max(2, 0.001 * seeds), f"{refused} sound units of {seeds} were refused"
    return np.append(np.mean(held, axis=0), np.mean(of_magnitude))


def coverage_table(seeds: int) -> Table:
    rows = []
    for count in (3, 4, 6, 14):
        found = coverage(seeds, count)
        groups = [found[:3], found[3:6], found[6:9], found[9:]]
        rows.append([str(count), *(f"{g.min():.3f} … {g.max():.3f}" if len(g) > 1 else f"{g[0]:.3f}" for g in groups)])
    head = ["poses", "scale factors", "misalignments", "biases", "|a|"]
    return Table(f"Share of stated 95 % intervals that hold the truth, {seeds} simulated units each", head, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer simulated units")
    parser.add_argument("--list", action="store_true", help="a line for each pair of runs")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    if FOLDER.is_dir():
        pairs = real(options.jobs)
        print(real_table(pairs))
        for p in pairs if options.list else ():
            after = ", ".join(f"{g * 1e6:.0f}" for g in p.after_g)
            print(f"{p.sensor} {p.run}: {p.before_g * 1e6:.0f} -> {after} µg; a new fit {p.anew_g * 1e6:.0f}")
    else:
        print(f"real runs: skipped, since {FOLDER} is not there")
    print(coverage_table(QUICK if options.quick else SEEDS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
