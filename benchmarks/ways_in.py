"""Other ways in: a unit that turns slowly, poses of known attitude, refinement of passport values.

rms over parameters and seeds of errors over the Cramér–Rao bound, and over their own stated standard errors.
"""

from __future__ import annotations

import numpy as np

from benchmarks.table import Table, chosen
from benchmarks.truth import information, plan
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.attitude import fit_attitudes
from triaxcal.inputs.datasheet import Datasheet, refine
from triaxcal.inputs.moments import Moments
from triaxcal.inputs.rotation import fit_rotation
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

UNIT = Sensor(np.array([-2.41, 2.0, 3.1]), np.array([6e-3, 4e-2, -6e-3]), np.array([0.05, -0.03, 0.04]))
SIGNS = (-1, 1, 1)
TRUTH = np.concatenate([UNIT.scale_factor, UNIT.misalignment, UNIT.bias])
SAMPLES = {1000: 100, 10_000: 60, 100_000: 30, 1_000_000: 6}
NOISES: tuple[tuple[float, ...], ...] = (
    (1e-4, 1e-4, 1e-4),
    (0.005, 0.005, 0.005),
    (0.02, 0.02, 0.02),
    (0.05, 0.05, 0.05),
    (0.01, 0.01, 0.02),
    (0.01, 0.01, 0.03),
)


def slow_turn(count: int) -> np.ndarray:
    """Directions (n,3) of a turn about two axes at once that passes everywhere, as slow as the samples allow."""
    t = np.arange(count) * max(0.003, min(0.05, 60 / count))
    z = 0.999 * np.sin(np.pi / 2 * (2 * np.abs(0.618 * t / np.pi % 2 - 1) - 1))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(np.pi * t), r * np.sin(np.pi * t), z], axis=1)


def rms(values: list[np.ndarray]) -> str:
    return f"{np.sqrt(np.mean(np.square(values))):.2f}"


def turning(share: float) -> Table:
    rows = []
    for count, most in SAMPLES.items():
        a, seeds = slow_turn(count), max(3, round(most * share))
        for noise in NOISES:
            over_bound, over_stated = [], []
            bound = np.sqrt(np.diag(np.linalg.inv(information(UNIT, a, np.array(noise) * UNIT.scale_factor))))
            for seed in range(seeds):
                rng = np.random.default_rng([seed, count])
                moments = Moments()
                moments.feed(UNIT.output(a, {}) + rng.standard_normal(a.shape) * noise * UNIT.scale_factor)
                c = fit_rotation(moments, signs=SIGNS).calibration
                over_bound.append((c.values - TRUTH) / bound)
                over_stated.append((c.values - TRUTH) / c.standard_errors)
            told = " : ".join(f"{v:g}" for v in noise) if len(set(noise)) > 1 else f"{noise[0]:g}"
            rows.append([f"{count}", f"{told} g", f"{seeds}", rms(over_bound), rms(over_stated)])
    return Table("A turning unit", ["samples", "noise", "seeds", "over the bound", "over the stated error"], rows)


def attitudes(seeds: int) -> Table:
    rows = []
    for count in (6, 14, 26):
        ups = np.concatenate([np.eye(3), -np.eye(3)]) if count == 6 else plan(count)
        for error_rad in (0.0, 1e-5, 1e-4, 1e-3, 1e-2):
            for declared in (error_rad, None):
                pulls, ratio = [], []
                for seed in range(seeds):
                    rng = np.random.default_rng([seed, count])
                    true = ups + np.cross(rng.standard_normal(ups.shape) * error_rad, ups)
                    poses = noisy_poses(UNIT, true / np.linalg.norm(true, axis=1, keepdims=True), 1e-5, rng)
                    c = fit_attitudes(poses, ups, signs=SIGNS, attitude_error_rad=declared).calibration
                    pulls.append((c.values - TRUTH) / c.standard_errors)
                    if count > 6:
                        ratio.append(c.standard_errors / fit(poses, signs=SIGNS, excluded=()).standard_errors)
                known = "declared" if declared is not None else "estimated"
                rows.append([f"{count}", f"{error_rad:g}", known, rms(pulls), rms(ratio) if ratio else "—"])
    title = f"Poses of known attitude, noise 1e-5 g, {seeds} seeds"
    return Table(title, ["poses", "error, rad", "", "over the stated error", "stated, over the ellipsoid's"], rows)


def passports(seeds: int) -> Table:
    rows = []
    error = np.concatenate([np.abs(TRUTH[:3]) * 1e-3, np.full(6, 1e-3)])
    for count in (1, 2, 4, 6, 9, 14):
        for noise in (1e-6, 1e-5, 1e-3):
            pulls, shares, conflicts = [], [], []
            for seed in range(seeds):
                rng = np.random.default_rng([seed, count])
                v = TRUTH + rng.standard_normal(9) * error
                found = refine(
                    noisy_poses(UNIT, plan(14)[:count], noise, rng),
                    Datasheet(Sensor(v[:3], v[3:6], v[6:]), error, {}, 1.0),
                )
                pulls.append((found.calibration.values - TRUTH) / found.calibration.standard_errors)
                shares.append(found.share)
                conflicts.append((found.conflict_p or 0.0) < 0.01)
            share = f"{np.mean(shares):.2f}"
            rows.append([f"{count}", f"{noise:g} g", rms(pulls), share, f"{np.mean(conflicts):.1%}"])
    title = f"Passport values good to 1e-3, refined; {seeds} seeds"
    return Table(title, ["poses", "noise", "over the stated error", "share of the poses", "false conflicts"], rows)


def main(arguments: list[str] | None = None) -> int:
    quick = chosen(__doc__, arguments)
    print(turning(0.1 if quick else 1.0))
    print(attitudes(10 if quick else 60))
    print(passports(20 if quick else 200))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
