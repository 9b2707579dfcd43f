"""The documents of the metrology against their models."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.documents import to_text
from triaxcal.interchange.calibration_document import poses_document
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.schema import Model, Poses
from triaxcal.synthetic import noisy_poses

UNIT = Sensor(np.array([-2.41, 2.40, -2.37]), np.array([6e-3, 4e-3, -1e-3]), np.array([5e-3, -3e-3, 4e-3]))


def poses_of(unit: Sensor = UNIT, seed: int = 1) -> list[tc.Pose]:
    ups = np.array([v for _, v in directions(26)])
    temperatures = 25 + np.linspace(-5, 5, 26)[np.random.default_rng(2).permutation(26)]
    return noisy_poses(unit, ups, 1e-5, np.random.default_rng(seed), channels={"temp_c": temperatures})


WRITTEN: dict[str, tuple[type[Model], Callable[[], Mapping[str, Any]]]] = {
    "poses": (Poses, lambda: poses_document(poses_of())),
    "no pose": (Poses, lambda: poses_document([])),
}


@cache
def written(name: str) -> str:
    return to_text(WRITTEN[name][1]())


@pytest.mark.parametrize("name", WRITTEN)
def test_a_document_comes_back_byte_for_byte(name: str) -> None:
    read = WRITTEN[name][0].read(json.loads(written(name)))
    assert read is not None
    assert to_text(read.document()) == written(name)


@pytest.mark.parametrize(
    ("name", "key"),
    [(name, key) for name in ("poses",) for key in WRITTEN[name][0].model_fields],
    ids=str,
)
def test_a_document_with_a_wrong_value_is_not_read(name: str, key: str) -> None:
    assert WRITTEN[name][0].read(json.loads(written(name)) | {key: 1j}) is None


@pytest.mark.parametrize(
    ("name", "key"),
    [(name, key) for name in ("poses",) for key, of in WRITTEN[name][0].model_fields.items() if of.is_required()],
    ids=str,
)
def test_a_document_without_a_key_is_not_read(name: str, key: str) -> None:
    document = json.loads(written(name))
    del document[key]
    assert WRITTEN[name][0].read(document) is None


@pytest.mark.parametrize("model", [Poses])
def test_the_json_schema_describes_every_key(model: type[Model]) -> None:
    schema = model.model_json_schema()
    described = [node["properties"] for node in (schema, *schema["$defs"].values()) if "properties" in node]
    assert described
    assert all(of["description"] for properties in described for of in properties.values())
