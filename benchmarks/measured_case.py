"""Writes the complete case of docs/measured.md: one measured recording from its residual to the next run.

    python -m benchmarks.measured_case            # prints the table
    python -m benchmarks.measured_case --write    # puts it into docs/measured.md, and the pictures into docs/pictures

The recordings are runs 1 and 2 of sensor 6 of the board in ../shared/datasets/mimu4444.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.next_recording import FOLDER, SIGNS, poses_of
from benchmarks.pages import DOCS, PICTURES, write
from benchmarks.pictures import save
from triaxcal.arrays import Floats, rms
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.hold_out import magnitude_errors
from triaxcal.estimate.pose_fit import fit
from triaxcal.pictures import traces_figure
from triaxcal.poses.pose import Pose
from triaxcal.units import ErrorUnit

RUN, SENSOR = 1, 6
SMALL = ErrorUnit()
HEAD = ("| error of \\|a\\| | before | after |", "|---|--:|--:|")
BEFORE, AFTER = "C1", "C0"


def errors_on(c: Calibration, poses: Sequence[Pose]) -> tuple[Floats, Floats]:
    """In g, with their standard errors, in poses of another run."""
    return magnitude_errors(
        c.sensor, poses, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
    )


def table(loop: Loop, following: Sequence[Pose]) -> str:
    both = loop.before.residual, loop.after.residual
    rows = [
        [f"run {RUN}: cross-validated, rms, µg", *(SMALL.written(r.cross_validated_rms_g) for r in both)],
        [f"run {RUN}: residuals in standard errors, rms", *(f"{r.weighted_rms:.2g}" for r in both)],
        [f"run {RUN}: χ² per degree of freedom", *(f"{r.reduced_chi2:.2g}" for r in both)],
        [f"run {RUN}: residual, rms, µg", *(SMALL.written(r.rms_g) for r in both)],
        [
            f"**run {RUN + 1}**, poses that no fit saw: rms, µg",
            *(f"**{SMALL.written(rms(errors_on(c, following)[0]))}**" for c in (loop.before, loop.after)),
        ],
    ]
    return "\n".join([*HEAD, *(f"| {' | '.join(row)} |" for row in rows)])


def pictures(loop: Loop, following: Sequence[Pose]) -> None:
    PICTURES.mkdir(exist_ok=True)
    save(PICTURES / "case-residual.png", _before_and_after(loop))
    save(PICTURES / "case-trace.png", traces_figure(loop.traces, SMALL))
    save(PICTURES / "case-next.png", _next(loop, following))


def _before_and_after(loop: Loop) -> Figure:
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, c, name, colour in zip(
        panels, (loop.before, loop.after), ("before", "after"), (BEFORE, AFTER), strict=True
    ):
        _errors(axes, [p.pose for p in c.poses], np.array([p.residual_g for p in c.poses]),
                np.array([p.standard_error_g for p in c.poses]), colour)  # fmt: skip
        axes.set_title(f"run {RUN}, {name}", loc="left")
    return figure


def _next(loop: Loop, following: Sequence[Pose]) -> Figure:
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    axes = figure.subplots()
    for c, name, colour in ((loop.before, "linear", BEFORE), (loop.after, "with the warm-up", AFTER)):
        _errors(axes, following, *errors_on(c, following), colour, f"run {RUN}'s calibration, {name}")
    axes.set_title(f"run {RUN + 1}", loc="left")
    axes.legend(frameon=False, fontsize=8)
    return figure


def _errors(axes: Axes, poses: Sequence[Pose], error: Floats, noise: Floats, colour: str, label: str = "") -> None:
    t_s = np.array([p.t_s for p in poses])
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.errorbar(
        t_s, SMALL.count(1.0) * error, SMALL.count(1.0) * noise, fmt="o", markersize=4, color=colour, label=label
    )
    axes.set(xlabel="time, s", ylabel=f"error of |a|, {SMALL}")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="into docs/measured.md")
    chosen = parser.parse_args(arguments)
    if not FOLDER.is_dir():
        sys.stderr.write(f"{FOLDER}: no recordings there\n")
        return 2
    loop = diagnose(poses_of(RUN, SENSOR), signs=SIGNS)
    following = [p for p in poses_of(RUN + 1, SENSOR) if not p.fault]
    found = table(loop, following)
    print(found)
    print(f"the linear fit to run {RUN + 1} itself: {SMALL.in_full(fit(following, signs=SIGNS).residual.rms_g)}")
    for finding in loop.findings:
        print(finding.effect, finding.probability, dict(finding.alternatives))
        for name, (value, error, unit) in finding.coefficients.items():
            print(" ", name, value, error, unit)
    if chosen.write:
        pictures(loop, following)
        return write(DOCS / "measured.md", {"case": found})
    return 0


if __name__ == "__main__":
    sys.exit(main())
