"""The calibration parameters that a device's registers may hold: the roles of a
profile's registers.

A role is a quantity, or a quantity with the axis or coefficient it is of:
``scale_factor.x``, ``temperature_bias.y``, ``reference_temperature``. The
coefficients of effects are roles too; which effects there are, the metrology
knows.
"""

from __future__ import annotations

from typing import NamedTuple

AXES = ("x", "y", "z")
SCALE_FACTOR, MISALIGNMENT, BIAS = "scale_factor", "misalignment", "bias"
LINEAR = (SCALE_FACTOR, MISALIGNMENT, BIAS)
"""The quantities of the linear model, in the order of its parameters."""
LINEAR_ROLES = tuple(f"{quantity}.{axis}" for quantity in LINEAR for axis in AXES)
"""A device without one of these nine cannot take a calibration."""

MATRIX, OFFSET = "matrix", "offset"
CORRECTION = (MATRIX, OFFSET)
"""The quantities of a correction ``y = C (u − o)`` that a device makes."""
DIAGONAL_ROLES = tuple(f"{MATRIX}.{axis}{axis}" for axis in AXES)
UPPER_ROLES = tuple(f"{MATRIX}.{axes}" for axes in ("xy", "xz", "yz"))
LOWER_ROLES = tuple(f"{MATRIX}.{axes}" for axes in ("yx", "zx", "zy"))
OFFSET_ROLES = tuple(f"{OFFSET}.{axis}" for axis in AXES)
CORRECTION_GROUPS = (
    DIAGONAL_ROLES, UPPER_ROLES, LOWER_ROLES, OFFSET_ROLES,
    *(tuple(f"{role}.t1" for role in group) for group in (DIAGONAL_ROLES, UPPER_ROLES, LOWER_ROLES, OFFSET_ROLES)),
    tuple(f"{role}.t2" for role in OFFSET_ROLES),
)  # fmt: skip
"""Roles of a correction; a device has all or none of each group. ``.t1`` and ``.t2``
are per K and per K², about the reference temperature."""
CORRECTION_ROLES = tuple(role for group in CORRECTION_GROUPS for role in group)

CRC_ROLE, DATE_ROLE, REFERENCE_ROLE = "calibration_crc", "calibration_date", "reference_temperature"
SERIAL_ROLE, WRITE_COUNTER_ROLE = "serial_number", "write_counter"
NOT_CALIBRATION = (SERIAL_ROLE, WRITE_COUNTER_ROLE)
"""What a device says of itself; a calibration never writes it."""
OTHER_ROLES = (REFERENCE_ROLE, DATE_ROLE, CRC_ROLE, *NOT_CALIBRATION)
"""Those that are no coefficients."""


class Role(NamedTuple):
    """``of`` is the axis or coefficient, empty where the role has none."""

    quantity: str
    of: str = ""

    @property
    def axis(self) -> int:
        """0 to 2, and 0 of a role without one. Raises ValueError where the role is
        of something else."""
        return "xyz".index(self.of)


def parsed(role: str | None) -> Role:
    """A role's parts; an empty quantity where a register has no role."""
    quantity, _, of = (role or "").partition(".")
    return Role(quantity, of)
