"""Units as they are written where the reference is not in g."""

from __future__ import annotations

import pytest

from triaxcal.units import ErrorUnit, in_units_of


@pytest.mark.parametrize(
    ("unit", "of_tesla"),
    [
        ("g", "T"),
        ("g/g²", "T/T²"),
        ("g/s²", "T/s²"),
        ("g/(K/s)", "T/(K/s)"),
        ("1/[gyro]", "1/[gyro]"),
        ("g/[voltage_v]", "T/[voltage_v]"),
        ("g/[g]", "T/[g]"),
        ("g/[a]g[b]", "T/[a]g[b]"),
        ("mg/deg", "mg/deg"),
    ],
)
def test_g_is_replaced_as_a_unit_and_in_no_name(unit: str, of_tesla: str) -> None:
    assert in_units_of(unit, "T") == of_tesla
    assert in_units_of(unit, "g") == unit


def test_a_unit_with_a_fraction_stands_in_brackets() -> None:
    assert in_units_of("g", "m/s²") == "m/s²"
    assert in_units_of("g/K", "m/s²") == "(m/s²)/K"
    assert in_units_of("g/g", r"\1/s") == r"(\1/s)/(\1/s)"


@pytest.mark.parametrize(
    ("unit", "reference", "text", "number"),
    [
        ("g", 0.998, "µg", "2.00"),
        ("reference unit", 9.80665, "ppm of the reference", "0.204"),
        ("reference unit", 5e-5, "ppm of the reference", "40000"),
        ("reference unit", 1e-320, "ppm of the reference", None),
        ("µT", 48.0, "1e-6 µT", "2.00"),
        ("nT", 48_000.0, "1e-3 nT", "0.00"),
        ("T", 5e-5, "1e-12 T", "2000000"),
        ("T", 1e-320, "1e-258 T", None),
    ],
)
def test_errors_are_told_in_about_millionths_of_the_reference(
    unit: str, reference: float, text: str, number: str | None
) -> None:
    small = ErrorUnit.of(unit, reference)
    assert str(small) == text
    assert number is None or small.written(2e-6) == number
    assert small.written(None) == "—"


def test_a_sentence_has_the_unit_of_the_reference_behind_numbers_alone() -> None:
    said = "channel_bias:dust_µg: from 1.53e+04 µg to 12 µg, one pose (-3.2 µg, +4 µg)"
    assert ErrorUnit.of("g", 1.0).in_words(said) == said
    assert (
        ErrorUnit.of("µT", 48.0).in_words(said)
        == "channel_bias:dust_µg: from 15300e-6 µT to 12e-6 µT, one pose (-3.2e-6 µT, +4e-6 µT)"
    )
    assert ErrorUnit.of("T", 5e-5).in_words("from 0.00153 µg to +1.2e-05 µg") == "from 1530e-12 T to +12e-12 T"
    unnamed = ErrorUnit.of("reference unit", 9.80665)
    assert unnamed.in_words("from 98.0665 µg to +9.81 µg") == "from 10 ppm of the reference to +1 ppm of the reference"


def test_a_power_of_ten_is_written_on_to_its_number() -> None:
    small = ErrorUnit.of("m/s^2", 9.80665)
    assert [small.in_full(v) for v in (20.06e-6, 0.0, None)] == ["20.1e-6 m/s^2", "0.00e-6 m/s^2", "— 1e-6 m/s^2"]
    assert ErrorUnit.of("g", 1.0).in_full(20.06e-6) == "20.1 µg"
    assert ErrorUnit.of("reference unit", 9.80665).in_full(98.0665e-6) == "10.0 ppm of the reference"
