"""The documents hold what the contract lists, and a sensor comes back out of them as it went in."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.diagnosis import diagnose
from triaxcal.documents import earlier_of
from triaxcal.effects import Effect, effect_named
from triaxcal.effects.time import BiasStep, WarmUp
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Exclusion
from triaxcal.estimate.pose_fit import fit
from triaxcal.inputs.bias_update import updated_biases
from triaxcal.interchange.calibration_document import calibration_document, poses_document
from triaxcal.interchange.calibration_reading import calibration_of, calibration_part, sensor_of
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.rounding import error, number, numbers, probability, uncertainty
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import Stated
from triaxcald.documents import loop_document, rezero_document, to_text

SECOND = effect_named("second_order_nonlinearity")
TRUTH = Sensor(
    np.array([-2.41, 2.40, -2.37]),
    np.array([6e-3, 4e-3, -1e-3]),
    np.array([5e-3, -3e-3, 4e-3]),
    ((SECOND, np.array([4e-4, -3e-4, 5e-4])),),
)
SIGNS = (-1, 1, -1)


@pytest.fixture(scope="module")
def poses() -> list[Pose]:
    ups = np.array([v for _, v in directions(26)])
    temperatures = 25 + np.linspace(-5, 5, 26)[np.random.default_rng(2).permutation(26)]
    return noisy_poses(TRUTH, ups, 1e-5, np.random.default_rng(1), channels={"temp_c": temperatures})


def test_a_number_has_ten_digits_and_what_is_none_is_null() -> None:
    assert number(1 / 3) == 0.3333333333
    assert number(-1.23456789012345e-300) == -1.23456789e-300
    assert str(number(-0.0)) == "0.0"
    assert [number(v) for v in (None, float("nan"), float("inf"))] == [None, None, None]
    assert numbers(np.array([[1, 2], [3, np.nan]])) == [[1.0, 2.0], [3.0, None]]


def test_an_error_of_the_magnitude_lies_on_a_grid_that_no_last_bit_reaches() -> None:
    assert error(1.23456789e-6) == error(1.23456789e-6 + 3e-16) == 1.23457e-6
    assert (error(3e-12), error(None), error(float("nan"))) == (0.0, None, None)
    assert (uncertainty(1.23456789e-6), probability(0.123456789)) == (1.23457e-6, 0.1235)


def test_the_grid_of_errors_is_as_fine_as_the_reference_is_small() -> None:
    assert error(1.23456789e-6, 1.0013) == error(1.23456789e-6, 0.998) == error(1.23456789e-6)
    assert error(5.4321e-10, 5e-5) == 5.4321e-10
    assert error(5.43214e-10, 5e-5) == 5.43214e-10
    assert error(1.2345678e-3, 48_000.0) == 1.235e-3
    assert error(1e-320, 1e-320) == 0.0


def test_a_document_reads_back_and_ends_with_a_line() -> None:
    text = to_text({"unit": "µg", "a": [1.5]})
    assert text == '{\n  "unit": "µg",\n  "a": [\n    1.5\n  ]\n}\n'
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_text({"a": float("nan")})


def test_poses_have_the_keys_of_the_contract(poses: list[Pose]) -> None:
    document = poses_document(poses)
    assert document["format"] == "triaxcal.poses/1"
    assert len(document["poses"]) == 26
    first = document["poses"][0]
    assert set(first) == {"start_s", "end_s", "samples", "mean", "standard_error", "channels"}
    assert len(first["mean"]) == len(first["standard_error"]) == 3
    assert first["channels"] == {"temp_c": pytest.approx(poses[0].channels["temp_c"], rel=1e-9)}
    assert poses_document([]) == {"format": "triaxcal.poses/1", "poses": []}


def test_a_pose_that_was_left_out_says_why(poses: list[Pose]) -> None:
    started_problem = [
        replace(poses[0], before=None),
        *(replace(p, before=poses[i].mean) for i, p in enumerate(poses[1:])),
    ]
    started_problem[3] = replace(started_problem[3], fault="saturation")
    for effects, why, before in (
        ((), Exclusion.CALLER, "caller"),
        ((), Exclusion.OUTLIER, "spoiled"),
        ((effect_named("hysteresis"),), Exclusion.OUTLIER, "unknown_history"),
    ):
        c = fit(started_problem, effects=effects, excluded=[0], why=why)
        poses_of_document = calibration_document(c, output_unit="V", reference_unit="g", stated=None)["poses"]
        assert poses_of_document[0]["excluded"] == ("unknown_history" if effects else why)
        assert poses_of_document[0]["left_out"] == before  # as documents of 0.1 have it
        assert poses_of_document[1]["excluded"] is None
        assert "left_out" not in poses_of_document[1]
        assert (poses_of_document[3]["excluded"], poses_of_document[3]["left_out"]) == ("fault", "saturation")


def test_a_calibration_comes_back_as_a_sensor(poses: list[Pose]) -> None:
    calibration = fit(poses, signs=SIGNS, effects=[SECOND, effect_named("temperature_bias")], reference=1.5)
    document = json.loads(to_text(calibration_document(calibration, output_unit="V")))
    sensor, reference, magnitude = sensor_of(document, where="cal.json")
    assert magnitude == 1.5
    assert reference == {"temp_c": pytest.approx(calibration.channel_reference["temp_c"], rel=1e-9)}
    np.testing.assert_allclose(sensor.scale_factor, calibration.sensor.scale_factor, rtol=1e-9)
    np.testing.assert_allclose(sensor.misalignment, calibration.sensor.misalignment, rtol=1e-9)
    np.testing.assert_allclose(sensor.bias, calibration.sensor.bias, rtol=1e-9)
    assert [e.name for e, _ in sensor.effects] == ["second_order_nonlinearity", "temperature_bias"]
    for (_, held), (_, meant) in zip(sensor.effects, calibration.sensor.effects, strict=True):
        np.testing.assert_allclose(held, meant, rtol=1e-9)


def test_matrix_and_centre_are_those_of_the_coefficients(poses: list[Pose]) -> None:
    """a = A (u − c): the measured mean of a pose goes to its direction, but for noise and the missing effect."""
    document = calibration_document(fit(poses, signs=SIGNS))
    A, c = np.array(document["matrix"]), np.array(document["centre"])
    assert A.shape == (3, 3)
    for pose in document["poses"]:
        up = A @ (np.array(pose["mean"]) - c)
        assert np.linalg.norm(up) == pytest.approx(1.0, abs=2e-3)
        np.testing.assert_allclose(up, pose["direction"], atol=2e-3)


def test_units_name_the_reference_of_another_sensor(poses: list[Pose]) -> None:
    calibration = fit(poses, signs=SIGNS, effects=[SECOND])
    document = calibration_document(calibration, output_unit="counts", reference_unit="µT")
    assert document["units"]["scale_factor"] == "counts/µT"
    assert document["units"]["bias"] == "µT"
    assert document["effects"]["second_order_nonlinearity"]["x"]["unit"] == "µT/µT²"


@pytest.mark.slow
def test_a_loop_says_what_each_pose_was_before(poses: list[Pose]) -> None:
    document = loop_document(diagnose(poses, signs=SIGNS), data_quality=["missing_samples: 1 of 2"])
    assert document["data_quality"] == ["missing_samples: 1 of 2"]
    assert "held_out" not in document
    before = np.array([p["before_residual_g"] for p in document["calibration"]["poses"]])
    after = np.array([p["residual_g"] for p in document["calibration"]["poses"]])
    assert np.sqrt(np.mean(before**2)) == pytest.approx(document["before"]["rms_g"], abs=2e-11)
    assert np.sqrt(np.mean(after**2)) == pytest.approx(document["after"]["rms_g"], abs=2e-11)


@pytest.mark.slow
def test_a_loop_has_the_keys_of_the_contract() -> None:
    rng = np.random.default_rng(3)
    warm = replace(TRUTH, effects=((effect_named("temperature_bias"), np.array([3e-4, -2e-4, 4e-4])),))
    ups = np.array([v for _, v in directions(26)])
    held = {"temp_c": 25 + rng.permutation(np.linspace(-5, 5, 26))}
    loop = diagnose(noisy_poses(warm, ups, 1e-5, rng, channels=held, channel_reference={"temp_c": 25.0}), signs=SIGNS)
    document = json.loads(to_text(loop_document(loop)))
    assert document["call"] == loop.call
    assert len(document["summary"]) == 4
    (finding,) = document["findings"]
    assert finding["verdict"] == loop.findings[0].verdict
    assert finding["probability"] == document["probabilities"][finding["effect"]] > 0.5
    assert set(finding["probabilities"]) == set(finding["alternatives"])
    # What 0.1 had, and means nothing since names have probabilities.
    assert [finding[key] for key in ("p_value", "coincidence", "spoiled", "apart", "residual")] == [None] * 5
    left = document["unexplained"]
    assert (left["significant"], left["p_value"], left["or_named"]) == (False, None, None)
    assert 0 < left["probability"] < 0.5
    assert document["not_corrected"] is document["another_unit"] is None
    assert 0 < document["nothing_probability"] < 1e-3 or document["nothing_probability"] == 0.0
    calibration = document["calibration"]
    assert calibration["next_recording"]["source"] == "assumed"
    assert calibration["next_recording"]["start_to_start_g"] == 2e-3
    assert calibration["next_recording"]["expanded_uncertainty_g"] > 2 * 2e-3 * 0.9
    assert all(0 <= p["outlier_probability"] < 0.5 for p in calibration["poses"])


@pytest.mark.slow
def test_each_effect_of_an_average_has_its_weight_and_that_comes_back(poses: list[Pose]) -> None:
    loop = diagnose(poses, signs=SIGNS)
    document = json.loads(to_text(loop_document(loop)))
    weights = {name: held["weight"] for name, held in document["calibration"]["effects"].items()}
    adopted = {f.effect for f in loop.findings if f.verdict == "adopted"}
    assert weights == {
        name: 1.0 if name in adopted else pytest.approx(p, abs=1e-4) for name, p in loop.after.weights.items()
    }
    back = calibration_of(document, where="x")
    assert back.weights == weights
    assert [e for e, _ in back.sensor.effects] == [e for e, _ in loop.after.sensor.effects]


SHAPED = [(WarmUp(75.0), "time_constant", 75.0), (BiasStep(127.0), "at", 127.0), (BiasStep(130.0), "at", 130.0)]


@pytest.mark.parametrize(("effect", "shape", "value"), SHAPED, ids=["warm-up", "within a pose", "between two"])
def test_the_shape_of_an_effect_stands_beside_its_coefficients_and_comes_back(
    effect: Effect, shape: str, value: float, poses: list[Pose]
) -> None:
    # Poses of 10 s without a gap: half a second off at both ends.
    apart = [replace(p, start_s=p.start_s + 0.5, end_s=p.end_s - 0.5) for p in poses]
    fitted = fit(apart, signs=SIGNS, effects=[SECOND, effect])
    document = json.loads(to_text(calibration_document(fitted)))
    held = document["effects"][effect.name]
    assert list(held) == ["x", "y", "z", shape]
    assert (held[shape]["value"], held[shape]["unit"]) == (value, "s")
    assert held[shape]["standard_error"] > 0
    sensor, reference, _ = sensor_of(document, where="cal.json")
    assert [e for e, _ in sensor.effects] == [SECOND, effect]
    u = np.array([p.mean for p in apart])
    own = fitted.covariates_of(apart)
    assert set(reference) == set(own)
    assert sensor.specific_force(u, own) == pytest.approx(fitted.sensor.specific_force(u, own), abs=1e-8)


@pytest.mark.slow
def test_the_calibration_is_found_in_a_loop_and_in_a_certificate(poses: list[Pose]) -> None:
    loop = loop_document(diagnose(poses, signs=SIGNS))
    inner = loop["calibration"]
    for document in (inner, loop, {"format": "triaxcal.certificate/1", "result": loop}):
        assert calibration_part(document, where="x") == inner


def test_a_rezero_comes_back_byte_for_byte(poses: list[Pose]) -> None:
    earlier = earlier_of(tc.calibrate(poses, signs=SIGNS), "cal.json", recording="first.csv")
    document = rezero_document(updated_biases(poses, earlier, first=6), data_quality=["missing_samples: 1 of 2"])
    assert document["calibration"]["origin"]["calibration"]["name"] == "cal.json"
    read = tc.schema.Rezero.read(json.loads(to_text(document)))
    assert read is not None
    assert to_text(read.document()) == to_text(document)


def _without(*keys: str) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for key in keys:
            del document[key]

    return change


def _with(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.__setitem__(key, value)


def _effect(value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda d: d["effects"]["second_order_nonlinearity"]["x"].__setitem__("value", value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_with("format", "triaxcal.poses/1"), "format: expected a triaxcal.calibration/1"),
        (_without("format"), "format: expected a triaxcal.calibration/1"),
        (_without("scale_factor"), "scale_factor: missing"),
        (_with("bias", [1, 2]), "expected three numbers each"),
        (_with("bias", [1, 2, None]), "numbers"),
        (_with("bias", [1, 2, float("nan")]), "expected three numbers each"),
        (_with("bias", "a few"), "numbers"),
        (_with("scale_factor", [1, 0, 1]), "none zero in the first"),
        (_with("misalignment", {"x": 1}), "numbers"),
        (_with("effects", {"flat_earth": {}}), "flat_earth"),
        (_with("effects", {"second_order_nonlinearity": {"w": {"value": 1}}}), "second_order_nonlinearity.w"),
        (_with("effects", [1]), "numbers"),
        (_effect("much"), "numbers"),
        (_effect(float("nan")), "effects.second_order_nonlinearity: expected finite numbers"),
        (_with("channel_reference", {"temp_c": "warm"}), "numbers"),
        (_with("channel_reference", {"temp_c": float("inf")}), "channel_reference.temp_c: expected a finite number"),
        (_with("reference", 0), "reference: expected a positive number"),
        (_with("reference", float("nan")), "reference: expected a positive number"),
    ],
)
def test_a_malformed_calibration_is_an_error_that_names_file_and_field(
    poses: list[Pose], change: Callable[[dict[str, Any]], None], words: str
) -> None:
    document = calibration_document(fit(poses, signs=SIGNS, effects=[SECOND]))
    change(document)
    with pytest.raises(InvalidData) as caught:
        sensor_of(document, where="cal.json")
    assert str(caught.value).startswith("cal.json: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_budget_stands_beside_the_standard_errors(poses: list[Pose]) -> None:
    fitted = fit(poses, signs=SIGNS, effects=[SECOND])
    said = calibration_document(fitted, stated=Stated(reference=1e-4))["uncertainty"]
    lines = {x["source"]: x for x in said["budget"]}
    assert said["dominant"] == said["budget"][0]["source"] == "reference"
    assert lines["reference"]["how"] == "as stated"
    assert lines["reference"]["degrees_of_freedom"] is None
    assert sum(x["share"] for x in said["budget"]) == pytest.approx(1, abs=1e-5)
    for name, index in (("scale_factor", 0), ("misalignment", 3), ("bias", 6)):
        squares = np.sum([np.square(x[name]) for x in said["budget"]], axis=0)
        factors = np.array(said["coverage_factor"][name])
        np.testing.assert_allclose(said["expanded"][name], factors * np.sqrt(squares), rtol=1e-4)
        assert np.all(squares >= (fitted.standard_errors[index : index + 3] ** 2) * (1 - 1e-6))
    assert set(said["expanded"]["effects"]["second_order_nonlinearity"]) == {"x", "y", "z"}
    assert "not_evaluated" in said


def test_the_correlation_is_that_of_the_fit(poses: list[Pose]) -> None:
    fitted = fit(poses, signs=SIGNS, effects=[SECOND])
    document = calibration_document(fitted)
    assert document["parameters"] == list(fitted.parameters)
    held = np.array(document["correlation"])
    assert np.array_equal(held, held.T)
    np.testing.assert_allclose(np.diag(held), 1.0)
    back = held * np.outer(fitted.standard_errors, fitted.standard_errors)
    np.testing.assert_allclose(back, fitted.covariance, atol=1e-6 * np.max(np.diag(fitted.covariance)))
