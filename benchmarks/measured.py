"""Writes the table of docs/measured.md: what `fit` and `diagnose` say of the measured recordings.

    python benchmarks/measured.py            # prints the table
    python benchmarks/measured.py --write    # puts it into docs/measured.md

The recordings are expected in ../shared/datasets, beside the project; --datasets names another folder.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from triaxcal.errors import Refused
from triaxcal.loop import Loop, diagnose
from triaxcald.inputs import Measured, measure

PROJECT = Path(__file__).parents[1]
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
HEAD = (
    "| recording | poses | noise floor | residual | cross-validated | findings "
    "| residual after | cross-validated after | left over | warnings |"
)
RULE = "|---|--:|--:|--:|--:|---|--:|--:|--:|---|"


def row(name: str, measured: Measured) -> str:
    """One line of the table; numbers in µg."""
    try:
        loop = diagnose(measured.poses)
    except Refused as e:
        return f"| {name} | {len(measured.poses)} | — | — | — | refused: {e} | — | — | — | — |"
    before, after = loop.before.residual, loop.after.residual
    numbers = [before.noise_floor_g, before.rms_g, before.cross_validated_rms_g]
    numbers_after = [after.rms_g, after.cross_validated_rms_g]
    left = loop.unexplained.rms_g if loop.unexplained.significant else None
    cells = [name, str(len(measured.poses)), *map(micro, numbers), findings(loop)]
    cells += [*map(micro, numbers_after), micro(left), warnings(loop, measured)]
    return f"| {' | '.join(cells)} |"


def micro(value: float | None) -> str:
    return "—" if value is None else f"{value * 1e6:.0f}"


def findings(loop: Loop) -> str:
    """An effect in question has the others that would do as well behind it."""
    named = [
        f.effect if f.verdict == "adopted" else f"{f.effect} (or {', '.join(f.alternatives)})" for f in loop.findings
    ]
    return "; ".join(named) or "none"


def warnings(loop: Loop, measured: Measured) -> str:
    """In few words: by how much residuals exceed the noise in the end, and what the raw stream is blamed for."""
    found = [f"noise ×{loop.after.inflation:.1f}"] if loop.after.inflation > 1 else []
    found += [line.split(",")[0].replace("_", " ") for line in measured.data_quality]
    found += [w.split(":")[0] for w in loop.after.warnings if "poorly spread" in w or "alone carries" in w]
    aside = sum(not p.used for p in loop.after.poses)
    found += [f"{aside} poses set aside" if aside > 1 else "1 pose set aside"] if aside else []
    found += ["spoiled poses that cannot be told apart" for w in loop.after.warnings if w.startswith("some poses")]
    return "; ".join(found) or "none"


def main() -> int:
    parser = argparse.ArgumentParser(description="The table of docs/measured.md.")
    parser.add_argument("--datasets", type=Path, default=PROJECT.parent / "shared" / "datasets")
    parser.add_argument("--write", action="store_true", help="into docs/measured.md")
    chosen = parser.parse_args()
    files = sorted(chosen.datasets.rglob("*.csv.gz"))
    if not files:
        sys.stderr.write(f"{chosen.datasets}: no recordings (*.csv.gz) there\n")
        return 2
    rows = [row(str(f.relative_to(chosen.datasets)).removesuffix(".csv.gz"), measure(str(f))) for f in files]
    table = "\n".join([HEAD, RULE, *rows])
    print(table)
    if chosen.write:
        page = PROJECT / "docs" / "measured.md"
        text = page.read_text("utf-8")
        if BEGIN not in text or END not in text:
            sys.stderr.write(f"{page}: the marks {BEGIN} and {END} are missing\n")
            return 2
        whole = f"{BEGIN}\n{table}\n{END}"
        page.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: whole, text, flags=re.DOTALL), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
