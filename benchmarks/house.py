"""How large the metrology is, by room: files, lines, constants, and who imports whom.

    python -m benchmarks.house [FOLDER]

FOLDER is a package, by default `triaxcal/`; that of an earlier checkout can be set beside it. A room is a folder of the
package, or a module that lies beside them. A floor is one above the highest room that it imports; rooms that import
each other in a circle have none.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import Table

PACKAGE = Path(__file__).parents[1] / "triaxcal"


def rooms(package: Path) -> dict[str, list[Path]]:
    """The files of each; the package's own ``__init__`` imports by name alone and is none."""
    found: dict[str, list[Path]] = {}
    for file in sorted(package.rglob("*.py")):
        if file != package / "__init__.py":
            found.setdefault(file.relative_to(package).parts[0].removesuffix(".py"), []).append(file)
    return found


def imported(package: Path, tree: ast.Module) -> Iterator[str]:
    """The rooms that a file imports from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == package.name:
            modules = [f"{node.module}.{n.name}" for n in node.names]
        elif isinstance(node, ast.Import):
            modules = [n.name for n in node.names if n.name.startswith(f"{package.name}.")]
        else:
            continue
        yield from (module.split(".")[1] for module in modules)


def constants(tree: ast.Module) -> int:
    """Names in capitals that hold numbers."""
    return sum(
        isinstance(node, ast.Assign | ast.AnnAssign)
        and any(isinstance(n, ast.Name) and n.id.isupper() for n in ast.walk(node))
        and any(isinstance(n, ast.Constant) and isinstance(n.value, int | float) for n in ast.walk(node))
        for node in tree.body
    )


def floors(arrows: dict[str, set[str]]) -> dict[str, int]:
    """Of the rooms that are in no circle, nor above one."""
    out: dict[str, int] = {}
    while ready := [room for room, below in arrows.items() if room not in out and below <= out.keys()]:
        out |= {room: 1 + max((out[b] for b in arrows[room]), default=0) for room in ready}
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=PACKAGE, metavar="FOLDER")
    package: Path = parser.parse_args(arguments).folder
    found = rooms(package)
    trees = {room: [ast.parse(file.read_text("utf-8")) for file in files] for room, files in found.items()}
    arrows = {
        room: {b for tree in of_room for b in imported(package, tree) if b in found and b != room}
        for room, of_room in trees.items()
    }
    level = floors(arrows)
    rows, every = [], list[str]()
    for room in sorted(found, key=lambda r: (level.get(r, 0), r)):
        lines = [line for file in found[room] for line in file.read_text("utf-8").splitlines()]
        every += lines
        named = sum(map(constants, trees[room]))
        floor = str(level[room]) if room in level else "circle"
        rows.append([floor, room, str(len(found[room])), str(len(lines)), str(named), ", ".join(sorted(arrows[room]))])
    print(Table("Rooms, from the ground", ["floor", "room", "files", "lines", "constants", "imports"], rows))
    written = np.array([len(line) for line in every if line.strip()])
    print(
        f"{len(found)} rooms on {max(level.values(), default=0)} floors, {sum(map(len, arrows.values()))} arrows; "
        f"{len(every)} lines, nine in ten of which have at most {np.quantile(written, 0.9):.0f} columns"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
