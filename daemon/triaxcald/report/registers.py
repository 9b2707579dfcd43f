"""What a station put into the device: the registers, and what the device itself
then measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import triaxcal as tc
from triaxcald.doubts import is_passing
from triaxcald.report.figures import number
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
    """Effects: ``held`` are in its registers, for ``host`` it has none,
    ``passing`` depend on how the poses were taken. ``checked`` are errors in g
    of the device's own output; ``state`` says in words what it holds now.
    """

    state: str
    not_written: str
    held: tuple[str, ...]
    host: tuple[str, ...]
    passing: tuple[str, ...]
    rounding_rms_g: float | None
    checked: tuple[tuple[str, float | None], ...]
    checked_verdict: str
    words: tuple[Word, ...]


def read_device(papers: Mapping[str, object]) -> Device | None:
    """None where the certificate tells nothing of a device."""
    known, checked = mapping(papers.get("registers")), mapping(papers.get("verification"))
    not_written = str(papers.get("not_written") or "")
    if not (known or checked or not_written):
        return None
    left = texts(known.get("left_to_host"))
    words = known.get("words")
    return Device(
        state=str(papers.get("device") or ""),
        not_written=not_written,
        held=tuple(name for name in texts(known.get("terms")) if name != "linear"),
        host=tuple(name for name in left if not passes(name)),
        passing=tuple(name for name in left if passes(name)),
        rounding_rms_g=number(known.get("rounding_rms_g")),
        checked=_checked(checked),
        checked_verdict=str(checked.get("verdict") or ""),
        words=tuple(_word(mapping(entry)) for entry in (words if isinstance(words, list) else [])),
    )


def passes(effect: str) -> bool:
    """Whether an effect of that name is the recording's rather than the unit's."""
    try:
        return is_passing(tc.effects.effect_named(effect))
    except KeyError:
        return effect in {e.name for e in tc.effects.BETWEEN_RUNS}


def _checked(known: Mapping[str, object]) -> tuple[tuple[str, float | None], ...]:
    if not known:
        return ()
    return (
        ("With the old registers, rms", number(known.get("before_rms_g"))),
        ("With the new registers, rms", number(known.get("after_rms_g"))),
        ("With the new registers, largest", number(known.get("after_max_abs_g"))),
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
