"""Recomputes a recording's result from the recording alone and compares it with the one stored in it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triaxcal.errors import TriaxcalError
from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald.certificate import certify, software
from triaxcald.documents import to_text
from triaxcald.errors import RecordingError
from triaxcald.inputs import CALIBRATION, STATION_FILE, VERIFICATION, bundle_of, losses_of, signs_of
from triaxcald.pipeline import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import RECOVERY_RECORD, Phase, RawDigest
from triaxcald.station.config import parse_station
from triaxcald.station.line import CERTIFICATE
from triaxcald.station.write_back import REGISTERS_AFTER, VERIFICATION_FILE
from triaxcald.verification import verification_document, verified

MOST = 8
"""So many differences are listed, the others counted."""
_NOTHING = object()


@dataclass(frozen=True)
class Audit:
    """``differences`` one line each; none means that everything comes out the same, byte for byte.

    ``notes`` are what an auditor should know and what is no difference: other versions of the software, losses.
    """

    recording: str
    checked: tuple[str, ...]
    differences: tuple[str, ...]
    notes: tuple[str, ...] = ()


def audit(path: Path) -> Audit:
    """Raises RecordingError where the file cannot be read, or holds no result."""
    with Recording.open(path) as recording:
        held = recording.attachments
        for name in (STATION_FILE, CERTIFICATE):
            if name not in held:
                raise RecordingError(f"{path}: attachment {name}: missing; the recording holds no result to audit")
        return _audit(str(path), recording)


def _audit(name: str, recording: Recording) -> Audit:
    bundle = bundle_of(recording)
    station_text = recording.attachments[STATION_FILE]
    station = parse_station(station_text, where=f"{name}: {STATION_FILE}")
    unit = recording.metadata.get("unit", {})
    checked, differences = [CERTIFICATE], []

    def replay(phase: Phase, streams: tuple[str, ...]) -> tuple[dict[str, Pipeline], RawDigest]:
        pipelines = {s: Pipeline(bundle, s) for s in streams if s in bundle.profile.streams}
        digest = RawDigest(recording.ends_with)
        for batch in recording.raw(phase):
            digest.update(phase, batch)
            for pipeline in pipelines.values():
                pipeline.feed(batch)
        return pipelines, digest

    tumble, digest = replay(CALIBRATION, (READINGS, CORRECTED))
    try:
        signs = signs_of(recording)
        if signs is None:
            raise ValueError("metadata unit.signs: expected three signs")
        again = certify(
            bundle,
            station,
            station_text,
            tumble[READINGS],
            tumble[READINGS].finish(),
            digest,
            unit_name=unit.get("name", ""),
            serial=unit.get("serial") or None,
            signs=signs,
            computed_with=recording.metadata.get("software", {}),
        )
    except (TriaxcalError, DriverError, ValueError) as e:
        return Audit(name, tuple(checked), (f"{CERTIFICATE}: cannot be computed again: {e}",))
    differences += _compare(CERTIFICATE, recording.attachments[CERTIFICATE], to_text(again.document))
    if VERIFICATION_FILE in recording.attachments:
        checked.append(VERIFICATION_FILE)
        if CORRECTED not in tumble:
            missing = f"{VERIFICATION_FILE}: cannot be computed again: the profile has no stream '{CORRECTED}'"
            return Audit(name, tuple(checked), (*differences, missing))
        check, check_digest = replay(VERIFICATION, (CORRECTED,))
        document = verification_document(
            verified(tumble[CORRECTED], station.reference),
            verified(check[CORRECTED], station.reference),
            limit_g=station.limits.verification_rms_g,
            raw_sha256=check_digest.hexdigest(),
        )
        differences += _compare(VERIFICATION_FILE, recording.attachments[VERIFICATION_FILE], to_text(document))
    if REGISTERS_AFTER in recording.attachments and again.image is not None:
        checked.append(REGISTERS_AFTER)
        wanted = {w.register: w.raw.hex() for w in again.image.words}
        differences += _compare_registers(recording.attachments[REGISTERS_AFTER], wanted)
    return Audit(name, tuple(checked), tuple(differences), tuple(_notes(recording)))


def _notes(recording: Recording) -> list[str]:
    then, now = recording.metadata.get("software", {}), software()
    notes = [f"{n}: {then[n]} then, {now[n]} now" for n in now if n in then and then[n] != now[n]]
    notes += losses_of(recording)
    if RECOVERY_RECORD in recording.metadata:
        notes.append("the recording was cut short or damaged, and mended")
    return notes


def _compare(name: str, stored: bytes, again: str) -> list[str]:
    if stored == again.encode():
        return []
    try:
        before = json.loads(stored)
    except ValueError:
        return [f"{name}: the stored one is no JSON document"]
    paths = list(differing(before, json.loads(again)))
    if not paths:
        return [f"{name}: the bytes differ, the content does not"]
    rest = [f"{name}: and {len(paths) - MOST} more"] if len(paths) > MOST else []
    return [f"{name}: {line}" for line in paths[:MOST]] + rest


def differing(stored: Any, again: Any, at: str = "") -> list[str]:
    """Where two JSON values differ, one line each."""
    if isinstance(stored, Mapping) and isinstance(again, Mapping):
        pairs = {k: (stored.get(k, _NOTHING), again.get(k, _NOTHING)) for k in [*stored, *again]}
        return [d for k, (s, t) in pairs.items() for d in differing(s, t, f"{at}.{k}" if at else str(k))]
    if isinstance(stored, list) and isinstance(again, list) and len(stored) == len(again):
        return [d for i, (s, t) in enumerate(zip(stored, again, strict=True)) for d in differing(s, t, f"{at}[{i}]")]
    if type(stored) is type(again) and stored == again:
        return []
    return [f"{at}: stored {_short(stored)}, computed again {_short(again)}"]


def _short(value: Any) -> str:
    if value is _NOTHING:
        return "nothing"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "…"


def _compare_registers(stored: bytes, wanted: Mapping[str, str]) -> list[str]:
    try:
        held = json.loads(stored)
    except ValueError:
        held = None
    if not isinstance(held, dict):
        return [f"{REGISTERS_AFTER}: no JSON document of registers"]
    return [
        f"{REGISTERS_AFTER}: {name}: the device holds {held.get(name)}, the certificate asks for {raw}"
        for name, raw in wanted.items()
        if held.get(name) != raw
    ]
