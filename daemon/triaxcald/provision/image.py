"""What is to be written: a calibration's coefficients as raw register words. No
I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal_drivers import registers as codec
from triaxcal_drivers.errors import ProfileError, RegisterValueError
from triaxcal_drivers.profile import Profile
from triaxcald.errors import InputError

CRC_ROLE, DATE_ROLE, REFERENCE_ROLE = "calibration_crc", "calibration_date", "reference_temperature"
NOT_CALIBRATION = ("serial_number", "write_counter")


@dataclass(frozen=True)
class Word:
    """One register of an image. ``value`` is wanted and ``held`` is what
    ``raw`` (bytes as on the wire) says, both in the register's ``unit``."""

    register: str
    role: str
    raw: bytes
    value: float
    held: float
    unit: str
    step: float
    """How far apart the values are that the register can hold there."""

    @property
    def cost(self) -> float:
        """What the register's format changes: held − value, in ``unit``."""
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


def calibration_registers(profile: Profile) -> tuple[str, ...]:
    """Writable registers with a role in a calibration, in the profile's order,
    the checksum last."""
    names = [
        name for name, r in profile.registers.items() if r.access == "rw" and r.role and r.role not in NOT_CALIBRATION
    ]
    last = profile.crc.register_name if profile.crc else profile.by_role(CRC_ROLE)
    return tuple(sorted(names, key=lambda name: name == last))


def build_image(profile: Profile, coefficients: Mapping[str, float], *, date_days: int) -> RegisterImage:
    """``coefficients`` by role, each in its register's unit, with
    ``reference_temperature`` among them; ``date_days`` since 1970-01-01.

    A register whose role has no coefficient gets 0: the calibration does not
    have that effect. Raises RegisterValueError for a value that does not fit,
    InputError where a scale factor (or the reference temperature of temperature
    effects) is missing, ProfileError where the checksum covers other registers.
    """
    names = calibration_registers(profile)
    wanted = {**coefficients, DATE_ROLE: float(date_days)}
    roles = {profile.registers[name].role for name in names}
    _refuse_gaps(roles, coefficients)
    checksum = profile.crc.register_name if profile.crc else None
    words = [_word(profile, name, wanted.get(profile.registers[name].role, 0.0)) for name in names if name != checksum]
    if checksum:
        value = checksum_of(profile, {word.register: word.raw for word in words})
        words.append(_word(profile, checksum, value))
    return RegisterImage(tuple(words), tuple(role for role in coefficients if role not in roles))


def image_of(profile: Profile, raw: Mapping[str, bytes]) -> RegisterImage:
    """The image whose raw bytes are known. Raises ProfileError for a register
    that the profile has not."""
    words = []
    for name, data in raw.items():
        if name not in profile.registers:
            raise ProfileError(f"profile {profile.name}: no register named '{name}'")
        register, value = profile.registers[name], profile.decode(name, data)
        words.append(Word(name, register.role or "", data, value, value, register.unit, codec.step(register, value)))
    return RegisterImage(tuple(words), ())


def _refuse_gaps(roles: set[str], coefficients: Mapping[str, float]) -> None:
    """Zero is a fair value for an effect that is absent, but not for these."""
    missing = [role for role in sorted(roles) if role.startswith("scale_factor.") and role not in coefficients]
    thermal = [role for role, value in coefficients.items() if role.startswith("temperature_") and value]
    if thermal and REFERENCE_ROLE in roles and REFERENCE_ROLE not in coefficients:
        missing.append(f"{REFERENCE_ROLE} (of {thermal[0]})")
    if missing:
        raise InputError(f"calibration: no {', '.join(missing)}, which the device needs")


def _word(profile: Profile, name: str, value: float) -> Word:
    register = profile.registers[name]
    raw = profile.encode(name, value)
    return Word(name, register.role, raw, value, profile.decode(name, raw), register.unit, codec.step(register, value))


def checksum_of(profile: Profile, raw: Mapping[str, bytes]) -> int:
    """The profile's checksum over registers' raw bytes (as on the wire), by
    name.

    Raises ProfileError where it covers a register that is not given,
    RegisterValueError where one holds no number or has a wrong length.
    """
    if profile.crc is None:
        raise ProfileError(f"profile {profile.name}: crc: none is described")
    for name in profile.crc.over:
        if name not in raw:
            raise ProfileError(
                f"profile {profile.name}: crc: covers register {name}, which is no writable register with a role"
            )
        if not math.isfinite(profile.decode(name, raw[name])):
            raise RegisterValueError(f"register {name}: {raw[name].hex()} is no number")
    covered = b"".join(profile.most_significant_first(raw[name]) for name in profile.crc.over)
    return codec.crc(profile.crc.algorithm, covered)
