"""Writes the table and the pictures of docs/measured.md: what is found in the measured recordings.

    python -m benchmarks.measured            # prints both tables
    python -m benchmarks.measured --write    # writes them, and the pictures into docs/pictures

The table of all recordings is benchmarks/results/measured.csv; docs/measured.md has a row for each group of sensors.

The recordings are expected in ../shared/datasets, beside the project; --datasets names another folder.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.pages import DOCS, PICTURES, write
from benchmarks.pictures import draw
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import HighLeverage, PoorSpread
from triaxcal.text import caution
from triaxcal.text.advice import chance
from triaxcald.inputs import Measured, measure
from triaxcald.tables.native_csv import read_csv

PROJECT = Path(__file__).parents[1]
HEAD = [
    "recording",
    "poses",
    "noise floor",
    "residual",
    "cross-validated",
    "findings",
    "residual after",
    "cross-validated after",
    "left over",
    "warnings",
]
GROUP_HEAD = "| recording | sensors | poses | noise floor | residual | findings | residual after | left over |"
GROUP_RULE = "|---|--:|--:|--:|--:|---|--:|---|"
RESULTS = PROJECT / "benchmarks" / "results" / "measured.csv"


def row(name: str, measured: Measured) -> list[str]:
    """One line of the table; numbers in µg."""
    try:
        loop = diagnose(measured.poses)
    except Refused as e:
        return [name, str(len(measured.poses)), "—", "—", "—", f"refused: {e}", "—", "—", "—", "—"]
    before, after = loop.before.residual, loop.after.residual
    numbers = [before.noise_floor_g, before.rms_g, before.cross_validated_rms_g]
    numbers_after = [after.rms_g, after.cross_validated_rms_g]
    left = loop.found.unexplained.rms_g if loop.found.unexplained.significant else None
    cells = [name, str(len(measured.poses)), *map(micro, numbers), findings(loop)]
    return [*cells, *map(micro, numbers_after), micro(left), warnings(loop, measured)]


def by_group(rows: Iterable[Sequence[str]]) -> str:
    """A row for each group of sensors: the range of each figure, and in how many sensors each name is found."""
    groups: dict[str, list[Sequence[str]]] = {}
    for cells in rows:
        groups.setdefault(re.sub(r"(_sensor|unit)\d+$", "", cells[0]).rstrip("/"), []).append(cells)
    return "\n".join([GROUP_HEAD, GROUP_RULE, *(_group_row(name, of) for name, of in groups.items())])


def _group_row(name: str, of: Sequence[Sequence[str]]) -> str:
    _, poses, noise, residual, _, named, after, _, left, _ = zip(*of, strict=True)
    if all(cell == "—" for cell in noise):
        return f"| {name} | {len(of)} | {_range(poses)} | — | — | refused | — | — |"
    leading = [cell.split(" ")[0] for cell in named if cell != "none"]
    count = "; ".join(f"{effect} in {leading.count(effect)}" for effect in dict.fromkeys(leading)) or "none"
    over = [cell for cell in left if cell != "—"]
    unnamed = f"{_range(over)} in {len(over)}" if over else "—"
    cells = [name, str(len(of)), _range(poses), _range(noise), _range(residual), count, _range(after), unnamed]
    return f"| {' | '.join(cells)} |"


def _range(cells: Iterable[str]) -> str:
    values = sorted(int(cell) for cell in cells)
    return str(values[0]) if values[0] == values[-1] else f"{values[0]}…{values[-1]}"


def micro(value: float | None) -> str:
    return "—" if value is None else f"{value * 1e6:.0f}"


def findings(loop: Loop) -> str:
    """Names that are certain, alone or as one of several, and likely ones, each with its probability."""
    groups = [{f.effect: f.probability, **f.alternatives} for f in loop.findings]
    groups += [{c.effect: c.probability} for c in loop.candidates]
    return "; ".join(" or ".join(f"{name} {chance(p)}" for name, p in of.items()) for of in groups) or "none"


def warnings(loop: Loop, measured: Measured) -> str:
    """In few words: by how much residuals exceed the noise in the end, and what the raw stream is blamed for."""
    found = [f"noise ×{loop.after.birge_ratio:.1f}"] if loop.after.birge_ratio >= 1.05 else []
    found += [f"{1e6 * loop.after.excess_g:.0f} µg beside the noise"] if loop.after.excess_g else []
    found += [line.split(",")[0].replace("_", " ") for line in measured.data_quality]
    cautions = loop.after.cautions
    found += [caution(c).split(":")[0] for c in cautions if isinstance(c, PoorSpread | HighLeverage)]
    excluded = sum(not p.used for p in loop.after.poses)
    found += [f"{excluded} {'poses' if excluded > 1 else 'pose'} excluded"] if excluded else []
    return "; ".join(found) or "none"


def pictures(folder: Path, files: list[Path], found: dict[Path, Measured]) -> str:
    """Draws each recording, the sensors of one board together; the lines of the page that show them."""
    PICTURES.mkdir(exist_ok=True)
    groups: dict[str, list[Path]] = {}
    for file in files:
        groups.setdefault(re.sub(r"_sensor\d+$", "", name_of(folder, file)), []).append(file)
    lines = []
    for name, members in groups.items():
        first = members[0]
        shown = read_csv(str(first))
        of_many = f", outputs of {name_of(folder, first)}, spans of all {len(members)}" if len(members) > 1 else ""
        each = [(name_of(folder, f).removeprefix(name).lstrip("_") or "poses", found[f].poses) for f in members]
        path = PICTURES / f"{name.replace('/', '-')}.png"
        draw(path, f"{name}{of_many}", shown, each)
        lines.append(f"![{name}{of_many}](pictures/{path.name})")
    return "\n\n".join(lines)


def name_of(folder: Path, file: Path) -> str:
    return str(file.relative_to(folder)).removesuffix(".csv.gz")


def main() -> int:
    parser = argparse.ArgumentParser(description="The table of docs/measured.md.")
    parser.add_argument("--datasets", type=Path, default=PROJECT.parent / "shared" / "datasets")
    parser.add_argument("--write", action="store_true", help="into docs/measured.md and benchmarks/results")
    chosen = parser.parse_args()
    files = sorted(chosen.datasets.rglob("*.csv.gz"))
    if not files:
        sys.stderr.write(f"{chosen.datasets}: no recordings (*.csv.gz) there\n")
        return 2
    found = {f: measure(str(f)) for f in files}
    rows = [row(name_of(chosen.datasets, f), m) for f, m in found.items()]
    groups = by_group(rows)
    csv.writer(sys.stdout).writerows([HEAD, *rows])
    print(f"\n{groups}")
    if chosen.write:
        with RESULTS.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([HEAD, *rows])
        return write(DOCS / "measured.md", {"table": groups, "pictures": pictures(chosen.datasets, files, found)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
