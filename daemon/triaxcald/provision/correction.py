"""May the readings be corrected already, by the registers that are to be
written?

A device may correct all that it sends by its calibration registers. What is
measured of it then is only what those registers leave, and a calibration of
that, written over them, would lose theirs.
"""

from __future__ import annotations

from triaxcal.errors import Refused
from triaxcal_drivers import registers as codec
from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import CORRECTED, Profile
from triaxcald.provision.image import CRC_ROLE, DATE_ROLE, REFERENCE_ROLE, calibration_registers
from triaxcald.provision.plausible import is_blank
from triaxcald.provision.snapshot import Snapshot

NAMED = 3
"""So many registers tell enough."""


class ReadingsNotStated(Refused):
    """The readings may be corrected already, and the profile does not say.
    Raised before anything is written."""


def leaves_open(profile: Profile) -> bool:
    """Whether the profile does not say if the readings are those before the
    device's correction: by a second stream for the corrected ones, or by
    ``correction.readings``."""
    stated = profile.correction is not None and profile.correction.readings is not None
    return CORRECTED not in profile.streams and not stated and bool(_correcting(profile))


def require_readings_before(profile: Profile, snapshot: Snapshot) -> None:
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


def not_neutral(profile: Profile, snapshot: Snapshot) -> tuple[str, ...]:
    """The registers of ``snapshot`` by which the device would change its
    readings; none of a blank device."""
    held = {name: snapshot.raw[name] for name in _correcting(profile) if name in snapshot.raw}
    if is_blank(Snapshot(held)):
        return ()
    return tuple(name for name, raw in held.items() if not _is_neutral(profile, name, raw))


def _correcting(profile: Profile) -> tuple[str, ...]:
    """The calibration registers that change readings by themselves."""
    labels = (CRC_ROLE, DATE_ROLE, REFERENCE_ROLE)
    return tuple(name for name in calibration_registers(profile) if profile.registers[name].role not in labels)


def _is_neutral(profile: Profile, name: str, raw: bytes) -> bool:
    register, value = profile.registers[name], profile.decode(name, raw)
    quantity, _, axis = (register.role or "").partition(".")
    if quantity != "scale_factor":
        return value == _nearest(profile, name, 0.0)
    # The device divides by it. Who wrote the nominal one may have rounded it
    # otherwise, by a step of the register at most.
    nominal = profile.output.nominal_scale_factor
    neutral = [1.0, *([nominal["xyz".index(axis)]] if nominal else [])]
    return any(abs(value - _nearest(profile, name, n)) <= codec.step(register, n) * (1 + 1e-9) for n in neutral)


def _nearest(profile: Profile, name: str, value: float) -> float:
    """What the register holds for ``value``, which its format may not have."""
    try:
        return profile.decode(name, profile.encode(name, value))
    except RegisterValueError:  # outside its limits
        return value
