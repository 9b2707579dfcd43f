"""An audit finds any change of what a result stands on, also where every checksum of the file is right."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.audit import audit, differing
from triaxcald.errors import RecordingError
from triaxcald.recording import schema

CERTIFICATE, VERIFICATION, AFTER = "certificate.json", "verification.json", "registers-after.json"


@pytest.mark.parametrize("unit", ["can", "modbus"])
def test_an_unchanged_recording_gives_the_same_bytes(finished_run: Any, unit: str) -> None:
    found = audit(finished_run.recording(unit))
    assert found.differences == ()
    assert found.checked == (CERTIFICATE, VERIFICATION, AFTER)


def test_a_recording_written_anew_without_a_change_passes(finished_run: Any, rewrite: Callable[..., Path]) -> None:
    assert audit(rewrite(finished_run.can)).differences == ()


class _Once:
    """Changes the first raw message of a phase, and counts."""

    def __init__(self, phase: str, change: Callable[[RawBatch], RawBatch]) -> None:
        self.phase, self.change, self.changed = phase, change, 0

    def __call__(self, topic: str, data: bytes) -> bytes:
        if topic != schema.RAW or self.changed:
            return data
        first, phase, batch = schema.decode_raw(data)
        if phase != self.phase or not len(batch):
            return data
        self.changed += 1
        return schema.encode_raw(first, phase, self.change(batch))


def _other_byte(batch: RawBatch) -> RawBatch:
    payload = bytearray(batch.payload)
    payload[len(payload) // 2] ^= 1
    return RawBatch(batch.time_ns, batch.source, batch.flags, batch.length, bytes(payload))


def _other_flag(batch: RawBatch) -> RawBatch:
    flags = batch.flags.copy()
    flags[0] ^= 16
    return RawBatch(batch.time_ns, batch.source, flags, batch.length, batch.payload)


def _other_time(batch: RawBatch) -> RawBatch:
    return RawBatch(batch.time_ns + np.int64(1), batch.source, batch.flags, batch.length, batch.payload)


@pytest.mark.parametrize("change", [_other_byte, _other_flag, _other_time])
def test_a_changed_raw_record_is_found(
    finished_run: Any, rewrite: Callable[..., Path], change: Callable[[RawBatch], RawBatch]
) -> None:
    once = _Once("calibration", change)
    found = audit(rewrite(finished_run.can, message=once))
    assert once.changed == 1
    assert any(d.startswith(f"{CERTIFICATE}: recording.raw_sha256: stored ") for d in found.differences)


def test_a_changed_raw_record_of_the_verification_is_found(finished_run: Any, rewrite: Callable[..., Path]) -> None:
    once = _Once("verification", _other_byte)
    found = audit(rewrite(finished_run.modbus, message=once))
    assert once.changed == 1
    assert any(d.startswith(f"{VERIFICATION}: raw_sha256: stored ") for d in found.differences)


def _in(name: str, old: bytes, new: bytes) -> Callable[[str, bytes], bytes]:
    def change(found: str, data: bytes) -> bytes:
        if found != name:
            return data
        assert data.count(old) >= 1
        return data.replace(old, new, 1)

    return change


@pytest.mark.parametrize(
    ("attachment", "old", "new", "named"),
    [
        ("profile.toml", b"reference unit", b"Reference unit", f"{CERTIFICATE}: profile.sha256"),
        ("profile.toml", b"rate_hz = 100.0", b"rate_hz = 100.5", f"{CERTIFICATE}: profile.sha256"),
        ("profile/triax-ref-can.dbc", b"SG_ Ux : 0|24@1- (", b"SG_ Ux : 0|24@1- ( ", f"{CERTIFICATE}: profile.sha256"),
        ("station.toml", b'name = "bench"', b'name = "Bench"', f"{CERTIFICATE}: station.name"),
        ("station.toml", b"hold_s = 1.0", b"hold_s = 1.1", f"{CERTIFICATE}: station.sha256"),
    ],
)
def test_a_changed_byte_of_profile_or_station_file_is_found(
    finished_run: Any, rewrite: Callable[..., Path], attachment: str, old: bytes, new: bytes, named: str
) -> None:
    found = audit(rewrite(finished_run.can, attachment=_in(attachment, old, new)))
    assert any(d.startswith(named) for d in found.differences), found.differences


def _edited(name: str, edit: Callable[[Any], None]) -> Callable[[str, bytes], bytes]:
    def change(found: str, data: bytes) -> bytes:
        if found != name:
            return data
        document = json.loads(data)
        edit(document)
        return (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode()

    return change


def _better_residual(document: Any) -> None:
    document["result"]["after"]["rms_g"] *= 0.5


def _better_verification(document: Any) -> None:
    document["after_rms_g"] *= 0.5


def _other_register(document: Any) -> None:
    document["bias_x"] = "00000000"


@pytest.mark.parametrize(
    ("attachment", "edit", "named"),
    [
        (CERTIFICATE, _better_residual, f"{CERTIFICATE}: result.after.rms_g: stored "),
        (VERIFICATION, _better_verification, f"{VERIFICATION}: after_rms_g: stored "),
        (AFTER, _other_register, f"{AFTER}: bias_x: the device holds 00000000, the certificate asks for "),
    ],
)
def test_a_changed_number_in_a_stored_result_is_found_and_named(
    finished_run: Any, rewrite: Callable[..., Path], attachment: str, edit: Callable[[Any], None], named: str
) -> None:
    found = audit(rewrite(finished_run.can, attachment=_edited(attachment, edit)))
    assert len(found.differences) == 1
    assert found.differences[0].startswith(named)


def test_other_spacing_in_the_stored_certificate_is_a_difference(
    finished_run: Any, rewrite: Callable[..., Path]
) -> None:
    found = audit(rewrite(finished_run.can, attachment=_in(CERTIFICATE, b'"unit": {', b'"unit":  {')))
    assert found.differences == (f"{CERTIFICATE}: the bytes differ, the content does not",)


@pytest.mark.parametrize(("key", "value"), [("serial", "4799"), ("name", "other"), ("signs", "1,1,1"), ("signs", "?")])
def test_another_unit_in_the_metadata_is_found(
    finished_run: Any, rewrite: Callable[..., Path], key: str, value: str
) -> None:
    def change(name: str, record: dict[str, str]) -> dict[str, str]:
        return {**record, key: value} if name == "unit" else record

    found = audit(rewrite(finished_run.can, metadata=change))
    assert found.differences
    assert found.differences[0].startswith(f"{CERTIFICATE}: ")


def test_other_software_in_the_metadata_is_found(finished_run: Any, rewrite: Callable[..., Path]) -> None:
    def change(name: str, record: dict[str, str]) -> dict[str, str]:
        return {**record, "numpy": "0.0"} if name == "software" else record

    found = audit(rewrite(finished_run.can, metadata=change))
    assert found.differences[0].startswith(f"{CERTIFICATE}: software.numpy: stored ")


@pytest.mark.parametrize(
    ("attachment", "text"),
    [(CERTIFICATE, b"no JSON"), (CERTIFICATE, b"5"), (VERIFICATION, b"{}"), (AFTER, b"no JSON"), (AFTER, b"[1]")],
)
def test_a_stored_result_that_is_something_else_is_a_difference(
    finished_run: Any, rewrite: Callable[..., Path], attachment: str, text: bytes
) -> None:
    found = audit(rewrite(finished_run.can, attachment=lambda name, data: text if name == attachment else data))
    assert found.differences
    assert all(d.startswith(attachment) for d in found.differences)


def test_a_profile_without_the_stream_that_was_verified_is_a_difference(
    finished_run: Any, rewrite: Callable[..., Path]
) -> None:
    def change(name: str, data: bytes) -> bytes:
        return data.replace(b"[streams.corrected", b"[streams.corrupted") if name == "profile.toml" else data

    found = audit(rewrite(finished_run.modbus, attachment=change))
    assert any(d.startswith(f"{CERTIFICATE}: profile.sha256") for d in found.differences)
    assert any(d.startswith(f"{VERIFICATION}: ") for d in found.differences)


@pytest.mark.parametrize("missing", [CERTIFICATE, "station.toml", "profile.toml"])
def test_a_recording_without_a_result_cannot_be_audited(
    finished_run: Any, rewrite: Callable[..., Path], missing: str
) -> None:
    path = rewrite(finished_run.can, attachment=lambda name, data: None if name == missing else data)
    with pytest.raises(RecordingError, match=f"attachment {missing}: missing"):
        audit(path)


def test_differences_are_named_by_their_place() -> None:
    assert differing({"a": [1, {"b": 2}], "c": 3}, {"a": [1, {"b": 4}], "d": 3}) == [
        "a[1].b: stored 2, computed again 4",
        "c: stored 3, computed again nothing",
        "d: stored nothing, computed again 3",
    ]
    assert differing({"a": [1, 2]}, {"a": [1]}) == ["a: stored [1, 2], computed again [1]"]
    assert differing({"a": 1}, {"a": 1.0}) == ["a: stored 1, computed again 1.0"]
    assert differing({"a": True}, {"a": 1}) == ["a: stored true, computed again 1"]
    assert differing({"a": None}, {}) == ["a: stored null, computed again nothing"]
