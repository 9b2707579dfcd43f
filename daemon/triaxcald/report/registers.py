"""What a station put into the device: the registers, what they cost, and what the device itself then measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.effects import effect_named
from triaxcald.certificate import is_passing
from triaxcald.report.document import Outcome
from triaxcald.report.figures import effect_title, number
from triaxcald.report.untrusted import mapping, texts


@dataclass(frozen=True)
class Word:
    register: str
    role: str
    wanted: float | None
    held: float | None
    unit: str
    raw: str


@dataclass(frozen=True)
class Device:
    """``passing`` effects depend on how the poses were taken. ``choices`` are (who corrects what, rms error that
    it leaves in g); ``checked`` the same of the device's own output; ``state`` says in words what it holds now.
    """

    state: str
    not_written: str
    choices: tuple[tuple[str, float | None], ...]
    left_to_host: tuple[str, ...]
    passing: tuple[str, ...]
    rounding_rms_g: float | None
    checked: tuple[tuple[str, float | None], ...]
    checked_verdict: str
    words: tuple[Word, ...]


def read_device(papers: Mapping[str, object], outcome: Outcome) -> Device | None:
    """None where the certificate tells nothing of a device."""
    known, checked = mapping(papers.get("registers")), mapping(papers.get("verification"))
    not_written = str(papers.get("not_written") or "")
    if not (known or checked or not_written):
        return None
    left = texts(known.get("left_to_host"))
    passing, host = (tuple(effect_title(n).lower() for n in left if _passes(n) is kind) for kind in (True, False))
    words = known.get("words")
    return Device(
        state=str(papers.get("device") or ""),
        not_written=not_written,
        choices=_choices(known, outcome, host) if known else (),
        left_to_host=host,
        passing=passing,
        rounding_rms_g=number(known.get("rounding_rms_g")),
        checked=_checked(checked),
        checked_verdict=str(checked.get("verdict") or ""),
        words=tuple(_word(mapping(entry)) for entry in (words if isinstance(words, list) else [])),
    )


def _passes(effect: str) -> bool:
    try:
        return is_passing(effect_named(effect))
    except KeyError:
        return False


def _choices(
    known: Mapping[str, object], outcome: Outcome, host: tuple[str, ...]
) -> tuple[tuple[str, float | None], ...]:
    held = [effect_title(name).lower() for name in texts(known.get("terms")) if name != "linear"]
    rows = []
    if len(outcome.stages) > 1:
        rows.append(("The linear model alone", outcome.stages[0].residual.rms_g))
    rows.append(("The registers: linear" + "".join(f", {name}" for name in held), number(known.get("rms_g"))))
    if host:
        rows.append((f"The registers' model and, in the host, {', '.join(host)}", outcome.final.rms_g))
    return tuple(rows)


def _checked(known: Mapping[str, object]) -> tuple[tuple[str, float | None], ...]:
    if not known:
        return ()
    return (
        ("Before, with the old registers, rms", number(known.get("before_rms_g"))),
        ("After a power cycle, with the new ones, rms", number(known.get("after_rms_g"))),
        ("After, largest", number(known.get("after_max_abs_g"))),
        ("Noise floor of the check poses", number(known.get("noise_floor_g"))),
        ("Limit, rms", number(known.get("limit_rms_g"))),
    )


def _word(entry: Mapping[str, object]) -> Word:
    names = (str(entry.get(key) or "") for key in ("register", "role"))
    register, role = names
    return Word(
        register,
        role,
        number(entry.get("wanted")),
        number(entry.get("held")),
        str(entry.get("unit") or ""),
        str(entry.get("raw") or ""),
    )
