"""Tables as Markdown, and the one option that every benchmark has."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __str__(self) -> str:
        widths = [max(len(row[i]) for row in [self.head, *self.rows]) for i in range(len(self.head))]
        lines = [self.head, ["-" * w for w in widths], *self.rows]
        body = "\n".join(
            "| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in lines
        )
        return f"\n### {self.title}\n\n{body}"


def chosen(about: str | None, arguments: Sequence[str] | None) -> bool:
    """Whether ``--quick`` was asked for."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--quick", action="store_true", help="fewer runs: the same tables within half a minute")
    return bool(parser.parse_args(arguments).quick)


def run(
    about: str | None, arguments: Sequence[str] | None, table: Callable[[int], Table], *, quick: int, full: int
) -> int:
    """Prints a benchmark's one table, which takes the number of its seeds."""
    print(table(quick if chosen(about, arguments) else full))
    return 0
