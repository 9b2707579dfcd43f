"""Messages about an import, in English."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import triaxcal as tc

_REMARKS = {
    "no_times": "the log tells no times: samples are laid at the profile's rate, from zero",
    "no_date": "the log has no date: times count from its start",
    "date_without_zone": "the log's date names no time zone, and is taken for UTC",
    "times_added_up": "each time in the log is since the line before: they are added up",
    "channels_follow": "the messages come on one channel after another, as of a publisher started anew: all are taken",
    "two_senders": "two units send on the readings' stream, and their samples are mixed: they are no good for a fit",
    "stamp_stands_still": "the messages' own time stamp stands still: times are those at which they were logged",
}
_RATE_OFF = 1.1
"""Samples by the counter last so many times as long as the log, or so many times
less: oscillators are off by a hundredth at most."""
_COUNTS = {
    "not_finite": "whose outputs are no finite numbers",
    "invalid": "that the unit says are not valid",
    "missing": "missing by the counter",
    "duplicates": "repeated",
    "incomplete": "that lack messages",
    "errors": "in error",
    "malformed": "too short for the profile's message, or not as it is defined",
}


def summary(output: object, detail: Mapping[str, Any], seconds: float) -> str:
    """One line."""
    counts = detail["samples"]
    came = f"{tc.number_format.number_of(counts['samples'], 'sample')} in {seconds:.2f} s"
    return ", ".join([f"{output}: {came} from {detail['file']} ({detail['kind']})", *no_samples(counts)])


def no_samples(counts: Mapping[str, int]) -> list[str]:
    """What of the readings gave none, by kind."""
    return [f"{counts[name]} {what}" for name, what in _COUNTS.items() if counts[name]]


def left_out(detail: Mapping[str, Any]) -> str:
    """What of the log is not in the recording; empty where all is."""
    whole, elsewhere = detail["other_frames"], detail["elsewhere"]
    one, of = ("message", "topics") if detail["kind"] == "MCAP" else ("frame", "identifiers")
    parts = [f"{tc.number_format.number_of(whole, one)} of other {of}"] if whole else []
    parts += [f"{elsewhere} of other channels or nodes"] if elsewhere else []
    parts += [f"{count} of kind '{kind}'" for kind, count in detail["other_records"].items()]
    return f"left out: {', '.join(parts)}" if parts else ""


def _off(detail: Mapping[str, Any], seconds: float) -> str:
    """Where the samples' own time is not the log's; empty where it is."""
    by_log = detail["seconds_by_log"]
    if not by_log or "no_times" in detail["remarks"] or by_log / _RATE_OFF < seconds < by_log * _RATE_OFF:
        return ""
    return (
        f"the samples last {seconds:.2f} s by their own time, which is their counter at the profile's"
        f" sampling.rate_hz, or their stamps, and {by_log:.2f} s by the log's times"
    )


def remarks(detail: Mapping[str, Any], seconds: float) -> list[str]:
    """What a reader of the recording ought to know, a line each; ``seconds``
    are those that the samples cover."""
    lines = [_REMARKS[name] for name in detail["remarks"]]
    times = detail["times"]
    if times["back"]:
        lines.append(
            f"{tc.number_format.number_of(times['back'], 'record')} came with a time before that of an earlier "
            "one, by up to"
            f" {times['furthest_back_s']:.6g} s; these times are kept"
        )
    if times["equal"]:
        lines.append(
            f"{tc.number_format.number_of(times['equal'], 'sample')} came with the time of the one before; the "
            "commands that read the"
            " recording leave such out"
        )
    if off := _off(detail, seconds):
        lines.append(off)
    if times["pauses"]:
        lines.append(
            f"{tc.number_format.number_of(times['pauses'], 'pause')}, the longest of {times['longest_pause_s']:.6g} s"
        )
    if detail["damaged"]:
        more = (
            f", and {tc.number_format.number_of(detail['damaged'] - 1, 'more place')}" if detail["damaged"] > 1 else ""
        )
        lines.append(f"damaged: {detail['damage']}{more}; what is whole was taken")
    return lines
