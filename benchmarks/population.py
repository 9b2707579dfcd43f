"""What the population's model names: effects of places in fleets of 500 units, and what learned odds add on 14 poses.

    python -m benchmarks.population --worlds 20 --empty 100 [--jobs 2] [--first 500000]
    python -m benchmarks.population --full 1          # a world whose every unit goes through `diagnose`
    python -m benchmarks.population --odds 12         # units of a type before, and after odds are learned

Seeds from 500000 on are not looked at while a method is made.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import triaxcal as tc
from benchmarks.processes import one_thread
from benchmarks.table import Table
from tests.population.worlds import World, judged, with_broken_end, world
from tests.undeclared import invented, invented_later, uncatalogued
from tests.undeclared.examine import still_poses
from tests.undeclared.generator import CannotShow, recording

TEST = 500_000
UNITS = 500


@dataclass(frozen=True)
class Line:
    """Of one world: for each truth whether its place was named, or listed; names of other places; seconds of processor
    time; difference of the change from the true one in days."""

    seed: int
    truths: tuple[str, ...]
    named: tuple[bool, ...]
    listed: tuple[bool, ...]
    patterns: tuple[bool, ...]
    wrong: tuple[str, ...]
    seconds: float
    days: tuple[float, ...]


def of_world(seed: int, effects: int, units: int = UNITS) -> Line:
    return _line(seed, world(seed, effects, units))


def of_broken_end(seed: int) -> Line:
    return _line(seed, with_broken_end(world(seed, 0, UNITS), seed))


def _line(seed: int, made: World) -> Line:
    begin = time.process_time()
    found = tc.population.placed_effects(made.runs)
    seconds = time.process_time() - begin
    each = [judged(made, k, found) for k in range(len(made.truths))]
    mine = {id(s) for judgement in each for s in judgement.statements}
    return Line(
        seed,
        tuple(f"{t.what} at {t.kind.value} {t.name}, {t.size:.1f}" for t in made.truths),
        tuple(j.named for j in each),
        tuple(j.listed for j in each),
        tuple(j.pattern for j in each),
        tuple(f"{s.place.kind.value} {s.place.name}: {s.pattern.form.value} of {s.pattern.name}"
              for s in found.statements if id(s) not in mine),
        seconds,
        tuple(j.since_off_s / 86400 for j in each if j.since_off_s is not None),
    )  # fmt: skip


def worlds(first: int, count: int, jobs: int, of: Callable[[int], Line]) -> list[Line]:
    with ProcessPoolExecutor(jobs, initializer=one_thread) as pool:
        lines = []
        for line in pool.map(of, range(first, first + count)):
            print(line, file=sys.stderr, flush=True)
            lines.append(line)
    return lines


def table(lines: Sequence[Line], empty: Sequence[Line], broken: Sequence[Line] = ()) -> Table:
    def share(of: Sequence[bool]) -> str:
        return f"{sum(of)} of {len(of)}"

    rows = []
    for what in ("all", *sorted({t.partition(" at ")[0] for line in lines for t in line.truths})):
        mine = [
            (line.named[k], line.listed[k], line.patterns[k])
            for line in lines for k, t in enumerate(line.truths) if what == "all" or t.startswith(f"{what} at ")
        ]  # fmt: skip
        rows.append([what, *(share([m[i] for m in mine]) for i in range(3))])
    days = [abs(d) for line in lines for d in line.days]
    rows.append(["statements of other places", str(sum(len(line.wrong) for line in lines)), "", ""])
    rows.append(["median days off a change", f"{np.median(days):.1f}" if days else "", "", ""])
    seconds = [line.seconds for line in (*lines, *empty, *broken)] or [0.0]
    rows.append(["seconds a world, median and most", f"{np.median(seconds):.1f}", f"{max(seconds):.1f}", ""])
    rows.append(["empty worlds with anything named", share([bool(line.wrong) for line in empty]), "", ""])
    if broken:
        rows.append(["the same with a broken unit at the end", share([bool(line.wrong) for line in broken]), "", ""])
    return Table("Effects of places", ("effect", "place named alone", "named or listed", "pattern too"), rows)


# A world in full: every unit's poses through `diagnose`.


def in_full(seed: int, units: int, jobs: int) -> Table:
    made = world(seed, 2, units)
    with ProcessPoolExecutor(jobs, initializer=one_thread) as pool:
        runs = list(pool.map(diagnosed, made.runs, chunksize=8))
    return table([_line(seed, replace(made, runs=runs))], [])


def diagnosed(run: tc.population.UnitRun) -> tc.population.UnitRun:
    """The run with what a diagnosis of its poses says."""
    poses, n = run.poses, 0
    assert poses is not None
    n = len(poses.residual)
    rng = np.random.default_rng(abs(hash((run.serial, run.time_s))) % 2**32)
    # |a| − 1 of the linear fit is back in the readings; a room's temperature goes with them.
    scale = np.asarray(run.coefficients[:3])
    readings = poses.readings + scale * poses.measured * poses.residual[:, None]
    found = tc.diagnosis.diagnose(
        tc.Poses.of_means(
            readings, t=np.arange(n) * 12.0, standard_errors=np.abs(scale) * np.outer(poses.standard_error, np.ones(3)),
            channels={"temp_c": 23.0 + 0.02 * np.arange(n) + 0.01 * rng.normal(size=n)},
        )
    )  # fmt: skip
    before = found.before
    effects = {
        name: tc.population.SeenEffect(p, {k: (v, e or np.nan) for k, (v, e, _) in _coefficients(found, name).items()})
        for name, p in found.stated.items()
    }
    kept = {k: v for k, v in run.effects.items() if k.startswith("temperature_")}
    return replace(
        run,
        coefficients=before.values[:9],
        standard_errors=before.standard_errors[:9],
        effects=effects | kept,
        poses=replace(poses, residual=np.array([p.residual_g for p in before.poses])),
    )


def _coefficients(loop: tc.diagnosis.Loop, name: str) -> tc.diagnosis.Coefficients:
    return next((f.coefficients for f in (*loop.findings, *loop.candidates) if f.effect == name), {})


# Learned odds on 14 poses.

TYPES = ("warm_up", "third_order_nonlinearity", "hysteresis", "temperature_bias", "second_order_nonlinearity")
OUTSIDE = (uncatalogued.KINDS[0], invented.KINDS[0], invented_later.KINDS[0])
OFTEN = 0.7
"""Share of units of a type that have its effect."""
LEARNED_FROM = 12


def units_of(kind: str, first: int, count: int) -> list[tuple[tuple[str, ...], tc.Poses, tuple[float, ...]]]:
    rng = np.random.default_rng(first)
    out = []
    for seed in range(first, first + 4 * count):
        if len(out) == count:
            break
        try:
            made = recording(seed, kind if rng.random() < OFTEN else "none", (20.0, 60.0), 14)
        except CannotShow:
            continue
        out.append((made.names, still_poses(made.samples()), made.signs))
    return out


def of_type(kind: str, first: int, count: int) -> dict[str, Counter[str]]:
    """Counts of units after the first `LEARNED_FROM`, without and with what these taught."""
    units = units_of(kind, first, LEARNED_FROM + count)
    seen = [
        tc.population.SeenUnit.of(tc.diagnosis.diagnose(poses, signs=signs)) for _, poses, signs in units[:LEARNED_FROM]
    ]
    learned = tc.population.learned_odds(seen)
    out = {}
    for label, odds in (("before", None), ("after", learned.prior)):
        counts: Counter[str] = Counter()
        for names, poses, signs in units[LEARNED_FROM:]:
            loop = tc.diagnosis.diagnose(poses, signs=signs, odds=odds)
            unique = [f.effect for f in loop.findings if not f.alternatives]
            counts["units"] += 1
            counts["with an effect of the catalogue"] += bool(names)
            counts["unique right"] += any(name in names for name in unique)
            counts["unique wrong"] += any(name not in names for name in unique)
            counts["unmodelled"] += loop.found.unexplained.significant
        out[label] = counts
    print(kind, {k: dict(v) for k, v in out.items()},
          {n: round(e.odds, 4) for n, e in learned.effects.items() if e.units > 0.5},
          round(learned.unmodelled_probability, 3), file=sys.stderr, flush=True)  # fmt: skip
    return out


def odds_table(first: int, count: int, jobs: int) -> Table:
    kinds = [*TYPES, *OUTSIDE]
    with ProcessPoolExecutor(jobs, initializer=one_thread) as pool:
        each = list(pool.map(of_type, kinds, [first + 1000 * k for k in range(len(kinds))], [count] * len(kinds)))
    rows = []
    for kind, found in zip(kinds, each, strict=True):
        before, after = found["before"], found["after"]
        rows.append(
            [kind, str(before["with an effect of the catalogue"]), str(before["units"])]
            + [f"{before[k]} → {after[k]}" for k in ("unique right", "unique wrong", "unmodelled")]
        )
    return Table(
        f"Odds learned from {LEARNED_FROM} units of a type, 14 poses",
        ("effect of the type", "units with it", "of", "unique right", "unique wrong", "unmodelled"), rows,
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=0, metavar="N")
    parser.add_argument("--empty", type=int, default=0, metavar="N")
    parser.add_argument("--broken", type=int, default=0, metavar="N", help="without effects, a broken unit last")
    parser.add_argument("--full", type=int, default=0, metavar="N")
    parser.add_argument("--odds", type=int, default=0, metavar="UNITS", help="of each type, after those learned from")
    parser.add_argument("--units", type=int, default=UNITS)
    parser.add_argument("--first", type=int, default=TEST, metavar="SEED")
    parser.add_argument("--jobs", type=int, default=1)
    a = parser.parse_args(arguments)
    if a.worlds or a.empty or a.broken:
        two, none = partial(of_world, effects=2), partial(of_world, effects=0)
        print(
            table(
                worlds(a.first, a.worlds, a.jobs, two),
                worlds(a.first + 10_000, a.empty, a.jobs, none),
                worlds(a.first + 30_000, a.broken, a.jobs, of_broken_end),
            )
        )
    for k in range(a.full):
        print(in_full(a.first + 20_000 + k, a.units, a.jobs))
    if a.odds:
        print(odds_table(a.first, a.odds, a.jobs))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
