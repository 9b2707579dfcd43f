"""A station's folder with small signed recordings, made as a run makes them but for the physics."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tests.daemon.audit.forging import Forgery
from triaxcal_drivers.interface import RawBatch
from triaxcald.audit import Policy, contents
from triaxcald.audit.beside import beside
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import Signature, check
from triaxcald.documents import json_value, to_text
from triaxcald.outcome import ATTACHMENT, FORMAT, digest_of
from triaxcald.recording.manifest import SealedContents, SignatureMade
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.recording.survey import survey
from triaxcald.recording.writer import RecordingWriter
from triaxcald.signing.keys import SigningKey
from triaxcald.signing.station import StationSigning
from triaxcald.utc import iso_time

SECOND_NS = 1_000_000_000
T0_NS = 1_700_000_000 * SECOND_NS  # in November 2023


def when(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="seconds")


@dataclass
class Line:
    """``now_ns`` is the station's clock, which each recording moves on by a minute."""

    folder: Path
    key: SigningKey
    now_ns: int = T0_NS
    authority: str | None = None
    made: list[Path] = field(default_factory=list)

    @property
    def signing(self) -> StationSigning:
        return StationSigning(self.key, self.folder, "bench", self.authority, lambda: self.now_ns)

    def record(self, name: str | None = None, *, signed: bool = True, **outcome: Any) -> Path:
        """A recording of a run, with the files beside it."""
        number = len(self.made)
        name = name or f"unit-{number:04d}.mcap"
        path, started = self.folder / name, iso_time(self.now_ns)
        run = f"01a21f9f-0000-7000-8000-{number:012d}"
        metadata: dict[str, dict[str, str]] = {
            "station": {"name": "bench"},
            "unit": {"name": "unit", "serial": str(number), "signs": "1,1,1"},
            "software": {"triaxcal": "0.2.0"},
            "run": {"run": run, "started": started},
            "work": {"slot": "unit", "operator": "Ada"},
        }
        writer = RecordingWriter(path, metadata=metadata, clock_ns=lambda: self.now_ns, ends_with=FORMAT)
        writer.attach("station.toml", "application/toml", b'name = "bench"\n')
        writer.attach("profile.toml", "application/toml", b'name = "profile"\n')
        for i in range(3):
            writer.raw("calibration", batch(self.now_ns + i * SECOND_NS, number + i))
        self.now_ns += 60 * SECOND_NS
        writer.attach("certificate.json", "application/json", b'{"bias": 1}\n')
        documents: list[bytes] = []

        def make(inventory: Mapping[str, Any]) -> bytes:
            document = {
                "format": FORMAT, "unit": "unit", "serial": str(number), "station": "bench", "run": run,
                "started": started, "ended": iso_time(self.now_ns), "verdict": "pass", "code": "within_limits",
                "exit_code": 0, "device_state": "untouched", "recording": name, "work": {"slot": "unit"},
                **outcome, "contents": inventory,
            }  # fmt: skip
            documents.append(to_text(document).encode())
            return documents[0]

        writer.seal(ATTACHMENT, "application/json", make, self.signing.sign if signed else None)
        path.with_suffix(f".{ATTACHMENT}").write_bytes(documents[0])
        if signed:
            path.with_suffix(f".{SIGNATURE_FILE}").write_bytes(envelope_of(path))
        self.made.append(path)
        return path

    def forged(self, forgery: Forgery, out: Path, *, signed: bool = True) -> Path:
        """All of it sealed anew, and signed by the line's key if asked for."""
        forgery.drop(SIGNATURE_FILE)
        forgery.seal()
        forgery.write(out)
        if signed:
            sign_anew(out, self.signing.sign)
        return out


def batch(time_ns: int, seed: int, records: int = 8) -> RawBatch:
    payload = np.random.default_rng(seed).integers(0, 256, 6 * records, dtype=np.uint8).tobytes()
    return RawBatch(
        np.arange(records, dtype=np.int64) * 1000 + time_ns,
        np.zeros(records, dtype=np.uint32),
        np.zeros(records, dtype=np.uint8),
        np.full(records, 6, dtype=np.uint16),
        payload,
    )


def envelope_of(path: Path) -> bytes:
    with Recording.open(path) as recording:
        return recording.attachments[SIGNATURE_FILE]


def sign_anew(path: Path, sign: Any) -> None:
    """Sign what is in a recording, and put the signature behind its outcome."""
    with Recording.open(path) as recording:
        sealed = survey(recording, ATTACHMENT).sealed
    assert sealed is not None
    with sign(sealed) as made:
        put_signature(path, made.data)


def put_signature(path: Path, data: bytes) -> None:
    forgery = Forgery.of(path)
    forgery.drop(SIGNATURE_FILE)
    outcome = forgery.attachment(ATTACHMENT)
    at = forgery.records.index(outcome) + 1
    made = type(outcome)(outcome.create_time, outcome.log_time, SIGNATURE_FILE, MEDIA_TYPE, data)
    forgery.records.insert(at, made)
    forgery.write(path)


MEDIA_TYPE = "application/vnd.dsse.envelope.v1+json"


def signed_by(path: Path, sign: Any) -> AbstractContextManager[SignatureMade]:
    with Recording.open(path) as recording:
        sealed = survey(recording, ATTACHMENT).sealed
    assert isinstance(sealed, SealedContents)
    found: AbstractContextManager[SignatureMade] = sign(sealed)
    return found


def looked_at(path: Path, policy: Policy) -> tuple[Signature, list[Kind]]:
    """All that an audit finds without computing anything again."""
    with Recording.open(path) as recording:
        found = survey(recording, ATTACHMENT)
        held = dict(recording.attachments)
        signature, differences = check(path, held, found, policy)
        differences += contents.faults(found)
        differences += contents.against_inventory(found, json_value(held.get(ATTACHMENT, b"{}")))
    differences += beside(path, held)[0]
    return signature, [d.kind for d in differences if d.kind is not Kind.ALONE or SIGNATURE_FILE in d.part]


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "chain.jsonl").read_text().splitlines()]


def write_lines(folder: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    (folder / "chain.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def outcome_digest(path: Path) -> str:
    with Recording.open(path) as recording:
        return digest_of(recording.attachments[ATTACHMENT])
