import struct

import pytest

from triaxcal_drivers.errors import ProfileError, RegisterValueError
from triaxcal_drivers.registers import crc
from triaxcald.errors import InputError
from triaxcald.provision.registers import build_image

COEFFICIENTS = {
    "scale_factor.x": -2.41,
    "scale_factor.y": -2.39,
    "scale_factor.z": -2.4,
    "misalignment.x": 0.001,
    "bias.z": -0.02,
}


def test_the_words_are_the_coefficients_as_single_precision_floats(bench) -> None:
    image = build_image(bench.profile, COEFFICIENTS, date_days=20_000)
    assert image.raw["scale_factor_x"] == bytes.fromhex("c01a3d71")  # -2.41
    assert image.raw["bias_z"] == bytes.fromhex("bca3d70a")  # -0.02
    assert image.raw["calibration_date"] == bytes.fromhex("00004e20")


def test_effects_that_the_calibration_does_not_have_are_written_as_zero(bench) -> None:
    image = build_image(bench.profile, COEFFICIENTS, date_days=0)
    assert image.raw["second_order_y"] == bytes(4)
    assert image.raw["temperature_bias_z"] == bytes(4)
    assert len(image.words) == 21


def test_the_cost_is_what_single_precision_changes(bench) -> None:
    image = build_image(bench.profile, COEFFICIENTS, date_days=0)
    (word,) = [w for w in image.words if w.register == "scale_factor_x"]
    assert word.value == -2.41
    assert word.held == -2 * (1 + 0x1A3D71 / 2**23)
    assert word.cost == pytest.approx(-8.583e-08, rel=1e-4)
    (exact,) = [w for w in image.words if w.register == "second_order_y"]
    assert exact.cost == 0.0


@pytest.mark.parametrize("little_endian", [False, True])
def test_the_checksum_is_over_big_endian_bytes_whatever_the_transport(make_bench, little_endian: bool) -> None:
    bench = make_bench(little_endian=little_endian)
    image = build_image(bench.profile, COEFFICIENTS, date_days=20_000)
    covered = struct.pack(">19fI", -2.41, -2.39, -2.4, 0.001, 0, 0, 0, 0, -0.02, *[0] * 10, 20_000)
    expected = crc("crc-16/modbus", covered).to_bytes(2, "little" if little_endian else "big")
    assert image.raw["calibration_crc"] == expected
    assert image.words[-1].register == "calibration_crc"


def test_coefficients_that_no_register_takes_are_listed(bench) -> None:
    image = build_image(bench.profile, {**COEFFICIENTS, "third_order.x": 1e-4}, date_days=0)
    assert image.not_held == ("third_order.x",)


def test_a_value_outside_its_limits_is_refused_by_name(bench) -> None:
    with pytest.raises(RegisterValueError, match=r"register bias_y: 0\.6 .*limits -0\.5 to 0\.5"):
        build_image(bench.profile, {**COEFFICIENTS, "bias.y": 0.6}, date_days=0)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_value_that_is_no_number_is_refused_by_name(bench, value: float) -> None:
    with pytest.raises(RegisterValueError, match="register bias_y"):
        build_image(bench.profile, {**COEFFICIENTS, "bias.y": value}, date_days=0)


def test_a_date_before_1970_is_refused_by_name(bench) -> None:
    with pytest.raises(RegisterValueError, match="register calibration_date"):
        build_image(bench.profile, COEFFICIENTS, date_days=-1)


def test_a_missing_scale_factor_is_not_taken_for_zero(bench) -> None:
    with pytest.raises(InputError, match=r"no scale_factor\.y"):
        build_image(bench.profile, {k: v for k, v in COEFFICIENTS.items() if k != "scale_factor.y"}, date_days=0)


def test_temperature_effects_need_their_reference_temperature(bench) -> None:
    thermal = {**COEFFICIENTS, "temperature_bias.x": 1e-4}
    with pytest.raises(InputError, match=r"no reference_temperature \(of temperature_bias\.x\)"):
        build_image(bench.profile, thermal, date_days=0)
    image = build_image(bench.profile, {**thermal, "reference_temperature": 22.5}, date_days=0)
    assert image.raw["reference_temperature"] == bytes.fromhex("41b40000")


def test_a_checksum_over_a_register_without_a_role_is_refused(bench) -> None:
    bare = bench.profile.registers["bias_x"].model_copy(update={"role": None})
    profile = bench.profile.model_copy(update={"registers": {**bench.profile.registers, "bias_x": bare}})
    with pytest.raises(ProfileError, match="crc: covers register bias_x"):
        build_image(profile, COEFFICIENTS, date_days=0)


def test_a_read_only_register_takes_no_coefficient(bench) -> None:
    fixed = bench.profile.registers["bias_z"].model_copy(update={"access": "ro"})
    profile = bench.profile.model_copy(update={"registers": {**bench.profile.registers, "bias_z": fixed}, "crc": None})
    image = build_image(profile, COEFFICIENTS, date_days=0)
    assert image.not_held == ("bias.z",)
    assert "bias_z" not in image.raw
