"""Several recordings for one command: whether they go together, and what came of each at the console."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from triaxcal.agreement import Agreement
from triaxcal.errors import Refused
from triaxcal.loop import Loop
from triaxcal.runs import residuals_by_run, together
from triaxcald.cli.console import micro, table
from triaxcald.cli.showing import Choice, chosen
from triaxcald.errors import InputError
from triaxcald.inputs import Measured, measure


def measured_each(a: argparse.Namespace) -> list[Measured]:
    """The recordings that the arguments name. Raises InputError where one is named twice, Refused for one without a
    pose among several."""
    names: list[str] = a.recording
    twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
    if twice is not None:
        raise InputError(f"{twice}: given twice; a recording counts once")
    out = [measure(name) for name in names]
    empty = next((m for m in out if not m.poses), None)
    if empty is not None and len(out) > 1:
        raise Refused(f"{empty.name}: no still pose")
    return out


def as_one_unit(recordings: Sequence[Measured], a: argparse.Namespace) -> Measured:
    """All poses together, the rest as in the first. Raises InputError where they are not alike."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for other in recordings[1:]:
        _require_alike(first, other, a)
    return replace(
        first,
        name=f"{first.name} and {len(recordings) - 1} more",
        poses=together([m.poses for m in recordings]),
        windows=None,
        data_quality=[f"{m.name}: {line}" for m in recordings for line in m.data_quality],
        unit=next((m.unit for m in recordings if m.unit), None),
    )


def _require_alike(first: Measured, other: Measured, a: argparse.Namespace) -> None:
    ours, theirs = ({"unit": _serial(m), **_settings(chosen(a, m))} for m in (first, other))
    for what, said in theirs.items():
        if said != ours[what] and not (what == "unit" and None in (said, ours[what])):
            hint = "; --units judges units side by side" if what == "unit" else ""
            raise InputError(f"{other.name}: {what}: {said}; {first.name} has {ours[what]}{hint}")


def _serial(m: Measured) -> str | None:
    return m.unit.get("serial") if m.unit else None


def _settings(choice: Choice) -> dict[str, str | None]:
    return {
        "signs of the scale factors": ",".join("+" if s > 0 else "-" for s in choice.signs),
        "reference": f"{choice.reference:g} {choice.reference_unit}",
        "output unit": choice.output_unit,
    }


def show_by_recording(loop: Loop, names: Sequence[str], choice: Choice) -> None:
    table(
        f"by recording, {choice.micro_unit} rms",
        ["", "poses", "before", "after", "noise floor"],
        [
            [name, r.poses, micro(r.before_rms_g), micro(r.after_rms_g), micro(r.noise_floor_g)]
            for name, r in zip(names, residuals_by_run(loop.before, loop.after), strict=True)
        ],
    )


def show_agreement(found: Agreement, names: Sequence[str], loops: Sequence[Loop], choices: Sequence[Choice]) -> None:
    table(
        f"each unit by itself, {choices[0].micro_unit}",
        ["", "finding", "verdict", "would do as well", "cross-validated before", "after", "noise floor"],
        [
            [
                name,
                ", ".join(f.effect for f in loop.findings) or "none",
                ", ".join(f.verdict for f in loop.findings),
                ", ".join(dict.fromkeys(other for f in loop.findings for other in f.alternatives)),
                micro(loop.before.residual.cross_validated_rms_g),
                micro(loop.after.residual.cross_validated_rms_g),
                micro(loop.after.residual.noise_floor_g),
            ]
            for name, loop in zip(names, loops, strict=True)
        ],
    )
    table(
        "all units together",
        ["", "worse than the best", "gain", "shown by", "named by", "listed by", "not found by"],
        [
            [
                c.effect,
                f"{c.worse:.1f}",
                f"{c.gain:.1f}",
                len(c.shown),
                len(c.named),
                len(c.listed),
                len(names) - len({*c.named, *c.listed}),
            ]
            for c in found.effects
        ],
    )
    print(f"the units {found.verdict}" if not found.verdict.startswith("no ") else found.verdict)
    for c in found.effects:
        for name, s in c.shapes.items():
            known = "" if s.standard_error is None else f" ± {s.standard_error:.2g}"
            alike = "" if s.p_value is None else f"; the units' own values agree with p {s.p_value:.2g}"
            print(f"{c.effect}: {name} {s.value:.4g}{known} {s.unit}{alike}")
