"""Recordings with an effect inside that nobody declares: what the loop makes of them.

    python -m benchmarks.undeclared [--quick] [--jobs 2] [--only confusion none power two outside] [--list-misses]
    python -m benchmarks.undeclared --one hysteresis 3 --poses 26 --size 20:200 --noise white

The recordings are those of `tests/undeclared`, whose physics is written without the effects of the package. Sizes s
and the told-in-advance optimum: docs/explanation/diagnosis.md.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from benchmarks.processes import one_thread
from benchmarks.table import Table
from tests.undeclared import physics, uncatalogued
from tests.undeclared.examine import Case, Outcome, describe, examine

SIZES = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 20.0)
ASKED, TIMES = 5.0, 12
"""Of the size for which a figure is asked there are so many times as many."""
LARGE = (20.0, 200.0)
PAIR = (20.0, 40.0)
NOISES = ("white", "first_order", "mixed")
ELSEWHERE = 9990
"""First seed of the power curves: other recordings than those of the confusion matrix."""
APART = 8.0
"""What is left of an effect beside another has to be as large to be told from it for certain."""
SECTIONS = ("confusion", "none", "power", "two", "outside")


@dataclass(frozen=True)
class Counts:
    """Recordings of each kind of question."""

    named_26: int
    named_14: int
    none: int
    power: int
    two: int
    outside: int

    @classmethod
    def of(cls, seeds: int) -> Counts:
        """``seeds`` recordings of 26 poses with one large effect, the others in proportion."""
        many = max(2 * seeds // 3, 20)
        return cls(seeds, max(seeds // 3, 15), seeds, max(seeds // 4, 15), many, many)


def cases(counts: Counts, section: str) -> list[Case]:
    if section == "confusion":
        return [
            Case(*_turn(physics.KINDS, i), LARGE, poses, _noise(physics.KINDS, i), held_out=True)
            for poses, n in ((26, counts.named_26), (14, counts.named_14))
            for i in range(n)
        ]
    if section == "none":
        return [
            Case("none", i, (1.0, 1.0), 14 if i % 4 == 3 else 26, noise)
            for noise in ("white", "first_order")
            for i in range(counts.none)
        ]
    if section == "power":
        return [
            Case(*_turn(physics.KINDS, i), (s, s), 26, _noise(physics.KINDS, i))
            for s in SIZES
            for i in range(ELSEWHERE, ELSEWHERE + counts.power * (TIMES if s == ASKED else 1))
        ]
    if section == "two":
        return [Case("two", i, PAIR, 26, NOISES[i % 3]) for i in range(counts.two)]
    kinds = uncatalogued.KINDS
    return [
        Case(*_turn(kinds, i), LARGE, poses, _noise(kinds, i))
        for poses, n in ((26, counts.outside), (14, counts.outside // 2))
        for i in range(n)
    ]


def _turn(kinds: Sequence[str], i: int) -> tuple[str, int]:
    return kinds[i % len(kinds)], i


def _noise(kinds: Sequence[str], i: int) -> str:
    """Every kind of effect meets every kind of noise."""
    return NOISES[(i + i // len(kinds)) % len(NOISES)]


def percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f}" if whole else "-"


@dataclass
class Report:
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)

    def tables(self) -> Iterable[Table]:
        makers: dict[str, Callable[[Sequence[Outcome]], Iterable[Table]]] = {
            "confusion": _confusion,
            "none": _nothing,
            "power": _power,
            "two": _two,
            "outside": _outside,
        }
        for section, found in self.outcomes.items():
            yield from makers[section](found)


def _confusion(all_found: Sequence[Outcome]) -> Iterable[Table]:
    for poses in (26, 14):
        found = [o for o in all_found if o.case.poses == poses]
        if not found:
            continue
        head = ["truth", "n", "adopted", "confounded, truth in it", "truth a candidate", "wrong unique name"]
        head += ["other names listed or likely", "unexplained only", "nothing", "any wrong unique"]
        head += ["named, yet unexplained", "other names first"]
        groups = [(k, [o for o in found if o.case.kind == k]) for k in physics.KINDS]
        rows = []
        for kind, group in [*((k, g) for k, g in groups if g), ("all, %", found)]:
            verdicts = Counter(o.verdict for o in group)
            wrong = sum(o.wrong for o in group)
            open_ = sum(bool(o.found) and o.unexplained for o in group)
            total = kind == "all, %"
            names = Counter(o.found[0][0] for o in group if o.found and o.found[0][0] not in o.names)
            first = "" if total else ", ".join(f"{n} {c}" for n, c in names.most_common(4))
            told = ("adopted", "confounded", "candidate", "wrong", "astray", "unexplained", "nothing")
            share = [verdicts[v] for v in told]
            counts = [percent(c, len(group)) if total else str(c) for c in [*share, wrong, open_]]
            rows.append([kind, str(len(group)), *counts, first])
        yield Table(f"What is named first, one effect of s = 20 to 200, {poses} poses", head, rows)
        yield _held_out(found, poses)
        lost = sum(o.poses_found != o.poses_made for o in found)
        moving, failed = sum(o.moving > 0 for o in found), sum(o.error != "" for o in found)
        print(f"\nOf {len(found)} recordings {lost} show more or fewer poses than were made (a step parts one),")
        print(f"{moving} have a move inside a pose, {failed} ended in an error.")


def _held_out(found: Sequence[Outcome], poses: int) -> Table:
    head = [
        "truth",
        "n",
        "median",
        "share ≤ 1.1, %",
        "pooled rms",
        "told: median",
        "told: share ≤ 1.1, %",
        "told: pooled",
    ]
    rows = []
    groups = [(k, [o for o in found if o.case.kind == k]) for k in physics.KINDS]
    unique, either, likely = ([o for o in found if o.verdict == v] for v in ("adopted", "confounded", "candidate"))
    sums = [("all", list(found)), ("all named uniquely", unique), ("all confounded with the truth in it", either)]
    sums.append(("all with the truth a candidate", likely))
    for kind, group in [*groups, *sums]:
        ratios = np.array([(o.after_ratio, o.told_ratio) for o in group if np.isfinite(o.after_ratio)])
        if not len(ratios):
            continue
        cells = [kind, str(len(ratios))]
        for r in ratios.T:
            cells += [f"{np.median(r):.2f}", f"{100 * np.mean(r <= 1.1):.0f}", f"{np.sqrt(np.mean(r**2)):.2f}"]
        rows.append(cells)
    title = f"Held-out error after, over what noise alone gives, {poses} poses (told: by a fit that knows the effect)"
    return Table(title, head, rows)


def _nothing(found: Sequence[Outcome]) -> Iterable[Table]:
    rows = []
    for noise in ("white", "first_order"):
        for poses in (26, 14):
            group = [o for o in found if o.case.noise == noise and o.case.poses == poses]
            findings, likely = sum(bool(o.found) for o in group), sum(bool(o.candidates) for o in group)
            left, seen = sum(o.unexplained for o in group), sum(o.detected for o in group)
            cells = [f"{c} ({percent(c, len(group))} %)" for c in (findings, likely, left, seen)]
            rows.append([noise, str(poses), str(len(group)), *cells])
    head = ["noise", "poses", "n", "findings", "candidates", "unexplained", "something likelier than nothing"]
    yield Table("Nothing inside", head, rows)


def _power(found: Sequence[Outcome]) -> Iterable[Table]:
    head = ["s", "n", "told, %", "detected, %", "of told", "truth named, listed or likely, %", "wrong unique, %"]
    rows = []
    for s in SIZES:
        group = [o for o in found if o.case.size[0] == s]
        n = len(group)
        told = 100 * float(np.mean([o.told_power for o in group])) if group else np.nan
        detected = 100 * sum(o.detected for o in group) / max(n, 1)
        row = [f"{s:g}", str(n), f"{told:.1f}", f"{detected:.1f}", f"{detected / told:.2f}"]
        rows.append([*row, percent(sum(o.stated for o in group), n), percent(sum(o.wrong for o in group), n)])
    yield Table("Power, 26 poses; told: the test that was told the effect, at 1 % false alarms", head, rows)
    five = [o for o in found if o.case.size[0] == ASKED]
    rows = []
    for kind in physics.KINDS:
        group = [o for o in five if o.case.kind == kind]
        told = 100 * float(np.mean([o.told_power for o in group])) if group else np.nan
        cells = [percent(sum(o.detected for o in group), len(group)), percent(sum(o.stated for o in group), len(group))]
        rows.append([kind, str(len(group)), f"{told:.0f}", *cells])
    yield Table("By effect, s = 5", ["truth", "n", "told, %", "detected, %", "truth named, listed or likely, %"], rows)


def _two(found: Sequence[Outcome]) -> Iterable[Table]:
    apart = [o for o in found if min(o.beside, default=0.0) >= APART]
    rows = []
    for name, group in (("all", found), (f"each of s ≥ {APART:g} beside the other", apart)):
        both = [sum(n in o.stated_names for n in o.names) for o in group]
        cells = [percent(sum(b == k for b in both), len(group)) for k in (2, 1, 0)]
        rows.append([name, str(len(group)), *cells, percent(sum(o.wrong for o in group), len(group))])
    head = ["pairs", "n", "both, %", "one, %", "neither, %", "wrong unique, %"]
    yield Table("Two at once, s = 20 to 40 each, 26 poses: named, listed or likely", head, rows)


def _outside(all_found: Sequence[Outcome]) -> Iterable[Table]:
    for poses in (26, 14):
        found = [o for o in all_found if o.case.poses == poses]
        if found:
            yield _of_no_catalogue(found, poses)


def _of_no_catalogue(found: Sequence[Outcome], poses: int) -> Table:
    rows = []
    apart = [o for o in found if o.imitation[1] >= APART]
    sums = [("all", list(found)), (f"all of which no name leaves less than s = {APART:g}", apart)]
    for kind, group in [*((k, [o for o in found if o.case.kind == k]) for k in uncatalogued.KINDS), *sums]:
        if not group:
            continue
        left, wrong = sum(o.unexplained for o in group), sum(o.wrong for o in group)
        only = sum(o.unexplained and not o.stated_names for o in group)
        names = Counter(n for o in group for n, verdict, _ in o.found if verdict == "adopted")
        cells = [percent(c, len(group)) for c in (left, only, wrong)]
        rows.append([kind, str(len(group)), *cells, ", ".join(f"{n} {c}" for n, c in names.most_common(3))])
    head = ["truth", "n", "unexplained, %", "unexplained and nothing named, %", "wrong unique, %", "names"]
    return Table(f"In no catalogue, s = 20 to 200, {poses} poses", head, rows)


def misses(section: str, outcomes: Sequence[Outcome]) -> list[str]:
    def failed(o: Outcome) -> bool:
        if o.error:
            return True
        if section == "confusion":
            return o.wrong or not o.stated or o.after_ratio > max(1.1, 1.1 * o.told_ratio)
        if section == "none":
            return o.detected
        if section == "power":
            return o.case.size[0] in (5.0, 20.0) and (o.wrong or not o.detected)
        if section == "two":
            return o.wrong or not set(o.names) <= o.stated_names
        return o.wrong or not o.unexplained

    return [o.line for o in outcomes if failed(o)]


def _size(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    return float(low), float(high or low)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the recordings")
    parser.add_argument("--seeds", type=int, help="recordings of 26 poses with one large effect (default 330)")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--list-misses", action="store_true", help="a line for each recording that failed")
    parser.add_argument("--one", nargs=2, metavar=("KIND", "SEED"), help="one recording in full")
    parser.add_argument("--poses", type=int, choices=(14, 26), default=26, help="with --one")
    parser.add_argument("--size", type=_size, default=LARGE, help="with --one: s, or its limits as 20:200")
    parser.add_argument("--noise", choices=NOISES, default="white", help="with --one")
    options = parser.parse_args(arguments)
    if options.one:
        print(
            describe(
                Case(options.one[0], int(options.one[1]), options.size, options.poses, options.noise, held_out=True)
            )
        )
        return 0
    counts = Counts.of(options.seeds or (45 if options.quick else 330))
    report = Report()
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        for section in options.only:
            report.outcomes[section] = list(pool.map(examine, cases(counts, section), chunksize=4))
    for table in report.tables():
        print(table)
    if options.list_misses:
        for section, outcomes in report.outcomes.items():
            print(f"\nMissed, {section}:")
            print("\n".join(misses(section, outcomes)) or "none")
    return 0


if __name__ == "__main__":
    sys.exit(main())
