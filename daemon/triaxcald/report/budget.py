"""The uncertainty budget of a calibration document, read without trust like the
rest of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from triaxcald.report.figures import number
from triaxcald.report.untrusted import mapping, numbers, texts, vector


@dataclass(frozen=True)
class BudgetLine:
    """``magnitude_g`` is a standard uncertainty of |a|; ``share`` of its
    variance, 0…1."""

    source: str
    evaluation: str
    magnitude_g: float | None
    share: float | None
    how: str
    assumes: tuple[str, ...] = ()

    @property
    def percent(self) -> str:
        if self.share is None:
            return ""
        return "< 1 %" if 0 < self.share < 0.01 else f"{self.share:.0%}".replace("%", " %")


@dataclass(frozen=True)
class Uncertainty:
    lines: tuple[BudgetLine, ...]
    standard_g: float | None
    coverage_factor: float | None
    expanded_g: float | None
    level_percent: float | None
    expanded: Mapping[str, float | None]
    dominant: str
    halved_by: str
    if_halved_g: float | None
    not_evaluated: tuple[str, ...]
    scopes: tuple[tuple[str, str, float | None], ...] = ()
    """Name, meaning, and expanded uncertainty of |a| in g."""


SCOPES = {
    "this_fit": ("This fit", "the calibration by itself, at the reference conditions"),
    "this_sessions_poses": ("This session’s poses", "one more pose of this recording, with its noise"),
    "another_day": ("Another day", "the next recording, with how the unit starts"),
}


def read_uncertainty(calibration: Mapping[str, object]) -> Uncertainty | None:
    """None where the document has no budget."""
    known = mapping(calibration.get("uncertainty"))
    entries = known.get("budget")
    if not isinstance(entries, (list, tuple)) or not entries:
        return None
    whole, level = mapping(known.get("magnitude")), number(known.get("level"))
    return Uncertainty(
        lines=tuple(_line(mapping(entry)) for entry in entries),
        standard_g=number(whole.get("standard_g")),
        coverage_factor=number(whole.get("coverage_factor")),
        expanded_g=number(whole.get("expanded_g")),
        level_percent=None if level is None else 100 * level,
        expanded=dict(_expanded(mapping(known.get("expanded")))),
        dominant=_words(known.get("dominant")),
        halved_by=str(known.get("halved_by") or ""),
        if_halved_g=number(known.get("magnitude_if_halved_g")),
        not_evaluated=texts(known.get("not_evaluated")),
        scopes=tuple(_scopes(mapping(calibration.get("expanded_uncertainty_g")))),
    )


def _scopes(known: Mapping[str, object]) -> Iterator[tuple[str, str, float | None]]:
    for key, (name, meaning) in SCOPES.items():
        if key in known:
            yield name, meaning, number(known[key])


def _line(entry: Mapping[str, object]) -> BudgetLine:
    return BudgetLine(
        _words(entry.get("source")),
        str(entry.get("evaluation") or ""),
        number(entry.get("magnitude_g")),
        number(entry.get("share")),
        str(entry.get("how") or ""),
        texts(entry.get("assumes")),
    )


def _expanded(known: Mapping[str, object]) -> Iterator[tuple[str, float | None]]:
    """Of every coefficient, by a name like `bias.x` or `warm_up.x`."""
    for group in ("scale_factor", "misalignment", "bias"):
        for axis, value in zip("xyz", vector(known.get(group)) or (None, None, None), strict=True):
            yield f"{group}.{axis}", value
    for effect, values in mapping(known.get("effects")).items():
        for name, value in numbers(values).items():
            yield f"{effect}.{name}", value


def _words(name: object) -> str:
    return str(name or "").replace("_", " ")
