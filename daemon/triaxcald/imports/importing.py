"""From a log that others recorded to a recording of ours; messages about it."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.decoded import DecodedStream, only_finite
from triaxcald.errors import InputError
from triaxcald.files import new_beside, require_new
from triaxcald.inputs import CALIBRATION, PROFILE
from triaxcald.recording import disk
from triaxcald.recording.schema import IMPORTED, PREVIEWS, PreviewTopic, preview_channels
from triaxcald.recording.writer import RecordingWriter
from triaxcald.software import versions
from triaxcald.utc import iso_time

# What is said of the times of a log, which stay as they are.

PAUSE_S = 1.0
PERIODS = 10
"""A pause is longer than this many periods, and than `PAUSE_S`."""


@dataclass
class Times:
    """Of records or samples, in their order."""

    period_ns: float
    first_ns: int | None = None
    latest_ns: int = 0
    back: int = 0  # those whose time is before that of one that came earlier
    furthest_back_ns: int = 0
    equal: int = 0  # those whose time is that of the one before
    pauses: int = 0
    longest_pause_ns: int = 0
    paused_ns: int = 0  # all pauses together

    def note(self, time_ns: int) -> None:
        if self.first_ns is None:
            self.first_ns = self.latest_ns = time_ns
            return
        step_ns = time_ns - self.latest_ns
        if step_ns < 0:
            self.back += 1
            self.furthest_back_ns = max(self.furthest_back_ns, -step_ns)
            return
        if step_ns == 0:
            self.equal += 1
        elif self.is_pause(step_ns):
            self.pauses += 1
            self.longest_pause_ns = max(self.longest_pause_ns, step_ns)
            self.paused_ns += step_ns
        self.latest_ns = time_ns

    def is_pause(self, step_ns: int) -> bool:
        return step_ns > max(PERIODS * self.period_ns, PAUSE_S * 1e9)

    @property
    def seconds(self) -> float:
        """From the first to the latest."""
        return 0.0 if self.first_ns is None else (self.latest_ns - self.first_ns) / 1e9

    def rate_hz(self, count: int) -> float | None:
        """Of so many samples in that time, without the pauses; None where that
        cannot be told."""
        steps, busy_s = count - 1 - self.pauses, self.seconds - self.paused_ns / 1e9
        return steps / busy_s if steps > 0 and busy_s > 0 else None

    def document(self) -> dict[str, float | int]:
        return {
            "back": self.back,
            "furthest_back_s": self.furthest_back_ns / 1e9,
            "equal": self.equal,
            "pauses": self.pauses,
            "longest_pause_s": self.longest_pause_ns / 1e9,
        }


class Ticks:
    """Times for a log that tells none: a period later each time the message
    that leads comes again."""

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self._lead: Hashable = None
        self._ticks = 0

    def of(self, key: Hashable, leads: bool) -> int:
        """``leads``: it may be the one, where it is the first of those."""
        if self._lead is None and leads:
            self._lead = key
        elif key == self._lead:
            self._ticks += 1
        return round(self._ticks * self._period_ns)


BATCH = 4096  # records; a quarter of an hour of a slow unit, 4 s of a fast one
BATCH_BYTES = 2**20  # of their data; a chunk of a recording may have 16 MiB
DRAINED_EACH = 32  # batches; the writer's queue has room for 256, and drops what comes beyond
COUNTED = ("missing", "duplicates", "incomplete", "errors", "malformed", "invalid", "not_finite")

Record = tuple[int, int, int, bytes]
"""Time, source, flags and bytes of a raw record."""


Describe = Callable[["Importing"], dict[str, Any]]
"""What the event has to say, of what came of the readings."""


@dataclass(frozen=True)
class Imported:
    """What came of it. ``document`` is the event in the recording; ``seconds``
    from the first sample to the last."""

    output: Path
    document: Mapping[str, Any]
    seconds: float


class Importing:
    """One recording being made of a log's records. ``times`` are those of the
    readings' samples, by their own stamps or counter."""

    def __init__(self, bundle: td.Bundle, writer: RecordingWriter) -> None:
        driver = td.driver_named(bundle.profile.driver)
        self.counts = dict.fromkeys(("samples", *COUNTED), 0)
        self.times = Times(1e9 / bundle.profile.sampling.rate_hz)
        self._writer = writer
        self.readings = DecodedStream(bundle, td.READINGS)
        self._decoders: dict[str, td.Decoder] = {
            name: self.readings if name == td.READINGS else driver.decoder(bundle, name)
            for name in bundle.profile.streams
        }
        self._batches = 0
        self.two_senders = False
        """Whether two units send on the readings' stream."""

    def take(self, records: Sequence[Record]) -> None:
        """Raises RecordingError."""
        batch = td.RawBatch.of(records)
        self._batches += 1
        if self._batches % DRAINED_EACH == 0:
            self._writer.drain()
        self._writer.raw(CALIBRATION, batch)
        for name, decoder in self._decoders.items():
            block = only_finite(decoder.feed(batch))
            if topic := _topic(name):
                self._writer.preview(topic, block)
            if name != td.READINGS:
                continue
            self.two_senders = self.two_senders or block.two_senders
            for what in COUNTED:
                self.counts[what] += getattr(block, what)
            self.counts["samples"] += len(block)
            for time_ns in block.time_ns.tolist():
                self.times.note(time_ns)


def _topic(stream: str) -> PreviewTopic | None:
    return next((topic for topic in PREVIEWS if topic.endswith(f"/{stream}")), None)


@dataclass
class _LogClock:
    """The writer's clock, at the log's time, so that a recording does not
    stretch from the log's day to today."""

    now_ns: int = 0

    def __call__(self) -> int:
        return self.now_ns


def write_recording(
    out: Path, bundle: td.Bundle, records: Iterator[Record], source: Path, describe: Describe
) -> tuple[dict[str, Any], float]:
    """Makes the recording ``out`` of all the records; its `imported` event, and
    the seconds that the samples cover.

    ``describe`` is called once all have been taken: it gives what the event has
    to say besides, or raises InputError where the log is not one unit's.
    Nothing is left then. Raises InputError, RecordingError, LogError.
    """
    require_new(out)
    disk.require_room(out)
    try:
        with new_beside(out) as temporary:
            temporary.unlink()
            return _write(temporary, out, bundle, records, source, describe)
    except OSError as e:
        raise InputError(f"{out}: cannot be written: {e.strerror}") from e


def _write(
    temporary: Path, out: Path, bundle: td.Bundle, records: Iterator[Record], source: Path, describe: Describe
) -> tuple[dict[str, Any], float]:
    batches = in_batches(records)
    first = next(batches, [])
    clock = _LogClock(max(0, first[0][0]) if first else 0)
    signs = bundle.profile.output.signs
    unit = {"name": bundle.profile.name, "serial": "", "signs": ",".join(map(str, signs)) if signs else ""}
    with RecordingWriter(
        temporary,
        metadata={"unit": unit, "software": versions(), "import": {"file": source.name}},
        preview_channels=preview_channels(bundle.profile),
        preview_unit=bundle.profile.output.unit,
        clock_ns=clock,
        provisional=True,
    ) as writer:
        writer.path = out  # what messages name
        writer.attach(PROFILE, "application/toml", bundle.text)
        for name, data in bundle.files.items():
            writer.attach(f"profile/{name}", "application/octet-stream", data)
        importing = Importing(bundle, writer)
        if first:
            importing.take(first)
        for batch in batches:
            importing.take(batch)
            clock.now_ns = max(clock.now_ns, batch[-1][0])
        detail = {
            **file_told(source),
            **describe(importing),
            "data_quality": importing.readings.faults(),
            "samples": importing.counts,
            "imported": iso_time(time.time_ns(), "seconds"),
        }
        writer.event(IMPORTED, detail)
    return detail, importing.times.seconds


def in_batches(records: Iterable[Record]) -> Iterator[list[Record]]:
    batch: list[Record] = []
    count = 0
    for record in records:
        batch.append(record)
        count += len(record[3])
        if len(batch) == BATCH or count >= BATCH_BYTES:
            yield batch
            batch, count = [], 0
    if batch:
        yield batch


def file_told(path: Path) -> dict[str, Any]:
    """Raises InputError."""
    try:
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            return {"file": path.name, "bytes": os.fstat(file.fileno()).st_size, "sha256": digest}
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e


# Messages about an import, in English.

_REMARKS = {
    "no_times": "the log tells no times: samples are laid at the profile's rate, from zero",
    "no_date": "the log has no date: times count from its start",
    "date_not_understood": (
        "a date of the log is not understood and not used ({unread_date}): {then}; in a text log "
        "write it as Thu May 16 18:16:50.884 2024, and import again"
    ),
    "date_without_zone": "the log's date names no time zone, and is taken for UTC",
    "times_added_up": "each time in the log is since the line before: they are added up",
    "channels_follow": "the messages come on one channel after another, as of a publisher started anew: all are taken",
    "two_senders": "two units send on the readings' stream, and their samples are mixed: they are no good for a fit",
    "stamp_stands_still": "the messages' own time stamp stands still: times are those at which they were logged",
}
RATE_OFF = 1.1
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
    if not by_log or "no_times" in detail["remarks"] or by_log / RATE_OFF < seconds < by_log * RATE_OFF:
        return ""
    return (
        f"the samples last {seconds:.2f} s by their own time, which is their counter at the profile's"
        f" sampling.rate_hz, or their stamps, and {by_log:.2f} s by the log's times"
    )


def remarks(detail: Mapping[str, Any], seconds: float) -> list[str]:
    """What a reader of the recording ought to know, a line each; ``seconds``
    are those that the samples cover."""
    known = "date_without_zone" in detail["remarks"]
    then = "times go on from the date before" if known else "times count from the start of the log"
    lines = [_REMARKS[name].format(unread_date=detail.get("unread_date"), then=then) for name in detail["remarks"]]
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
    lines += detail.get("data_quality", [])
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
