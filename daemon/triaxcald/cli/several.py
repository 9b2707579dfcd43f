"""Several recordings for one command: whether they go together, and what came
of each at the console."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from triaxcal.diagnosis import Loop
from triaxcal.errors import Refused
from triaxcal.estimate.recordings import gather, residuals_by_run, shape_by_poses, shape_of
from triaxcal.number_format import plain
from triaxcal.pooled_units import Answer, PooledAnalysis
from triaxcal.text import diagnosis
from triaxcal.text.pooled_units import other_unit, verdict
from triaxcald.cli.console import show, table
from triaxcald.cli.results import WORTH_A_LINE, chance_of
from triaxcald.cli.showing import Choice, chosen, read_recording, warn
from triaxcald.errors import InputError
from triaxcald.inputs import Measured
from triaxcald.verification import unlike

COLUMNS = {
    "in all": "probability that the effect acts in every unit",
    "one value": "probability that its coefficients are the same in all, if it does",
    "in each unit by itself": "probability that it acts there, by that unit alone, in the order of the recordings",
}
"""What stands in the table of all units."""


def measured_each(a: argparse.Namespace) -> list[Measured]:
    """The recordings that the arguments name. Raises InputError where one is
    named twice, Refused for one without a pose among several."""
    names: list[str] = a.recording
    places = [_place(name) for name in names]
    twice = next((n for i, n in enumerate(names) if places[i] in places[:i]), None)
    if twice is not None:
        raise InputError(f"{twice}: given twice; a recording counts once")
    if a.check and _place(a.check) in places:
        raise InputError(f"--check {a.check}: is what is diagnosed; held-out poses are of another recording")
    out = [read_recording(a, name) for name in names]
    empty = next((m for m in out if not m.poses), None)
    if empty is not None and len(out) > 1:
        warn(named_quality(empty))
        raise Refused(f"{empty.name}: no still pose")
    return out


def measured_check(measured: Measured, a: argparse.Namespace) -> Measured | None:
    """The recording of the held-out poses, where the arguments name one. Raises
    InputError where it is not alike."""
    if not a.check:
        return None
    check = read_recording(a, a.check)
    _require_alike(measured, check, a)
    return check


def _place(name: str) -> Path | None:
    """Where a recording lies, however its path is written; None for standard
    input."""
    return None if name == "-" else Path(name).resolve()


def as_one_unit(recordings: Sequence[Measured], a: argparse.Namespace) -> Measured:
    """All poses together, the rest as in the first. Raises InputError where
    they are not alike."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for one, other in combinations(recordings, 2):  # the first may not say of which unit it is
        _require_alike(one, other, a, hint="; --units judges units side by side")
    return replace(
        first,
        name=f"{first.name} and {len(recordings) - 1} more",
        poses=gather([m.poses for m in recordings]),
        windows=None,
        unconfirmed=first.unconfirmed if all(m.unconfirmed for m in recordings) else "",
        data_quality=[line for m in recordings for line in named_quality(m)],
        unit=next((m.unit for m in recordings if m.unit), None),
    )


def named_quality(m: Measured) -> list[str]:
    """Its data quality, where that stands beside another recording's."""
    return [f"{m.name}: {line}" for line in m.data_quality]


def _require_alike(first: Measured, other: Measured, a: argparse.Namespace, *, hint: str = "") -> None:
    """``hint`` is for recordings of two units."""
    ours, theirs = ({"unit": _serial(m), **_settings(chosen(a, m))} for m in (first, other))
    for what, said in theirs.items():
        if said != ours[what] and not (what == "unit" and None in (said, ours[what])):
            more = hint if what == "unit" else f"; {_SAID_BY[what]} says it for all"
            raise InputError(f"{other.name}: {what}: {said}; {first.name} has {ours[what]}{more}")


def channels_of_some(recordings: Sequence[Measured]) -> list[str]:
    """A line for each channel that not all of several recordings have: no
    effect of it can be put to all poses."""
    logged = {m.name: set.intersection(*(set(p.channels) for p in m.poses)) for m in recordings if m.poses}
    out = []
    for channel in sorted(set().union(*logged.values())):
        lacking = [name for name, channels in logged.items() if channel not in channels]
        if lacking:
            having = ", ".join(name for name in logged if name not in lacking)
            out.append(f"channel {channel}: in {having}, but not in {', '.join(lacking)}; no effect of it was tried")
    return out


def doubts_of_one_unit(recordings: Sequence[Measured], loop: Loop, choice: Choice) -> list[str]:
    """Lines where several recordings can hardly be of one unit; ``loop`` is
    that of all of them."""
    if len(recordings) == 1:
        return []
    names = " and ".join(m.name for m in recordings)
    if said := unlike(names, loop.before.residual.rms_g, choice.reference, "do not look like one unit"):
        return said
    shapes = [(m.name, shape_by_poses(m.poses, choice.signs, choice.reference)) for m in recordings]
    known = [(name, shape) for name, shape in shapes if shape is not None]
    return [line for name, shape in known[1:] for line in other_unit(known[0][0], name, known[0][1], shape)]


def doubts_of_check(measured: Measured, check: Measured, loop: Loop, choice: Choice) -> list[str]:
    """A line where the held-out poses can hardly be of the unit of those
    diagnosed in ``loop``."""
    assert loop.held_out is not None
    if said := unlike(check.name, loop.held_out.before_rms_g, choice.reference):
        return said
    own = shape_by_poses(check.poses, choice.signs, choice.reference)
    return other_unit(measured.name, check.name, shape_of(loop.before), own)


def _serial(m: Measured) -> str | None:
    return m.unit.get("serial") if m.unit else None


_SAID_BY = {
    "signs of the scale factors": "--sign",
    "reference": "--reference, --reference-unit",
    "output unit": "--output-unit",
}
"""The options by which a setting is the same for all recordings."""


def _settings(choice: Choice) -> dict[str, str | None]:
    return {
        "signs of the scale factors": ",".join("+" if s > 0 else "-" for s in choice.signs),
        "reference": f"{choice.reference:g} {choice.reference_unit}",
        "output unit": choice.output_unit or "not stated",
    }


def show_by_recording(loop: Loop, names: Sequence[str], choice: Choice) -> None:
    small = choice.small
    table(
        f"by recording, {small} rms",
        ["", "poses", "before", "after", "noise floor"],
        [
            [name, r.poses, *(small.written(v) for v in (r.before_rms_g, r.after_rms_g, r.noise_floor_g))]
            for name, r in zip(names, residuals_by_run(loop.before, loop.after), strict=True)
        ],
    )


def show_agreement(
    found: PooledAnalysis, names: Sequence[str], loops: Sequence[Loop], choices: Sequence[Choice]
) -> None:
    small = choices[0].small
    table(
        f"each unit by itself, {small}",
        ["", "finding", "probability", "or instead", "residual before", "after", "noise floor"],
        [
            [
                name,
                tuple(f.effect for f in loop.findings) or "none",
                tuple(chance_of(f.probability) for f in loop.findings),
                tuple(", ".join(f.alternatives) for f in loop.findings),
                small.written(loop.before.residual.rms_g),
                small.written(loop.after.residual.rms_g),
                small.written(loop.after.residual.noise_floor_g),
            ]
            for name, loop in zip(names, loops, strict=True)
        ],
    )
    table(
        "all units together",
        ["", "in all", "one value", "in each unit by itself"],
        [
            [
                c.effect,
                diagnosis.chance(c.probability),
                diagnosis.chance(c.common),
                " ".join(f"{p:.2f}" for p in c.units),
            ]
            for c in found.effects
            if c.probability >= WORTH_A_LINE or max(c.units) >= WORTH_A_LINE
        ],
    )
    for column, meaning in COLUMNS.items():
        show(f"{column}: {meaning}")
    said = verdict(found)
    show(said if found.answer is Answer.NOTHING else f"the units {said}")
    for c in found.effects:
        if any(c.effect in group for group in found.agreed):
            for name, s in c.shapes.items():
                known = "" if s.shared.standard_error is None else f" ± {plain(s.shared.standard_error, 2)}"
                show(f"{c.effect}: {name} {plain(s.shared.value, 4)}{known} {s.shared.unit}")
