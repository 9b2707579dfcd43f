"""plan: a set of poses, what it shows, and what a recording still lacks."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

import triaxcal as tc
from triaxcald.cli.console import emit, say, show, table
from triaxcald.cli.showing import counted, fit_settings, read_recording, telling_data_quality, warn
from triaxcald.errors import InputError

POSES_MOST, POSES_MOST_FOR = 1000, 200


def plan_command(a: argparse.Namespace) -> int:
    if a.effects and a.recording is None and not _known(a.effects[-1]) and _looks_like_recording(a.effects[-1]):
        a.recording = a.effects.pop()  # --for takes all that follows, the recording too
    for name in a.effects:
        if not _known(name):
            raise InputError(
                f"--for {name}: no effect of that name; known: {', '.join(e.name for e in tc.effects.CATALOGUE)}"
            )
    effects = [tc.planning.in_plan(tc.effects.effect_named(name)) for name in dict.fromkeys(a.effects)]
    for effect in effects:
        if set(effect.needs) & {*tc.effects.BEFORE, *tc.effects.CHANGE, *tc.effects.SCATTER}:
            raise InputError(
                f"--for {effect.name}: expected an effect of direction, time or a channel; this one goes with the pose "
                "before or with shaking, for which any plan does, taken twice in different orders"
            )
        if any(tc.effects.lag_in(n) for n in effect.needs):
            raise InputError(
                f"--for {effect.name}: expected an effect of direction, time or a channel; this one goes with what a "
                "channel was before, for which any plan does, taken while that rises, falls and stands still"
            )
    if a.poses and a.poses > POSES_MOST:
        raise InputError(f"--poses {a.poses}: at most {POSES_MOST}")
    if a.poses and effects and a.poses > POSES_MOST_FOR:
        raise InputError(f"--poses {a.poses}: at most {POSES_MOST_FOR} with --for")
    if a.recording:
        return _plan_for_recording(a, effects)
    try:
        return _plan_for(a, effects) if effects else _plain_plan(a)
    except tc.InvalidData as e:
        raise InputError(f"--poses: {e}") from e


def _known(name: str) -> bool:
    try:
        tc.effects.effect_named(name)
    except KeyError:
        return False
    return True


def _looks_like_recording(word: str) -> bool:
    return word == "-" or word.endswith((".mcap", ".segments.json", ".csv", ".csv.gz"))


# Without a recording


def _plain_plan(a: argparse.Namespace) -> int:
    plan = tc.planning.closed(tc.planning.directions(a.poses or tc.planning.FULL))
    document = _document(plan, _sights(plan, tc.effects.CATALOGUE))
    if a.json:
        emit(document)
    else:
        _show(plan, document)
    return 0


def _plan_for(a: argparse.Namespace, effects: Sequence[tc.effects.Effect]) -> int:
    found = tc.planning.optimal(a.poses or _enough_for(effects), effects)
    plan = list(found.plan)
    others = [e for e in tc.effects.CATALOGUE if e.name not in [targets.name for targets in effects]]
    document = _document(plan, _sights(plan, [*effects, *others], found.levels))
    for i, pose in enumerate(document["poses"]):
        if found.levels:
            pose["levels"] = {name: tc.rounding.number(float(v[i])) for name, v in found.levels.items()}
    document |= {
        "for": [e.name for e in effects],
        "together": _together(found.targets),
        "efficiency": tc.rounding.uncertainty(found.efficiency),
        "promised": _errors(found.errors),
        "moves": _moves(found),
    }
    if a.json:
        emit(document)
    else:
        _show(plan, document)
        show(f"{found.efficiency:.0%} of what any plan of as many poses could tell of {', '.join(document['for'])}")
        _show_errors(
            found.errors, 1.0, "in poses' standard errors" + (", by half the range" if document["moves"] else "")
        )
        for name, text in document["moves"].items():
            show(f"{name}: {text}")
    for line in _never_seen(document):
        say(f"warning: {line}")
    return 0


def _enough_for(effects: Sequence[tc.effects.Effect]) -> int:
    """The smaller of the plain plans that shows the effects; more where they
    have more coefficients than it poses."""
    names = {e.name for e in effects}
    plain = (
        n
        for n in (tc.planning.PAPER, tc.planning.FULL)
        if not names & set(tc.planning.unseen_effects(_ups(tc.planning.closed(tc.planning.directions(n))), effects))
    )
    return max(next(plain, tc.planning.FULL), tc.planning.LEAST + tc.planning.target_effects(effects).rank)


def _ups(plan: Sequence[tc.planning.Direction]) -> tc.Floats:
    return np.array([v for _, v in plan])


def _sights(
    plan: Sequence[tc.planning.Direction],
    effects: Sequence[tc.effects.Effect],
    held: Mapping[str, tc.Floats] | None = None,
) -> dict[str, tc.planning.Observability]:
    return {e.name: tc.planning.observability(_ups(plan), e, held) for e in effects}


def _document(
    plan: Sequence[tc.planning.Direction], observabilities: Mapping[str, tc.planning.Observability]
) -> tc.interchange.Document:
    poses: list[tc.interchange.Document] = [{"label": label, "up": tc.rounding.numbers(v)} for label, v in plan]
    poses[-1]["repeat"] = True
    return {
        "format": "triaxcal.plan/1",
        "poses": poses,
        "directions": len(plan) - 1,
        "dilution": tc.rounding.number(tc.planning.dilution(ups := _ups(plan))),
        "worst_standard_error": tc.rounding.number(tc.planning.worst_error(tc.planning.linear_design(ups, ups))),
        **_seen(observabilities),
    }


def _seen(observabilities: Mapping[str, tc.planning.Observability]) -> tc.interchange.Document:
    return {
        "blind_to": [name for name, s in observabilities.items() if s.visible < s.of],
        "sees": {
            name: {
                "visible": s.visible,
                "of": s.of,
                "hidden": [{"coefficients": {k: tc.rounding.uncertainty(w) for k, w in h.items()}} for h in s.hidden],
            }
            for name, s in observabilities.items()
        },
    }


def _together(targets: tc.planning.TargetEffects) -> tc.interchange.Document:
    return {"visible": targets.rank, "of": len(targets.seen)}


def _errors(errors: Mapping[str, Mapping[str, float | None]], scale: float | None = 1.0) -> tc.interchange.Document:
    return {
        name: {c: None if e is None or scale is None else tc.rounding.uncertainty(e * scale) for c, e in of.items()}
        for name, of in errors.items()
    }


def _moves(found: tc.planning.OptimalPlan) -> dict[str, str]:
    out = {}
    for name, levels in found.levels.items():
        steps, at = [], 1
        for level, group in groupby(levels):
            size = len(list(group))
            steps.append(f"{_level(level)} for poses {at} to {at + size - 1}" if size > 1 else f"{_level(level)} {at}")
            at += size
        out[name] = f"over as wide a range as can be had: {', '.join(steps)}"
    if tc.planning.needs_time(found.targets.effects):
        out[tc.effects.TIME] = "the poses at even intervals and in this order, the first again at the end"
    return out


def _level(level: float) -> str:
    named = {-1.0: "lowest", 0.0: "middle", 1.0: "highest"}
    return named.get(round(level, 6), f"{(1 + level) / 2:.0%} of the range")


def _never_seen(document: tc.interchange.Document) -> list[str]:
    out = []
    for name in document["for"]:
        s = document["sees"][name]
        if s["visible"] < s["of"]:
            out.append(f"{name}: |a| shows {s['visible']} of its {s['of']} coefficients or combinations of them")
    whole = sum(document["sees"][name]["visible"] for name in document["for"])
    if document["together"]["visible"] < whole:
        out.append(
            f"the effects asked for share {whole - document['together']['visible']} combinations of coefficients"
        )
    return out


# With one


def _plan_for_recording(a: argparse.Namespace, effects: Sequence[tc.effects.Effect]) -> int:
    measured = read_recording(a, a.recording)
    settings = fit_settings(a, measured)
    existing = [p for p in measured.poses if not p.fault]
    with telling_data_quality(measured):
        found = tc.planning.missing_poses(existing, effects, signs=settings.signs, reference=settings.reference)
    observabilities = (
        None
        if found.existing is None
        else {e.name: tc.planning.observability(found.existing.up, e) for e in tc.effects.CATALOGUE}
    )
    document: tc.interchange.Document = {
        "format": "triaxcal.plan/1",
        "have": len(existing),
        "left_out": len(measured.poses) - len(existing),
        "dilution": tc.rounding.number(found.dilution),
        "worst_standard_error": None if found.existing is None else tc.rounding.number(found.existing.worst_error),
        "noise_g": tc.rounding.uncertainty(found.noise),
        **(_seen(observabilities) if observabilities else {"blind_to": None, "sees": None}),
        "poses": [_added(found, pose) for pose in found.wanted],
    }
    if effects:
        document |= {
            "for": [e.name for e in effects],
            "promised": _errors(_of_all(effects, found.now), found.noise),
            "cannot_show": _not_shown(found, effects),
            "moves": {name: tc.text.advice.to_move(channel) for name, channel in found.moves.items()},
        }
    document["data_quality"] = measured.data_quality
    if a.json:
        emit(document)
        return 0
    if document["left_out"]:
        show(f"{measured.name}: {counted(len(measured.poses), document['left_out'])}")
    title = f"the {len(existing)} of {measured.name}"
    if found.wanted:
        _show_wanted(f"poses worth adding to {title}", found)
    elif not found.absent:
        show(f"{title.replace('of', 'poses of', 1)} are well spread; none is wanted")
    if effects and found.noise is not None:
        _show_errors(found.now, found.noise, "by the poses there")
        if found.wanted:
            _show_errors(found.wanted[-1].errors, found.noise, "with them")
    for why in document.get("cannot_show", {}).values():
        show(why)
    for name, channel in found.moves.items():
        show(f"{name}: {tc.text.advice.to_move(channel)}")
    if observabilities is not None:
        show(f"the {len(existing)} there are cannot show: {_list(document['blind_to'])}")
    warn(measured.data_quality)
    return 0


def _added(found: tc.planning.MissingPoses, pose: tc.planning.Addition) -> tc.interchange.Document:
    noise = found.noise
    out: tc.interchange.Document = {
        "label": pose.label,
        "up": tc.rounding.numbers(pose.up),
        "dilution": tc.rounding.number(pose.dilution),
        "worst_standard_error": tc.rounding.number(pose.worst_error),
        "standard_error_g": None if noise is None else tc.rounding.uncertainty(pose.worst_error * noise),
    }
    if pose.errors:
        out["promised"] = _errors(pose.errors, noise)
    if pose.levels:
        out["levels"] = {name: tc.rounding.number(v) for name, v in pose.levels.items()}
    return out


def _of_all(
    effects: Sequence[tc.effects.Effect], errors: Mapping[str, Mapping[str, float | None]]
) -> dict[str, Mapping[str, float | None]]:
    """Errors by effect, with those effects for which the recording has no channel."""
    return {e.name: errors.get(e.name) or dict.fromkeys(c.name for c in e.coefficients) for e in effects}


def _not_shown(found: tc.planning.MissingPoses, effects: Sequence[tc.effects.Effect]) -> dict[str, str]:
    """Text by effect: its part that the existing poses cannot show, and whether the
    added poses show it."""
    out = {}
    for effect in effects:
        lost = [n for n in effect.needs if n in found.absent]
        missing = [c for c, e in _of_all([effect], found.now)[effect.name].items() if e is None]
        if lost:
            out[effect.name] = f"{effect.name}: cannot show, since the recording has no channel {', '.join(lost)}"
        elif missing and found.existing is not None:
            then = found.wanted[-1].errors.get(effect.name, {}) if found.wanted else {}
            never = [c for c in missing if then.get(c) is None]
            after = "; nor with the poses to add" if never == missing else "; with the poses to add they can"
            if never and never != missing:
                after = f"; with the poses to add all but {', '.join(never)}"
            out[effect.name] = (
                f"{effect.name}: the poses there cannot tell {', '.join(missing)} from the other parameters"
                + (after if found.wanted else "")
            )
    return out


def _show_wanted(title: str, found: tc.planning.MissingPoses) -> None:
    channels = list(found.wanted[0].levels)
    rows = [
        [
            i + 1,
            p.label,
            *(f"{c:+.3f}" for c in p.up),
            *(_level(p.levels[c]) for c in channels),
            f"{p.worst_error:.3g}" if np.isfinite(p.worst_error) else "—",
        ]
        for i, p in enumerate(found.wanted)
    ]
    table(title, ["pose", "up", "x", "y", "z", *channels, "worst parameter then"], rows)


def _show_errors(errors: Mapping[str, Mapping[str, float | None]], scale: float | None, note: str) -> None:
    for name, of in errors.items():
        values = ", ".join(f"{c} {'—' if e is None or scale is None else f'{e * scale:.3g}'}" for c, e in of.items())
        show(f"standard errors of {name} ({note}): {values}")


def _show(plan: Sequence[tc.planning.Direction], document: tc.interchange.Document) -> None:
    title = f"{document['directions']} directions, the first repeated at the end"
    rows = [[i + 1, label, *(f"{c:+.3f}" for c in v)] for i, (label, v) in enumerate(plan)]
    table(title, ["pose", "up", "x", "y", "z"], rows)
    show(f"worst parameter: {document['worst_standard_error']:.2f} standard errors of one pose")
    show(f"cannot show: {_list(document['blind_to'])}")
    for name in document["blind_to"]:
        s = document["sees"][name]
        if s["visible"]:
            hidden = "; ".join(" ".join(f"{w:+.2f} {k}" for k, w in h["coefficients"].items()) for h in s["hidden"])
            show(f"{name}: {s['visible']} of {s['of']} coefficients show; not {hidden}")


def _list(names: Sequence[str]) -> str:
    return ", ".join(names) or "nothing of the catalogue"
