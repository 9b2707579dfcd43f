"""What the loop makes of the benchmark's recordings, one line each, to set another state of it beside by the seed.

    python -m benchmarks.frozen --write FILE.jsonl.gz [--jobs 2] [--range development]
    python -m benchmarks.frozen --show benchmarks/results/loop-test.jsonl.gz benchmarks/results/posterior-test.jsonl.gz
    python -m benchmarks.frozen --paired benchmarks/results/posterior-test.jsonl.gz FILE.jsonl.gz

``loop-*`` are the results of the search for effects that the posterior has taken the place of.

A recording is one of `tests/undeclared`; what is inside, and the error of |a| in fifteen poses of another recording,
before and after, with and without the noise of these poses, are in its line. Methods are made on the development range
of seeds alone, and judged on the test range.
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, ttest_1samp

from benchmarks.processes import one_thread
from benchmarks.table import Table
from benchmarks.undeclared import LARGE, NOISES, PAIR
from tests.undeclared import invented, invented_later, physics, uncatalogued
from tests.undeclared.examine import Case, still_poses
from tests.undeclared.generator import CannotShow, Recording
from tests.undeclared.told import rms_g
from triaxcal.diagnosis import diagnose
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.hold_out import magnitude_errors
from triaxcal.poses.pose import Pose

RANGES = {"development": 0, "test": 500_000}
"""First seeds; the test range is not looked at while a method is made."""
CERTAIN = 0.99
"""What a verdict of the search, which knew no probabilities, is taken to say."""
LEAST = 1e-4
"""What a statement is taken to leave open, or one false certainty would make the score infinite."""
TOLD = 1e-3
"""Names of less probability are not kept."""
LEVELS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
"""Of the reliability table."""
WORSE = 1.05
"""An error after that is larger than so many times the one before has become worse."""


@dataclass(frozen=True)
class Judged:
    """What is said: findings (name, verdict, alternatives), whether something is left, the calibrations, and the
    probability of names, where it says so."""

    found: tuple[tuple[str, str, tuple[str, ...]], ...]
    unexplained: bool
    before: Calibration
    after: Calibration
    probabilities: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Line:
    """``names`` are the truth's that a catalogue has; ``before_g`` and ``after_g`` errors of |a| in the poses
    of another recording, NaN where the poses found are not those made; ``quiet`` are those without the noise of these
    poses; ``seconds`` of processor time."""

    section: str
    kind: str
    seed: int
    poses: int
    noise: str
    names: tuple[str, ...] = ()
    size: float = 0.0
    found: tuple[tuple[str, str, tuple[str, ...]], ...] = ()
    unexplained: bool = False
    before_g: float = float("nan")
    after_g: float = float("nan")
    quiet_before_g: float = float("nan")
    quiet_after_g: float = float("nan")
    noise_floor_g: float = float("nan")
    seconds: float = float("nan")
    error: str = ""
    probabilities: tuple[tuple[str, float], ...] = ()

    @property
    def stated(self) -> dict[str, float]:
        """The probability of each name. Where only verdicts are known: a name adopted has 0.99, and those that are
        alternatives share it."""
        if self.probabilities:
            return dict(self.probabilities)
        out: dict[str, float] = {}
        for name, verdict, others in self.found:
            group = (name,) if verdict == "adopted" else (name, *others)
            out |= dict.fromkeys(group, CERTAIN / len(group))
        return out

    @property
    def unique(self) -> tuple[str, ...]:
        return tuple(name for name, verdict, _ in self.found if verdict == "adopted")

    @property
    def right(self) -> bool:
        return bool(set(self.unique) & set(self.names))

    @property
    def wrong(self) -> bool:
        return bool(set(self.unique) - set(self.names))

    @property
    def listed(self) -> bool:
        listed = {n for name, verdict, others in self.found if verdict != "adopted" for n in (name, *others)}
        return not self.right and bool(listed & set(self.names))


def judged(poses: Sequence[Pose], signs: Sequence[float]) -> Judged:
    """What the loop of today says."""
    loop = diagnose(poses, signs=signs)
    found = tuple((f.effect, f.verdict.value, tuple(f.alternatives)) for f in loop.findings)
    told = tuple((name, float(f"{p:.4g}")) for name, p in loop.probabilities.items() if p >= TOLD)
    return Judged(found, loop.found.unexplained.significant, loop.before, loop.after, told)


def cases(first: int, share: float = 1.0) -> Iterator[tuple[str, Case]]:
    """With their section. ``share`` of the usual number."""

    def seeds(count: int) -> range:
        return range(first, first + max(round(count * share), 1))

    def turn(kinds: Sequence[str], i: int) -> tuple[str, int, str]:
        return kinds[i % len(kinds)], i, NOISES[(i + i // len(kinds)) % len(NOISES)]

    # Effects that were invented after the method was fixed are those of the test range alone; "later" ones by somebody
    # who did not know it, after the others had been looked at.
    later = ("invented", invented.KINDS, 100, 100), ("later", invented_later.KINDS, 100, 100)
    further = later if first == RANGES["test"] else ()
    for section, kinds, count_26, count_14 in (
        ("catalogue", physics.KINDS, 165, 165),
        ("outside", uncatalogued.KINDS, 150, 150),
        *further,
    ):
        for poses, count in ((26, count_26), (14, count_14)):
            for kind, i, noise in (turn(kinds, i) for i in seeds(count)):
                yield section, Case(kind, i, LARGE, poses, noise)
    for i in seeds(120):
        yield "nothing", Case("none", i, (1.0, 1.0), 14 if i % 4 == 3 else 26, NOISES[i % 3])
    for i in seeds(60):
        yield "two", Case("two", i, PAIR, 14 if i % 3 == 2 else 26, NOISES[i % 3])


def line(asked: tuple[str, Case]) -> Line:
    """Whatever goes wrong is an outcome too."""
    section, case = asked
    bare = Line(section, case.kind, case.seed, case.poses, case.noise)
    try:
        r = case.make()
    except CannotShow as e:
        return replace(bare, error=f"not drawn: {e}")
    bare = replace(bare, names=r.names, size=max(r.sizes, default=0.0))
    try:
        poses = still_poses(r.samples())
        begin = time.process_time()
        said = judged(poses, r.signs)
        seconds = time.process_time() - begin
        check = still_poses(r.held_out_samples())
        (before, quiet_before), (after, quiet_after) = (errors_g(r, check, c) for c in (said.before, said.after))
    except Exception as e:  # noqa: BLE001 -- a benchmark goes on
        return replace(bare, error=f"{type(e).__name__}: {e}")
    floor = said.before.residual.noise_floor_g
    return replace(
        bare,
        found=said.found,
        unexplained=said.unexplained,
        before_g=before,
        after_g=after,
        quiet_before_g=quiet_before,
        quiet_after_g=quiet_after,
        noise_floor_g=floor,
        seconds=seconds,
        probabilities=said.probabilities,
    )


def errors_g(r: Recording, check: Sequence[Pose], c: Calibration) -> tuple[float, float]:
    """Of |a| in the poses of the other recording: of their means, and of these without noise."""
    there = r.held_out.scene
    if len(check) != there.poses:
        return float("nan"), float("nan")
    means = r.triad.outputs(there.pose_force + there.by_pose(r.held_out.added_g))
    quiet = [replace(p, mean=u) for p, u in zip(check, means, strict=True)]

    def error(poses: Sequence[Pose]) -> float:
        miss, _ = magnitude_errors(
            c.sensor, poses, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
        )
        return rms_g(r, miss)

    return error(check), error(quiet)


def write(path: Path, lines: Sequence[Line]) -> None:
    text = "".join(json.dumps(_plain(asdict(one))) + "\n" for one in lines)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(gzip.compress(text.encode(), 9, mtime=0))


def read(path: Path) -> list[Line]:
    rows = [json.loads(row) for row in gzip.decompress(path.read_bytes()).decode().splitlines()]
    return [Line(**{k: _of_plain(k, v) for k, v in row.items()}) for row in rows]


def _plain(row: dict[str, Any]) -> dict[str, Any]:
    """Six digits are enough of an error, and NaN is no JSON."""
    return {
        k: (float(f"{v:.6g}") if np.isfinite(v) else None) if isinstance(v, float) else v
        for k, v in row.items()
        if v not in ("", ()) and v is not False
    }


def _of_plain(key: str, value: Any) -> Any:
    if value is None:
        return float("nan")
    if key == "names":
        return tuple(value)
    if key == "probabilities":
        return tuple((name, p) for name, p in value)
    return tuple((name, verdict, tuple(others)) for name, verdict, others in value) if key == "found" else value


def table(lines: Sequence[Line]) -> Table:
    """The rows of the comparison: names, and the error after over that before."""
    rows = []
    for section in ("catalogue", "outside", "invented", "later", "two", "nothing"):
        for poses in (26, 14):
            group = [one for one in lines if one.section == section and one.poses == poses and not one.error]
            if not group:
                continue
            ratios = np.array([one.after_g / one.before_g for one in group])
            ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
            seconds = float(np.median([one.seconds for one in group]))
            rows.append([
                section, str(poses), str(len(group)), str(sum(one.right for one in group)),
                str(sum(one.listed for one in group)), str(sum(one.wrong for one in group)),
                str(sum(one.unexplained for one in group)), f"{np.exp(np.mean(np.log(ratios))):.3f}",
                f"{int((ratios > WORSE).sum())} ({ratios.max():.1f})", f"{seconds:.2f}",
            ])  # fmt: skip
    head = ["truth", "poses", "n", "unique right", "listed", "unique wrong", "unexplained"]
    return Table("By section", [*head, "after / before", "worse by 5 % (worst)", "s"], rows)


def reliability(lines: Sequence[Line]) -> Table:
    """Of what was stated with a probability the share that is true, and the scores of all of it: a name acts or not.

    The population: one effect of s = 20 to 200, of the catalogue or of none, pairs of 20 to 40, and nothing.
    """
    stated = [(p, name in one.names) for one in lines if not one.error for name, p in one.stated.items()]
    missed = sum(name not in one.stated for one in lines if not one.error for name in one.names)
    p, true = np.clip([s for s, _ in stated], LEAST, 1 - LEAST), np.array([t for _, t in stated])
    rows = []
    for low, high in itertools.pairwise(LEVELS):
        inside = (p >= low) & ((p < high) | (high == LEVELS[-1]))
        if inside.any():
            n, share = int(inside.sum()), float(true[inside].mean())
            error = np.sqrt(max(share * (1 - share), 1 / n) / n)
            rows.append([f"{low:g} to {high:g}", str(n), f"{p[inside].mean():.3f}", f"{share:.3f} ± {error:.3f}"])
    count = len([one for one in lines if not one.error])
    brier = float(np.sum((p - true) ** 2) + missed) / count
    log = float(-np.sum(np.log(np.where(true, p, 1 - p))) - missed * np.log(TOLD)) / count
    rows.append(["Brier score a recording", str(count), f"{brier:.4f}", ""])
    rows.append(["log score a recording", str(count), f"{log:.3f}", ""])
    return Table("Reliability of stated probabilities", ["stated", "n", "mean", "true"], rows)


def paired(old: Sequence[Line], new: Sequence[Line]) -> Table:
    """Differences of ``new`` from ``old`` over the recordings that both have, with Holm's correction over all rows."""
    tested = [row for group, pairs in by_group(old, new).items() for row in differences(*group, pairs)]
    corrected = holm([p for _, p in tested])
    rows = [[*row, f"{p:.3f}", f"{q:.3f}"] for (row, p), q in zip(tested, corrected, strict=True)]
    return Table("Paired differences", ["truth", "poses", "n", "of", "old", "new", "change", "p", "p (Holm)"], rows)


def by_group(old: Sequence[Line], new: Sequence[Line]) -> dict[tuple[str, int], list[tuple[Line, Line]]]:
    """By section and number of poses: pairs of lines of one recording, without those that ended in an error."""
    known = {(one.section, one.kind, one.seed, one.poses, one.noise): one for one in old if not one.error}
    pairs: dict[tuple[str, int], list[tuple[Line, Line]]] = {}
    for one in new:
        before = known.get((one.section, one.kind, one.seed, one.poses, one.noise))
        if before is not None and not one.error:
            pairs.setdefault((one.section, one.poses), []).append((before, one))
    return pairs


def differences(section: str, poses: int, pairs: Sequence[tuple[Line, Line]]) -> Iterator[tuple[list[str], float]]:
    """Rows of a table, each with its p-value.

    Names right and wrong: the exact test of McNemar. The error: a paired t-test of log(after / before); a recording
    that was not corrected has the ratio 1.
    """
    for what in ("right", "wrong"):
        gained = sum(getattr(b, what) and not getattr(a, what) for a, b in pairs)
        lost = sum(getattr(a, what) and not getattr(b, what) for a, b in pairs)
        p = float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0
        values = [str(sum(getattr(one, what) for one in side)) for side in zip(*pairs, strict=True)]
        yield [section, str(poses), str(len(pairs)), f"unique {what}", *values, f"+{gained} −{lost}"], p
    logs = np.log([[one.after_g / one.before_g for one in pair] for pair in pairs])
    logs = logs[np.isfinite(logs).all(axis=1)]
    change = logs[:, 1] - logs[:, 0]
    error = float(change.std(ddof=1) / np.sqrt(len(change)))
    p = float(ttest_1samp(change, 0.0).pvalue) if error > 0 else 1.0
    values = [f"{np.exp(v):.3f}" for v in logs.mean(axis=0)]
    told = f"{change.mean():+.3f} ± {error:.3f}"
    yield [section, str(poses), str(len(change)), "after / before", *values, told], p


def holm(p: Sequence[float]) -> list[float]:
    """Each p-value corrected for their number m: the k-th smallest, from 0, is multiplied by m - k, and none is below
    the one before it."""
    order = np.argsort(p)
    scaled = np.asarray(p)[order] * np.arange(len(p), 0, -1)
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return corrected.tolist()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, metavar="FILE", help="run the loop and freeze its results")
    parser.add_argument("--show", type=Path, metavar="FILE", nargs="+", default=[], help="tables of frozen results")
    parser.add_argument("--paired", type=Path, metavar="FILE", nargs=2, help="differences of the second from the first")
    parser.add_argument("--range", choices=RANGES, default="development", help="of seeds")
    parser.add_argument("--share", type=float, default=1.0, help="of the recordings; default all")
    parser.add_argument("--section", help="only this one, in the place of what FILE has of it")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    for path in options.show:
        print(path)
        print(table(read(path)))
        print(reliability(read(path)))
    if options.paired:
        print(paired(*map(read, options.paired)))
    if options.write:
        with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
            asked = [c for c in cases(RANGES[options.range], options.share) if options.section in (None, c[0])]
            lines = list(pool.map(line, asked, chunksize=2))
        if options.section and options.write.exists():
            lines = [*(one for one in read(options.write) if one.section != options.section), *lines]
        write(options.write, lines)
        print(table(lines))
        print(reliability(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
