"""A device's calibration registers: their image, a snapshot of their values with
sanity warnings, the correction that they make, and all of it in words for people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.provision.correction import has_form, held_correction
from triaxcald.provision.identity import read_serial

# What is to be written: a calibration's coefficients as raw register words. No I/O.


@dataclass(frozen=True)
class Word:
    """One register of an image. ``value`` is the wanted value, ``held`` the one that
    ``raw`` (bytes as on the wire) encodes, both in the register's ``unit``."""

    register: str
    role: str
    raw: bytes
    value: float
    held: float
    unit: str
    step: float
    """Distance of neighbouring register values there."""

    @property
    def cost(self) -> float:
        """Rounding of the register's format: held − value, in ``unit``."""
        return self.held - self.value


@dataclass(frozen=True)
class RegisterImage:
    """The words in the profile's order, the checksum last; ``not_held`` are
    roles with no register to take them."""

    words: tuple[Word, ...]
    not_held: tuple[str, ...]

    @property
    def raw(self) -> dict[str, bytes]:
        return {word.register: word.raw for word in self.words}


def calibration_registers(profile: td.Profile) -> tuple[str, ...]:
    """Writable registers with a role in a calibration, in the profile's order,
    the checksum last."""
    names = [
        name
        for name, r in profile.registers.items()
        if r.access == "rw" and r.role and r.role not in td.roles.NOT_CALIBRATION
    ]
    last = profile.crc.register_name if profile.crc else profile.by_role(td.roles.CRC_ROLE)
    return tuple(sorted(names, key=lambda name: name == last))


def build_image(profile: td.Profile, coefficients: Mapping[str, float], *, date_days: int) -> RegisterImage:
    """``coefficients`` by role, each in its register's unit, with
    ``reference_temperature`` among them; ``date_days`` since 1970-01-01.

    A register whose role has no coefficient gets 0: the calibration does not
    have that effect. Raises RegisterValueError for a value that does not fit,
    InputError where a scale factor (or the reference temperature of temperature
    effects) is missing, ProfileError where the checksum covers other registers.
    """
    names = calibration_registers(profile)
    wanted = {**coefficients, td.roles.DATE_ROLE: float(date_days)}
    roles = {profile.registers[name].role for name in names}
    _refuse_gaps(roles, coefficients)
    checksum = profile.crc.register_name if profile.crc else None
    words = [_word(profile, name, wanted.get(profile.registers[name].role, 0.0)) for name in names if name != checksum]
    if checksum:
        value = checksum_of(profile, {word.register: word.raw for word in words})
        words.append(_word(profile, checksum, value))
    return RegisterImage(tuple(words), tuple(role for role in coefficients if role not in roles))


def image_of(profile: td.Profile, raw: Mapping[str, bytes]) -> RegisterImage:
    """The image whose raw bytes are known. Raises ProfileError for a register
    that the profile has not."""
    words = []
    for name, data in raw.items():
        if name not in profile.registers:
            raise td.ProfileError(f"profile {profile.name}: no register named '{name}'")
        register, value = profile.registers[name], profile.decode(name, data)
        words.append(
            Word(name, register.role or "", data, value, value, register.unit, td.registers.step(register, value))
        )
    return RegisterImage(tuple(words), ())


def _refuse_gaps(roles: set[str], coefficients: Mapping[str, float]) -> None:
    """Zero is a fair value for an effect that is absent, but not for these."""
    missing = [
        role for role in sorted(roles) if role.startswith(f"{td.roles.SCALE_FACTOR}.") and role not in coefficients
    ]
    thermal = [role for role, value in coefficients.items() if role.startswith("temperature_") and value]
    if thermal and td.roles.REFERENCE_ROLE in roles and td.roles.REFERENCE_ROLE not in coefficients:
        missing.append(f"{td.roles.REFERENCE_ROLE} (of {thermal[0]})")
    if missing:
        raise InputError(f"calibration: no {', '.join(missing)}, which the device needs")


def _word(profile: td.Profile, name: str, value: float) -> Word:
    register = profile.registers[name]
    raw = profile.encode(name, value)
    return Word(
        name, register.role, raw, value, profile.decode(name, raw), register.unit, td.registers.step(register, value)
    )


def checksum_of(profile: td.Profile, raw: Mapping[str, bytes]) -> int:
    """The profile's checksum over registers' raw bytes (as on the wire), by
    name.

    Raises ProfileError where it covers a register that is not given,
    RegisterValueError where one holds no number or has a wrong length.
    """
    if profile.crc is None:
        raise td.ProfileError(f"profile {profile.name}: crc: none is described")
    for name in profile.crc.over:
        if name not in raw:
            raise td.ProfileError(
                f"profile {profile.name}: crc: covers register {name}, which is no writable register with a role"
            )
        if not math.isfinite(profile.decode(name, raw[name])):
            raise td.RegisterValueError(f"register {name}: {raw[name].hex()} is no number")
    covered = b"".join(profile.most_significant_first(raw[name]) for name in profile.crc.over)
    return td.registers.crc(profile.crc.algorithm, covered)


# What the registers could hold, as what it makes of 1 g. Profile alone, no I/O.


@dataclass(frozen=True)
class RoleRange:
    """Range and step of a role's register in g: what a value makes of 1 g, of an
    effect of temperature at 1 K. A gain of 1 is the nominal one. None without a bound,
    or where the nominal scale factor is not known; ``nominal`` is what a device
    without a calibration holds."""

    role: str
    register: str
    least_g: float | None
    most_g: float | None
    resolution_g: float | None
    per: str
    nominal_g: float

    @property
    def holds_nominal(self) -> bool:
        low = -math.inf if self.least_g is None else self.least_g
        high = math.inf if self.most_g is None else self.most_g
        slack = 1e-9 * max(1.0, abs(self.nominal_g))  # a minimum may be the nominal value, which is computed
        return low - slack <= self.nominal_g <= high + slack


def role_ranges(profile: td.Profile) -> list[RoleRange]:
    """Of every coefficient of a calibration that has a writable register."""
    return [
        _range(profile, name)
        for name in calibration_registers(profile)
        if profile.registers[name].role not in td.roles.OTHER_ROLES
    ]


def _range(profile: td.Profile, name: str) -> RoleRange:
    register = profile.registers[name]
    worth, nominal, per = _worth(profile, register.role or "")
    type_ = td.registers.TYPES[register.type]
    low, high = register.minimum, register.maximum
    if isinstance(type_, td.registers.Integer):  # the bounds of a float do not matter
        ends = sorted(raw * register.scale + register.offset for raw in (type_.lowest, type_.highest))
        low = ends[0] if low is None else max(low, ends[0])
        high = ends[1] if high is None else min(high, ends[1])
    if worth is None:
        return RoleRange(register.role, name, None, None, None, per, nominal)
    found = [None if bound is None else bound * worth for bound in ((low, high) if worth > 0 else (high, low))]
    step = td.registers.step(register, 1.0 / worth) * abs(worth)
    return RoleRange(register.role, name, found[0], found[1], step, per, nominal)


def _worth(profile: td.Profile, role: str) -> tuple[float | None, float, str]:
    """What a value of 1 makes of 1 g, None where the nominal scale factor is not
    known; the nominal value in g; and by what both are divided."""
    bare = role.removesuffix(".t1").removesuffix(".t2")
    per = {"t1": "K", "t2": "K²"}.get(role.rpartition(".")[2], "")
    quantity, of = td.roles.parsed(bare)
    gain = 1.0 if bare == role else 0.0
    if quantity == td.roles.SCALE_FACTOR:
        nominal = profile.output.nominal_scale_factor
        return (None if nominal is None else 1.0 / nominal[td.roles.AXES.index(of)]), 1.0, per
    if quantity == td.roles.MATRIX:
        column = td.roles.AXES.index(of[1])
        return 1.0 / profile.nominal_diagonal[column], gain if of[0] == of[1] else 0.0, per
    if quantity == td.roles.OFFSET:
        after = profile.correction is not None and profile.correction.form == "matrix-after"
        row = 1.0 if after else abs(profile.nominal_diagonal[td.roles.AXES.index(of)])
        return row / profile.output_per_g, 0.0, per
    units = [c.unit for e in tc.effects.CATALOGUE if e.name == quantity for c in e.coefficients if c.name == of]
    divisor = units[0].partition("/")[2].strip("()") if units else ""
    return 1.0, 0.0, "" if divisor.startswith("g") else divisor  # g/g² at 1 g is g


# What the device holds: its calibration registers as raw bytes.


@dataclass(frozen=True)
class Snapshot:
    """Raw bytes as on the wire by register, in the order in which they are to
    be written, and whose they are (None where the profile has no serial
    number)."""

    raw: Mapping[str, bytes]
    serial: str | None = None

    def differing(self, other: Mapping[str, bytes]) -> tuple[str, ...]:
        """The registers in which ``other`` differs, in this snapshot's order."""
        return tuple(name for name, raw in self.raw.items() if name in other and other[name] != raw)


async def take_snapshot(device: td.Device, bundle: td.Bundle, names: Iterable[str] | None = None) -> Snapshot:
    """Read ``names``, by default every calibration register. Raises
    RegisterRefused, DeviceSilent."""
    serial = await read_serial(device, bundle)
    names = calibration_registers(bundle.profile) if names is None else names
    return Snapshot({name: await device.read(name) for name in names}, serial)


# Sanity warnings about a snapshot. Values alone, no I/O.

Kind = Literal["not_a_number", "outside_limits", "implausible", "unstable", "checksum", "corrected_output"]

BOUNDS: Mapping[str, tuple[float, float]] = {
    td.roles.MISALIGNMENT: (-0.5, 0.5),  # rad: half a right angle's worth; housings are square to a hundredth of that
    td.roles.BIAS: (-20.0, 20.0),  # g: the full scale of the triads in question
    td.roles.REFERENCE_ROLE: (-273.15, 1000.0),  # °C
    td.roles.DATE_ROLE: (0.0, 100_000.0),  # days: until the year 2243
}
EFFECT_BOUND = 10.0
"""g per g², per K and so on: a larger effect would exceed the measurement itself."""


def _bounds_of_form(profile: td.Profile, role: str) -> tuple[float, float]:
    """Limits of a coefficient of a linear correction in a sound device."""
    gain = max(map(abs, profile.nominal_diagonal))
    if role in td.roles.DIAGONAL_ROLES:
        gain = abs(profile.nominal_diagonal[td.roles.DIAGONAL_ROLES.index(role)])
        return (-td.SCALE_FACTOR_RATIO * gain, td.SCALE_FACTOR_RATIO * gain)
    if role.startswith(f"{td.roles.MATRIX}."):
        return (-td.SCALE_FACTOR_RATIO * gain, td.SCALE_FACTOR_RATIO * gain)
    per_g = profile.output_per_g
    if profile.correction is not None and profile.correction.form == "matrix":
        per_g /= min(map(abs, profile.nominal_diagonal))  # the offset is in the unit of u
    low, high = BOUNDS[td.roles.BIAS]
    return low * per_g, high * per_g


@dataclass(frozen=True)
class SanityWarning:
    """Reason why a snapshot is hardly a calibration. ``low`` and ``high`` are the
    expected limits of ``value``."""

    kind: Kind
    register: str
    value: float
    low: float = math.nan
    high: float = math.nan


def is_blank(snapshot: Snapshot) -> bool:
    """Never written: every byte 0xFF, or every byte 0x00."""
    held = b"".join(snapshot.raw.values())
    return bool(held) and len(set(held)) == 1 and held[0] in (0x00, 0xFF)


def unstable(profile: td.Profile, first: Snapshot, second: Snapshot) -> list[SanityWarning]:
    """Warnings of registers whose two readings in a row differ."""
    return [
        SanityWarning("unstable", name, profile.decode(name, second.raw[name])) for name in first.differing(second.raw)
    ]


def sanity_warnings(profile: td.Profile, snapshot: Snapshot, image: RegisterImage) -> list[SanityWarning]:
    """Warnings of register values outside their limits, and of a wrong checksum;
    none for a blank device."""
    if is_blank(snapshot):
        return []
    wanted = {word.register: word.value for word in image.words}
    found = [warning for name, raw in snapshot.raw.items() if (warning := _of(profile, name, raw, wanted))]
    return [*found, *_checksum(profile, snapshot)]


def _of(profile: td.Profile, name: str, raw: bytes, wanted: Mapping[str, float]) -> SanityWarning | None:
    value = profile.decode(name, raw)
    if not math.isfinite(value):
        return SanityWarning("not_a_number", name, value)
    register = profile.registers[name]
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    if not low <= value <= high:
        return SanityWarning("outside_limits", name, value, low, high)
    role = td.roles.parsed(register.role)
    if role.quantity in td.roles.CORRECTION:
        low, high = _bounds_of_form(profile, register.role or "")
        implausible = not low <= value <= high
    elif role.quantity == td.roles.SCALE_FACTOR:
        nominal = profile.output.nominal_scale_factor
        size = abs(nominal[role.axis] if nominal else wanted.get(name, math.nan))
        low, high = size / td.SCALE_FACTOR_RATIO, size * td.SCALE_FACTOR_RATIO
        implausible = abs(value) < low or abs(value) > high
    else:
        low, high = BOUNDS.get(role.quantity, (-EFFECT_BOUND, EFFECT_BOUND))
        implausible = role.quantity != td.roles.CRC_ROLE and not low <= value <= high
    return SanityWarning("implausible", name, value, low, high) if implausible else None


def fits_its_checksum(profile: td.Profile, snapshot: Snapshot) -> bool:
    """Whether the device has a checksum, and it matches the registers."""
    return profile.crc is not None and not _checksum(profile, snapshot)


def _checksum(profile: td.Profile, snapshot: Snapshot) -> Sequence[SanityWarning]:
    if profile.crc is None or profile.crc.register_name not in snapshot.raw:
        return []
    name = profile.crc.register_name
    held = profile.decode(name, snapshot.raw[name])
    try:
        right = float(checksum_of(profile, snapshot.raw))
    except (td.RegisterValueError, td.ProfileError, OverflowError, ValueError):  # a register holds no number
        right = math.nan
    return [] if held == right else [SanityWarning("checksum", name, held, right, right)]


# Does a device's corrected output follow its own registers? Values alone, no I/O.

TOLERANCE_G = 0.01
"""Wrong word order, axes, signs or conventions make errors of the size of the
bias at least; rounding, and an order of correction other than ours, make ones
of the size of a product of two small coefficients."""
LEAST = 3
"""Fewer samples or poses are no evidence."""


def sensor_in(profile: td.Profile, snapshot: Snapshot) -> tuple[tc.Sensor, float] | None:
    """The sensor that the registers describe, and its reference temperature in
    °C; None where they describe none."""
    held = {r.role: profile.decode(n, snapshot.raw[n]) for n, r in profile.registers.items() if n in snapshot.raw}
    linear = [[held.get(f"{name}.{axis}") for axis in td.roles.AXES] for name in td.roles.LINEAR]
    if any(value is None or not np.isfinite(value) for values in linear for value in values):
        return None
    scale_factor, misalignment, bias = (np.array(values, dtype=float) for values in linear)
    if not scale_factor.all():
        return None
    effects: dict[str, dict[str, float]] = {}
    for role, value in held.items():
        name, coefficient = td.roles.parsed(role)
        if coefficient and name not in td.roles.LINEAR:
            effects.setdefault(name, {})[coefficient] = value
    found = [tc.effects.effect_of(name, values) for name, values in effects.items() if any(values.values())]
    return tc.Sensor(scale_factor, misalignment, bias, tuple(found)), held.get(td.roles.REFERENCE_ROLE, 0.0)


def departure_g(
    profile: td.Profile,
    snapshot: Snapshot,
    readings: tc.Floats,
    corrected: tc.Floats,
    channels: Mapping[str, tc.Floats],
) -> float | None:
    """Median distance in g of the ``corrected`` output (n,3) from what the
    registers make of the ``readings`` (n,3) of the same moments; ``channels``
    (n,) each. None where that cannot be told."""
    if len(readings) < LEAST:
        return None
    if has_form(profile):
        return _departure_of_form(profile, snapshot, readings, corrected, channels)
    if (described := sensor_in(profile, snapshot)) is None:
        return None
    sensor, reference_c = described
    covariates = {"temp_c": channels["temp_c"] - reference_c} if "temp_c" in channels else {}
    if any(need not in covariates for effect, _ in sensor.effects for need in effect.needs):
        return None
    try:
        expected = sensor.specific_force(readings, covariates)
    except tc.Refused:
        return None
    return float(np.median(np.linalg.norm(corrected - expected, axis=1)))


def _departure_of_form(
    profile: td.Profile,
    snapshot: Snapshot,
    readings: tc.Floats,
    corrected: tc.Floats,
    channels: Mapping[str, tc.Floats],
) -> float | None:
    held = held_correction(profile, snapshot.raw)
    if held is None or (held.thermal and "temp_c" not in channels):
        return None
    temperature_c = channels.get("temp_c", np.full(len(readings), held.reference_c))
    off = (corrected - held.output(readings, temperature_c)) / held.output_per_g
    return float(np.median(np.linalg.norm(off, axis=1)))


def departure_warnings(off_g: float | None) -> list[SanityWarning]:
    if off_g is None or off_g <= TOLERANCE_G:
        return []
    return [SanityWarning("corrected_output", "", off_g, 0.0, TOLERANCE_G)]


# May the readings be corrected already, by the registers that are to be written?

NAMED = 3
"""Number of registers named in a message."""


class ReadingsNotStated(tc.Refused):
    """The readings may be corrected already, and the profile does not say.
    Raised before anything is written."""


def leaves_open(profile: td.Profile) -> bool:
    """Whether the profile does not say if the readings are those before the
    device's correction: by a second stream for the corrected ones, or by
    ``correction.readings``."""
    stated = profile.correction is not None and profile.correction.readings is not None
    return td.CORRECTED not in profile.streams and not stated and bool(_correcting(profile))


def require_readings_before(profile: td.Profile, snapshot: Snapshot) -> None:
    """Raises ReadingsNotStated where the profile leaves open whether the readings are
    corrected, and registers of the ``snapshot`` would correct them."""
    if not leaves_open(profile) or not (names := not_neutral(profile, snapshot)):
        return
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    raise ReadingsNotStated(
        f"the device holds a calibration ({', '.join(names[:NAMED])}{more}), and the profile {profile.name} does not "
        "say whether its readings are corrected by it already, in which case a new one would replace it wrongly: "
        'where they are not, write [correction] readings = "before" in the profile; nothing was written'
    )


def not_neutral(profile: td.Profile, snapshot: Snapshot) -> tuple[str, ...]:
    """The registers of ``snapshot`` by which the device would change its
    readings; none of a blank device."""
    held = {name: snapshot.raw[name] for name in _correcting(profile) if name in snapshot.raw}
    if is_blank(Snapshot(held)):
        return ()
    return tuple(name for name, raw in held.items() if not _is_neutral(profile, name, raw))


def _correcting(profile: td.Profile) -> tuple[str, ...]:
    """The calibration registers that change readings by themselves."""
    labels = (td.roles.CRC_ROLE, td.roles.DATE_ROLE, td.roles.REFERENCE_ROLE)
    return tuple(name for name in calibration_registers(profile) if profile.registers[name].role not in labels)


def _is_neutral(profile: td.Profile, name: str, raw: bytes) -> bool:
    register, value = profile.registers[name], profile.decode(name, raw)
    role = td.roles.parsed(register.role)
    if register.role in td.roles.DIAGONAL_ROLES:
        gain = profile.nominal_diagonal[td.roles.DIAGONAL_ROLES.index(register.role)]
        return any(abs(value - n) <= td.registers.step(register, n) * (1 + 1e-9) for n in (gain, abs(gain), 1.0))
    if role.quantity != td.roles.SCALE_FACTOR:
        return value == _nearest(profile, name, 0.0)
    # The device divides by it. Who wrote the nominal one may have rounded it
    # otherwise, by a step of the register at most.
    nominal = profile.output.nominal_scale_factor
    neutral = [1.0, *([nominal[role.axis]] if nominal else [])]
    return any(abs(value - _nearest(profile, name, n)) <= td.registers.step(register, n) * (1 + 1e-9) for n in neutral)


def _nearest(profile: td.Profile, name: str, value: float) -> float:
    """Nearest register value to ``value``."""
    try:
        return profile.decode(name, profile.encode(name, value))
    except td.RegisterValueError:  # outside its limits
        return value


# The registers in words, for people. No I/O.


@dataclass(frozen=True)
class Row:
    """One register. ``raw_hex`` as on the wire; ``crc_ok`` is None for
    registers other than the checksum."""

    register: str
    role: str
    raw_hex: str
    value: float
    unit: str
    description: str
    within_limits: bool
    crc_ok: bool | None


def explain(bundle: td.Bundle, snapshot: Snapshot) -> list[Row]:
    """A row for each register of the snapshot. Raises RegisterValueError on
    bytes of a wrong length."""
    return [_row(bundle.profile, snapshot, name) for name in snapshot.raw]


def _row(profile: td.Profile, snapshot: Snapshot, name: str) -> Row:
    register, raw = profile.registers[name], snapshot.raw[name]
    value = profile.decode(name, raw)
    low = -math.inf if register.minimum is None else register.minimum
    high = math.inf if register.maximum is None else register.maximum
    is_checksum = profile.crc is not None and profile.crc.register_name == name
    return Row(
        name,
        register.role or "",
        raw.hex(),
        value,
        register.unit,
        register.description,
        math.isfinite(value) and low <= value <= high,
        _checksum_ok(profile, snapshot, value) if is_checksum else None,
    )


def _checksum_ok(profile: td.Profile, snapshot: Snapshot, held: float) -> bool:
    try:
        return checksum_of(profile, snapshot.raw) == held
    except td.RegisterValueError:  # a register holds no number
        return False
