"""The documents in the stored recordings against their models, and documents that are wrong."""

from __future__ import annotations

import json
import os
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import triaxcal as tc
from triaxcald.documents import to_text
from triaxcald.recording.reader import Recording
from triaxcald.schema.certificate import Certificate
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.outcome import Outcome
from triaxcald.schema.verification import Verification

RECORDINGS = Path(__file__).parents[3] / "recordings"
EVERY = sorted(RECORDINGS.rglob("*.mcap"))
MODELS: dict[str, type[tc.schema.Model]] = {
    "outcome.json": Outcome,
    "certificate.json": Certificate,
    "verification.json": Verification,
    "certificate.json/result": tc.schema.Loop,
    "certificate.json/result/calibration": tc.schema.Calibration,
}


@cache
def stored(path: Path, name: str) -> bytes:
    """An attachment, or the part of it at a key and the keys below."""
    attachment, *keys = name.split("/")
    with Recording.open(path) as recording:
        data = recording.attachments[attachment]
    if not keys:
        return data
    document = json.loads(data)
    for key in keys:
        document = document[key]
    return to_text(document).encode()


def golden(name: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(stored(RECORDINGS / "can-second-order.mcap", name))
    return document


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("path", EVERY, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_stored_document_comes_back_byte_for_byte(path: Path, name: str) -> None:
    data = stored(path, name)
    read = MODELS[name].read(json.loads(data))
    assert read is not None
    assert to_text(read.document()).encode() == data


@pytest.mark.parametrize(
    ("name", "key"), [(name, key) for name, model in MODELS.items() for key in model.model_fields], ids=str
)
def test_a_document_with_a_wrong_value_is_not_read(name: str, key: str) -> None:
    assert MODELS[name].read(golden(name) | {key: 1j}) is None


@pytest.mark.parametrize(
    ("name", "key"),
    [(name, key) for name, model in MODELS.items() for key, of in model.model_fields.items() if of.is_required()],
    ids=str,
)
def test_a_document_without_a_key_is_not_read(name: str, key: str) -> None:
    document = golden(name)
    del document[key]
    assert MODELS[name].read(document) is None


@pytest.mark.parametrize("value", [None, [], "text", 1.0, {}, {"format": "triaxcal.poses/1"}])
@pytest.mark.parametrize("name", MODELS)
def test_anything_else_is_not_read(name: str, value: object) -> None:
    assert MODELS[name].read(value) is None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", True])
def test_a_figure_is_a_finite_number(value: object) -> None:
    figures = dict.fromkeys(tc.schema.Residual.model_fields, 1.0)
    assert tc.schema.Residual.read(figures) is not None
    assert tc.schema.Residual.read(figures | {"rms_g": value}) is None


def test_a_figure_keeps_what_an_audit_needs_of_it() -> None:
    rms_g = tc.rounding.error(1.23456789e-5)
    assert isinstance(rms_g, tc.rounding.Printed)
    found = tc.schema.Residual(
        rms_g=rms_g, max_abs_g=None, cross_validated_rms_g=None, noise_floor_g=None, lack_of_fit_p=0.5
    ).document()
    assert found["rms_g"].exact == 1.23456789e-5
    assert list(found) == ["rms_g", "max_abs_g", "cross_validated_rms_g", "noise_floor_g", "lack_of_fit_p"]


@pytest.mark.parametrize("key", ["reason", "forced", "journal"])
def test_an_outcome_may_quote_a_name_that_is_no_utf_8(key: str) -> None:
    quoted = os.fsdecode(b"/stations/\xff/journal/1.json")
    document = golden("outcome.json") | {key: quoted}
    read = Outcome.read(document)
    assert read is not None
    assert read.document() == document


def test_a_key_that_a_later_version_adds_is_ignored() -> None:
    document = golden("outcome.json")
    read = Outcome.read(document | {"later": 1})
    assert read is not None
    assert read.verdict is Verdict.PASS
    assert read.code is Code.WITHIN_LIMITS
    assert read.document() == document


@pytest.mark.parametrize("name", MODELS)
def test_the_json_schema_describes_every_key(name: str) -> None:
    schema, document = MODELS[name].model_json_schema(), golden(name)
    keys = schema["$defs"][MODELS[name].__name__] if "$ref" in schema else schema
    assert [key for key in keys["properties"] if key in document] == list(document)
    for properties in (node["properties"] for node in (schema, *schema["$defs"].values()) if "properties" in node):
        assert all(of["description"] for of in properties.values())


def test_the_result_of_a_certificate_may_be_a_rezero() -> None:
    loop, nothing = golden("certificate.json/result"), dict[str, Any](findings=[], candidates=[], choices=[], advice=[])
    rezero = {key: loop[key] for key in tc.schema.Rezero.model_fields} | {"format": "triaxcal.rezero/1"} | nothing
    document = golden("certificate.json") | {"result": rezero}
    read = Certificate.read(document)
    assert read is not None
    assert isinstance(read.result, tc.schema.Rezero)
    assert to_text(read.document()) == to_text(document)
    assert Certificate.read(document | {"result": rezero | {"candidates": [{"effect": "warm_up"}]}}) is None
    assert Certificate.read(document | {"result": rezero | {"format": "triaxcal.poses/1"}}) is None
