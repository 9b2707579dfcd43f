"""Where a recording says one thing, and what it rests on another. Values alone."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

from triaxcald.documents import json_value

MOST = 8
"""So many differences of one document are listed, the others counted."""


SENTENCES = frozenset({
    "advice", "apart", "data_quality", "halved_by", "holds", "how", "lead", "not_evaluated", "notes", "reason",
    "remedy", "summary", "warnings",
})  # fmt: skip
"""Keys of documents under which English stands: words may be better in another
version, numbers may not differ."""


class Nothing:
    """In the place of a value that is not there."""

    def __repr__(self) -> str:
        return "nothing"


NOTHING = Nothing()


class Kind(Enum):
    """How a part differs. ``stored`` is what it says, ``again`` what it should
    say by all the rest."""

    VALUE = auto()
    BYTES = auto()
    """The content is the same, its bytes are not."""
    MORE = auto()
    """``again`` more of them."""
    NO_DOCUMENT = auto()
    NOT_COMPUTED = auto()
    """``again`` says why."""
    MISSING = auto()
    """The outcome lists it, or the result rests on it."""
    UNCALLED_FOR = auto()
    """By the verdict there is none."""
    UNLISTED = auto()
    """The outcome does not list it."""
    LISTED = auto()
    """``place`` is otherwise than the outcome lists it."""
    NOT_DRAWN = auto()
    """Drawn again, it comes out otherwise."""
    ORDER = auto()
    NOT_LAST = auto()
    NO_END = auto()
    """The recording says that it ends with it."""
    TWICE = auto()
    TIMES = auto()
    SEQUENCE = auto()
    RUNNING_INDEX = auto()
    TOPIC = auto()
    UNDECODABLE = auto()
    INDEX = auto()
    NOT_OF_RAW = auto()
    """The content is not what the raw records give."""
    NOT_HELD = auto()
    """The device holds ``stored``, the certificate asks for ``again``."""
    NOT_READ = auto()
    """``stored`` is said to have been read, and ``again`` was."""
    NOT_ASKED_FOR = auto()
    """``stored`` was written, which nothing asks for."""
    NOT_SHOWN = auto()
    """The register traffic does not show ``stored``."""
    NOT_FORCED = auto()
    """What the device held there is no calibration, and nobody is said to have
    overruled that."""
    BESIDE = auto()
    """The file beside the recording is not what is in the recording."""
    ALONE = auto()
    """There is none in the recording."""

    # Of signatures.
    UNSIGNED = auto()
    """It has none, and the trust file asks for one."""
    NO_ENVELOPE = auto()
    """It is none; ``again`` says why."""
    NOT_VERIFIED = auto()
    """It is not of its key, or a time stamp is not of it."""
    UNTRUSTED = auto()
    """The trust file does not have the key ``again``."""
    REVOKED = auto()
    CLOCK = auto()
    """A time before one that it cannot be before."""
    MENDED = auto()
    """A later start signed it, with a verdict that it cannot vouch for."""

    # Of the chain of a folder.
    REMOVED = auto()
    """A recording of the chain that is not there, and that no tombstone is of."""
    INSERTED = auto()
    """A recording that the chain does not have."""
    COPIED = auto()
    """``again`` is the other file with the same recording."""
    RENAMED = auto()
    LATE = auto()
    """Signed long after its end."""
    BROKEN = auto()
    """An entry that does not follow from the one before."""
    CUT = auto()
    """The chain ends before an entry that is known."""
    NO_CHAIN = auto()


@dataclass(frozen=True)
class Difference:
    """``part`` is an attachment, a topic, a metadata record, or a file;
    ``place`` where in it. ``of_uncertainty``: by how much of its uncertainty a figure
    of other software is off, where it has one and that was asked for."""

    part: str
    kind: Kind
    place: str = ""
    stored: Any = NOTHING
    again: Any = NOTHING
    of_uncertainty: float | None = field(default=None, kw_only=True)


def compare(part: str, stored: bytes, again: bytes, *, by_another: bool = False) -> list[Difference]:
    """Two JSON documents, of which the second was computed again. ``by_another``:
    another version made the first; then sentences, keys that the first lacks
    and bytes are not compared."""
    if stored == again:
        return []
    try:
        before = json_value(stored)
    except (ValueError, RecursionError):
        return [Difference(part, Kind.NO_DOCUMENT)]
    found = list(differing(part, before, json.loads(again), by_another=by_another))
    if by_another and not found:
        return []
    if not found:
        return [Difference(part, Kind.BYTES)]
    rest = [Difference(part, Kind.MORE, again=len(found) - MOST)] if len(found) > MOST else []
    return found[:MOST] + rest


def differing(part: str, stored: Any, again: Any, at: str = "", *, by_another: bool = False) -> Iterator[Difference]:
    """Where two JSON values differ; ``by_another`` as in `compare`."""
    if isinstance(stored, Mapping) and isinstance(again, Mapping):
        for key in dict.fromkeys([*stored, *again]):
            if by_another and (key in SENTENCES or key not in stored):
                continue
            inner = f"{at}.{key}" if at else str(key)
            yield from differing(part, stored.get(key, NOTHING), again.get(key, NOTHING), inner, by_another=by_another)
    elif isinstance(stored, list) and isinstance(again, list) and len(stored) == len(again):
        for i, (s, t) in enumerate(zip(stored, again, strict=True)):
            yield from differing(part, s, t, f"{at}[{i}]", by_another=by_another)
    elif type(stored) is not type(again) or stored != again:
        yield Difference(part, Kind.VALUE, at, stored, again)
