"""A certificate follows from recording, profile and station file alone, and says what the device cannot hold."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.errors import Refused
from triaxcal.interchange.calibration_reading import calibration_of
from triaxcal_drivers.catalogue import BUILT_IN, parse_bundle
from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import Bundle
from triaxcald.certificate import Certified, certify, held_by_device, roles
from triaxcald.documents import to_text
from triaxcald.inputs import CALIBRATION
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import RawDigest
from triaxcald.station.config import parse_station

TEXT = (BUILT_IN / "triax-ref-can.toml").read_bytes()
FILES = {"triax-ref-can.dbc": (BUILT_IN / "triax-ref-can.dbc").read_bytes()}
STATION = """\
format = "triaxcal.station/1"
name = "bench"
limits = { LIMITS }
units = [{ name = "can", profile = "triax-ref-can", bus = {} }]
"""


def _bundle(change: Callable[[str], str] = lambda text: text) -> Bundle:
    return parse_bundle(change(TEXT.decode()).encode(), FILES, where="profile")


def _without_second_order(text: str) -> str:
    text = re.sub(r"(?m)^(stored_)?second_order_. = .*\n", "", text)
    return re.sub(r'"second_order_.", ?', "", text)


Make = Callable[..., Certified]


@pytest.fixture(scope="module")
def anew(finished_run: Any) -> Make:
    def make(bundle: Bundle | None = None, limits: str = "") -> Certified:
        bundle = bundle or _bundle()
        text = STATION.replace("LIMITS", limits).encode()
        pipeline, digest = Pipeline(bundle, "readings"), RawDigest()
        with Recording.open(finished_run.can) as recording:
            for batch in recording.raw(CALIBRATION):
                digest.update(CALIBRATION, batch)
                pipeline.feed(batch)
        return certify(
            bundle,
            parse_station(text, where="station"),
            text,
            pipeline,
            pipeline.finish(),
            digest,
            unit_name="can",
            serial="4711",
            signs=(-1, -1, -1),
            computed_with={"triaxcal": "9.9"},
        )

    return make


@pytest.fixture(scope="module")
def plain(anew: Make) -> Certified:
    """By the built-in profile, without limits."""
    return anew()


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes(anew: Make, plain: Certified) -> None:
    assert to_text(anew().document) == to_text(plain.document)


def test_the_document_says_what_it_stands_on(plain: Certified) -> None:
    document = plain.document
    assert document["format"] == "triaxcal.certificate/1"
    assert document["unit"] == {"name": "can", "vendor": "triaxcal", "product": "TRIAX-REF", "serial": "4711"}
    assert document["software"] == {"triaxcal": "9.9"}
    assert document["settings"] == {"signs": [-1, -1, -1], "reference": 1.0}
    assert document["recording"]["missing"] == document["recording"]["duplicates"] == 0
    assert document["recording"]["samples"] > 26 * 200
    assert len(document["recording"]["raw_sha256"]) == 64
    assert document["result"]["format"] == "triaxcal.loop/1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "verdict", "outside"),
    [
        ("", "not judged", 0),
        ("rms_g = 1e-4, cross_validated_rms_g = 1e-4", "within limits", 0),
        ("rms_g = 1e-9", "outside limits", 1),
        ("rms_g = 1e-9, cross_validated_rms_g = 1e-9", "outside limits", 2),
        ("verification_rms_g = 1e-9", "not judged", 0),
    ],
)
def test_the_verdict_follows_the_limits(anew: Make, plain: Certified, limits: str, verdict: str, outside: int) -> None:
    made = anew(limits=limits) if limits else plain
    assert made.document["verdict"] == verdict
    assert len(made.document["outside"]) == outside
    assert made.within_limits is (outside == 0)
    assert all(" is above the limit 0.001 µg" in line for line in made.document["outside"])


def test_the_registers_hold_the_result_and_what_rounding_costs_is_said(plain: Certified) -> None:
    made = plain
    registers = made.document["registers"]
    assert registers["terms"] == ["linear", "second_order_nonlinearity"]
    assert set(registers["left_to_host"]) == set(made.loop.after.terms) - set(registers["terms"])
    assert registers["holds"] == []  # what depends on the direction alone has no conditions
    assert 0 < registers["rounding_rms_g"] < 1e-6
    words = {w["role"]: w for w in registers["words"]}
    held = held_by_device(_bundle().profile, calibration_of(made.document, where="certificate"))
    assert held is not None
    for role, value in roles(held.registers.calibration.sensor, {}).items():
        assert words[role]["wanted"] == pytest.approx(value, rel=1e-8, abs=1e-12)
        assert words[role]["held"] == pytest.approx(value, rel=2**-23)
    assert words["temperature_bias.x"]["held"] == 0.0
    assert made.image is not None
    assert made.image.words[-1].role == "calibration_crc"


@pytest.mark.slow
def test_an_effect_without_registers_is_left_to_the_host_and_the_linear_part_comes_as_near_as_it_can(
    anew: Make, plain: Certified
) -> None:
    full, cut = plain, anew(_bundle(_without_second_order))
    assert cut.document["result"]["after"] == full.document["result"]["after"]
    registers = cut.document["registers"]
    assert registers["terms"] == ["linear"]
    assert "second_order_nonlinearity" in registers["left_to_host"]
    # What is left is what a linear fit leaves, and the cost says so over the sphere.
    before = full.document["result"]["before"]["rms_g"]
    assert registers["rms_g"] == pytest.approx(before, rel=0.1)
    assert registers["cost_rms_g"] == pytest.approx(before, rel=0.3)
    words = {w["role"]: w["wanted"] for w in registers["words"]}
    linear = cut.loop.before
    off = [words[f"bias.{a}"] for a in "xyz"] - linear.sensor.bias
    assert np.all(np.abs(off) < 0.3 * before)


@pytest.mark.slow
def test_a_device_without_calibration_registers_gets_a_certificate_all_the_same(
    anew: Make,
) -> None:
    def without_roles(text: str) -> str:
        return re.sub(r', role = "(scale_factor|misalignment|bias)\.."', "", text)

    made = anew(_bundle(without_roles))
    assert made.image is None
    assert made.document["registers"] is None
    assert made.document["result"]["calibration"]["effects"]


@pytest.mark.slow
def test_what_no_register_can_hold_is_refused(anew: Make) -> None:
    def narrow(text: str) -> str:
        return text.replace("minimum = -10.0, maximum = 10.0", "minimum = -2.0, maximum = 2.0")

    with pytest.raises(RegisterValueError, match="scale_factor_x"):
        anew(_bundle(narrow))


def test_too_few_poses_are_refused(finished_run: Any, tmp_path: Path) -> None:
    pipeline = Pipeline(_bundle(), "readings")
    with pytest.raises(Refused):
        certify(
            _bundle(),
            parse_station(STATION.replace("LIMITS", "").encode(), where="station"),
            b"",
            pipeline,
            pipeline.finish(),
            RawDigest(),
            unit_name="can",
            serial=None,
            signs=(1, 1, 1),
            computed_with={},
        )


def test_the_registers_have_a_budget_of_their_own_with_their_steps_in_it(plain: Certified) -> None:
    document = plain.document
    free = {x["source"]: x for x in document["result"]["calibration"]["uncertainty"]["budget"]}
    held = {x["source"]: x for x in document["registers"]["uncertainty"]["budget"]}
    assert set(held) - set(free) == {"register_rounding", "not_held"}
    assert held["not_held"]["magnitude_g"] == pytest.approx(document["registers"]["cost_rms_g"], rel=0.1, abs=1e-8)
    # float32 near 2.4 has steps of 2^-22
    assert held["register_rounding"]["scale_factor"] == pytest.approx([2**-22 / 12**0.5] * 3, rel=1e-5)
    assert 0 < held["register_rounding"]["magnitude_g"] < 1e-6
