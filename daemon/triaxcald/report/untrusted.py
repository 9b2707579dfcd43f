"""Values of a document, read without trust: what is missing or of the wrong
kind counts as missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from triaxcald.report.figures import number

Vector = tuple[float, float, float]


def mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def texts(value: object) -> tuple[str, ...]:
    """A list of sentences or names; an entry with keys becomes `key: value;
    key: value`."""
    entries = value if isinstance(value, (list, tuple)) else [] if value is None else [value]
    return tuple(words(entry) for entry in entries if entry is not None)


def vector(value: object) -> Vector | None:
    """Three finite numbers, or None."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 3:
        return None
    x, y, z = (number(component) for component in value)
    return None if x is None or y is None or z is None else (x, y, z)


def numbers(value: object) -> dict[str, float | None]:
    return {str(name): number(entry) for name, entry in mapping(value).items()}


def words(entry: object) -> str:
    if isinstance(entry, Mapping):
        return "; ".join(f"{key}: {value}" for key, value in entry.items())
    return str(entry)
