"""Which figures of a document are the same, though another processor computed
them again."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import floor, log10
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.audit.differences import SENTENCES

SHARE = 1e-3
"""Of its own uncertainty: so much a figure may be off and is the same."""
RELATIVE = 1e-9
"""Of itself, where it has no uncertainty."""
EDGE = 0.5
"""Of the last printed digit: so far from an edge between two roundings both are
right. Three times what an ill-conditioned fit was seen to differ by: its
cross-validated rms by 0.17 of the seventh digit."""
LINE = 1e-6
"""Of the combined variance: so much the variance of a line in a budget may be
off, which is a difference of two. A fit to two effects that are hard to tell
apart makes 1e-8."""
CORRELATION = 1e-2
"""The standard uncertainty of a correlation, (1 − ρ²)/√ν, is 0.014 for ρ = 0.95
and ν = 50."""
WORDED = 5e-5
"""Of itself: so far a figure may be from the edge between two wordings."""
LAST_PLACES = 100
"""Of a figure that is written with two digits of its uncertainty: so many make one
uncertainty, at most."""
_OF_ONE_POSE = ("residual_g", "before_residual_g", "error_g")
_NUMERAL = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")


@dataclass
class Agreement:
    """How far figures that are the same are off, at most: by which share of
    their uncertainty at the place ``worst``, and those that have none by which
    share of themselves."""

    figures: int = 0
    of_uncertainty: float = 0.0
    relative: float = 0.0
    worst: str = ""

    def take(self, place: str, off: float, figure: float, uncertainty: float | None) -> None:
        self.figures += 1
        share = off / uncertainty if uncertainty else 0.0
        if share > self.of_uncertainty or not self.worst:
            self.worst = place
        self.of_uncertainty = max(self.of_uncertainty, share)
        if not uncertainty:
            self.relative = max(self.relative, off / max(abs(figure), 1e-300))


@dataclass(frozen=True)
class Figures:
    """Those of a document that was computed again: their uncertainties by
    place, and the digits of all of them. ``share`` of its uncertainty is how far
    a figure may be off and be the same; ``derived`` are uncertainties, by place,
    that follow from those in the document."""

    document: Mapping[str, Any]
    share: float = SHARE
    derived: Mapping[str, float] = field(default_factory=dict)
    uncertainties: Mapping[str, float] = field(init=False)
    digits: Sequence[float] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "uncertainties", dict(_stated(self.document)))
        exact = (abs(figure.exact) for figure in _printed(self.document))
        object.__setattr__(self, "digits", sorted(map(_mantissa, filter(None, exact))))

    def taken(self, part: str, stored: Any, agreement: Agreement) -> dict[str, Any]:
        """The document with the ``stored`` one's figures and numerals where
        they are the same."""
        merged = self._taken(stored, self.document, "", "", part, agreement)
        return dict(merged)

    def _taken(self, stored: Any, again: Any, at: str, key: str, part: str, agreement: Agreement) -> Any:
        if isinstance(again, Mapping) and isinstance(stored, Mapping):
            return {
                k: self._taken(stored[k], v, inside(at, k), k, part, agreement) if k in stored else v
                for k, v in again.items()
            }
        if isinstance(again, list) and isinstance(stored, list) and len(again) == len(stored):
            pairs = enumerate(zip(stored, again, strict=True))
            return [self._taken(s, a, f"{at}[{i}]", key, part, agreement) for i, (s, a) in pairs]
        if isinstance(again, tc.rounding.Printed) and type(stored) is float and stored != again:
            uncertainty = self.uncertainty_of(at, again)
            if same_figure(stored, again, uncertainty, self.share):
                agreement.take(f"{part}: {at}", abs(stored - again), again, uncertainty)
                return stored
        worded = key in SENTENCES and isinstance(again, str) and isinstance(stored, str) and stored != again
        if worded and self.same_words(stored, again):
            agreement.figures += 1
            return stored
        return again

    def uncertainty_of(self, place: str, figure: float) -> float | None:
        """Of the ``figure`` at the ``place``; None where there is none."""
        return self.derived.get(place) or self.uncertainties.get(place) or getattr(figure, "known_to", None)

    def same_words(self, stored: str, again: str) -> bool:
        """Whether two sentences have the same words, and numerals that are the
        two roundings of one of the figures."""
        if _NUMERAL.split(stored) != _NUMERAL.split(again):
            return False
        return all(map(self.same_numeral, _NUMERAL.findall(stored), _NUMERAL.findall(again)))

    def same_numeral(self, stored: str, again: str) -> bool:
        if stored == again:
            return True
        one, other = float(stored), float(again)
        try:
            apart = 1.001 * max(_last_place(stored), _last_place(again))
        except (OverflowError, ValueError):  # a power that no figure has
            return False
        if self.share > SHARE and not (stored.isdecimal() and again.isdecimal()):
            return abs(one - other) <= apart * (1 + self.share * LAST_PLACES)
        return abs(one - other) <= apart and self._is_edge((one + other) / 2)

    def _is_edge(self, between: float) -> bool:
        """Whether there is a figure with these digits, whatever the power of
        ten: sentences have µg and per cent."""
        if not between:
            return False
        digits = _mantissa(between)
        at = bisect_left(self.digits, digits)
        return any(abs(near - digits) <= WORDED * digits for near in self.digits[max(0, at - 1) : at + 1])


def furthest(stored: Any, again: Any) -> tuple[float, str] | None:
    """Of two calibrations by different versions: the largest difference between
    two coefficients, as a share of the standard error of the one computed
    ``again``, and its place; None where they have none in common."""
    values, errors = dict(placed(stored)), dict(_stated({"standard_error": again.get("standard_error", {})}))
    for name, coefficients in again.get("effects", {}).items():
        errors |= _stated(coefficients, inside("effects", name))
    now = dict(placed(again))
    shares = [
        (abs(values[at] - now[at]) / error, at)
        for at, error in errors.items()
        if error and isinstance(values.get(at), float) and isinstance(now.get(at), float)
    ]
    return max(shares, default=None)


def same_figure(stored: float, again: tc.rounding.Printed, uncertainty: float | None, share: float = SHARE) -> bool:
    """Whether the ``stored`` figure could be the one that was computed
    ``again``, up to this ``share`` of its uncertainty."""
    if abs(stored - again) <= max(share * (uncertainty or 0.0), RELATIVE * abs(again)):
        return True
    # A number on the edge between two printed ones may stand as either.
    steps = stored / again.step if again.step else 0.0
    is_printed = abs(steps - round(steps)) <= RELATIVE * max(1.0, abs(steps)) if abs(steps) < 1e15 else False
    within = share * (uncertainty or 0.0) if share > SHARE else 0.0
    return is_printed and abs(stored - again.exact) <= (0.5 + EDGE) * again.step + within


def _stated(node: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """The standard uncertainties that a document states of its figures, by
    place."""
    if isinstance(node, list):
        for i, inner in enumerate(node):
            yield from _stated(inner, f"{at}[{i}]")
    if not isinstance(node, Mapping):
        return
    of_value, of_pose = node.get("standard_error"), node.get("standard_error_g")
    if isinstance(of_value, Mapping):
        yield from placed(of_value, at)
    elif of_value:
        yield inside(at, "value"), of_value
    if of_pose:
        yield from ((inside(at, key), of_pose) for key in _OF_ONE_POSE)
    if node.get("expanded_uncertainty_g") and "after_rms_g" in node:
        yield inside(at, "after_rms_g"), node["expanded_uncertainty_g"] / 2
    if "centre" in node:
        yield from _of_transformation(node, at)
    if "correlation" in node:
        yield from ((place, CORRELATION) for place, _ in placed(node["correlation"], inside(at, "correlation")))
    if "significant" in node and node["rms_g"]:  # of what no effect explains: an estimate, known to its own size
        yield inside(at, "rms_g"), node["rms_g"]
    if "budget" in node:
        yield from _of_lines(node, at)
    if "words" in node and "uncertainty" in node:
        combined = _combined(node["uncertainty"])
        for i, word in enumerate(node["words"]):
            if error := combined.get(_place_of(word["role"])):
                yield f"{inside(at, 'words')}[{i}].wanted", error
    for key, inner in node.items():
        yield from _stated(inner, inside(at, key))


def _of_transformation(calibration: Mapping[str, Any], at: str) -> Iterator[tuple[str, float]]:
    """Of the centre c = K b and the matrix A = (K R)⁻¹, which repeat the
    parameters in another form: the uncertainty of the parameter that moves each
    most."""
    scale, matrix, errors = calibration["scale_factor"], calibration["matrix"], calibration["standard_error"]
    for i in range(3):
        yield f"{inside(at, 'centre')}[{i}]", abs(scale[i]) * (errors["bias"][i] or 0.0)
        yield f"{inside(at, 'matrix')}[{i}][{i}]", abs(matrix[i][i] / scale[i]) * (errors["scale_factor"][i] or 0.0)
        for j in range(i + 1, 3):  # the angle between axes i and j is that of the third
            yield f"{inside(at, 'matrix')}[{i}][{j}]", abs(matrix[j][j]) * (errors["misalignment"][3 - i - j] or 0.0)


def _of_lines(budget: Mapping[str, Any], at: str) -> Iterator[tuple[str, float]]:
    """Of the lines of a budget, which are estimates and differences of
    variances: as much as they are themselves, or more where they are small
    beside the combined one. Two processors were seen to differ by 5e-5 of a
    line where two effects are hard to tell apart."""
    combined, whole = _combined(budget), budget["magnitude"]["standard_g"]
    for i, line in enumerate(budget["budget"]):
        place = f"{inside(at, 'budget')}[{i}]"
        for inner, value in placed({key: line[key] for key in budget["expanded"]}):
            yield inside(place, inner), _of_line(value, combined[inner])
        yield inside(place, "magnitude_g"), _of_line(line["magnitude_g"], whole)
        yield inside(place, "share"), max(line["share"] or 0.0, LINE / SHARE)


def _of_line(value: float | None, combined: float | None) -> float:
    value, combined = value or 0.0, combined or 0.0
    by_variance = LINE * combined**2 / (2 * SHARE * value) if value else combined
    return max(value, min(combined, by_variance))


def _combined(budget: Mapping[str, Any]) -> dict[str, float | None]:
    """The combined standard uncertainties of a budget, by place."""
    coverage = dict(placed(budget["coverage_factor"]))
    return {place: v / coverage[place] if v and coverage[place] else None for place, v in placed(budget["expanded"])}


def _place_of(role: str) -> str:
    """Of a register's role, where its coefficient stands in a budget."""
    group, _, name = role.partition(".")
    return f"{group}[{'xyz'.index(name)}]" if group in td.roles.LINEAR else f"effects.{role}"


def placed(node: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of a document, by place."""
    if isinstance(node, Mapping):
        for key, inner in node.items():
            yield from placed(inner, inside(at, key))
    elif isinstance(node, list):
        for i, inner in enumerate(node):
            yield from placed(inner, f"{at}[{i}]")
    else:
        yield at, node


def _printed(document: Any) -> Iterator[tc.rounding.Printed]:
    return (leaf for _, leaf in placed(document) if isinstance(leaf, tc.rounding.Printed))


def beyond_rounding(stored: float, again: float) -> float:
    """The difference of two figures beyond what their rounding makes."""
    if not isinstance(again, tc.rounding.Printed):
        return abs(stored - again)
    return min(abs(stored - again), max(0.0, abs(stored - again.exact) - (0.5 + EDGE) * again.step))


def figures_of(document: Any) -> Iterator[tuple[str, float]]:
    """Those of a document, by place."""
    return ((at, leaf) for at, leaf in placed(document) if isinstance(leaf, float))


def inside(at: str, key: str) -> str:
    return f"{at}.{key}" if at else str(key)


def _last_place(numeral: str) -> float:
    """What one in its last digit is."""
    digits, _, power = numeral.partition("e")
    return float(10.0 ** (int(power or 0) - len(digits.partition(".")[2])))


def _mantissa(value: float) -> float:
    return float(value / 10.0 ** floor(log10(value)))
