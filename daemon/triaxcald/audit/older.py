"""Recordings from before there were outcomes, and recordings that were made to look like them."""

from __future__ import annotations

import json

from triaxcald.audit.differences import Difference, Kind
from triaxcald.audit.results import Digests
from triaxcald.outcome import ATTACHMENT, FORMAT
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import END_RECORD, FORMAT_RECORD, RAW_RECORD
from triaxcald.station.line import CERTIFICATE
from triaxcald.station.write_back import VERIFICATION_FILE


def turned_back(recording: Recording, raw: Digests) -> list[Difference]:
    """Whether a recording that does not say in what it ends was made to end with an outcome: the digests in it are of
    that too."""
    stored = {
        raw.whole.were_it(FORMAT): recording.metadata.get(RAW_RECORD, {}).get("sha256"),
        raw.calibration.were_it(FORMAT): _digest_in(recording, CERTIFICATE, "recording", "raw_sha256"),
        raw.verification.were_it(FORMAT): _digest_in(recording, VERIFICATION_FILE, "raw_sha256"),
    }
    left = ATTACHMENT in recording.attachments or END_RECORD in recording.metadata
    if left or any(digest == said for digest, said in stored.items()):
        return [Difference(FORMAT_RECORD, Kind.TURNED_BACK, stored=FORMAT)]
    return []


def _digest_in(recording: Recording, name: str, *path: str) -> object:
    try:
        found = json.loads(recording.attachments[name])
        for key in path:
            found = found[key]
    except (LookupError, ValueError, TypeError, RecursionError):
        return None
    return found
