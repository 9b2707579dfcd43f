"""Deletes recordings of a station that signs. The chain then says why they are gone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from triaxcald.errors import InputError
from triaxcald.outcome import CERTIFICATE, REPORT
from triaxcald.recording.reader import digest_of as file_digest
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.signing import chain
from triaxcald.signing.station import signing_of
from triaxcald.station.config import Station


def delete(station: Station, recordings: Sequence[Path], reason: str) -> list[Path]:
    """Delete each recording with its certificate, report and signature, after its
    tombstone is in the chain; the outcome stays. Raises InputError before anything is
    deleted if the station has no key or a recording is not in its folder; NotSigned."""
    signing = signing_of(station)
    if signing is None:
        raise InputError(f"{station.path}: the station has no key; `triaxcal keys new` makes one")
    folder = station.folder.resolve()
    for path in recordings:
        if path.suffix != ".mcap" or not path.is_file():
            raise InputError(f"{path}: no recording")
        if not path.resolve().is_relative_to(folder):
            raise InputError(f"{path}: not in the station's folder, {station.folder}")
    for path in recordings:
        signing.bury(_digest(path), path.name, reason)
        for file in (*(path.with_suffix(f".{name}") for name in (CERTIFICATE, REPORT, SIGNATURE_FILE)), path):
            try:
                file.unlink(missing_ok=True)
            except OSError as e:
                raise InputError(f"{file}: cannot be deleted: {e.strerror}") from e
    return list(recordings)


def _digest(path: Path) -> str:
    """As a tombstone has it. Raises InputError."""
    envelope = chain.envelope_in(path)
    if envelope is not None:
        return chain.digest_of(envelope.payload)
    return file_digest(path)
