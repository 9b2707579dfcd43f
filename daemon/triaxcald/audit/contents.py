"""The parts of the file against each other, and against the inventory that its
outcome has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from triaxcald.audit.differences import NOTHING, Difference, Kind
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording.schema import END_RECORD, RAW_RECORD, RECOVERY_RECORD
from triaxcald.recording.survey import Survey

_KINDS = {
    "twice": Kind.TWICE,
    "times": Kind.TIMES,
    "sequence": Kind.SEQUENCE,
    "running_index": Kind.RUNNING_INDEX,
    "topic": Kind.TOPIC,
    "undecodable": Kind.UNDECODABLE,
    "index": Kind.INDEX,
}
_OUTSIDE = (RAW_RECORD, END_RECORD, RECOVERY_RECORD)


def faults(found: Survey) -> list[Difference]:
    """What the file itself shows, whatever its format."""
    return [Difference(fault.part, _KINDS[fault.kind], again=fault.count) for fault in found.faults]


def against_inventory(found: Survey, outcome: Mapping[str, Any]) -> list[Difference]:
    """What was added, taken out, changed or put in another order since the
    outcome was written."""
    listed = outcome.get("contents")
    if not isinstance(listed, Mapping):
        return [Difference(ATTACHMENT, Kind.VALUE, "contents", listed, "an inventory")]
    held = found.inventory.document()
    differences = [d for group in held for d in _group(_by_name(listed.get(group)), _by_name(held[group]))]
    order = [[a.get("name") for a in _entries(some.get("attachments"))] for some in (listed, held)]
    if sorted(map(str, order[0])) == sorted(map(str, order[1])) and order[0] != order[1]:
        differences.append(Difference("attachments", Kind.ORDER))
    if found.last != ATTACHMENT:
        differences.append(Difference(ATTACHMENT, Kind.NOT_LAST, again=found.last))
    return differences


def _group(listed: Mapping[str, Any], held: Mapping[str, Any]) -> Iterator[Difference]:
    for name in dict.fromkeys([*listed, *held]):
        if name not in held:
            yield Difference(name, Kind.MISSING)
        elif name not in listed:
            if name not in _OUTSIDE:
                yield Difference(name, Kind.UNLISTED)
        else:
            for key in dict.fromkeys([*listed[name], *held[name]]):
                said, has = listed[name].get(key, NOTHING), held[name].get(key, NOTHING)
                if said != has:
                    yield Difference(name, Kind.LISTED, key, said, has)


def _by_name(listed: object) -> dict[str, Mapping[str, Any]]:
    """What bears a name twice is found as such in the file."""
    return {str(entry.get("name")): entry for entry in _entries(listed)}


def _entries(listed: object) -> list[Mapping[str, Any]]:
    return [e for e in listed if isinstance(e, Mapping)] if isinstance(listed, list) else []
