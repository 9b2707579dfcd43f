"""The files that lie beside a recording."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import triaxcal_drivers as td
from triaxcald.audit.differences import Difference, Kind
from triaxcald.outcome import ATTACHMENT, CERTIFICATE, REPORT, SUFFIX, digest_of
from triaxcald.recording.mcap_records import ATTACHMENT_LIMIT
from triaxcald.recording.schema import SIGNATURE_FILE

NAMES = (CERTIFICATE, REPORT, SIGNATURE_FILE, ATTACHMENT)


def beside(path: td.files.AnyPath, held: Mapping[str, bytes]) -> tuple[list[Difference], list[str]]:
    """Files that are otherwise than in the recording, and names of those that
    are not there."""
    differences, missing = [], []
    for name in NAMES:
        file = path.with_suffix(f".{name}")
        try:
            data = _read(file)
        except OSError:
            missing += [file.name] if name in held else []
            continue
        if name not in held:
            differences.append(Difference(file.name, Kind.ALONE))
        elif data != held[name]:
            differences.append(Difference(file.name, Kind.BESIDE))
    return differences, missing


def outcomes_beside(path: td.files.AnyPath) -> set[str]:
    """Digests of the outcomes in the recording's folder."""
    found = set()
    for file in path.parent.glob(f"*{SUFFIX}"):
        with suppress(OSError):
            found.add(digest_of(_read(file)))
    return found


def _read(file: td.files.AnyPath) -> bytes:
    with td.files.open_file(file) as stream:
        return stream.read(ATTACHMENT_LIMIT + 1)
