"""Deletes recordings of a station that signs. The chain then says why they are gone."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from triaxcald.errors import DiskError, InputError, RecordingError
from triaxcald.outcome import ATTACHMENT, CERTIFICATE, REPORT
from triaxcald.recording.reader import Recording
from triaxcald.recording.reader import digest_of as file_digest
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.recording.survey import survey
from triaxcald.signing import chain
from triaxcald.signing.envelope import NotAnEnvelope, parse_envelope
from triaxcald.signing.manifest import claims_in, manifest
from triaxcald.signing.station import signing_of
from triaxcald.station.config import Station


def delete(
    station: Station, recordings: Sequence[Path], reason: str, under_way: Collection[str] = ()
) -> Iterator[Path]:
    """Delete each recording with its certificate, report and signature, after its
    tombstone is in the chain; the outcome stays. Each is given when it is gone.
    ``under_way`` are names of recordings of runs that have not ended. Raises
    InputError, RecordingError before anything is deleted if the station has no key, or
    a recording is not in its folder, not finished or of a run under way; NotSigned,
    DiskError, InputError where a deletion fails."""
    signing = signing_of(station)
    if signing is None:
        raise InputError(f"{station.path}: the station has no key; `triaxcal keys new` makes one")
    folder = station.folder.resolve()
    for path in recordings:
        if path.suffix != ".mcap" or not path.is_file():
            raise InputError(f"{path}: no recording")
        if not path.resolve().is_relative_to(folder):
            raise InputError(f"{path}: not in the station's folder, {station.folder}")
        if path.name in under_way:
            raise InputError(f"{path}: of a run that has not ended; the next start settles one that was killed")
        if not _is_finished(path):
            raise InputError(f"{path}: is being written, or was cut short; `triaxcal log recover` mends such a file")
    chosen = list({path.resolve(): path for path in reversed(recordings)}.values())[::-1]  # as first named
    lines = _lines(signing.folder)
    digests = {path: _digest(path, lines) for path in chosen}  # all can be read
    for path, digest in digests.items():
        try:
            signing.bury(digest, path.name, reason)
        except OSError as e:
            raise DiskError(f"{path}: not deleted: {signing.folder / chain.NAME}: {e.strerror}") from e
        for file in (*(path.with_suffix(f".{name}") for name in (CERTIFICATE, REPORT, SIGNATURE_FILE)), path):
            try:
                file.unlink(missing_ok=True)
            except OSError as e:
                raise InputError(f"{file}: cannot be deleted: {e.strerror}") from e
        yield path


def _is_finished(path: Path) -> bool:
    """Whether it has its end; a damaged one may have it and cannot be read."""
    if not path.stat().st_size:
        return False
    try:
        with Recording.open(path, unfinished=True) as recording:
            return recording.finished
    except RecordingError:
        return True


def _lines(folder: Path) -> Mapping[str, str | None]:
    """Names of recordings by the digests of their lines in the chain."""
    found: dict[str, str | None] = {}
    with suppress(InputError, NotAnEnvelope):
        for line in chain.read_lines(folder / chain.NAME):
            entry = chain.entry_of(line)
            if entry.kind is chain.EntryKind.RECORDING:
                found[entry.digest] = entry.recording
    return found


def _digest(path: Path, lines: Mapping[str, str | None]) -> str:
    """As a tombstone has it: of what was signed if this is the recording that was
    signed, under its name and with its line in the chain; else of the file. An
    envelope of another recording would bury that one. Raises RecordingError."""
    with suppress(RecordingError, NotAnEnvelope, LookupError, ValueError):
        with Recording.open(path) as recording:
            envelope = parse_envelope(recording.attachments[SIGNATURE_FILE])
            contents = survey(recording, ATTACHMENT).sealed
        digest = chain.digest_of(envelope.payload)
        if contents is not None and digest in lines and lines[digest] == path.name:
            said = manifest(contents, claims_in(envelope))
            if said == envelope.payload and chain.recording_in(contents) == path.name:
                return digest
    return file_digest(path)
