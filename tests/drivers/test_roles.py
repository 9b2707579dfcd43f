"""Roles of registers: their names are what profiles say."""

from __future__ import annotations

import pytest

from triaxcal_drivers.profile import Register
from triaxcal_drivers.roles import LINEAR_ROLES, OTHER_ROLES, Role, parsed


def test_the_linear_ones_are_in_the_order_of_the_models_parameters() -> None:
    assert LINEAR_ROLES == (
        "scale_factor.x", "scale_factor.y", "scale_factor.z",
        "misalignment.x", "misalignment.y", "misalignment.z",
        "bias.x", "bias.y", "bias.z",
    )  # fmt: skip


def test_those_that_are_no_coefficients_are_named_in_the_model_of_a_register() -> None:
    assert all(f"``{role}``" in str(Register.__doc__) for role in OTHER_ROLES)


@pytest.mark.parametrize(
    ("role", "parts"),
    [
        ("scale_factor.z", Role("scale_factor", "z")),
        ("temperature_bias.x", Role("temperature_bias", "x")),
        ("reference_temperature", Role("reference_temperature")),
        (None, Role("")),
    ],
)
def test_a_role_is_a_quantity_and_what_it_is_of(role: str | None, parts: Role) -> None:
    assert parsed(role) == parts


@pytest.mark.parametrize(("axis", "place"), [("x", 0), ("y", 1), ("z", 2)])
def test_an_axis_has_its_place(axis: str, place: int) -> None:
    assert parsed(f"bias.{axis}").axis == place


def test_what_is_of_no_axis_has_no_place() -> None:
    with pytest.raises(ValueError):
        _ = parsed("memory.time_constant").axis
