"""Says what is in a recording, for `triaxcal log info`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from triaxcald.recording import schema
from triaxcald.recording.bus import describe_bus, is_of_bus
from triaxcald.recording.reader import Contents, Recording, Series, open_recording
from triaxcald.recording.writer import ENDED


def describe(path: Path) -> dict[str, Any]:
    """The recording's contents as a JSON document; also of one not finished, up
    to its last whole record.

    Raises RecordingError.
    """
    with open_recording(path, unfinished=True, alike=False) as recording:
        topics, events = _topics(recording), list(recording.events())
        starts = [topic["start_ns"] for topic in topics.values()]
        ends = [topic["end_ns"] for topic in topics.values()]
        return {
            "format": schema.FORMAT,
            "file": str(path),
            "bytes": recording.size,
            **(_segments(recording) if isinstance(recording, Series) else _file(recording)),
            "duration_s": (max(ends) - min(starts)) / 1e9 if starts else 0.0,
            "topics": topics,
            "raw": _phases(recording),
            **_imported(events),
            "ended": next((_detail(e) for e in reversed(events) if e.kind == ENDED), None),
            **({"bus": describe_bus(recording)} if is_of_bus(recording) else {}),
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
