"""Says what is in a recording, for `triaxcal log info`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from triaxcald.recording import schema
from triaxcald.recording.bus import describe_bus, is_of_bus
from triaxcald.recording.reader import Contents, Recording, Series, open_recording
from triaxcald.recording.writer import ENDED

COUNTED_MOST = 1_000_000
"""Raw records that are counted in a second or two: of more, those that the index
counts."""


def describe(path: Path, *, count: bool = False) -> dict[str, Any]:
    """The recording's contents as a JSON document; also of one not finished, up
    to its last whole record. ``count`` reads every record, also of a long recording
    whose index has the numbers.

    Raises RecordingError.
    """
    with open_recording(path, unfinished=True, alike=False) as recording:
        index = None if count or not is_long(recording) else recording.index()
        topics = _topics(recording) if index is None else _counted(index.topics)
        raw = _phases(recording) if index is None else _timed(_counted(index.phases))
        events = list(recording.events())
        starts = [topic["start_ns"] for topic in topics.values()]
        ends = [topic["end_ns"] for topic in topics.values()]
        return {
            "format": schema.FORMAT,
            "file": str(path),
            "bytes": recording.size,
            **(_segments(recording) if isinstance(recording, Series) else _file(recording)),
            "duration_s": (max(ends) - min(starts)) / 1e9 if starts else 0.0,
            "topics": topics,
            "raw": raw,
            "counted": index is None,
            **_imported(events),
            "ended": next((_detail(e) for e in reversed(events) if e.kind == ENDED), None),
            **({"bus": describe_bus(recording, None if index is None else raw)} if is_of_bus(recording) else {}),
            "metadata": recording.metadata,
            "attachments": {
                name: {
                    "media_type": recording.attachments.media_types[name],
                    "bytes": recording.attachments.sizes[name],
                }
                for name in recording.attachments
            },
            "events": [{"time_ns": e.time_ns, "kind": e.kind, "detail": _detail(e)} for e in events],
            "losses": [asdict(loss) for loss in recording.losses()],
        }


def is_long(recording: Contents) -> bool:
    """Whether it says that it has more raw records than are counted unasked."""
    if isinstance(recording, Series):
        return sum(segment.records for segment in recording.manifest.segments) > COUNTED_MOST
    records = recording.metadata.get(schema.RAW_RECORD, {}).get("records", "")
    return records.isdecimal() and len(records) < 20 and int(records) > COUNTED_MOST


def _counted(of: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    return {name: dict(vars(counts)) for name, counts in of.items()}


def _timed(phases: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    for entry in phases.values():
        entry["duration_s"] = (entry["end_ns"] - entry["start_ns"]) / 1e9
    return phases


def _detail(event: schema.Event) -> Any:
    """As text where it is no JSON: anybody may have written it."""
    try:
        return event.detail
    except (ValueError, RecursionError):
        return event.text


def _imported(events: Sequence[schema.Event]) -> dict[str, Any]:
    """From which log the recording was made, where it was."""
    details = [_detail(event) for event in events if event.kind == schema.IMPORTED]
    return {"imported": details[0]} if details else {}


def _file(recording: Recording) -> dict[str, Any]:
    return {
        "finished": recording.finished,
        "recovered": schema.RECOVERY_RECORD in recording.metadata,
        "chunks": recording.chunks,
    }


def _segments(series: Series) -> dict[str, Any]:
    return {
        "finished": all(s.state == "closed" for s in series.manifest.segments),
        "segments": [asdict(s) for s in series.manifest.segments],
        "deleted": series.manifest.deleted,
    }


def _topics(recording: Contents) -> dict[str, dict[str, int]]:
    topics: dict[str, dict[str, int]] = {}
    for topic, message in recording.messages():
        time_ns = message.log_time
        entry = topics.setdefault(topic, {"messages": 0, "start_ns": time_ns, "end_ns": time_ns})
        entry["messages"] += 1
        entry["start_ns"] = min(entry["start_ns"], time_ns)
        entry["end_ns"] = max(entry["end_ns"], time_ns)
    return topics


def _phases(recording: Contents) -> dict[str, dict[str, Any]]:
    """Of each phase: records, their bytes, and the time from the first to the
    last; how many records are unconfirmed, where any are."""
    phases: dict[str, dict[str, Any]] = {}
    for phase, batch in recording.joined_batches():
        if not len(batch):
            continue
        first_ns, last_ns = int(batch.time_ns.min()), int(batch.time_ns.max())
        entry = phases.setdefault(phase, {"records": 0, "bytes": 0, "start_ns": first_ns, "end_ns": last_ns})
        entry["records"] += len(batch)
        entry["bytes"] += len(batch.payload)
        if batch.unconfirmed:
            entry["unconfirmed"] = entry.get("unconfirmed", 0) + len(batch)
        entry["start_ns"] = min(entry["start_ns"], first_ns)
        entry["end_ns"] = max(entry["end_ns"], last_ns)
        entry["duration_s"] = (entry["end_ns"] - entry["start_ns"]) / 1e9
    return phases
