"""Frames of a bus that triaxcal itself recorded, as those of any log."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.recording.bus import frame_rows, is_of_bus
from triaxcald.recording.manifest import is_manifest
from triaxcald.recording.schema import PROFILE
from triaxcald.recording.series import open_recording

_PROFILE = slice(len(td.logs.MCAP) + 13, len(td.logs.MCAP) + 13 + len(PROFILE))
"""Of an MCAP file, behind its header's type and length and its own."""


def is_own(path: Path) -> bool:
    """Whether it is a recording of ours, or the manifest of one in segments.
    Raises InputError where such a one is packed."""
    if is_manifest(path):
        return True
    try:
        with td.files.open_file(path) as file:
            head = file.read(_PROFILE.stop)
            packed = head.startswith(b"\x1f\x8b")
            if packed:
                file.seek(0)
                head = gzip.GzipFile(fileobj=file).read(_PROFILE.stop)
    except (OSError, EOFError, zlib.error):
        return False
    own = head.startswith(td.logs.MCAP) and head[_PROFILE] == PROFILE.encode()
    if own and packed:
        raise InputError(f"{path}: a recording of triaxcal, packed with gzip; unpack it first")
    return own


def own_log(path: Path) -> td.logs.Log:
    """Its frames raise RecordingError, InputError."""

    def frames(_: BinaryIO, account: td.logs.Account) -> Iterator[td.logs.LoggedFrame]:
        with open_recording(path) as recording:
            if not is_of_bus(recording):
                raise InputError(f"{path}: a recording of one unit already, expected one of all frames of a bus")
            for row in frame_rows(recording):
                yield td.logs.LoggedFrame(*row)

    return td.logs.Log(str(path), td.logs.Kind("triaxcal", frames), io.BytesIO())
