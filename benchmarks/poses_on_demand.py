"""Poses on demand: whether an acquisition that ends by itself is as honest as one of fixed length, and what it saves.

    python -m benchmarks.poses_on_demand [--quick] [--units N] [--jobs 1] [--save UNITS.jsonl] [--show UNITS.jsonl]

Simulated units whose truth is known. A unit takes the poses in the order in which a station asks for them, and the
station's own judge ends it. Beside it are fixed plans of 14 and 26 poses, diagnosed in the same way, and the naive
rule, which ends by the standard uncertainty that the residuals of the linear fit give. A quarter of the units has
something inside that nobody declares: an effect, or a stand that does not come back to the same place. Many more units
are only fitted, by the rules on which the station's is built.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processes import one_thread
from benchmarks.table import Table
from triaxcal.diagnosis import diagnose
from triaxcal.effects import effect_named
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import LEAST, directions, spiral
from triaxcal.model.sensor import Sensor
from triaxcal.planning.sequential import best_first
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.propagation import uncertainty_of_magnitude
from triaxcald.station.config import Stop
from triaxcald.station.on_demand import CONFIRMING, LEFT_LEAST, Judge

UNITS, QUICK = 200, 8
LINEAR_UNITS = 20
"""Times as many units are only fitted."""
STOP = Stop(uncertainty_g=3e-5)
SIGNS = (-1.0, -1.0, -1.0)
NOISES_G = (1.5e-5, 2.5e-5, 3.5e-5, 5e-5)
"""Standard error of a pose mean, by axis: that of the paper, and others, of which the largest needs all 26 poses."""
NOISE_DOF = 100.0
"""Degrees of freedom of the noise that the scatter inside the poses tells."""
INSIDE = ("second_order_nonlinearity", "third_order_nonlinearity", "scale_factor_asymmetry", "stand")
SIZES = (4.0, 40.0)
"""Largest coefficient of an effect, in standard errors of a pose mean; logarithmic."""
STAND = 2.0
"""A stand scatters by so many standard errors of a pose mean."""
POSE_S = 10.0
"""Of a pose with its turn."""
DIRECTIONS = spiral(200)
FIXED = (14, 26)
PLANS = {f"{n} poses": n for n in FIXED}
RULES = ("on demand", "14 poses", "26 poses", "naive")


@dataclass
class Unit:
    """A unit on its stand, one pose after the other."""

    seed: int
    noise_g: float
    inside: str

    def __post_init__(self) -> None:
        rng = self.rng = np.random.default_rng([self.seed, 27])
        k = -2.4 * (1 + 0.02 * rng.standard_normal(3))
        self.sensor = Sensor(k, 5e-3 * rng.standard_normal(3), 5e-3 * rng.standard_normal(3))
        self.scatter_g = STAND * self.noise_g if self.inside == "stand" else 0.0
        if self.inside not in ("", "stand"):
            effect = effect_named(self.inside)
            size = self.noise_g * np.exp(rng.uniform(*np.log(SIZES)))
            values = rng.uniform(-1, 1, len(effect.coefficients))
            self.sensor = replace(self.sensor, effects=((effect, size * values / np.abs(values).max()),))
        # One estimate of the noise for all poses.
        self.known = float(rng.chisquare(NOISE_DOF) / NOISE_DOF)

    def poses(self, ups: Iterable[np.ndarray], seed: int) -> list[Pose]:
        """Poses one after the other, of noise of their own."""
        rng = np.random.default_rng([self.seed, seed, 28])
        error = self.noise_g * np.abs(self.sensor.scale_factor)
        found: list[Pose] = []
        for i, up in enumerate(ups):
            noise = rng.standard_normal(3) * error + rng.standard_normal(3) * self.scatter_g * self.sensor.scale_factor
            mean = self.sensor.output(up[None], {})[0] + noise
            covariance = np.diag(error**2) * self.known
            before = found[-1].mean if found else None
            found.append(
                Pose(
                    i * POSE_S, i * POSE_S + 3.0, 300, mean, covariance,
                    NOISE_DOF, shared_dof=NOISE_DOF, before=before,
                )
            )  # fmt: skip
        return found


@dataclass(frozen=True)
class Result:
    """``poses`` that were taken, the repeated first one among them; ``covered`` the share of the nine parameters whose
    95 % interval holds the truth, and ``covered_a`` that of directions of |a|; ``rms_g`` the error of |a| over the
    sphere, ``stated_g`` its stated standard uncertainty. ``judged``: number of diagnoses."""

    poses: int
    covered: float
    covered_a: float
    rms_g: float
    stated_g: float
    judged: int = 0


def result(unit: Unit, c: Calibration, poses: int, judged: int = 0) -> Result:
    b = budget(c)
    truth = np.concatenate([unit.sensor.scale_factor, unit.sensor.misalignment, unit.sensor.bias])
    held = np.abs(c.values[:9] - truth) <= b.parameters.expanded[:9]
    u = unit.sensor.output(DIRECTIONS, {})
    covariates = {name: np.zeros(len(u)) for name in c.channel_reference}
    error = c.sensor.magnitude(u, covariates)[0] - 1.0
    uncertainty = uncertainty_of_magnitude(c.sensor, c.covariance, u, covariates, c.unmodelled)
    held_a = np.abs(error) <= float(b.magnitude.coverage) * uncertainty
    rms_g = float(np.sqrt(np.mean(error**2)))
    return Result(poses, float(held.mean()), float(held_a.mean()), rms_g, float(b.magnitude.standard), judged)


@cache
def asked_for(count: int = STOP.poses_most) -> list[np.ndarray]:
    """(count) directions in the order in which a station asks for them on demand."""
    left, taken = directions(count), list[np.ndarray]()
    while left:
        (label, up), *_ = best_first(np.array(taken).reshape(-1, 3), left)
        taken.append(up)
        left = [other for other in left if other[0] != label]
    return taken


def on_demand(unit: Unit) -> Result:
    """As a station does it: confirming poses follow those that suffice, the first one once more as the last."""
    judge, judged, ups = Judge(STOP, SIGNS), 0, asked_for()
    taken: list[np.ndarray] = []
    while True:
        # Until the poses suffice, or are as many as are allowed.
        while len(taken) < len(ups):
            taken.append(ups[len(taken)])
            poses = unit.poses(taken, 0)
            predicted_g = judge.predicted_g(poses) if len(taken) >= LEAST + LEFT_LEAST else None
            if predicted_g is not None and predicted_g <= STOP.uncertainty_g:
                judged += 1
                if judge(poses).enough:
                    break
        taken += ups[len(taken) : len(taken) + CONFIRMING - 1]
        poses = unit.poses([*taken, ups[0]], 0)
        judged += 1
        if len(taken) == len(ups) or not judge(poses).unexplained:
            break
    return result(unit, diagnose(poses, signs=SIGNS).after, len(poses), judged)


def fixed(unit: Unit, count: int) -> Result:
    plan = [v for _, v in directions(count)]
    return result(unit, diagnose(unit.poses([*plan, plan[0]], count), signs=SIGNS).after, count + 1)


def naive(unit: Unit) -> Result:
    """Ends as soon as the residuals of the linear fit say so, as if the noise inside the poses were not known."""
    ups = asked_for()
    for n in range(STOP.poses_least + 1, len(ups) + 1):
        found = fit([replace(p, dof=0.0, shared_dof=np.inf) for p in unit.poses(ups[:n], 0)], signs=SIGNS)
        if float(budget(found).magnitude.standard) <= STOP.uncertainty_g:
            break
    return result(unit, found, n)


def by_linear_fit(rule: str, unit: Unit) -> Result:
    """Without a diagnosis, as quick as a fit. ``predicted`` ends by the noise inside the poses and their directions
    alone, ``naive`` by the residuals alone, ``stated`` as soon as the budget of the fit states the uncertainty and
    nothing unexplained shows; ``confirmed`` is the same with the two conditions of a station."""
    judge, ups = Judge(STOP, SIGNS), asked_for()
    if rule in PLANS:
        plan = [v for _, v in directions(PLANS[rule])]
        return result(unit, fit(unit.poses([*plan, plan[0]], PLANS[rule]), signs=SIGNS), len(plan) + 1)
    if rule == "naive":
        return naive(unit)
    for n in range(max(STOP.poses_least, LEAST + LEFT_LEAST if rule == "confirmed" else LEAST + 1), len(ups) + 1):
        poses = unit.poses(ups[:n], 0)
        predicted_g = judge.predicted_g(poses)
        if predicted_g is None or predicted_g > STOP.uncertainty_g:
            continue
        found = fit(poses, signs=SIGNS)
        p = found.residual.lack_of_fit_p
        low = float(budget(found).magnitude.standard) <= STOP.uncertainty_g and p is not None and p > LACK_OF_FIT
        if rule == "predicted" or low:
            break
    if rule == "confirmed":
        taken = [*ups[: n + CONFIRMING - 1], ups[0]]
        return result(unit, fit(unit.poses(taken, 0), signs=SIGNS), len(taken))
    return result(unit, fit(unit.poses(ups[:n], 0), signs=SIGNS), n)


LINEAR_RULES = ("predicted", "stated", "confirmed", "naive", "14 poses", "26 poses")


def of_linear_unit(i: int) -> dict[str, Any]:
    noise_g, inside = NOISES_G[i // 2 % len(NOISES_G)], "stand" if i % 2 else ""
    found = {rule: asdict(by_linear_fit(rule, Unit(i, noise_g, inside))) for rule in LINEAR_RULES}
    return {"inside": inside, "noise_g": noise_g} | found


def kinds(i: int) -> tuple[float, str]:
    """Noise and what is inside, of unit ``i``: three of four have nothing inside, at every noise."""
    turn = i // 4
    if i % 4 < 3:
        return NOISES_G[(3 * turn + i % 4) % len(NOISES_G)], ""
    return NOISES_G[(turn + turn // len(INSIDE)) % len(NOISES_G)], INSIDE[turn % len(INSIDE)]


def of_unit(i: int) -> dict[str, Any]:
    noise_g, inside = kinds(i)
    unit = Unit(i, noise_g, inside)
    rules: dict[str, Callable[[], Result]] = {
        "on demand": lambda: on_demand(unit),
        **{name: partial(fixed, unit, count) for name, count in PLANS.items()},
        "naive": lambda: naive(unit),
    }
    return {"seed": i, "noise_g": noise_g, "inside": inside} | {name: asdict(rule()) for name, rule in rules.items()}


def mean_of(units: Sequence[dict[str, Any]], rule: str, key: str) -> tuple[float, float]:
    """Mean over the units, and its standard error: parameters of one unit go together."""
    values = np.array([unit[rule][key] for unit in units])
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def table(title: str, units: Sequence[dict[str, Any]], rules: Sequence[str] = RULES) -> Table:
    rows = []
    for rule in rules:
        shares = [mean_of(units, rule, key) for key in ("covered", "covered_a")]
        poses = mean_of(units, rule, "poses")[0]
        rms, stated = (
            1e6 * float(np.sqrt(np.mean([unit[rule][key] ** 2 for unit in units]))) for key in ("rms_g", "stated_g")
        )
        saved = [f"{POSE_S * (n + 1 - poses):+.0f}" for n in FIXED]
        covered = [f"{100 * m:.1f} ± {100 * e:.1f}" for m, e in shares]
        rows.append([rule, f"{poses:.1f}", *saved, *covered, f"{rms:.1f}", f"{stated:.1f}"])
    head = ["", "poses", "s saved on 14", "on 26", "parameters, %", "|a|, %", "error of |a|, µg", "stated, µg"]
    return Table(f"{title}, {len(units)} units", head, rows)


def tables(units: Sequence[dict[str, Any]]) -> Iterable[Table]:
    yield table("All", units)
    yield table("Nothing inside", [u for u in units if not u["inside"]])
    yield table("Something inside that nobody declares", [u for u in units if u["inside"]])
    for inside in INSIDE:
        if some := [u for u in units if u["inside"] == inside]:
            yield table(inside, some)
    for noise_g in NOISES_G:
        if some := [u for u in units if u["noise_g"] == noise_g]:
            yield table(f"Noise of a pose mean {1e6 * noise_g:g} µg", some)


def linear_tables(units: Sequence[dict[str, Any]]) -> Iterable[Table]:
    of_stand = [u for u in units if u["inside"]]
    yield table("Linear fits, nothing inside", [u for u in units if not u["inside"]], LINEAR_RULES)
    yield table(f"Linear fits, a stand that scatters by {STAND:g} standard errors", of_stand, LINEAR_RULES)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} units")
    parser.add_argument("--units", type=int, help=f"so many (default {UNITS})")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--save", type=Path, help="append a line for each unit; units that are there are not done again"
    )
    parser.add_argument("--linear", action="store_true", help="only the rules of the linear fit")
    parser.add_argument("--show", type=Path, help="tables of these lines alone")
    options = parser.parse_args(arguments)
    file, only_tables = options.show or options.save, bool(options.show or options.linear)
    units = [json.loads(line) for line in file.read_text().splitlines()] if file and file.exists() else []
    many = options.units or (QUICK if options.quick else UNITS)
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        if not options.show:
            for found in linear_tables(list(pool.map(of_linear_unit, range(LINEAR_UNITS * many), chunksize=20))):
                print(found, flush=True)
        done = {unit["seed"] for unit in units}
        for unit in pool.map(of_unit, [i for i in range(many) if i not in done]) if not only_tables else ():
            units.append(unit)
            if options.save:
                with options.save.open("a") as lines:
                    lines.write(json.dumps(unit) + "\n")
    for found in tables(units) if units else ():
        print(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
