"""Recordings, ours or as text, as still poses: what every measuring command
begins with."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.decoded import DecodedStream
from triaxcald.documents import TooManyContainers, json_value
from triaxcald.errors import InputError, RecordingError
from triaxcald.provision.correction import from_attachments, removed_from, samples_before
from triaxcald.provision.identity import same_serial
from triaxcald.raw_to_poses import Pipeline, of_poses, together
from triaxcald.recording.bus import require_of_unit
from triaxcald.recording.reader import Contents, is_recording, open_recording
from triaxcald.recording.schema import CALIBRATION as CALIBRATION
from triaxcald.recording.schema import ODDS_FILE, PROFILE_FILE, RECOVERY_RECORD, STATION_FILE, UNCONFIRMED, Phase
from triaxcald.recording.schema import VERIFICATION as VERIFICATION
from triaxcald.station.config import parse_station
from triaxcald.stores import path_of
from triaxcald.tables.naming import ERRORS
from triaxcald.tables.samples import Reading, Table, read_table
from triaxcald.work import RECORD as WORK_RECORD

DOCUMENT_MOST = 4 * 2**20  # bytes of a JSON document; one of a thousand poses has one or two million
PROFILE = PROFILE_FILE
UNKNOWN_NOISE = "unknown_noise"


@dataclass(frozen=True)
class Measured:
    """The still poses of a recording. ``windows`` are for pictures.
    ``too_short`` says why no pose could be among the samples, if so;
    ``unconfirmed`` that most of what was recorded is not used, and why.

    ``profile``, ``signs`` of the scale factors and ``reference`` are what the
    recording was made with, where it says; ``unit`` is its name and serial;
    ``output_unit`` what the header of a table says. ``remarks`` say how a table
    was read. ``at_start`` are the registers by which the device corrected the
    readings; the poses are of the readings before that. ``parted`` gives the same
    for another ``turn_s``, as for `find_spans`; None where poses are all that was read.
    ``odds`` is the file of learned odds that a `run` had, ``part_number`` the unit's.
    """

    name: str
    poses: list[tc.Pose]
    windows: tc.poses.Windows | None
    data_quality: list[str]
    profile: td.Profile | None = None
    signs: tuple[int, int, int] | None = None
    reference: float | None = None
    unit: Mapping[str, str] | None = None
    stated: tc.Stated | None = None
    holds_at: tc.Moment | float | None = None
    at_start: Mapping[str, bytes] | None = None
    output_unit: str = ""
    remarks: tuple[str, ...] = ()
    too_short: tc.TooShort | None = None
    unconfirmed: str = ""
    parted: Callable[[float | None], Measured] | None = None
    odds: bytes | None = None
    part_number: str | None = None


def measure(
    name: str,
    *,
    phase: Phase = CALIBRATION,
    stream: str = td.READINGS,
    moments: tc.inputs.Moments | None = None,
    reading: Reading | None = None,
    turn_s: float | None = None,
) -> Measured:
    """``name`` is a path to an `.mcap`, to the manifest of a recording in
    segments, to a text table or a Parquet file, or `-`; ``reading`` says how a
    table is to be read. Raises InputError, RecordingError.

    ``moments`` are fed all raw samples and their temperature on the way, block
    by block: of a unit that turns, where what turns slowly enough would pass
    for a pose that creeps. ``turn_s``: the unit may turn in place, as for
    `find_spans`.
    """
    if is_recording(name):
        with open_recording(path_of(name)) as recording:
            return _measure_recording(recording, phase, stream, moments, turn_s)
    table = read_table(name, reading)
    samples = table.samples
    if reading is not None and reading.pose_means:
        return _of_means(name, table)
    finder = tc.poses.PoseFinder()
    try:
        finder.feed(samples.time_ns, samples.readings, samples.channels)
        finder.finish()
        if finder.windows is None and (too_short := finder.too_short()) is not None:
            raise too_short
        if moments is not None:
            moments.feed(samples.readings, samples.channels.get(tc.effects.TEMPERATURE))
    except tc.InvalidData as e:
        raise InputError(f"{name}: {e}") from e
    counted = {"rate": table.wrong_rate} if table.wrong_rate else {}
    counted |= {"duplicate_samples": str(samples.duplicates)} if samples.duplicates else {}
    read = Measured(
        name, [], finder.windows, [], output_unit=table.output_unit, remarks=table.remarks, too_short=finder.too_short()
    )

    def parted(turn_s: float | None) -> Measured:
        finder.part_by(turn_s)
        poses = finder.poses()
        quality = together(counted, finder.findings())
        quality += [] if moments is not None else of_poses(poses, table.output_unit)
        return replace(read, poses=poses, data_quality=quality, parted=parted)

    return parted(turn_s)


def require_same_outputs(calibration: tc.Calibration, name: str, unit: str) -> None:
    """Raises InputError where the outputs of the recording ``name`` are in
    another ``unit`` than those that were calibrated, as far as both say."""
    if unit and calibration.output_unit and not tc.units.same_unit(unit, calibration.output_unit):
        raise InputError(
            f"{name}: outputs in {unit}, and the calibration is of outputs in {calibration.output_unit}; "
            "nothing is converted; --output-unit is for a table that states a wrong unit"
        )


def _of_means(name: str, table: Table) -> Measured:
    """Raises InputError, Refused."""
    held = dict(table.samples.channels)
    columns = [held.pop(error, None) for error in ERRORS]
    errors = [c for c in columns if c is not None]
    if errors and len(errors) < len(columns):
        raise InputError(f"{name}: standard errors for {len(errors)} outputs, expected {', '.join(ERRORS)} or none")
    try:
        poses = tc.estimate.poses_of_means(
            table.samples.readings, table.samples.time_ns * 1e-9, np.stack(errors, axis=1) if errors else None, held
        )
    except tc.InvalidData as e:
        raise InputError(f"{name}: {e}") from e
    quality = [] if errors else [f"{UNKNOWN_NOISE}: told from the residuals, so that no lack of fit can show"]
    return Measured(name, poses, None, quality, output_unit=table.output_unit, remarks=table.remarks)


def _measure_recording(
    recording: Contents, phase: Phase, stream: str, moments: tc.inputs.Moments | None, turn_s: float | None
) -> Measured:
    bundle = bundle_of(recording)
    pipeline = Pipeline(bundle, stream, turn_s=turn_s)
    at_start = from_attachments(recording.attachments, recording.name)
    used = 0
    for batch in recording.raw(phase):
        used += len(batch)
        block = pipeline.rising(batch)
        if moments is not None:
            block = samples_before(bundle.profile, block, at_start)
            moments.feed(block.readings, block.channels.get(tc.effects.TEMPERATURE))
    pipeline.close()
    lost = losses_of(recording)
    signs = signs_of(recording) or bundle.profile.output.signs
    station = None
    if STATION_FILE in recording.attachments:
        where = f"{recording.name}: {STATION_FILE}"
        station = parse_station(recording.attachments[STATION_FILE], where=where)
    stated = tc.Stated(thermal_sensitivity=bundle.profile.output.thermal_sensitivity_per_k)
    reference, at = None, None
    if station is not None:
        reference, stated, at = station.reference, station.stated(bundle.profile), station.moment
    meant = recording.metadata.get("unit", {})
    unit = {"name": meant.get("name", ""), "serial": meant["serial"]} if meant.get("serial") else None
    read = Measured(
        recording.name, [], pipeline.windows, [], bundle.profile, signs, reference, unit, stated, at, at_start,
        too_short=pipeline.too_short(), unconfirmed=_mostly_unconfirmed(recording, phase, used),
        odds=recording.attachments.get(ODDS_FILE),
        part_number=recording.metadata.get(WORK_RECORD, {}).get("part_number") or None,
    )  # fmt: skip

    def parted(turn_s: float | None) -> Measured:
        poses = pipeline.parted(turn_s)
        if stream == td.READINGS and phase == CALIBRATION:
            poses = removed_from(bundle.profile, poses, at_start)
        quality = (
            pipeline.data_quality() + lost + ([] if moments is not None else of_poses(poses, pipeline.output_unit))
        )
        return replace(read, poses=poses, data_quality=quality, parted=parted)

    return parted(turn_s)


def require_unit(document: Mapping[str, Any], measured: Measured, *, where: str) -> None:
    """Raises InputError where a calibration document, ``where``, is of another
    unit than the recording."""
    held = document.get("unit")
    theirs, ours = held.get("serial") if isinstance(held, Mapping) else None, (measured.unit or {}).get("serial")
    if theirs and ours and not (isinstance(theirs, str) and same_serial(theirs, ours)):
        raise InputError(f"{where}: unit.serial is {theirs}; {measured.name} is of {ours}")


def signs_of(recording: Contents) -> tuple[int, int, int] | None:
    """Of the scale factors, as the station that made the recording had them."""
    parts = recording.metadata.get("unit", {}).get("signs", "").split(",")
    if len(parts) != 3 or any(p not in ("1", "-1") for p in parts):
        return None
    return int(parts[0]), int(parts[1]), int(parts[2])


def losses_of(recording: Contents) -> list[str]:
    """What did not get into the recording, was lost from it since, or is not used,
    one line each."""
    lost = sum(loss.records for loss in recording.losses())
    found = [f"missing_samples: {_were(lost)} lost between bus and disk"] if lost else []
    mended = recording.metadata.get(RECOVERY_RECORD, {})
    counts = (mended.get(key, "") for key in ("raw_missing", "raw_dropped"))
    missing = sum(int(count) for count in counts if count.isdecimal())
    if missing:
        found.append(f"missing_samples: {_were(missing)} lost when the recording was damaged")
    if unconfirmed := recording.unconfirmed_records():
        found.append(f"unconfirmed_records: {text.unconfirmed(unconfirmed)}")
    return found


def _mostly_unconfirmed(recording: Contents, phase: Phase, used: int) -> str:
    """Why most records of the phase are not used, of which ``used`` are; empty
    where most are: what else is wrong with them may matter more then."""
    if not recording.any_unconfirmed:
        return ""
    unconfirmed = sum(len(b) for name, b in recording.joined_batches() if b.unconfirmed and name == phase)
    if unconfirmed <= used:
        return ""
    told = [
        e.detail.get("error") for e in recording.events() if e.kind == UNCONFIRMED and isinstance(e.detail, Mapping)
    ]
    return text.mostly_unconfirmed(unconfirmed, unconfirmed + used, str(told[-1]) if told and told[-1] else "")


def _were(records: int) -> str:
    return f"{tc.number_format.number_of(records, 'record')} {'was' if records == 1 else 'were'}"


def samples_of(recording: Contents, phases: Iterable[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Of each phase, and each stream of the profile that came in it: how many
    ``samples`` in how many ``seconds`` of their own time, and whatever else was
    counted. Raises InputError, ProfileError, DriverMissing."""
    bundle = bundle_of(recording)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for phase in phases:
        streams = {name: DecodedStream(bundle, name) for name in bundle.profile.streams}
        for batch in recording.raw(phase):
            for stream in streams.values():
                stream.feed(batch)
        found[phase] = {
            name: {
                "samples": stream.counts["samples"],
                "seconds": round(stream.seconds, 9),
                **{kind: n for kind, n in stream.counts.items() if n and kind != "samples"},
            }
            for name, stream in streams.items()
            if any(stream.counts.values())
        }
    return found


def bundle_of(recording: Contents) -> td.Bundle:
    """The profile that a recording carries. Raises RecordingError."""
    require_of_unit(recording)
    try:
        text = recording.attachments[PROFILE]
    except KeyError:
        raise RecordingError(f"{recording.name}: attachment {PROFILE}: missing; not a recording of a station") from None
    files = {n.removeprefix("profile/"): d for n, d in recording.attachments.items() if n.startswith("profile/")}
    return td.parse_bundle(text, files, where=f"{recording.name}: {PROFILE}")


def read_document(path: str) -> Mapping[str, Any]:
    """A JSON document. Raises InputError with the line at fault."""
    return parse_document(document_bytes(path), where=path)


def document_bytes(path: str) -> bytes:
    """Of the file that is to be a JSON document. Raises InputError."""
    try:
        return td.files.read_whole(path_of(path), DOCUMENT_MOST, pipe=True)
    except td.files.TooLarge as e:
        _require_no_other_kind(e.head, path)
        raise InputError(f"{path}: {e.strerror}") from e
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e


def _require_no_other_kind(data: bytes, where: str) -> None:
    if known := td.files.special_kind(data, json=False):
        raise InputError(f"{where}: {known}, expected a JSON document, such as a calibration")


def parse_document(data: bytes, *, where: str) -> Mapping[str, Any]:
    """An object of JSON in which no key is given twice. Raises InputError with
    the line at fault, or with what the data are where they are of another
    kind."""
    _require_no_other_kind(data, where)
    try:
        document = json_value(data)
        if b"\\u" in data:
            json.dumps(document, ensure_ascii=False).encode()
    except TooManyContainers as e:
        raise InputError(f"{where}: {e}, expected a JSON document") from e
    except json.JSONDecodeError as e:
        raise InputError(f"{where}, line {e.lineno}: not JSON: {e.msg}; expected a JSON document") from e
    except RecursionError as e:
        raise InputError(f"{where}: not JSON: nested too deeply") from e
    except UnicodeDecodeError as e:
        raise InputError(f"{where}: not UTF-8 text (byte {e.start}), expected a JSON document") from e
    except UnicodeEncodeError as e:
        raise InputError(f"{where}: half of a surrogate pair, which is no character") from e
    except ValueError as e:  # a number of thousands of digits, a key given twice
        raise InputError(f"{where}: not JSON that can be read: {e}") from e
    if not isinstance(document, dict):
        raise InputError(f"{where}: expected a JSON object")
    return document
