"""The documents of the metrology against their models."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from enum import StrEnum
from functools import cache
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.diagnosis import Recommendation, Verdict
from triaxcal.documents import earlier_of, to_text
from triaxcal.effects import effect_named
from triaxcal.effects.time import BiasStep
from triaxcal.estimate.calibration import Exclusion
from triaxcal.estimate.hold_out import Contradiction
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.partial_residuals import Quantity
from triaxcal.inputs.bias_update import updated_biases
from triaxcal.interchange.calibration_document import calibration_document, poses_document
from triaxcal.model.directions import directions
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import Sensor
from triaxcal.schema import AnotherUnit, Calibration, Finding, HeldOut, Loop, Model, Poses, Rezero, Trace, Unexplained
from triaxcal.schema.calibration import FittedPose, HoldsAt, NextRecording
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import Stated
from triaxcal.uncertainty.combined import Source

UNIT = Sensor(np.array([-2.41, 2.40, -2.37]), np.array([6e-3, 4e-3, -1e-3]), np.array([5e-3, -3e-3, 4e-3]))
SIGNS = (-1, 1, -1)
EFFECTS = [effect_named("second_order_nonlinearity"), effect_named("temperature_bias"), BiasStep(127.0)]


def poses_of(unit: Sensor = UNIT, seed: int = 1) -> list[tc.Pose]:
    ups = np.array([v for _, v in directions(26)])
    temperatures = 25 + np.linspace(-5, 5, 26)[np.random.default_rng(2).permutation(26)]
    return noisy_poses(unit, ups, 1e-5, np.random.default_rng(seed), channels={"temp_c": temperatures})


def faulty() -> list[tc.Pose]:
    poses = poses_of()
    return [*poses[:3], replace(poses[3], fault="saturation"), *poses[4:]]


def rezeroed() -> Mapping[str, Any]:
    earlier = earlier_of(tc.calibrate(poses_of(), signs=SIGNS), "cal.json", recording="first.csv")
    later = poses_of(replace(UNIT, bias=UNIT.bias + 1e-4), seed=2)
    return calibration_document(updated_biases(later, earlier, first=6), output_unit="V")


WRITTEN: dict[str, tuple[type[Model], Callable[[], Mapping[str, Any]]]] = {
    "poses": (Poses, lambda: poses_document(poses_of())),
    "no pose": (Poses, lambda: poses_document([])),
    "linear": (Calibration, lambda: calibration_document(fit(poses_of(), signs=SIGNS), output_unit="V")),
    "with effects": (
        Calibration,
        lambda: calibration_document(fit(poses_of(), signs=SIGNS, effects=EFFECTS), stated=Stated(reference=1e-4)),
    ),
    "without a budget": (Calibration, lambda: calibration_document(fit(poses_of(), signs=SIGNS), budgeted=False)),
    "excluded poses": (
        Calibration,
        lambda: calibration_document(fit(faulty(), signs=SIGNS, excluded=[0], why=Exclusion.CALLER)),
    ),
    "means alone": (
        Calibration,
        lambda: tc.calibrate(tc.Poses.of_means(np.array([p.mean for p in poses_of()])), signs=SIGNS).to_dict(),
    ),
    "of another reference": (
        Calibration,
        lambda: calibration_document(fit(poses_of(), signs=SIGNS), output_unit="counts", reference_unit="µT"),
    ),
    "rezeroed": (Calibration, rezeroed),
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
    [(name, key) for name in ("poses", "linear") for key in WRITTEN[name][0].model_fields],
    ids=str,
)
def test_a_document_with_a_wrong_value_is_not_read(name: str, key: str) -> None:
    assert WRITTEN[name][0].read(json.loads(written(name)) | {key: 1j}) is None


@pytest.mark.parametrize(
    ("name", "key"),
    [
        (name, key)
        for name in ("poses", "linear")
        for key, of in WRITTEN[name][0].model_fields.items()
        if of.is_required()
    ],
    ids=str,
)
def test_a_document_without_a_key_is_not_read(name: str, key: str) -> None:
    document = json.loads(written(name))
    del document[key]
    assert WRITTEN[name][0].read(document) is None


@pytest.mark.parametrize("vector", [[], [1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, None], [1.0, 2.0, "3"]])
def test_a_vector_is_three_numbers(vector: list[object]) -> None:
    document = json.loads(written("linear"))
    assert Calibration.read(document | {"bias": [1.0, 2.0, 3.0]}) is not None
    assert Calibration.read(document | {"bias": vector}) is None
    assert Calibration.read(document | {"matrix": [vector] * 3}) is None


@pytest.mark.parametrize("model", [Poses, Calibration, Loop, Rezero])
def test_the_json_schema_describes_every_key(model: type[Model]) -> None:
    schema = model.model_json_schema()
    described = [node["properties"] for node in (schema, *schema["$defs"].values()) if "properties" in node]
    assert described
    assert all(of["description"] for properties in described for of in properties.values())


def words_of(annotation: Any) -> Iterator[str]:
    """Of the lists of words in a type."""
    if get_origin(annotation) is Literal:
        yield from get_args(annotation)
    else:
        for inner in get_args(annotation):
            yield from words_of(inner)


@pytest.mark.parametrize(
    ("model", "key", "words"),
    [
        (HoldsAt, "moment", Moment),
        (NextRecording, "source", Source),
        (FittedPose, "excluded", Exclusion),
        (HeldOut, "contradicts", Contradiction),
        (Finding, "verdict", Verdict),
        (Unexplained, "kind", UnmodelledKind),
        (Trace, "quantity", Quantity),
        (Loop, "call", Recommendation),
        (Loop, "not_corrected", Refusal),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_the_words_of_a_key_are_those_that_are_written(model: type[Model], key: str, words: type[StrEnum]) -> None:
    assert set(words_of(model.model_fields[key].annotation)) == {word.value for word in words}


def test_a_pose_of_a_change_may_have_no_time() -> None:
    assert AnotherUnit.read({"start_s": None, "recording": 1, "probability": 0.9}) is not None
