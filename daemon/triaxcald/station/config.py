"""The station file: units and their places, the plan of their measurement, and the
limits."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, FailFast, Field, ValidationInfo, field_validator, model_validator

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import work
from triaxcald.errors import InputError, SerialTwice, TwoAnswer
from triaxcald.mounting import AXES, rotation
from triaxcald.provision.identity import WrongUnit, same_serial
from triaxcald.station.buses import BUSES_MOST, NAME, Bus, BusPlace, bus_places, taken_for
from triaxcald.station.faces import OWN_NAMES
from triaxcald.station.reconnect import RetryPolicy, claimed, until_open
from triaxcald.station.simulators import others_at
from triaxcald.station.starting import StartingDevice

PathText = Annotated[str, Field(pattern=r"^[^\x00]+$")]
UNITS_MOST = 128  # as many nodes as a CAN bus has


class Stop(td.Strict):
    """Poses on demand: the acquisition ends as soon as they suffice."""

    uncertainty_g: Annotated[
        float,
        Field(
            gt=0,
            description="combined standard uncertainty of the magnitude, rms over all orientations, as the budget of "
            "the certificate states it",
        ),
    ]
    poses_least: Annotated[int, Field(ge=9, le=1000, description="distinct poses in any case")] = 9
    poses_most: Annotated[
        int, Field(ge=9, le=1000, description="distinct poses of the plan, after which it ends in any case")
    ] = 26

    @model_validator(mode="after")
    def _least_is_not_above_most(self) -> Self:
        if self.poses_least > self.poses_most:
            raise ValueError(f"poses_least: {self.poses_least} is above poses_most, {self.poses_most}")
        return self


class Plan(td.Strict):
    """Poses to record, seconds to hold each, poses to check the device by
    afterwards."""

    poses: Annotated[int, Field(ge=9, le=1000)] = 26
    stop: Annotated[Stop | None, Field(description="in place of poses: as many as an uncertainty needs")] = None
    hold_s: Annotated[float, Field(ge=0.6, le=3600)] = 3.0
    repeat: Annotated[bool, Field(description="ask for the first pose once more at the end")] = True
    check_poses: Annotated[int, Field(ge=1, le=100)] = 6
    rezero_poses: Annotated[
        int, Field(ge=3, le=1000, description="poses of `run --rezero`, which renews the biases alone")
    ] = 4
    apart_deg: Annotated[float, Field(ge=1, le=60, description="poses nearer than this count once")] = 10.0
    patience_s: Annotated[
        float, Field(gt=0, description="give up when no new pose has come for so long, in seconds of the samples")
    ] = 300.0
    comes_back_s: Annotated[
        float,
        Field(
            ge=0,
            le=3600,
            description="wait so long for a unit that was lost, though no other is at work; others that are, are "
            "waited for in any case",
        ),
    ] = 10.0

    @property
    def poses_most(self) -> int:
        """The distinct poses of a full calibration; on demand the most."""
        return self.poses if self.stop is None else self.stop.poses_most

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if self.stop is not None and "poses" in self.model_fields_set:
            raise ValueError("poses and stop: give one or the other")
        return self


class Limits(td.Strict):
    """What is good enough; nothing is judged where nothing is given."""

    rms_g: Annotated[float | None, Field(gt=0)] = None
    cross_validated_rms_g: Annotated[float | None, Field(gt=0)] = None
    verification_rms_g: Annotated[float | None, Field(gt=0)] = None


class Provisioning(td.Strict):
    write: Annotated[bool, Field(description="write the result to the device")] = True
    power_cycle: Annotated[
        bool,
        Field(description="have the operator switch the supply off and on where nothing else shows what is stored"),
    ] = False


def _mounting(text: str) -> str:
    rotation(text)
    return text


FACE_MOST = 24
"""Characters of a face's name: a corner with three of them still fits a line of 80."""


class Fixture(td.Strict):
    together: Annotated[
        bool, Field(description="all units are turned together, by one instruction for the whole fixture")
    ] = False
    faces: dict[str, str] = Field(
        default_factory=dict, description="names of the fixture's faces by its axes, +x to -z"
    )

    @field_validator("faces")
    @classmethod
    def _faces_differ(cls, faces: dict[str, str]) -> dict[str, str]:
        for axis, name in faces.items():
            if axis not in AXES:
                raise ValueError(f"unknown axis '{axis}', expected {', '.join(AXES)}")
            if not 1 <= len(name) <= FACE_MOST or not name.isprintable():
                raise ValueError(f"{axis}: expected a name of 1 to {FACE_MOST} printable characters")
        names = list({**OWN_NAMES, **faces}.values())
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two faces have the name '{name}'; a face that is not given has that of its axis")
        return faces

    @property
    def names(self) -> dict[str, str]:
        """Name of each face by its axis."""
        return {**OWN_NAMES, **self.faces}


def _work_text(text: str) -> str:
    if why := work.wrong(text):
        raise ValueError(why.removesuffix(f", not {len(text)}"))  # the message quotes the text itself
    return text


WorkText = Annotated[str, AfterValidator(_work_text)]


class Golden(td.Strict):
    """A unit that is verified from time to time to check the station itself."""

    serial: WorkText
    every_h: Annotated[float, Field(gt=0, description="it is due in each slot so long after it last verified there")]
    calibration: Annotated[
        PathText, Field(description="the calibration that it is known to have, beside the station file")
    ]


class Rules(td.Strict):
    """Conditions under which a run may begin."""

    serial: Annotated[
        str | None, Field(description="regular expression that every serial number matches as a whole")
    ] = None
    attempts: Annotated[int | None, Field(ge=1, description="most attempts at one serial number")] = None
    operator: Annotated[bool, Field(description="nothing begins without an operator")] = False
    retest_reason: Annotated[bool, Field(description="a re-test after a pass needs a reason")] = False
    open_loopback: Annotated[bool, Field(description="requests from this machine need no session of an operator")] = (
        False
    )
    golden: Golden | None = None

    def of_golden(self, serial: str | None) -> bool:
        """Whether this is the serial number of the golden unit."""
        return self.golden is not None and serial is not None and same_serial(self.golden.serial, serial)

    @field_validator("serial")
    @classmethod
    def _compiles(cls, text: str | None) -> str | None:
        try:
            re.compile(text or "")
        except (re.error, OverflowError, RecursionError) as e:
            raise ValueError(f"expected a regular expression: {e}") from None
        return text


class WorkDefaults(td.Strict):
    """What units are measured for, where the command line does not say."""

    operator: WorkText | None = None
    order: WorkText | None = None
    batch: WorkText | None = None
    part_number: WorkText | None = None
    fixture: WorkText | None = None


class Receiver(td.Strict):
    """Where the service delivers each result (`triaxcal.result/1`)."""

    name: Annotated[str, Field(pattern=NAME)]
    url: Annotated[str | None, Field(pattern=r"^https?://\S+$", description="receives each result by POST")] = None
    folder: Annotated[PathText | None, Field(description="receives each result as a file, beside the station file")] = (
        None
    )
    token_file: Annotated[
        PathText | None, Field(description="file with the bearer token for `url`, beside the station file")
    ] = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.url is None) == (self.folder is None):
            raise ValueError("url or folder: give one of them")
        if self.token_file is not None and self.url is None:
            raise ValueError("token_file: only a url takes a token")
        return self


class Token(td.Strict):
    """A device that holds keys, by PKCS #11."""

    module: Annotated[PathText, Field(description="library of the device's maker")]
    token: Annotated[str, Field(min_length=1, description="label of the token")]


class Sign(td.Strict):
    """By which key the recordings of runs are signed. Without it, by the only key in
    the folder `keys`, if there is one."""

    key: Annotated[str | None, Field(pattern=NAME, description="name of the key")] = None
    folder: Annotated[PathText | None, Field(description="with the keys, beside the station file; default: keys")] = (
        None
    )
    passphrase_file: Annotated[
        PathText | None,
        Field(
            description="file with the key's passphrase, beside the station file; default: the environment's "
            "TRIAXCAL_KEY_PASSPHRASE"
        ),
    ] = None
    pkcs11: Annotated[Token | None, Field(description="the key is in this device, and the passphrase its PIN")] = None
    timestamp: Annotated[
        str | None, Field(pattern=r"^https?://\S+$", description="URL of a time-stamping authority (RFC 3161)")
    ] = None


class Unit(td.Strict):
    name: Annotated[str, Field(pattern=NAME)]
    profile: Annotated[
        str,
        Field(pattern=r"^[^\x00]+$", description="a file beside the station file, or the name of a built-in profile"),
    ]
    serial: Annotated[WorkText | None, Field(description="refuse any other unit")] = None
    signs: Annotated[
        tuple[Literal[-1, 1], Literal[-1, 1], Literal[-1, 1]] | None,
        Field(description="of the scale factors; by default the profile's"),
    ] = None
    mounting: Annotated[
        str,
        AfterValidator(_mounting),
        Field(description="the fixture's axes along which the unit's x, y, and z point"),
    ] = "+x+y+z"
    bus: dict[str, Any]


class StationFile(td.Strict):
    format: Literal["triaxcal.station/1"]
    name: str
    folder: Annotated[
        str, Field(pattern=r"^[^\x00]+$", description="where recordings and results go, beside the station file")
    ] = "."
    given_reference: Annotated[
        float | None,
        Field(
            alias="reference",
            ge=0.9,
            le=1.1,
            description="local gravity in units of g, which registers and limits are in too",
        ),
    ] = None
    latitude_deg: Annotated[
        float | None, Field(ge=-90, le=90, description="with height_m, instead of reference: gravity by formula")
    ] = None
    height_m: Annotated[float | None, Field(ge=-500, le=9000, description="above sea level")] = None
    reference_uncertainty: Annotated[
        float | None, Field(ge=0, le=0.1, description="standard uncertainty of the reference, in units of g")
    ] = None
    thermometer_uncertainty_k: Annotated[
        float | None, Field(ge=0, le=100, description="standard uncertainty of the units' thermometers")
    ] = None
    thermal_sensitivity_per_k: Annotated[
        float | None,
        Field(ge=0, le=0.1, description="by how much 1 K changes bias [g] and scale factor [relative] of such units"),
    ] = None
    holds_at: Annotated[
        Literal["end", "mean"] | Annotated[float, Field(ge=0, allow_inf_nan=False)],
        Field(description="moment of the recording, in s from its start, for which effects of time hold elsewhere"),
    ] = "end"
    odds: Annotated[
        PathText | None,
        Field(description="odds of effects learned from units of the type (`fleet -o`), beside the station file"),
    ] = None
    plan: Plan = Plan()
    limits: Limits = Limits()
    provisioning: Provisioning = Provisioning()
    fixture: Fixture = Fixture()
    rules: Rules = Rules()
    work: WorkDefaults = WorkDefaults()
    sign: Annotated[Sign | None, Field(description="by which key recordings are signed")] = None
    deliver: Annotated[tuple[Receiver, ...], Field(description="receivers of each result, for the service alone")] = ()
    buses: Annotated[
        tuple[Bus, ...],
        Field(max_length=BUSES_MOST, description="listened to by `record`: all their frames"),
        FailFast(),
    ] = ()
    units: Annotated[tuple[Unit, ...], Field(max_length=UNITS_MOST, validate_default=True), FailFast()] = ()

    @property
    def reference(self) -> float:
        """Local gravity in g: as given, or by the place's normal gravity, or 1
        where the unit is local gravity."""
        if self.latitude_deg is not None and self.height_m is not None:
            return tc.local_gravity_g(self.latitude_deg, self.height_m)[0]
        return 1.0 if self.given_reference is None else self.given_reference

    @property
    def moment(self) -> tc.Moment | float:
        """As `triaxcal.diagnosis.diagnose` has it."""
        return tc.Moment(self.holds_at) if isinstance(self.holds_at, str) else self.holds_at

    def stated(self, profile: td.Profile) -> tc.Stated:
        """Uncertainties stated by the station file, and the thermal sensitivity stated
        by the device's ``profile``."""

        own = self.thermal_sensitivity_per_k
        return tc.Stated.at(
            self.latitude_deg,
            self.height_m,
            self.reference_uncertainty,
            thermometer_k=self.thermometer_uncertainty_k,
            thermal_sensitivity=profile.output.thermal_sensitivity_per_k if own is None else own,
        )

    @model_validator(mode="after")
    def _one_reference(self) -> Self:
        if (self.latitude_deg is None) != (self.height_m is None):
            raise ValueError("latitude_deg and height_m: give both, or neither")
        if self.latitude_deg is not None and self.given_reference is not None:
            raise ValueError("reference: latitude_deg and height_m say it already; give one or the other")
        return self

    @model_validator(mode="after")
    def _golden_is_judged(self) -> Self:
        if self.rules.golden is not None and self.limits.verification_rms_g is None:
            raise ValueError("rules.golden: give limits.verification_rms_g too, by which the golden unit is judged")
        return self

    @model_validator(mode="after")
    def _poses_fit_apart(self) -> Self:
        plan = self.plan
        most = "poses" if plan.stop is None else "stop.poses_most"
        counts = {most: plan.poses_most, "check_poses": plan.check_poses, "rezero_poses": plan.rezero_poses}
        for name, count in counts.items():
            if plan.apart_deg > _farthest_apart_deg(count):
                raise ValueError(f"plan.{name}: there are not so many directions {plan.apart_deg:g} degrees apart")
        return self

    @model_validator(mode="after")
    def _stop_is_within_reach(self) -> Self:
        """No pose lowers the uncertainty of the reference."""
        reference = tc.Stated.at(self.latitude_deg, self.height_m, self.reference_uncertainty).reference
        if self.plan.stop is not None and reference is not None and self.plan.stop.uncertainty_g <= reference:
            raise ValueError(
                f"plan.stop.uncertainty_g: out of reach, since the reference alone is uncertain by {reference:.2g} g"
            )
        return self

    @field_validator("units")
    @classmethod
    def _something_is_there(cls, units: tuple[Unit, ...], info: ValidationInfo) -> tuple[Unit, ...]:
        if not units and not info.data.get("buses", True):
            raise ValueError("expected at least 1, or a bus that is listened to")
        return units

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        units, buses = [u.name for u in self.units], [b.name for b in self.buses]
        for key, names in ("units", units), ("buses", units + buses):
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f"{key}: the name '{name}' is given twice")
        receivers = [receiver.name for receiver in self.deliver]
        for name in receivers:
            if receivers.count(name) > 1:
                raise ValueError(f"deliver: the name '{name}' is given twice")
        for name in buses:
            if unit := taken_for(name, units):
                raise ValueError(f"buses: recordings of unit {unit} may be called '{name}'")
        return self


def _farthest_apart_deg(count: int) -> float:
    """No ``count`` points of a sphere are all farther apart than this (Fejes
    Tóth 1943; reached by 3, 4, 6 and 12)."""
    if count < 3:
        return 180.0
    chord = math.sqrt(4 - 1 / math.sin(math.pi * count / (6 * (count - 2))) ** 2)
    return math.degrees(2 * math.asin(chord / 2))


@dataclass(frozen=True)
class Place:
    """A unit with its profile and its bus settings; its start sequence is left out
    without ``start``."""

    unit: Unit
    bundle: td.Bundle
    bus: BaseModel
    start: bool = True

    @property
    def address(self) -> str:
        """Address of the unit, for messages."""
        return ", ".join(f"{k}={v}" for k, v in self.unit.bus.items())

    @property
    def device_name(self) -> str:
        """The device at its address in the driver's words, such as "node 5 on
        socketcan can0"."""
        claim = td.claim_of(self.bus)
        return f"{claim.device} of {claim.host}" if claim.host else claim.device

    def device(self) -> td.Device:
        return td.driver_named(self.bundle.profile.driver).device(self.bundle, self.bus)

    @asynccontextmanager
    async def opened(
        self,
        policy: RetryPolicy | None = None,
        tell: Callable[[Exception], None] = lambda _: None,
        identify: Callable[[td.Device], Awaitable[None]] | None = None,
    ) -> AsyncIterator[td.Device]:
        """The device, open and claimed until the context ends.

        Raises DeviceInUse, BusError, DeviceAbsent and the errors of ``identify``.
        With ``policy`` these are retried first, DeviceInUse only if the policy says
        so; ``tell`` receives each error meanwhile. The claim stays if the device is
        closed and opened in between, as a reset does. Where another unit answers, the
        error names the simulators of this machine at the place.
        """
        device = self.device()
        if self.start and self.bundle.profile.sequences.start:
            device = StartingDevice(device, self.bundle, self.device_name)

        async def attempt() -> None:
            await device.open()
            if identify is not None:
                await identify(device)

        async with claimed(td.claim_of(self.bus), policy, tell):
            try:
                await (attempt() if policy is None else until_open(attempt, policy, tell))
                yield device
            except (WrongUnit, TwoAnswer) as e:
                if others := others_at(self.bus, self.unit.serial):
                    raise type(e)("; ".join([str(e), *map(str, others)])) from e
                raise
            finally:
                with suppress(td.DriverError):
                    await device.close()

    @property
    def signs(self) -> tuple[int, int, int]:
        return self.unit.signs or self.bundle.profile.output.signs or (1, 1, 1)


@dataclass(frozen=True)
class Station:
    """A validated station file with its own text, the units' profiles, and the
    buses that are listened to."""

    path: Path
    text: bytes
    file: StationFile
    places: tuple[Place, ...]
    buses: tuple[BusPlace, ...] = ()

    @property
    def folder(self) -> Path:
        return self.path.parent / self.file.folder

    def place(self, name: str | None) -> Place:
        """The unit of that name, or the only one. Raises InputError."""
        self.require_units()
        names = [p.unit.name for p in self.places]
        if name is None and len(self.places) == 1:
            return self.places[0]
        if name not in names:
            raise InputError(f"{self.path}: units: name one of {', '.join(names)} with --unit")
        return self.places[names.index(name)]

    def require_units(self) -> None:
        """Raises InputError where it has none."""
        if not self.places:
            raise InputError(f"{self.path}: no units: only `triaxcal record` listens to its buses")


def parse_station(text: bytes, *, where: str) -> StationFile:
    """Raises ProfileError with file, line and key."""
    return td.toml_text.validate(
        StationFile, td.toml_text.parse_toml(text, where=where, expected=td.toml_text.STATION), text, where=where
    )


def load_station(path: Path) -> Station:
    """Opens no bus. Raises InputError, ProfileError, DriverMissing: one line
    with file, line and key."""
    try:
        text = td.toml_text.read_toml(path, expected=td.toml_text.STATION, pipe=True)
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e
    file = parse_station(text, where=str(path))
    bundles: dict[str, td.Bundle] = {}
    places = []
    for i, unit in enumerate(file.units):
        if unit.profile not in bundles:
            beside = path.parent / unit.profile
            bundles[unit.profile] = td.load_bundle(beside if os.path.exists(beside) else Path(unit.profile))
        bundle = bundles[unit.profile]
        driver = td.driver_named(bundle.profile.driver, where=str(path))
        bus = td.toml_text.validate(driver.bus_model, unit.bus, text, where=f"{path}: units.{i}.bus")
        judged = file.limits.verification_rms_g is not None and file.rules.golden is None  # which needs the limit too
        if judged and bundle.profile.own_output is None:
            raise InputError(
                f"{path}: limits.verification_rms_g: unit {unit.name} has no corrected stream to verify it by"
            )
        _check_roles(bundle, where=f"{path}: units.{i}.profile")
        places.append(Place(unit, bundle, bus))
        try:
            places[-1].device()  # so that a fault in the profile's files comes out before any bus is opened
        except td.AddressError as e:
            raise InputError(f"{path}: units.{i}.bus: {e}") from None
    _check_distinct(places, where=str(path))
    driven = [place.bus for place in places if isinstance(place.bus, td.can.BusSettings)]
    return Station(path, text, file, tuple(places), tuple(bus_places(file.buses, driven, text, where=str(path))))


def _check_distinct(places: Sequence[Place], *, where: str) -> None:
    """No two units are one device. Raises InputError with the key of the
    later one."""
    for (_, a), (i, b) in combinations(enumerate(places), 2):
        if td.claim_of(a.bus) == td.claim_of(b.bus):
            raise InputError(
                f"{where}: units.{i}.bus: unit {b.unit.name} is in the place of unit {a.unit.name} ({a.address})"
            )
        if a.unit.serial is not None and b.unit.serial is not None and same_serial(a.unit.serial, b.unit.serial):
            raise InputError(
                f"{where}: units.{i}.serial: unit {b.unit.name} has the serial number of unit {a.unit.name}, "
                f"{a.unit.serial}"
            )


def _check_roles(bundle: td.Bundle, *, where: str) -> None:
    """Check the roles of a profile; coefficients of effects are roles too, and only the
    daemon knows them. Raises InputError with the nearest role."""
    known = [*td.roles.LINEAR_ROLES, *td.roles.CORRECTION_ROLES]
    if any(r.role not in (None, *known, *td.roles.OTHER_ROLES) for r in bundle.profile.registers.values()):
        known += [f"{e.name}.{c.name}" for e in tc.effects.CATALOGUE for c in e.coefficients]
    known += td.roles.OTHER_ROLES
    for name, register in bundle.profile.registers.items():
        if register.role is not None and register.role not in known:
            raise InputError(
                f"{where}: {bundle.profile.name}: registers.{name}.role: "
                f"unknown role '{register.role}'{td.hints.nearest(register.role, known)}"
            )


# Changes of a station between two readings of its file.


def names_in(station: Station) -> set[str]:
    """Names of the station's units and buses."""
    return {place.unit.name for place in station.places} | {bus.name for bus in station.buses}


def changed(before: Station, after: Station) -> set[str]:
    """Names of removed, new and changed units and buses. All names, if the station's
    own entries changed: each recording contains the station file by which it is
    read."""
    if _itself(before) != _itself(after):
        return names_in(before) | names_in(after)
    old, new = _each(before), _each(after)
    return {name for name in old.keys() | new.keys() if old.get(name) != new.get(name)}


def _itself(station: Station) -> object:
    return station.file.model_copy(update={"units": (), "buses": ()})


def _each(station: Station) -> dict[str, object]:
    units = {place.unit.name: _of_unit(place) for place in station.places}
    return {**units, **{bus.name: (bus.settings, bus.given) for bus in station.buses}}


def _of_unit(place: Place) -> object:
    return place.unit, place.bundle.text, dict(place.bundle.files)


# The serial numbers that the units of one run report: a unit that answers in two
# places is one of them mixed up.


@dataclass
class SerialsSeen:
    _places: dict[str, tuple[str, str]] = field(default_factory=dict)

    def add(self, serial: str | None, unit: str, address: str) -> None:
        """Raises SerialTwice if another place has reported it before. None is a
        serial that nobody can read."""
        here = unit, address
        other = here if serial is None else self._places.setdefault(serial, here)
        if other != here:
            places = ", and ".join(f"unit {name} ({where})" for name, where in (other, here))
            raise SerialTwice(f"serial {serial} answers in two places: {places}")

    def discard(self, unit: str) -> None:
        """Forget the serial number of this unit."""
        self._places = {serial: place for serial, place in self._places.items() if place[0] != unit}


# The date: the one place that reads the calendar.

DAY_S = 86_400


def days_since_1970(now_s: float | None = None) -> int:
    """Whole days since 1970-01-01 UTC, as `calibration_date` counts them."""
    return int((time.time() if now_s is None else now_s) // DAY_S)


# Shared lines of a station: their load, and equal settings of all their users.


def check_lines(places: Sequence[Place], buses: Sequence[BusPlace] = (), *, where: str) -> None:
    """Check that every shared line can carry its recorded units, and that all its
    users, listeners too, have equal settings.

    The load of a line with one unit is not checked: its losses are counted. Raises
    InputError with the arithmetic.
    """
    _check_buses(places, buses, where=where)
    lines: dict[str, list[tuple[int, str, td.LineLoad]]] = {}
    for i, place in enumerate(places):
        loads = getattr(td.driver_named(place.bundle.profile.driver), "loads", None)
        of_streams: Mapping[str, td.LineLoad] = loads(place.bundle, place.bus) if loads else {}
        for name in (td.READINGS, td.CORRECTED):  # which are recorded side by side
            if name in of_streams:
                load = of_streams[name]
                lines.setdefault(load.line, []).append((i, f"{place.unit.name} {name}", load))
    for line, units in lines.items():
        first = units[0][2]
        for i, _, load in units:
            if load.settings != first.settings:
                raise InputError(
                    f"{where}: unit {places[i].unit.name} asks for {load.settings} on {line}, unit "
                    f"{places[units[0][0]].unit.name} for {first.settings}"
                )
        total = sum(load.share for _, _, load in units)
        if total > 1 and len({i for i, _, _ in units}) > 1:
            each = " + ".join(
                f"{name} {load.reads_per_s:.3g}/s × {1e3 * load.read_s:.3g} ms" for _, name, load in units
            )
            raise InputError(
                f"{where}: {line} at {first.settings} cannot carry its units at their rates: "
                f"{each} = {total:.0%} of its time; drive it faster, or lower sampling.rate_hz of the profiles"
            )


def _check_buses(places: Sequence[Place], buses: Sequence[BusPlace], *, where: str) -> None:
    """Raises InputError."""
    on_buses = [(f"unit {p.unit.name}", p.bus) for p in places if isinstance(p.bus, td.can.BusSettings)]
    first: dict[str, tuple[str, td.can.BusSettings]] = {}
    for who, settings in (*on_buses, *((f"bus {b.name}", b.settings) for b in buses)):
        other, theirs = first.setdefault(settings.name, (who, settings))
        if settings.driven != theirs.driven:
            raise InputError(
                f"{where}: {who} asks for {settings.driven} on {settings.name}, {other} for {theirs.driven}"
            )
