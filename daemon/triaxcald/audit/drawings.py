"""Whether a report that was drawn again is the stored one, though another
processor placed its lines."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import zip_longest
from typing import Any

from triaxcald.audit.figures import Agreement, Figures

POINT = 1e-3
"""So many points a line may be off: nobody sees them, and a processor makes a
millionth."""
_PICTURE = re.compile(r"(<svg.*?</svg>)", re.DOTALL)
_DESCRIBED = re.compile(r'<svg role="img" (aria-label="[^"]*") [^>]*>(<title>[^<]*</title>)')
"""Of a picture, what it begins with and how it is described."""
_TAG = re.compile(r"(<[^>]*>)")
_COORDINATE = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_MADE_OF_CONTENT = re.compile(r'((?: id="|href="#|url\(#)[\w-]*?)([0-9a-f]{10})(?=["\)])')


def same_report(stored: bytes, drawn: str, document: Mapping[str, Any], agreement: Agreement) -> bool:
    """Words have to be the same, and numerals too, unless a figure of the
    ``document`` is on the edge between both; lines in pictures may be off by
    `POINT`. Of a picture without lines in ``drawn`` (`charts.undrawn`) only the
    description is compared."""
    try:
        pairs = list(zip_longest(*map(_parts, _as_drawn(stored.decode(), drawn)), fillvalue=(None, "")))
    except UnicodeDecodeError:
        return False
    figures = Figures(document)
    for (kind, one), (kind_again, other) in pairs:
        if kind != kind_again:
            return False
        same = _same_place if kind == "place" else figures.same_words
        if one != other and not same(one, other):
            return False
    agreement.figures += 1
    return True


def _as_drawn(stored: str, drawn: str) -> tuple[str, str]:
    """Both pages, without lines in the pictures that have none in ``drawn``."""
    here, there = _PICTURE.split(stored), _PICTURE.split(drawn)
    if len(here) == len(there):
        for i in range(1, len(here), 2):
            again, kept = _DESCRIBED.match(there[i]), _DESCRIBED.match(here[i])
            if again and kept and there[i] == f"{again[0]}</svg>":
                here[i], there[i] = "".join(kept.groups()), "".join(again.groups())
    return "".join(here), "".join(there)


def _parts(page: str) -> Iterator[tuple[str, str]]:
    """A page in pieces: text, and tags of pictures, which place something."""
    for i, piece in enumerate(_PICTURE.split(_numbered(page))):
        if i % 2 == 0:
            yield "text", piece
            continue
        for k, inner in enumerate(_TAG.split(piece)):
            # The first tag has the picture's description.
            yield ("place" if k % 2 and k > 1 else "text"), inner


def _numbered(page: str) -> str:
    """With the names that a drawing makes of its content counted, in the order
    in which they come."""
    names: dict[str, int] = {}
    return _MADE_OF_CONTENT.sub(lambda found: f"{found[1]}{names.setdefault(found[2], len(names))}", page)


def _same_place(one: str, other: str) -> bool:
    if _COORDINATE.split(one) != _COORDINATE.split(other):
        return False
    pairs = zip(_COORDINATE.findall(one), _COORDINATE.findall(other), strict=True)
    return all(abs(float(a) - float(b)) <= POINT for a, b in pairs)
