"""fleet."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import triaxcal as tc
from triaxcald.cli.console import at, emit, erased, say, show, table
from triaxcald.cli.results import period_us, require_kind, write_table
from triaxcald.cli.syntax import writable
from triaxcald.documents import to_text
from triaxcald.errors import InputError
from triaxcald.files import write_text
from triaxcald.fleet.reading import WORK

TOLD_EVERY = 200
"""Certificates between two reports of progress."""
NAMED_MOST = 3
"""Files that are left out, by name; the others are counted."""
SHOWN_MOST = 40
"""Figures of a part number on the console."""


def fleet_command(a: argparse.Namespace) -> int:
    from triaxcald.fleet import COLUMNS, Asked, Selection, fleet_document, fleets_of, read_runs, table_rows
    from triaxcald.fleet.places import learned, placed
    from triaxcald.schema.fleet import FleetDocument

    require_kind(a.table)
    writable(a.report)
    writable(a.output)
    since_us, until_us = period_us(a.since, a.until)
    equal = {name: getattr(a, name) for name in WORK if getattr(a, name) is not None}
    told = {f"--{name.replace('_', '-')}": text for name, text in equal.items()}
    told = {option: text for option, text in (("--since", a.since), ("--until", a.until)) if text is not None} | told
    runs = read_runs(a.source, Selection(since_us, until_us, equal), _reading)
    fleets = fleets_of(runs)
    if not fleets and a.output is not None:
        _say_skipped(a.source, runs.skipped)
        raise _nothing_measured(a.source, told)
    at("statistics")
    asked = Asked(a.limit, a.probability, told)
    made = fleet_document(
        fleets, _shown(a.source), runs.skipped, asked, lambda fleet: placed(fleet, runs.folder, _reading)
    )
    odds = None if a.output is None else learned(fleets, _shown(a.source), runs.folder, _reading)
    document = FleetDocument.model_validate(made).document()
    if a.report is not None:
        from triaxcald.fleet import render_fleet

        write_text(a.report, render_fleet(document, fleets, lambda done, of: at("pictures", done / of)))
    if odds is not None:
        write_text(a.output, to_text(odds))
    if a.table is not None:
        write_table(a.table, COLUMNS, table_rows(fleets))
    erased()
    if a.json:
        emit(document)
    else:
        _show(document)
    _say_skipped(a.source, runs.skipped)
    if not fleets:
        raise _nothing_measured(a.source, told)
    return 0


def _say_skipped(source: str, skipped: Sequence[str]) -> None:
    if skipped:
        more = f" and {len(skipped) - NAMED_MOST} more" if len(skipped) > NAMED_MOST else ""
        say(f"{_shown(source)}: left out, not readable: {', '.join(skipped[:NAMED_MOST])}{more}")


def _nothing_measured(source: str, chosen: Mapping[str, str]) -> InputError:
    of = f" of {', '.join(f'{option} {text}' for option, text in chosen.items())}" if chosen else ""
    return InputError(f"{_shown(source)}: no run{of} has measured anything")


def _shown(source: str) -> str:
    """A database without its password."""
    if "://" not in source or source.startswith("sqlite:"):
        return source
    from triaxcald.service.database import shown_address

    return shown_address(source)


def _reading(done: int, of: int) -> None:
    if done % TOLD_EVERY == 0:
        at("certificates", done / of)


def _show(document: dict[str, Any]) -> None:
    from triaxcald.fleet.page import differing, mean_of, notices, percent, roughly, title_of, worst_study

    for product in document["products"]:
        part, failed = product["part_number"], product["left_out"]
        without = f", without {tc.number_format.number_of(failed, 'run')} that failed or were stopped" if failed else ""
        show(
            f"{f'part number {part}: ' if part else ''}{tc.number_format.number_of(product['units'], 'unit')} in "
            f"{tc.number_format.number_of(product['runs'], 'run')}, {product['repeated']} measured more than once"
            f"{without}"
        )
        figures: Sequence[dict[str, Any]] = product["figures"][:SHOWN_MOST]
        rows = [
            [
                title_of(f["name"]), str(f["n"]), mean_of(f), roughly(f["distribution"]["sd"], f["unit"]),
                "—" if f["charts"] is None else str(f["charts"]["cusum"]["count"]),
                percent((worst_study(f) or {}).get("grr")), differing(f),
            ]
            for f in figures
        ]  # fmt: skip
        head = ["figure", "units", "mean", "sd", "CUSUM", "%GRR", "differs by"]
        table("one value a unit; signals of the CUSUM; %GRR by the factor that matters most", head, rows)
        for text in notices(product):
            show(f"* {text}")
        if (interval := product["recalibration"]) is not None:
            from triaxcald.fleet.page import lasting

            show(
                f"* |a| is off by more than {roughly(interval['limit_g'], 'g')} with probability "
                f"{percent(interval['probability'])} after {lasting(interval['days'])}."
            )
