"""Recordings from before there were outcomes, those made to look like them, and
those whose effects a search named."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from triaxcal_drivers.profile import Profile
from triaxcald.audit.differences import Difference, Kind
from triaxcald.audit.results import Digests
from triaxcald.certificate import Certified, over_limits, verdict_of
from triaxcald.outcome import ATTACHMENT, FORMAT
from triaxcald.provision.image import image_of
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import END_RECORD, FORMAT_RECORD, RAW_RECORD
from triaxcald.run.line import CERTIFICATE
from triaxcald.run.write_back import VERIFICATION_FILE
from triaxcald.station.config import Limits


def turned_back(recording: Recording, raw: Digests) -> list[Difference]:
    """Whether a recording that does not say in what it ends was made to end
    with an outcome: the digests in it are of that too."""
    stored = {
        raw.whole.were_it(FORMAT): recording.metadata.get(RAW_RECORD, {}).get("sha256"),
        raw.calibration.were_it(FORMAT): _digest_in(recording, CERTIFICATE, "recording", "raw_sha256"),
        raw.verification.were_it(FORMAT): _digest_in(recording, VERIFICATION_FILE, "raw_sha256"),
    }
    left = ATTACHMENT in recording.attachments or END_RECORD in recording.metadata
    if left or any(digest == said for digest, said in stored.items()):
        return [Difference(FORMAT_RECORD, Kind.TURNED_BACK, stored=FORMAT)]
    return []


SEARCHED = ("result", "registers")
"""Of a certificate: what rests on the search for effects that there was before
the posterior."""
OF_A_POSE = ("start_s", "end_s", "mean")
"""What a pose is whatever acts."""


def as_searched(certified: Certified, stored: Mapping[str, Any], profile: Profile, limits: Limits) -> Certified:
    """With what the search of an earlier version made of the poses, which
    nobody can make again. Poses, the words of the registers and the verdict are
    made again from that. Raises LookupError, TypeError or ValueError where the
    ``stored`` certificate lacks a part, and DriverError for words that the
    profile does not have."""
    document = {**certified.document, **{key: stored[key] for key in SEARCHED}}
    poses = certified.document["result"]["calibration"]["poses"]
    said = stored["result"]["calibration"]
    again = poses
    if len(said["poses"]) == len(poses):
        again = [{**p, **{key: q[key] for key in OF_A_POSE}} for p, q in zip(said["poses"], poses, strict=True)]
    counts = document["recording"]
    if "malformed" not in stored["recording"]:  # they were counted as errors
        document["recording"] = counts | {"errors": counts["errors"] + counts.get("malformed", 0)}
    document["result"] = {**stored["result"], "calibration": {**said, "poses": again}}
    outside = over_limits(stored["result"]["after"], limits)
    document |= {"outside": outside, "verdict": verdict_of(outside, limits)}
    registers = stored["registers"]
    image = None
    if registers is not None:
        words = {w["register"]: profile.encode(w["register"], w["wanted"]) for w in registers["words"]}
        again = [{**w, "raw": words[w["register"]].hex()} for w in registers["words"]]
        document["registers"] = {**registers, "words": again}
        image = image_of(profile, words)
    return replace(certified, document=document, image=image, within_limits=not outside)


def _digest_in(recording: Recording, name: str, *path: str) -> object:
    try:
        found = json.loads(recording.attachments[name])
        for key in path:
            found = found[key]
    except (LookupError, ValueError, TypeError, RecursionError):
        return None
    return found
