"""What is said of an import, in English."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_REMARKS = {
    "no_times": "the log tells no times: samples are laid at the profile's rate, from zero",
    "no_date": "the log has no date: times count from its start",
    "date_without_zone": "the log's date names no time zone, and is taken for UTC",
    "times_added_up": "each time in the log is since the line before: they are added up",
    "stamp_stands_still": "the messages' own time stamp stands still: times are those at which they were logged",
}
_COUNTS = {
    "invalid": "that the unit says are not valid",
    "missing": "missing by the counter",
    "duplicates": "repeated",
    "incomplete": "that lack messages",
    "errors": "in error",
}


def summary(output: object, detail: Mapping[str, Any], seconds: float) -> str:
    """One line."""
    counts = detail["samples"]
    parts = [f"{output}: {counts['samples']} samples in {seconds:.2f} s from {detail['file']} ({detail['kind']})"]
    parts += [f"{counts[name]} {what}" for name, what in _COUNTS.items() if counts[name]]
    return ", ".join(parts)


def left_out(detail: Mapping[str, Any]) -> str:
    """What of the log is not in the recording; empty where all is."""
    whole, elsewhere = detail["other_frames"], detail["elsewhere"]
    what = "messages of other topics" if detail["kind"] == "MCAP" else "frames of other identifiers"
    parts = [f"{whole} {what}"] if whole else []
    parts += [f"{elsewhere} of other channels or nodes"] if elsewhere else []
    parts += [f"{count} of kind '{kind}'" for kind, count in detail["other_records"].items()]
    return f"left out: {', '.join(parts)}" if parts else ""


def remarks(detail: Mapping[str, Any]) -> list[str]:
    """What a reader of the recording ought to know, a line each."""
    lines = [_REMARKS[name] for name in detail["remarks"]]
    times = detail["times"]
    if times["back"]:
        lines.append(
            f"{times['back']} times are before those of records that came earlier, by up to"
            f" {times['furthest_back_s']:.6g} s; they are kept"
        )
    if times["pauses"]:
        lines.append(f"{times['pauses']} pauses, the longest of {times['longest_pause_s']:.6g} s")
    if detail["damaged"]:
        more = f", and {detail['damaged'] - 1} more places" if detail["damaged"] > 1 else ""
        lines.append(f"damaged: {detail['damage']}{more}; what is whole was taken")
    return lines
