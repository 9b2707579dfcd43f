"""What a device does with its calibration registers, where that is linear in the
reading: ``y = C (u − o)``, or ``y = C u − o``.

``u`` (n,3) is the reading before the device's correction, ``y`` (n,3) the reading
after it. ``C`` (3,3) and ``o`` (3,) may depend on the temperature: each coefficient
is a polynomial in the deviation from a reference temperature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.errors import InvalidData, Refused

AXES = "xyz"
ENTRIES = tuple(f"matrix.{row}{column}" for row in AXES for column in AXES)
OFFSETS = tuple(f"offset.{axis}" for axis in AXES)
DIAGONAL = ENTRIES[::4]
"""xx, yy and zz among three rows of three."""
POWERS: Mapping[str, int] = {"": 0, ".t1": 1, ".t2": 2}
"""Suffixes of the coefficients, by the power of the temperature's deviation [K]."""
COEFFICIENTS = (
    *ENTRIES, *OFFSETS,
    *(f"{name}.t1" for name in (*ENTRIES, *OFFSETS)),
    *(f"{name}.t2" for name in OFFSETS),
)  # fmt: skip
"""Every coefficient that a device may have a register for."""


@dataclass(frozen=True)
class LinearCorrection:
    """``values`` are the coefficients by name; one that is not there is 0. ``after``:
    the offset is subtracted after the matrix. ``output_per_g`` is y in its unit
    for 1 g. ``reference_c`` is the temperature [°C] about which the coefficients with
    ``.t1`` and ``.t2`` are (per K, per K²).
    """

    values: Mapping[str, float]
    after: bool = False
    output_per_g: float = 1.0
    reference_c: float = 0.0

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if name not in COEFFICIENTS:
                raise InvalidData(f"a linear correction has no coefficient {name}")
            if not np.isfinite(value):
                raise InvalidData(f"{name} is not a finite number")

    @classmethod
    def nominal(
        cls, scale_factor: Floats, *, after: bool = False, output_per_g: float = 1.0, reference_c: float = 0.0
    ) -> LinearCorrection:
        """Of a device that holds no calibration; ``scale_factor`` (3,) are the nominal
        ones of u, per g."""
        diagonal = output_per_g / np.asarray(scale_factor, dtype=float)
        return cls(dict(zip(DIAGONAL, diagonal.tolist(), strict=True)), after, output_per_g, reference_c)

    @property
    def thermal(self) -> bool:
        """Whether it depends on the temperature."""
        return any(value and name.endswith((".t1", ".t2")) for name, value in self.values.items())

    def moved(self, names: tuple[str, ...], by: Floats) -> LinearCorrection:
        """With ``by`` (p,) added to the coefficients of these names."""
        changed = {name: self.values.get(name, 0.0) + float(b) for name, b in zip(names, by, strict=True)}
        return replace(self, values={**self.values, **changed})

    def of(self, temperature_c: Floats) -> tuple[Floats, Floats]:
        """C (n,3,3) and o (n,3) at temperatures (n,) in °C."""
        dt = np.asarray(temperature_c, dtype=float) - self.reference_c
        matrix, offset = np.zeros((len(dt), 9)), np.zeros((len(dt), 3))
        for into, names in ((matrix, ENTRIES), (offset, OFFSETS)):
            for i, name in enumerate(names):
                for suffix, power in POWERS.items():
                    if value := self.values.get(name + suffix, 0.0):
                        into[:, i] += value * dt**power
        return matrix.reshape(-1, 3, 3), offset

    def output(self, u: Floats, temperature_c: Floats) -> Floats:
        """y (n,3)."""
        matrix, offset = self.of(temperature_c)
        if self.after:
            return np.asarray(np.einsum("nij,nj->ni", matrix, u) - offset)
        return np.asarray(np.einsum("nij,nj->ni", matrix, u - offset))

    def before(self, y: Floats, temperature_c: Floats) -> tuple[Floats, Floats]:
        """u (n,3) of corrected readings, and its derivatives by them (n,3,3). Raises
        Refused where the matrix has no inverse: the device's output then does not tell
        the reading."""
        matrix, offset = self.of(temperature_c)
        # A matrix of hardly any determinant would blow up the noise.
        size = np.linalg.norm(matrix, axis=(1, 2)) ** 3
        if not np.all(np.abs(np.linalg.det(matrix)) > 1e-9 * size):
            raise Refused("the matrix in the device's registers has no inverse: its output does not tell the reading")
        inverse = np.linalg.inv(matrix)
        if self.after:
            return np.einsum("nij,nj->ni", inverse, y + offset), inverse
        return np.einsum("nij,nj->ni", inverse, y) + offset, inverse

    def magnitude(self, u: Floats, temperature_c: Floats) -> Floats:
        """|y| / output_per_g (n,), in g."""
        return np.asarray(np.linalg.norm(self.output(u, temperature_c), axis=1) / self.output_per_g)

    def by_coefficients(self, names: tuple[str, ...], u: Floats, temperature_c: Floats) -> Floats:
        """(n,p) derivatives of `magnitude` by the coefficients of these names."""
        matrix, offset = self.of(temperature_c)
        y = self.output(u, temperature_c)
        n = y / np.linalg.norm(y, axis=1, keepdims=True) / self.output_per_g
        dt = np.asarray(temperature_c, dtype=float) - self.reference_c
        v = u if self.after else u - offset
        by_offset = -n if self.after else -np.einsum("ni,nij->nj", n, matrix)
        columns = []
        for name in names:
            base, power = _parsed(name)
            if base in ENTRIES:
                row, column = divmod(ENTRIES.index(base), 3)
                columns.append(n[:, row] * v[:, column] * dt**power)
            else:
                columns.append(by_offset[:, OFFSETS.index(base)] * dt**power)
        return np.stack(columns, axis=1) if columns else np.zeros((len(u), 0))


def _parsed(name: str) -> tuple[str, int]:
    """A coefficient without its suffix, and the power that this stands for."""
    for suffix, power in POWERS.items():
        if suffix and name.endswith(suffix):
            return name.removesuffix(suffix), power
    return name, 0
