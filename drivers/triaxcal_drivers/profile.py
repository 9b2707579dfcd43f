"""A device as data: the model of the TOML profile, and a profile with the files
it names.

The parts every device has stand here; a driver subclasses `Profile` and narrows
``streams`` and ``registers`` to its transport. An unknown key is an error that
names the nearest right one.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, FailFast, Field, Tag, model_validator

from triaxcal_drivers import registers as codec
from triaxcal_drivers.hints import clipped, nearest
from triaxcal_drivers.registers import ASCII, RegisterKind
from triaxcal_drivers.roles import (
    AXES,
    CORRECTION,
    CORRECTION_GROUPS,
    CORRECTION_ROLES,
    NOT_CALIBRATION,
    OFFSET_ROLES,
    OTHER_ROLES,
    REFERENCE_ROLE,
    SERIAL_ROLE,
)

READINGS, CORRECTED = "readings", "corrected"
READING_CHANNELS = tuple("u" + axis for axis in AXES)
"""A stream has these, and further ones by any names."""
STREAMS_MOST, CHANNELS_MOST = 16, 256  # ours have two of six channels; a Modbus reply has room for 125
STEPS_MOST = 100  # of a sequence; ours have at most three
TEXT_MOST = 250  # bytes: one reply of Modbus
SCALE_FACTOR_RATIO = 4.0
"""A scale factor this many times off its nominal value is no scale factor of
the device: data sheets allow 0.1."""


class Strict(BaseModel):
    """No unknown keys, no later changes, no numbers read out of text."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def require_readings(channels: Mapping[str, object]) -> None:
    """Raises ValueError with the first of `READING_CHANNELS` that is not
    there."""
    for name in READING_CHANNELS:
        if name not in channels:
            raise ValueError(f"channels.{name} is missing")


class Identity(Strict):
    vendor: Annotated[str, Field(description="for people")]
    product: Annotated[str, Field(description="for people")]
    serial_register: Annotated[
        str | None,
        Field(description="register that holds the serial number: text, or an integer without scale and offset"),
    ] = None
    expect: Annotated[
        dict[str, int], Field(description="registers that must hold these raw numbers: product code, vendor…")
    ] = {}


class Output(Strict):
    unit: Annotated[str, Field(description="unit of the decoded readings: V, counts, m/s²…")]
    nominal_scale_factor: Annotated[
        tuple[float, float, float] | None,
        Field(description="output per g, with its sign; guides the operator and gives the signs"),
    ] = None
    nominal_offset: Annotated[
        float | tuple[float, float, float],
        Field(description="output at 0 g, of each axis or of all: 2.5 where an analog output of 5 V is in the middle"),
    ] = 0.0
    thermal_sensitivity_per_k: Annotated[
        float | None,
        Field(ge=0, le=0.1, description="by how much 1 K changes bias [g] and scale factor [relative], for the budget"),
    ] = None

    @model_validator(mode="after")
    def _not_zero(self) -> Self:
        if self.nominal_scale_factor and 0.0 in self.nominal_scale_factor:
            raise ValueError("nominal_scale_factor must not be zero")
        return self

    @property
    def offsets(self) -> tuple[float, float, float]:
        """Of the three axes, at 0 g."""
        given = self.nominal_offset
        return given if isinstance(given, tuple) else (given, given, given)

    @property
    def signs(self) -> tuple[Literal[-1, 1], Literal[-1, 1], Literal[-1, 1]] | None:
        """Of the scale factors, where they are declared."""
        if self.nominal_scale_factor is None:
            return None
        x, y, z = self.nominal_scale_factor
        return (1 if x > 0 else -1, 1 if y > 0 else -1, 1 if z > 0 else -1)


class Sampling(Strict):
    rate_hz: Annotated[float, Field(gt=0, description="samples a second that the device delivers")]
    silence_timeout_s: Annotated[
        float, Field(gt=0, le=3600, description="without samples for so long a stream is silent")
    ] = 2.0
    reply_timeout_s: Annotated[float, Field(gt=0, le=3600, description="how long a request waits for its reply")] = 1.0


class Register(Strict):
    """A number in the device. ``role`` says what it is to a calibration.

    Roles: ``scale_factor.x`` [output unit/g], ``misalignment.x`` [rad],
    ``bias.x`` [g], any effect's coefficient (``second_order_nonlinearity.x``,
    ``temperature_bias.y``…); or ``matrix.xx``, ``offset.x`` … of a `Correction`
    with a form (``.t1`` per K, ``.t2`` per K²); ``reference_temperature`` [°C],
    ``calibration_date`` (days since 1970-01-01), ``calibration_crc``,
    ``serial_number``, ``write_counter``. The value is ``raw * scale + offset``;
    it is an exact integer where type, scale and offset are integers. A register of
    type "ascii" holds text of ``length`` characters, filled up with NULs or spaces.
    """

    type: Annotated[RegisterKind, Field(description="one of the register types")]
    role: Annotated[str | None, Field(description="what it is to a calibration: scale_factor.x, bias.y…")] = None
    length: Annotated[int | None, Field(ge=1, le=TEXT_MOST, description="bytes of a text, with what fills it up")] = (
        None
    )
    access: Annotated[Literal["ro", "rw", "wo"], Field(description="what may be done with it")] = "rw"
    unit: Annotated[str, Field(description="unit of its value")] = ""
    scale: Annotated[int | float, Field(description="value = raw * scale + offset")] = 1.0
    offset: Annotated[int | float, Field(description="value = raw * scale + offset")] = 0.0
    minimum: Annotated[int | float | None, Field(description="no smaller value is written")] = None
    maximum: Annotated[int | float | None, Field(description="no larger value is written")] = None
    description: Annotated[str, Field(description="for people")] = ""

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be zero")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError(f"minimum {self.minimum} is above maximum {self.maximum}")
        if (self.type == ASCII) != (self.length is not None):
            raise ValueError('type = "ascii" and length (in bytes) go together')
        if self.type == ASCII:
            self._require_plain_text()
        return self

    def _require_plain_text(self) -> None:
        if self.access != "ro":
            raise ValueError('a register of type "ascii" is read-only: set access = "ro"')
        if self.role not in (None, SERIAL_ROLE):
            raise ValueError(f'a register of type "ascii" has no role but {SERIAL_ROLE}')
        if given := {"scale", "offset", "minimum", "maximum"} & self.model_fields_set:
            raise ValueError(f'{min(given)} is for numbers, not for type "ascii"')


class WriteStep(Strict):
    write: Annotated[str, Field(description="register to write")]
    value: Annotated[int | float, Field(description="value in the register's unit")]
    timeout_s: Annotated[
        float | None, Field(gt=0, le=120, description="how long its reply may take, where longer than any other")
    ] = None


class WaitStep(Strict):
    wait_s: Annotated[float, Field(ge=0, le=60, description="do nothing for so long")]


class PollStep(Strict):
    poll: Annotated[str, Field(description="register to read until it holds `until`")]
    until: Annotated[int | float, Field(description="value to wait for")]
    mask: Annotated[int | None, Field(gt=0, description="the bits of an integer register that count")] = None
    timeout_s: Annotated[float, Field(gt=0, le=120, description="how long to wait for it")] = 2.0


class ReconnectStep(Strict):
    reconnect: Annotated[Literal[True], Field(description="close and open the connection, trying until it answers")]
    timeout_s: Annotated[float, Field(gt=0, le=120, description="how long to try")] = 5.0


class SendStep(Strict):
    send: Annotated[str, Field(description='identifier of the CAN frame: "0x050"')]
    data: Annotated[str, Field(description='its bytes, up to eight: "FF AA 03 09 00"')] = ""
    extended: Annotated[bool, Field(description="whether the identifier has 29 bits")] = False

    @model_validator(mode="after")
    def _on_the_bus(self) -> Self:
        if not re.fullmatch("0x[0-9A-Fa-f]{1,8}", self.send):
            raise ValueError(f'send: expected an identifier as in "0x050", not {clipped(repr(self.send))}')
        if not re.fullmatch("([0-9A-Fa-f]{2} ?){0,8}", self.data):
            raise ValueError(f'data: expected up to eight bytes as in "FF AA 03", not {clipped(repr(self.data))}')
        if self.identifier > (0x1FFFFFFF if self.extended else 0x7FF):
            hint = "" if self.extended or self.identifier > 0x1FFFFFFF else "; set extended = true"
            raise ValueError(f"send: {self.send} is no identifier of {29 if self.extended else 11} bits{hint}")
        return self

    @property
    def identifier(self) -> int:
        return int(self.send, 16)

    @property
    def octets(self) -> bytes:
        return bytes.fromhex(self.data)


Step = WriteStep | WaitStep | PollStep | ReconnectStep
_KEYS = {"write": WriteStep, "wait_s": WaitStep, "poll": PollStep, "reconnect": ReconnectStep, "send": SendStep}
"""The key that every step of a kind has."""


def _kind(step: object) -> str | None:
    """Name of the model of a step, so that a fault is told of that kind alone."""
    if isinstance(step, Mapping):
        return next((model.__name__ for key, model in _KEYS.items() if key in step), None)
    return type(step).__name__


_BY_KEY = Discriminator(
    _kind, custom_error_type="step", custom_error_message=f"expected a step with one of the keys {', '.join(_KEYS)}"
)
_Tagged = (
    Annotated[WriteStep, Tag("WriteStep")]
    | Annotated[WaitStep, Tag("WaitStep")]
    | Annotated[PollStep, Tag("PollStep")]
    | Annotated[ReconnectStep, Tag("ReconnectStep")]
)
Steps = Annotated[
    tuple[Annotated[_Tagged, _BY_KEY], ...], Field(max_length=STEPS_MOST), FailFast()
]  # a step has a dozen faults at once
StartSteps = Annotated[
    tuple[Annotated[_Tagged | Annotated[SendStep, Tag("SendStep")], _BY_KEY], ...],
    Field(max_length=STEPS_MOST),
    FailFast(),
]


SEQUENCES = ("start", "unlock", "store", "lock", "reset")


class Sequences(Strict):
    """What to do before the device streams, before writing, to make it permanent,
    after writing, and to start the device afresh."""

    start: Annotated[
        StartSteps, Field(description="steps after the identification, before each stream and after each restart")
    ] = ()

    unlock: Annotated[Steps, Field(description="steps before writing")] = ()
    store: Annotated[Steps, Field(description="steps that make writes last; without any, each write lasts")] = ()
    lock: Annotated[Steps, Field(description="steps after writing")] = ()
    reset: Annotated[Steps, Field(description="steps that restart the device; without any, only the supply does")] = ()


class Crc(Strict):
    """A checksum over the calibration registers' raw bytes in the order given.

    Each most significant byte first, whatever the order on the wire.
    """

    register_name: Annotated[str, Field(alias="register", description="register that holds it")]
    algorithm: Annotated[Literal["crc-16/modbus", "crc-32"], Field(description="how it is computed")]
    over: Annotated[tuple[str, ...], Field(min_length=1, description="registers that it covers, in order")]


class Correction(Strict):
    """How the device corrects its readings by its calibration registers.

    Without ``form``, u = K (R a + b) with the nine roles of the linear model. With
    it, u is the reading before the correction and y the one after it; a parameter
    without a register is fixed, C at its nominal diagonal.
    """

    form: Annotated[
        Literal["matrix", "matrix-after"] | None,
        Field(description='"matrix": y = C (u − o); "matrix-after": y = C u − o, by roles matrix.xx … and offset.x …'),
    ] = None
    readings: Annotated[
        Literal["before", "after"] | None,
        Field(
            description='"before": streams.readings are not corrected by the calibration registers; '
            '"after": they are, and there is no other output'
        ),
    ] = None
    output_per_g: Annotated[float, Field(gt=0, description="of y: 9.80665 where y is in m/s²")] = 1.0

    @model_validator(mode="after")
    def _of_a_form(self) -> Self:
        if self.form is None and self.readings == "after":
            raise ValueError(f"readings after the device's correction need a form: {_FORMS}")
        if self.form is None and "output_per_g" in self.model_fields_set:
            raise ValueError(f"output_per_g needs a form: {_FORMS}")
        return self


_FORMS = '"matrix" for y = C (u − o), "matrix-after" for y = C u − o'
ONE_UNIT = 0.5
"""Readings whose nominal output per g differs by a smaller share from that of the
corrected ones are in the same unit: no other unit of acceleration is so near."""


def _holds_calibration(role: str | None) -> bool:
    return role is not None and role not in NOT_CALIBRATION


def _is_of_form(role: str | None) -> bool:
    return role is not None and role.partition(".")[0] in CORRECTION


def _gaps(roles: Collection[str | None]) -> Iterator[str]:
    """What is missing of each group of roles that a device has all or none of."""
    for group in CORRECTION_GROUPS:
        missing = [role for role in group if role not in roles]
        if missing and len(missing) < len(group):
            there = ", ".join(role for role in group if role in roles)
            yield f"roles {there} without {', '.join(missing)}: [correction] takes a register for each axis"


class Profile(Strict):
    """The part of a profile that every device has."""

    wire_order: ClassVar[codec.ByteOrder] = "big"
    """Of the bytes that a driver reads and writes for a register."""
    sends: ClassVar[bool] = False
    """Whether its devices take frames by `SendStep`."""

    format: Annotated[Literal["triaxcal.profile/1"], Field(description="always this text")]
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$", description="lower case, digits, ., _ and -")]
    title: Annotated[str, Field(description="for people")] = ""
    source: Annotated[str, Field(description="for people: document and page that it was made from")] = ""
    driver: Annotated[str, Field(description="can, modbus, mcap (files alone), or an installed driver")]
    identity: Identity
    output: Output
    sampling: Sampling
    streams: Mapping[str, Any]
    registers: Mapping[str, Any] = {}
    sequences: Sequences = Sequences()
    crc: Crc | None = None
    correction: Correction | None = None

    @model_validator(mode="after")
    def _names_resolve(self) -> Self:
        if READINGS not in self.streams:
            raise ValueError(f"streams.{READINGS} is missing")
        named = [("identity.serial_register", self.identity.serial_register)] if self.identity.serial_register else []
        named += [("identity.expect", n) for n in self.identity.expect]
        for label in SEQUENCES:
            for step in getattr(self.sequences, label):
                if isinstance(step, WriteStep):
                    named.append((f"sequences.{label}", step.write))
                elif isinstance(step, PollStep):
                    named.append((f"sequences.{label}", step.poll))
                elif isinstance(step, SendStep) and not self.sends:
                    raise ValueError(f"sequences.{label}: send is for devices on CAN; write a register")
        if self.crc:
            named += [("crc", n) for n in (self.crc.register_name, *self.crc.over)]
        for where, name in named:
            if name not in self.registers:
                raise ValueError(f"{where}: no register named '{name}'{nearest(name, self.registers)}")
            if self.registers[name].type == ASCII and where != "identity.serial_register":
                raise ValueError(f'{where}: register {name} holds text (type "ascii"), where a number is needed')
        for step in self.sequences.start:
            if isinstance(step, WriteStep) and _holds_calibration(self.registers[step.write].role):
                raise ValueError(
                    f"sequences.start: register {step.write} holds calibration; only provisioning writes it"
                )
        roles = Counter(r.role for r in self.registers.values() if r.role)
        for role in sorted(r for r, count in roles.items() if count > 1):
            raise ValueError(f"registers: role '{role}' is given twice")
        self._require_sound_correction()
        return self

    def _require_sound_correction(self) -> None:
        """Raises ValueError where the roles do not go with the form of the
        correction, or with each other."""
        of_form = {r.role: name for name, r in self.registers.items() if _is_of_form(r.role)}
        form = None if self.correction is None else self.correction.form
        for role, name in of_form.items():
            if role not in CORRECTION_ROLES:
                raise ValueError(f"registers.{name}: no role '{role}'{nearest(role, CORRECTION_ROLES)}")
        if of_form and form is None:
            role, name = next(iter(of_form.items()))
            gaps = "".join(f"; {gap}" for gap in _gaps(of_form))
            raise ValueError(f"registers.{name}: the role {role} needs [correction] form = {_FORMS}{gaps}")
        if form is None:
            return
        if not of_form:
            raise ValueError(f"correction: form needs registers with roles such as {', '.join(OFFSET_ROLES)}")
        for name, r in self.registers.items():
            if r.role is not None and r.role not in of_form and r.role not in OTHER_ROLES:
                other, theirs = next(iter(of_form.items()))
                raise ValueError(
                    f"registers.{name}: the role {r.role} does not go with {other} (registers.{theirs}): a device "
                    f'corrects either by form = "{form}" or by the model of scale factor, misalignment and bias'
                )
        for gap in _gaps(of_form):
            raise ValueError(f"registers: {gap}")
        if any(role.endswith((".t1", ".t2")) for role in of_form) and self.by_role(REFERENCE_ROLE) is None:
            raise ValueError(f"registers: roles with .t1 or .t2 need one with the role {REFERENCE_ROLE}")
        self._require_sound_outputs()

    def _require_sound_outputs(self) -> None:
        assert self.correction is not None
        per_g, nominal = self.correction.output_per_g, self.output.nominal_scale_factor
        if self.correction.readings == "after":
            if CORRECTED in self.streams:
                raise ValueError('correction: with readings = "after" there is no streams.corrected beside them')
            if nominal is not None and not self._one_unit:
                raise ValueError(
                    f"correction: output_per_g = {per_g:g}, and output.nominal_scale_factor says "
                    f'{", ".join(f"{n:g}" for n in nominal)}: with readings = "after" both are of the same output'
                )
        elif nominal is None:
            raise ValueError("correction: form needs output.nominal_scale_factor")

    @property
    def _one_unit(self) -> bool:
        """Whether readings and corrected output are in one unit."""
        per_g = 1.0 if self.correction is None else self.correction.output_per_g
        nominal = self.output.nominal_scale_factor
        return nominal is None or all(abs(abs(n) / per_g - 1) < ONE_UNIT for n in nominal)

    @property
    def nominal_diagonal(self) -> tuple[float, float, float]:
        """Of the matrix C of the correction: as in a device that holds no
        calibration."""
        nominal = self.output.nominal_scale_factor
        if self.correction is None or nominal is None or self._one_unit:
            return (1.0, 1.0, 1.0)
        x, y, z = (self.correction.output_per_g / n for n in nominal)
        return (x, y, z)

    @property
    def own_output(self) -> str | None:
        """The stream of the device's own corrected output; None without one."""
        return CORRECTED if CORRECTED in self.streams else READINGS if self.reads_corrected else None

    @property
    def output_per_g(self) -> float:
        """Of `own_output`, in its unit."""
        return 1.0 if self.correction is None else self.correction.output_per_g

    def nominal_of(self, stream: str) -> tuple[float, float, float] | None:
        """Nominal output per g of a stream; None where nobody knows it."""
        nominal = self.output.nominal_scale_factor
        if stream != self.own_output or (self.reads_corrected and nominal is not None):
            return nominal
        return (self.output_per_g,) * 3

    def offset_of(self, stream: str) -> tuple[float, float, float]:
        """Nominal output of a stream at 0 g."""
        return self.output.offsets if stream == READINGS else (0.0, 0.0, 0.0)

    @property
    def reads_corrected(self) -> bool:
        """Whether `streams.readings` are corrected by the calibration registers."""
        return self.correction is not None and self.correction.readings == "after"

    def files(self) -> tuple[str, ...]:
        """Names of the files this profile refers to (DBC, EDS), relative to it."""
        return ()

    def optional_files(self) -> tuple[str, ...]:
        """Names of files that belong to it where they are there."""
        return ()

    def by_role(self, role: str) -> str | None:
        """The name of the register with that role."""
        return next((name for name, r in self.registers.items() if r.role == role), None)

    def encode(self, name: str, value: float) -> bytes:
        """``value`` as the bytes of register ``name`` in `wire_order`. Raises
        RegisterValueError."""
        return codec.encode(self.registers[name], value, order=self.wire_order, name=name)

    def decode(self, name: str, raw: bytes) -> float:
        """The inverse of `encode`. Raises RegisterValueError on a wrong length."""
        return codec.decode(self.registers[name], raw, order=self.wire_order, name=name)

    def raw_number(self, name: str, raw: bytes) -> int | None:
        """The bytes of register ``name`` as the device counts, without scale
        and offset; None where they are no number. Raises RegisterValueError on
        a wrong length."""
        return codec.raw_number(self.registers[name], raw, order=self.wire_order, name=name)

    def text(self, name: str, raw: bytes) -> str:
        """The text in register ``name`` of type "ascii". Raises
        RegisterValueError."""
        return codec.text(self.registers[name], raw, name=name)

    def most_significant_first(self, raw: bytes) -> bytes:
        """The bytes of a register, whatever their order on the wire."""
        return raw if self.wire_order == "big" else raw[::-1]


@dataclass(frozen=True)
class Bundle:
    """A validated profile with its own text and the bytes of every file it
    names.

    A recording carries one, so that a replay decodes with what the station
    decoded with.
    """

    profile: Profile
    text: bytes
    files: Mapping[str, bytes] = field(default_factory=dict)

    def digest(self) -> str:
        """SHA-256 over profile and files, hex."""
        h = hashlib.sha256(self.text)
        for name in sorted(self.files):
            h.update(name.encode() + b"\0" + len(self.files[name]).to_bytes(8, "big") + self.files[name])
        return h.hexdigest()
