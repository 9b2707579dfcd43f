"""The files that lie beside a recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from triaxcald.audit.differences import Difference, Kind
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording.frames import ATTACHMENT_LIMIT
from triaxcald.station.line import CERTIFICATE, REPORT

NAMES = (CERTIFICATE, REPORT, ATTACHMENT)


def beside(path: Path, held: Mapping[str, bytes]) -> tuple[list[Difference], list[str]]:
    """Files that are otherwise than in the recording, and names of those that are not there."""
    differences, missing = [], []
    for name in NAMES:
        file = path.with_suffix(f".{name}")
        try:
            with open(file, "rb") as stream:
                data = stream.read(ATTACHMENT_LIMIT + 1)
        except OSError:
            missing += [file.name] if name in held else []
            continue
        if name not in held:
            differences.append(Difference(file.name, Kind.ALONE))
        elif data != held[name]:
            differences.append(Difference(file.name, Kind.BESIDE))
    return differences, missing
