"""An audit finds any change of what a result stands on, also where every checksum of the file is right."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.audit import audit, text
from triaxcald.audit.differences import differing
from triaxcald.recording import schema
from triaxcald.recording.schema import decode_raw, encode_raw

pytestmark = pytest.mark.slow

CERTIFICATE, VERIFICATION, AFTER = "certificate.json", "verification.json", "registers-after.json"
CHECKED = ("outcome.json", CERTIFICATE, "report.html", VERIFICATION, "registers-before.json", AFTER)
Said = Callable[[Path], list[str]]
Change = Callable[[str, bytes], bytes]
"""Of an attachment's content, by its name."""


@pytest.mark.parametrize("unit", ["can", "modbus"])
def test_an_unchanged_recording_gives_the_same_bytes(finished_run: Any, unit: str) -> None:
    found = audit(finished_run.recording(unit))
    assert found.differences == ()
    assert found.checked == CHECKED
    assert found.verdict == "pass"
    assert text.notes(found.notes) == []


def test_a_recording_written_anew_without_a_change_passes(
    finished_run: Any, rewrite: Callable[..., Path], said: Said
) -> None:
    assert said(rewrite(finished_run.can)) == []


class _Once:
    """Changes the first raw message of a phase, and counts."""

    def __init__(self, phase: str, change: Callable[[RawBatch], RawBatch]) -> None:
        self.phase, self.change, self.changed = phase, change, 0

    def __call__(self, topic: str, data: bytes) -> bytes:
        if topic != schema.RAW or self.changed:
            return data
        first, phase, batch = decode_raw(data)
        if phase != self.phase or not len(batch):
            return data
        self.changed += 1
        return encode_raw(first, phase, self.change(batch))


def _other_byte(batch: RawBatch) -> RawBatch:
    payload = bytearray(batch.payload)
    payload[len(payload) // 2] ^= 1
    return RawBatch(batch.time_ns, batch.source, batch.flags, batch.length, bytes(payload))


def test_a_changed_raw_record_is_found_of_either_phase(
    finished_run: Any, rewrite: Callable[..., Path], said: Said
) -> None:
    """Of a record nothing is left out of the digest: see the tests of the schema."""
    once, later = _Once("calibration", _other_byte), _Once("verification", _other_byte)
    found = said(rewrite(finished_run.can, message=lambda topic, data: later(topic, once(topic, data))))
    assert (once.changed, later.changed) == (1, 1)
    for name in (f"{CERTIFICATE}: recording.raw_sha256", f"{VERIFICATION}: raw_sha256"):
        assert any(d.startswith(f"{name}: stored ") for d in found), found


def _in(name: str, old: bytes, new: bytes) -> Change:
    def change(found: str, data: bytes) -> bytes:
        if found != name:
            return data
        assert data.count(old) >= 1
        return data.replace(old, new, 1)

    return change


@pytest.mark.parametrize(
    ("of_profile", "of_station", "named"),
    [
        (
            _in("profile.toml", b"reference unit", b"Reference unit"),
            _in("station.toml", b'name = "bench"', b'name = "Bench"'),
            "station.name",
        ),
        (
            _in("profile/triax-ref-can.dbc", b"SG_ Ux : 0|24@1- (", b"SG_ Ux : 0|24@1- ( "),
            _in("station.toml", b"hold_s = 1.0", b"hold_s = 1.1"),
            "station.sha256",
        ),
    ],
)
def test_a_changed_byte_of_profile_or_station_file_is_found(
    finished_run: Any,
    rewrite: Callable[..., Path],
    said: Said,
    of_profile: Change,
    of_station: Change,
    named: str,
) -> None:
    found = said(rewrite(finished_run.can, attachment=lambda name, data: of_station(name, of_profile(name, data))))
    for path in ("profile.sha256", named):
        assert any(d.startswith(f"{CERTIFICATE}: {path}") for d in found), found


def _edited(name: str, edit: Callable[[Any], None]) -> Change:
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


def test_changed_numbers_in_stored_results_are_found_and_named(
    finished_run: Any, rewrite: Callable[..., Path], said: Said
) -> None:
    edits = {CERTIFICATE: _better_residual, VERIFICATION: _better_verification, AFTER: _other_register}

    def change(name: str, data: bytes) -> bytes:
        return _edited(name, edits[name])(name, data) if name in edits else data

    found = said(rewrite(finished_run.can, attachment=change))
    for line in (
        f"{CERTIFICATE}: result.after.rms_g: stored ",
        f"{VERIFICATION}: after_rms_g: stored ",
        f"{AFTER}: bias_x: the device holds 00000000, the certificate asks for ",
    ):
        assert any(d.startswith(line) for d in found), found


def test_other_names_in_the_metadata_are_found(finished_run: Any, rewrite: Callable[..., Path], said: Said) -> None:
    others = {"unit": {"serial": "4799", "name": "other"}, "software": {"numpy": "0.0"}}
    found = said(rewrite(finished_run.can, metadata=lambda name, record: record | others.get(name, {})))
    for path in ("unit.serial", "unit.name", "software.numpy"):
        assert any(d.startswith(f"{CERTIFICATE}: {path}: stored ") for d in found), found


@pytest.mark.parametrize("signs", ["1,1,1", "?"])
def test_other_signs_in_the_metadata_are_found(
    finished_run: Any, rewrite: Callable[..., Path], said: Said, signs: str
) -> None:
    def change(name: str, record: dict[str, str]) -> dict[str, str]:
        return {**record, "signs": signs} if name == "unit" else record

    found = said(rewrite(finished_run.can, metadata=change))
    assert any(d.startswith(f"{CERTIFICATE}: ") for d in found), found


def _by_part(lines: list[str]) -> dict[str, list[str]]:
    """By attachment, what is said of it."""
    found: dict[str, list[str]] = {}
    for line in lines:
        name, _, what = line.partition(": ")
        found.setdefault(name, []).append(what)
    return found


def test_other_spacing_in_the_stored_certificate_is_a_difference_and_other_documents_than_expected_are(
    finished_run: Any, rewrite: Callable[..., Path], said: Said
) -> None:
    others = {VERIFICATION: b"{}", AFTER: b"no JSON"}
    spaced = _in(CERTIFICATE, b'"unit": {', b'"unit":  {')
    found = _by_part(said(rewrite(finished_run.can, attachment=lambda n, data: others.get(n, spaced(n, data)))))
    assert "the bytes differ, the content does not" in found.pop(CERTIFICATE)
    assert {VERIFICATION, AFTER} <= set(found)


@pytest.mark.parametrize("others", [{CERTIFICATE: b"no JSON", AFTER: b"[1]"}, {CERTIFICATE: b"5"}])
def test_a_stored_result_that_is_something_else_is_a_difference(
    finished_run: Any, rewrite: Callable[..., Path], said: Said, others: dict[str, bytes]
) -> None:
    found = _by_part(said(rewrite(finished_run.can, attachment=lambda name, data: others.get(name, data))))
    assert set(others) <= set(found)


def test_a_profile_without_the_stream_that_was_verified_is_a_difference(
    finished_run: Any, rewrite: Callable[..., Path], said: Said
) -> None:
    def change(name: str, data: bytes) -> bytes:
        return data.replace(b"[streams.corrected", b"[streams.corrupted") if name == "profile.toml" else data

    found = said(rewrite(finished_run.modbus, attachment=change))
    assert any(d.startswith(f"{CERTIFICATE}: profile.sha256") for d in found)
    assert any(d.startswith(f"{VERIFICATION}: ") for d in found)


@pytest.mark.parametrize("missing", [CERTIFICATE, "station.toml", "profile.toml"])
def test_what_is_missing_is_a_difference_and_what_needs_it_cannot_be_computed(
    finished_run: Any, rewrite: Callable[..., Path], said: Said, missing: str
) -> None:
    found = said(rewrite(finished_run.can, attachment=lambda name, data: None if name == missing else data))
    assert f"{missing}: missing, though the result rests on it" in found
    if missing != CERTIFICATE:
        assert any(d.startswith(f"{CERTIFICATE}: cannot be computed again: ") for d in found), found


def _lines(stored: Any, again: Any) -> list[str]:
    return [text.difference(d).removeprefix("x: ") for d in differing("x", stored, again)]


def test_differences_are_named_by_their_place() -> None:
    assert _lines({"a": [1, {"b": 2}], "c": 3}, {"a": [1, {"b": 4}], "d": 3}) == [
        "a[1].b: stored 2, computed again 4",
        "c: stored 3, computed again nothing",
        "d: stored nothing, computed again 3",
    ]
    assert _lines({"a": [1, 2]}, {"a": [1]}) == ["a: stored [1, 2], computed again [1]"]
    assert _lines({"a": 1}, {"a": 1.0}) == ["a: stored 1, computed again 1.0"]
    assert _lines({"a": True}, {"a": 1}) == ["a: stored true, computed again 1"]
    assert _lines({"a": None}, {}) == ["a: stored null, computed again nothing"]
