"""plan: a set of poses, what it shows, and what a recording still lacks."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import CATALOGUE
from triaxcal.errors import InvalidData, Refused
from triaxcal.fit import fit
from triaxcal.plan import FULL, PAPER, dilution, directions, most_wanted
from triaxcal.visibility import unseen_effects
from triaxcald import documents
from triaxcald.cli.arguments import add_recording, count
from triaxcald.cli.console import emit, table
from triaxcald.cli.showing import chosen
from triaxcald.documents import number
from triaxcald.errors import InputError
from triaxcald.inputs import measure

POSES_MOST = 1000
ENOUGH = 1.1
"""A set is good whose worst parameter is no more uncertain than this many poses' standard errors; the 14 have 1.06."""


def register(commands: Any) -> None:
    p = commands.add_parser("plan", help="a pose plan, and what it can and cannot see")
    p.add_argument("--poses", type=count, metavar="14|26|N", help=f"default {FULL}")
    p.add_argument("--for", dest="effects", nargs="+", metavar="EFFECT", default=[], help="effects it has to show")
    add_recording(p, optional=True)
    p.set_defaults(run=plan_command)


def plan_command(a: argparse.Namespace) -> int:
    known = [e.name for e in CATALOGUE]
    if a.effects and a.recording is None and a.effects[-1] not in known and _looks_like_recording(a.effects[-1]):
        a.recording = a.effects.pop()  # --for takes all that follows, the recording too
    for name in a.effects:
        if name not in known:
            raise InputError(f"--for {name}: no effect of that name; known: {', '.join(known)}")
    if a.poses and a.poses > POSES_MOST:
        raise InputError(f"--poses {a.poses}: at most {POSES_MOST}")
    if a.recording:
        return _plan_for_recording(a)
    try:
        plan = directions(a.poses or _enough_for(a.effects))
    except InvalidData as e:
        raise InputError(f"--poses: {e}") from e
    ups = np.array([v for _, v in plan])
    blind = unseen_effects(ups)
    document = {
        "format": "triaxcal.plan/1",
        "poses": [{"label": label, "up": documents.numbers(v)} for label, v in plan],
        "dilution": number(dilution(ups)),
        "blind_to": blind,
    }
    if a.json:
        emit(document)
    else:
        _show_poses(f"{len(plan)} poses", plan)
        print(f"worst parameter: {document['dilution']:.2f} standard errors of one pose")
        print(f"cannot show: {', '.join(blind) or 'nothing of the catalogue'}")
    missed = [e for e in a.effects if e in blind]
    if missed:
        raise Refused(f"a plan of {len(plan)} poses cannot show {', '.join(missed)}; take {FULL}")
    return 0


def _enough_for(effects: list[str]) -> int:
    if not effects:
        return FULL
    return next((n for n in (PAPER, FULL) if not set(effects) & set(unseen_effects(_ups(n)))), FULL)


def _ups(n: int) -> Floats:
    return np.array([v for _, v in directions(n)])


def _looks_like_recording(word: str) -> bool:
    return word == "-" or word.endswith((".mcap", ".csv", ".csv.gz"))


def _plan_for_recording(a: argparse.Namespace) -> int:
    measured = measure(a.recording)
    choice = chosen(a, measured)
    blind: list[str] | None = None
    dilution_now: float | None = None
    try:
        have = np.array([p.direction for p in fit(measured.poses, signs=choice.signs).poses])
        dilution_now, blind = dilution(have), unseen_effects(have)
        wanted = most_wanted(have, enough=ENOUGH)
    except Refused as e:
        by_label = dict(directions(FULL))
        wanted = [(label, by_label[label]) for label in e.wanted]
    missed = [e for e in a.effects if blind is None or e in blind]
    if missed:
        have_labels = {label for label, _ in wanted}
        wanted += [(label, v) for label, v in directions(FULL)[PAPER:] if label not in have_labels]
    document = {
        "format": "triaxcal.plan/1",
        "have": len(measured.poses),
        "dilution": number(dilution_now),
        "blind_to": blind,
        "poses": [{"label": label, "up": documents.numbers(v)} for label, v in wanted],
    }
    if a.json:
        emit(document)
        return 0
    if wanted:
        _show_poses(f"poses worth adding to the {len(measured.poses)} of {measured.name}", wanted)
    else:
        print(f"the {len(measured.poses)} poses of {measured.name} are well spread; none is wanted")
    if blind is not None:
        print(f"the {len(measured.poses)} there are cannot show: {', '.join(blind) or 'nothing of the catalogue'}")
    return 0


def _show_poses(title: str, plan: list[tuple[str, Floats]]) -> None:
    rows = [[i + 1, label, *(f"{c:+.3f}" for c in v)] for i, (label, v) in enumerate(plan)]
    table(title, ["pose", "up", "x", "y", "z"], rows)
