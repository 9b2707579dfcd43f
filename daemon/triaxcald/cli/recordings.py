"""log."""

from __future__ import annotations

import argparse
import dataclasses
import io
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.cli.console import emit, say, show
from triaxcald.cli.syntax import writable
from triaxcald.decoded import DecodedStream, beside_samples
from triaxcald.errors import InputError
from triaxcald.files import is_stream, new_file, require_new, require_recording
from triaxcald.imports.importing import left_out, remarks, summary
from triaxcald.imports.opening import DRIVERS, opened_log
from triaxcald.inputs import bundle_of, losses_of, samples_of
from triaxcald.recording.info import describe
from triaxcald.recording.reader import Contents, open_recording
from triaxcald.recording.recover import recover
from triaxcald.tables.native_csv import Rows, write_csv


def info_command(a: argparse.Namespace) -> int:
    document = describe(a.recording, count=a.count)
    if "bus" not in document:  # beside the raw records of which they are made
        items = list(document.items())
        after = list(document).index("raw") + 1
        samples = _samples(a.recording, document["raw"]) if document["counted"] else None
        document = dict([*items[:after], ("samples", samples), *items[after:]])
    if a.json:
        emit(document)
    else:
        _show(document)
    return 0


def _samples(path: Path, phases: Iterable[str]) -> dict[str, Any]:
    """`samples_of`, or the ``fault`` of an unusable profile."""
    try:
        with open_recording(path, unfinished=True) as recording:
            return samples_of(recording, phases)
    except (InputError, td.DriverError) as e:
        return {"fault": str(e)}


def _show(value: Any, indent: str = "") -> None:
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(inner, (dict, list)) and inner:
            show(f"{indent}{key}:")
            _show(inner, indent + "  ")
        else:
            show(f"{indent}{key}: {'—' if inner in (None, {}, []) else inner}")


def recover_command(a: argparse.Namespace) -> int:
    out = a.output or a.recording.with_suffix(".recovered" + a.recording.suffix)
    recovery = recover(a.recording, out)
    if a.json:
        emit({"format": "triaxcal.recovery/1", "output": str(out), **dataclasses.asdict(recovery)})
    else:
        show(f"{out}: written")
        _show(dataclasses.asdict(recovery), "  ")
    return 0


def _opened(path: Path) -> AbstractContextManager[BinaryIO]:
    """A file that was not there, or a pipe or device as it is. Raises
    OSError."""
    return open(path, "wb") if is_stream(path) else new_file(path)


def delete_command(a: argparse.Namespace) -> int:
    from triaxcald.run.attempts import recordings_under_way
    from triaxcald.signing.deletion import delete
    from triaxcald.station.config import load_station

    station = load_station(a.station)
    deleted: list[str] = []
    try:
        for path in delete(station, a.recordings, a.reason, recordings_under_way(station.folder)):
            deleted.append(str(path))
            if not a.json:
                show(f"{path}: deleted")
    except BaseException:
        if a.json and deleted:  # and the next one could not be
            emit({"format": "triaxcal.deletion/1", "deleted": deleted})
        raise
    if a.json:
        emit({"format": "triaxcal.deletion/1", "deleted": deleted})
    return 0


def _rows(recording: Contents, stream: DecodedStream, phase: str) -> Iterator[Rows]:
    """The stream's samples in the phase. Raises InputError, before anything is
    written, where there are none."""
    blocks = (Rows.of(stream.rising(batch)) for batch in recording.raw(phase))
    first = next((block for block in blocks if len(block)), None)
    if first is not None:
        return chain([first], blocks)
    phases = recording.phases()
    if phase not in phases:
        raise InputError(f"--phase {phase}: {recording.name} has {', '.join(phases) or 'no raw records of any phase'}")
    counted = [*beside_samples(stream.counts), *losses_of(recording)]
    why = f" ({', '.join(counted)})" if counted else ""
    raise InputError(
        f"--stream {stream.stream}: {recording.name} has no sample of it in its phase {phase}{why}; samples:"
        f" {_there(samples_of(recording, phases))}"
    )


def _there(samples: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """Which streams have samples in which phases, of what `samples_of` gives."""
    shown = [f"{phase} {name}" for phase, of in samples.items() for name, found in of.items() if found["samples"]]
    return ", ".join(shown) or "none of any stream"


def export_command(a: argparse.Namespace) -> int:
    with open_recording(a.recording) as recording:
        bundle = bundle_of(recording)
        if a.stream not in bundle.profile.streams:
            raise InputError(f"--stream {a.stream}: the recording has {', '.join(bundle.profile.streams)}")
        stream = DecodedStream(bundle, a.stream)
        blocks = _rows(recording, stream, a.phase)
        if a.output is None:
            rows = write_csv(sys.stdout, blocks)
        else:
            try:
                with _opened(a.output) as file, io.TextIOWrapper(file, "utf-8") as out:
                    rows = write_csv(out, blocks)
            except OSError as e:
                raise InputError(f"{a.output}: cannot be written: {e.strerror}") from e
        lost = beside_samples(stream.counts) + losses_of(recording)
    say(f"{tc.number_format.number_of(rows, 'sample')}; {', '.join(lost) or 'none lost'}")
    return 0


# log import.


def import_command(a: argparse.Namespace) -> int:
    writable(a.output)
    require_new(a.output)
    require_recording(a.output)
    bundle = td.load_bundle(a.profile)
    driver = bundle.profile.driver
    if driver not in DRIVERS:
        raise InputError(f"{a.profile}: driver '{driver}' has no logs that can be imported, expected can or mcap")
    if driver == "mcap" and a.node is not None:
        raise InputError("--node: of a CAN bus; the profile's driver is 'mcap'")
    with opened_log(a.log, driver) as log:
        if driver == "can":
            from triaxcald.imports.of_can import import_can  # each with what it needs alone

            made = import_can(log, bundle, a.output, node=a.node, channel=a.channel)
        else:
            from triaxcald.imports.of_mcap import import_mcap

            made = import_mcap(log, bundle, a.output, channel=a.channel)
    for line in (left_out(made.document), *remarks(made.document, made.seconds)):
        if line:
            say(line)
    if a.json:
        emit({"format": "triaxcal.import/1", "output": str(a.output), "duration_s": made.seconds, **made.document})
    else:
        show(summary(a.output, made.document, made.seconds))
    return 0
