"""Several recordings of one session taken as one unit: what acts, and how well the next recording is predicted.

    python -m benchmarks.session [--jobs 2] [--agree] [--write]

Runs 1 to 5 of eight sensors on one board, one after the other, in ../shared/datasets/mimu4444. Runs 1 to k of a sensor
are diagnosed together, and the error of |a| in run k + 1 is set beside what was stated of it. ``--agree``: whether an
effect acts in all eight sensors, by all five runs. ``--write`` puts tables and pictures into docs/session.md, which has
the sensors by runs 1 to 4; the rows of all are in benchmarks/results/session.csv.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.next_recording import FOLDER, RUNS, SENSORS, error_g, poses_of
from benchmarks.pages import DOCS, PICTURES, write
from benchmarks.pictures import Line, draw_by_run, draw_pairs
from benchmarks.processes import one_thread
from benchmarks.table import Table
from triaxcal.arrays import Floats
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.estimate.recordings import gather
from triaxcal.pooled_units import PooledEffect, pooled_analysis
from triaxcal.text.advice import chance
from triaxcal.text.pooled_units import verdict
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import next_recording

SHOWN = 6
"""The sensor whose residuals are drawn: that with the largest warm-up."""
LEAST = 0.05
"""Effects of less probability, in all sensors and in each, are not listed."""
LISTED_RUNS = 4
"""Most runs after which a further run tests the calibration: those are on the page."""
RESULTS = Path(__file__).parent / "results" / "session.csv"


@dataclass(frozen=True, eq=False)
class Told:
    """Of runs 1 to ``runs`` of a sensor, in g; ``next_g`` in the run after them, NaN where there is none."""

    sensor: int
    runs: int
    found: str
    before_g: float
    after_g: float
    next_before_g: float
    next_after_g: float
    stated_g: float
    poses: Floats
    """(n,5) of each pose: its run, its moment in s, the residuals before and after in g, and by how much the effects
    that were found move the biases from where they are at the end, in g."""


def told(asked: tuple[int, int]) -> Told:
    sensor, runs = asked
    loop = diagnose(gather([poses_of(run, sensor) for run in range(1, runs + 1)]))
    nan = float("nan")
    following = poses_of(runs + 1, sensor) if runs < 5 else None
    shape = {e.name: dict(e.shape) for e, _ in loop.after.sensor.effects if e.shape}
    found = [f"{f.effect} {f.verdict.value} {_shape(shape.get(f.effect, {}))}".strip() for f in loop.findings]
    found += [f"{c.effect} {loop.probabilities[c.effect]:.2f}" for c in loop.candidates]
    found += [f"not corrected: {loop.refusal.value}"] if loop.refusal else []
    return Told(
        sensor,
        runs,
        ", ".join(found) or "nothing",
        loop.before.residual.rms_g,
        loop.after.residual.rms_g,
        nan if following is None else error_g(loop.before, following),
        nan if following is None else error_g(loop.after, following),
        next_recording(loop.after, budget(loop.after)).expanded_uncertainty,
        _poses(loop),
    )


def _poses(loop: Loop) -> Floats:
    c = loop.after
    poses = [p.pose for p in c.poses]
    held = c.covariates_of(poses)
    moved = c.sensor.departure(np.zeros((len(poses), 3)), held)
    run = np.array([p.run.index for p in poses])
    end = np.array([moved[run == k][-1] for k in run])
    residual = [(b.residual_g, a.residual_g) for b, a in zip(loop.before.poses, c.poses, strict=True)]
    return np.column_stack([run, [p.t_s for p in poses], residual, np.linalg.norm(moved - end, axis=1)])


def _shape(shape: dict[str, tuple[float, str]]) -> str:
    return " ".join(f"{value:.0f} {unit}" for value, unit in shape.values())


def agree() -> Table:
    found = pooled_analysis([diagnose(gather([poses_of(run, s) for run in range(1, 6)])) for s in SENSORS])
    rows = [
        [c.effect, chance(c.probability), chance(c.common), " ".join(f"{p:.2f}" for p in c.units), _shared(c)]
        for c in found.effects
        if max(c.probability, *c.units) > LEAST
    ]
    head = ["effect", "in all", "one value", "in each sensor by itself", "shape"]
    return Table(f"All eight sensors, by five runs each: {verdict(found)}", head, rows)


def _shared(c: PooledEffect) -> str:
    of_all = (shape.shared for shape in c.shapes.values())
    return ", ".join(f"{s.value:.0f} ± {s.standard_error or float('nan'):.0f} {s.unit}" for s in of_all)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--agree", action="store_true", help="whether an effect acts in all sensors")
    parser.add_argument("--write", action="store_true", help="tables and pictures into docs/session.md")
    options = parser.parse_args(arguments)
    if not FOLDER.is_dir():
        sys.stderr.write(f"{FOLDER}: no recordings there\n")
        return 2
    shared = agree() if options.agree or options.write else None
    if options.agree:
        print(shared)
        return 0
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        found = list(pool.map(told, [(sensor, runs) for runs in (2, 3, 4, 5) for sensor in SENSORS]))
    each, summary = of_runs(found), next_runs(found)
    print(each)
    print(f"\n{summary}")
    if shared is not None:
        draw_session(found)
        with RESULTS.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([each.head, *each.rows])
        listed = of_runs([one for one in found if one.runs == LISTED_RUNS])
        return write(DOCS / "session.md", {"runs": str(listed), "agree": str(shared), "next": summary})
    return 0


def draw_session(found: Sequence[Told]) -> None:
    """What a sensor leaves before and after, how the biases of all move, and the errors of the run that follows."""
    whole = {one.sensor: one.poses for one in found if one.runs == max(RUNS)}

    def panels(sensors: Sequence[int], columns: Sequence[tuple[int, str, str]]) -> list[list[Line]]:
        return [
            [
                (name.format(sensor), style, mine[:, 1], mine[:, column] * 1e3)
                for sensor in sensors
                for mine in [whole[sensor][whole[sensor][:, 0] == run - 1]]
                for column, name, style in columns
            ]
            for run in RUNS
        ]

    left = panels([SHOWN], [(2, "linear model", "."), (3, "with what was found", ".")])
    draw_by_run(PICTURES / "session-residuals.png", "|a| − 1 g, mg", left)
    corrected = [sensor for sensor in SENSORS if whole[sensor][:, 4].any()]
    moved = panels(corrected, [(4, "sensor {}", "-")])
    draw_by_run(PICTURES / "session-biases.png", "bias, from its end, mg", moved)
    following = [one for one in found if np.isfinite(one.next_before_g)]
    before, after = (
        np.array([1e3 * v for v in of])
        for of in zip(*((o.next_before_g, o.next_after_g) for o in following), strict=True)
    )
    labels = "next run, linear model, mg rms", "next run, with what was found, mg rms"
    draw_pairs(PICTURES / "session-next.png", labels, before, after, [f"runs 1 to {one.runs}" for one in following])


def of_runs(found: Sequence[Told]) -> Table:
    rows = []
    for one in found:
        figures = [one.before_g, one.after_g, one.next_before_g, one.next_after_g, one.stated_g]
        rows.append([f"1 to {one.runs}", str(one.sensor), one.found, *(_micro(v) for v in figures)])
    head = ["runs", "sensor", "what acts", "residual before", "after", "next run before", "after", "stated (95 %)"]
    return Table("Of a session, µg rms", head, rows)


def next_runs(found: Sequence[Told]) -> str:
    following = [one for one in found if np.isfinite(one.next_before_g)]
    ratios = np.array([one.next_after_g / one.next_before_g for one in following])
    within = np.mean([one.next_after_g <= one.stated_g for one in following])
    return (
        f"next run, after / before: geometric mean {np.exp(np.mean(np.log(ratios))):.3f}, worst {ratios.max():.2f}, "
        f"worse by 5 % {np.mean(ratios > 1.05):.0%}; within what was stated {within:.0%}"
    )


def _micro(value: float) -> str:
    return f"{value * 1e6:.0f}" if np.isfinite(value) else "—"


if __name__ == "__main__":
    sys.exit(main())
