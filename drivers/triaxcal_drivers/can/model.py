"""A CAN device's profile, the settings of its bus, and by which of these settings
processes share it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from triaxcal_drivers.claim import Claim, canonical_port
from triaxcal_drivers.errors import AddressError, ProfileError
from triaxcal_drivers.profile import (
    CHANNELS_MOST,
    READING_CHANNELS,
    STREAMS_MOST,
    Profile,
    Register,
    Strict,
    require_readings,
)
from triaxcal_drivers.registers import ByteOrder
from triaxcal_drivers.toml_text import validate

_SERIAL = ("slcan", "serial", "robotell", "seeedstudio")
"""Interfaces whose channel is a serial port."""

_NOTHING: Mapping[str, object] = MappingProxyType({})
_CHOOSING: Mapping[str, Mapping[str, object]] = {
    "socketcan": _NOTHING,
    "virtual": _NOTHING,
    "kvaser": _NOTHING,
    "udp_multicast": {"port": 43113},
    "socketcand": {"port": None},
    "vector": {"app_name": "CANalyzer", "serial": None},
    "ixxat": {"unique_hardware_id": None},
    "pcan": {"device_id": None},
    "gs_usb": {"index": None, "bus": None, "address": None},
    "usb2can": {"serial": None},
    "neovi": {"serial": None},
    "systec": {"device_number": None},
    "canalystii": {"device": 0},
    "neousys": {"device": 0},
    **dict.fromkeys(_SERIAL, _NOTHING),
}
"""Options that choose the adapter or the network, with python-can's default. Of
an interface that is not here every option counts."""


def bus_name(interface: str, channel: str | int, options: Mapping[str, object]) -> str:
    """The physical bus, the same however it is spelt."""
    name = str(channel)
    if interface in _SERIAL:
        name = _serial_port(name)
    elif interface == "virtual":
        name = f"{name} of process {os.getpid()}"
    elif interface == "udp_multicast":
        name = _address(name)
    defaults = _CHOOSING.get(interface)
    chosen = options if defaults is None else {key: options.get(key, default) for key, default in defaults.items()}
    words = [f"{key} {value}" for key, value in sorted(chosen.items()) if value is not None]
    return ", ".join([f"{interface} {name}", *words])


def claim_on_can(interface: str, channel: str | int, device: str, options: Mapping[str, object]) -> Claim:
    """``device`` is one process's. Its bus is not, unless the adapter is behind a
    serial port."""
    port = _serial_port(str(channel)) if interface in _SERIAL else None
    host = str(options["host"]) if interface == "socketcand" and "host" in options else None
    return Claim(f"{device} on {bus_name(interface, channel, options)}", host=host, serial_port=port)


def claim_to_listen(interface: str, channel: str | int, options: Mapping[str, object]) -> Claim | None:
    """A serial port is one process's; on any other bus as many may listen as
    like to."""
    if interface not in _SERIAL:
        return None
    return Claim(f"listening on {bus_name(interface, channel, options)}", serial_port=_serial_port(str(channel)))


def _serial_port(channel: str) -> str:
    return canonical_port(channel.partition("@")[0])


def _address(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError:
        return text


NODES_MOST, SOURCES_MOST = 127, 253  # nodes of CANopen, source addresses of J1939
VALUES_MOST = 256  # of a signal that says what is valid; such a signal has a byte at most

ObjectName = Annotated[
    str,
    Field(pattern=r"^0x[0-9A-Fa-f]{4}:[0-9A-Fa-f]{2}$", description='index and sub-index: "0x2100:01"'),
]


def object_address(name: str) -> tuple[int, int]:
    """``"0x2100:01"`` as (0x2100, 1)."""
    index, subindex = name.split(":")
    return int(index, 16), int(subindex, 16)


class Scaling(Strict):
    """Takes the place of the file's own scaling where given: value = raw *
    scale + offset."""

    scale: Annotated[float | None, Field(description="in place of the file's")] = None
    offset: Annotated[float | None, Field(description="in place of the file's")] = None

    @model_validator(mode="after")
    def _not_zero(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be zero")
        return self


class _Channel(Scaling):
    latest_s: Annotated[
        float | None,
        Field(gt=0, le=3600, description="the newest value before the sample, no older than this"),
    ] = None
    """A channel with it comes in a message outside the sample."""


class DbcChannel(_Channel):
    signal: Annotated[str, Field(description="name of the signal, Message.Signal, or Message@0x19.Signal")]


class PdoChannel(_Channel):
    object: Annotated[ObjectName, Field(description="mapped object, as 0x2300:01")]


class _Validity(Strict):
    """A sample whose signal holds another number than these is not valid."""

    values: Annotated[
        tuple[int, ...],
        Field(
            strict=False,  # a list, which it is once a short form has been looked for
            min_length=1,
            max_length=VALUES_MOST,
            description="unscaled numbers of a valid sample",
        ),
    ] = (1,)


class DbcValidity(_Validity):
    signal: Annotated[str, Field(description="name of the signal, or Message.Signal")]


class PdoValidity(_Validity):
    object: Annotated[ObjectName, Field(description="mapped object, as 0x2300:01")]


def _named(key: str, channel: type[Strict]) -> BeforeValidator:
    """What may be given by its name in the file alone."""
    return BeforeValidator(
        lambda given: {key: given} if isinstance(given, str) else given, json_schema_input_type=str | channel
    )


def _several(key: str, validity: type[Strict]) -> BeforeValidator:
    """One or a list, each of which may be given by its name in the file alone."""

    def listed(given: object) -> object:
        every = given if isinstance(given, list | tuple) else [given]
        return tuple({key: each} if isinstance(each, str) else each for each in every)

    return BeforeValidator(listed, json_schema_input_type=str | validity | list[str | validity])  # type: ignore[valid-type]


STAMPS_LEAST = 2
"""Counts of a time stamp from one sample to the next, at least: with fewer, two
samples of a device that is somewhat faster than it says may have one stamp."""
VALID_MOST = 16  # signals of one stream that say what is valid; three axes have a state each


class Begins(Strict):
    """A sample begins with that message and takes each other one once before the
    next begin, within one period."""

    begins: Annotated[str, Field(description="name of the message, or Message@0x19")]


Together = Annotated[
    Literal["time"] | Begins | None,
    Field(
        description='without a counter in every message: "time" joins messages that come within half a period of each '
        'other; { begins = "Message" } joins those from one such message to the next'
    ),
]


class _StampBy(Strict):
    """The device's time of a sample; it wraps with the width of its signal."""

    unit_s: Annotated[float, Field(gt=0, le=3600, description="seconds a count: 1e-6, 0.001…")]


class DbcStamp(_StampBy):
    signal: Annotated[str, Field(description="name of the signal, or Message.Signal; unscaled")]


class PdoStamp(_StampBy):
    object: Annotated[ObjectName, Field(description="mapped object, as 0x2300:01; unscaled")]


@dataclass(frozen=True)
class Wanted:
    """A channel by its name in the file."""

    reference: str
    channel: Scaling
    latest_s: float | None = None


class _Stream(Strict):
    counter: Annotated[
        str | None, Field(description="signal that all messages of a sample bear, or with `together` one of them")
    ] = None
    together: Together = None
    sync_period_s: Annotated[
        float | None, Field(ge=0.001, le=60, description="SYNC is sent so often while the stream is read (CiA 301)")
    ] = None
    channels: Mapping[str, Scaling]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        require_readings(self.channels)
        for name in READING_CHANNELS:
            if getattr(self.channels[name], "latest_s", None) is not None:
                raise ValueError(f"channels.{name}: latest_s is for other channels than ux, uy and uz")
        return self

    @property
    def begins(self) -> str | None:
        """The message that a sample begins with."""
        return self.together.begins if isinstance(self.together, Begins) else None


class DbcStream(_Stream):
    """A stream whose messages a DBC file describes.

    The sample is made of the messages that hold its channels; ``counter`` names
    a signal that each of them holds, ``valid`` one that says whether the sample
    is to be used. ``base_node_id`` is the node for which the DBC's identifiers
    are written: given it, a unit at another node sends them shifted by the
    difference.
    """

    layout: Annotated[Literal["dbc"], Field(description="dbc: a DBC file describes the messages")]
    file: Annotated[str, Field(description="the DBC file, in the profile's folder or below it")]
    base_node_id: Annotated[
        int | None, Field(ge=1, le=127, description="node of the DBC's identifiers; at another node they shift")
    ] = None
    j1939: Annotated[
        bool,
        Field(description="messages are told by their PGN, at any priority; the unit's bus has a source_address"),
    ] = False
    valid: Annotated[
        tuple[DbcValidity, ...],
        _several("signal", DbcValidity),
        Field(
            strict=False,
            max_length=VALID_MOST,
            description="signal that says whether a sample counts; of several all must say so",
        ),
    ] = ()
    time_stamp: Annotated[DbcStamp | None, Field(description="the device's time of a sample")] = None
    channels: Annotated[
        Mapping[str, Annotated[DbcChannel, _named("signal", DbcChannel)]], Field(max_length=CHANNELS_MOST)
    ]

    @model_validator(mode="after")
    def _one_address(self) -> Self:
        if self.j1939 and self.base_node_id is not None:
            raise ValueError("base_node_id does not go with j1939, where a unit has a source_address")
        return self

    def wanted(self) -> dict[str, Wanted]:
        """Each channel."""
        return {name: Wanted(c.signal, c, c.latest_s) for name, c in self.channels.items()}

    def validity(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """Names in the file, and the unscaled numbers of valid samples."""
        return tuple((valid.signal, valid.values) for valid in self.valid)

    def stamp(self) -> tuple[str, float] | None:
        """The time stamp's name in the file, and the seconds of a count."""
        return (self.time_stamp.signal, self.time_stamp.unit_s) if self.time_stamp else None


class PdoStream(_Stream):
    """A stream whose messages are the TPDOs that an EDS file maps; channels are
    the mapped objects."""

    layout: Annotated[Literal["pdo"], Field(description="pdo: an EDS file maps the messages")]
    eds: Annotated[str, Field(description="the EDS or DCF file, in the profile's folder or below it")]
    counter: Annotated[ObjectName | None, Field(description="object that all messages of a sample bear")] = None
    valid: Annotated[
        tuple[PdoValidity, ...],
        _several("object", PdoValidity),
        Field(
            strict=False,
            max_length=VALID_MOST,
            description="object that says whether a sample counts; of several all must say so",
        ),
    ] = ()
    time_stamp: Annotated[PdoStamp | None, Field(description="the device's time of a sample")] = None
    channels: Annotated[
        Mapping[str, Annotated[PdoChannel, _named("object", PdoChannel)]], Field(max_length=CHANNELS_MOST)
    ]

    @property
    def file(self) -> str:
        return self.eds

    def wanted(self) -> dict[str, Wanted]:
        """Each channel."""
        return {name: Wanted(c.object, c, c.latest_s) for name, c in self.channels.items()}

    def validity(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """Names in the file, and the unscaled numbers of valid samples."""
        return tuple((valid.object, valid.values) for valid in self.valid)

    def stamp(self) -> tuple[str, float] | None:
        """The time stamp's name in the file, and the seconds of a count."""
        return (self.time_stamp.object, self.time_stamp.unit_s) if self.time_stamp else None


CanStream = Annotated[DbcStream | PdoStream, Field(discriminator="layout")]


class CanRegister(Register):
    """A register that is an object of the CANopen object dictionary, reached by
    SDO."""

    object: Annotated[ObjectName, Field(description="index and sub-index, as 0x2100:01")]


class CanProfile(Profile):
    """A device on CAN. With registers, or streams laid out by an EDS, it is
    taken for a CANopen node."""

    wire_order: ClassVar[ByteOrder] = "little"
    sends: ClassVar[bool] = True
    streams: Annotated[Mapping[str, CanStream], Field(max_length=STREAMS_MOST)]
    registers: Mapping[str, CanRegister] = {}
    busy_codes: Annotated[
        tuple[int, ...], Field(description="SDO abort codes by which a read is refused for now, and may be repeated")
    ] = (0x08000022,)
    """By default "because of the present device state"; a write refused by it
    may as well be locked."""

    @model_validator(mode="after")
    def _fine_stamps(self) -> Self:
        for name, stream in self.streams.items():
            stamp, period_s = stream.time_stamp, 1 / self.sampling.rate_hz
            if stamp and stamp.unit_s > period_s / STAMPS_LEAST:
                raise ValueError(
                    f"streams.{name}.time_stamp: a count of {stamp.unit_s:g} s does not tell samples apart that come "
                    f"every {period_s:g} s; leave it out"
                )
        return self

    @property
    def j1939(self) -> bool:
        return any(isinstance(s, DbcStream) and s.j1939 for s in self.streams.values())

    @property
    def has_node(self) -> bool:
        """Whether a unit needs a node: for CANopen, or for identifiers that shift."""
        shifts = any(isinstance(s, DbcStream) and s.base_node_id is not None for s in self.streams.values())
        return self.canopen or shifts

    def require_address(self, bus: CanBus) -> None:
        """Raises AddressError where the bus of a unit lacks its address, or has one of
        another kind."""
        if self.has_node and bus.node_id is None:
            raise AddressError(f"node_id: missing; {self.name} needs it, 1 to {NODES_MOST}")
        if self.j1939 and bus.source_address is None:
            first = '"first" for the first that is heard'
            raise AddressError(f"source_address: missing; {self.name} needs it, 0 to {SOURCES_MOST} or {first}")
        if bus.source_address is not None and not self.j1939:
            raise AddressError(f"source_address: no stream of {self.name} is of J1939; leave it out")

    @property
    def canopen(self) -> bool:
        return bool(self.registers) or any(isinstance(s, PdoStream) for s in self.streams.values())

    def files(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(stream.file for stream in self.streams.values()))


LISTEN_ONLY: Mapping[str, Mapping[str, str | int | bool]] = {
    **{interface: {"listen_only": True} for interface in ("socketcan", "slcan", "vector", "nixnet")},
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},  # python-can's name for a silent one
    "seeedstudio": {"operation_mode": "silent"},
    **{interface: {"state": "PASSIVE"} for interface in ("pcan", "systec")},
}
"""By which options an interface is asked to listen only; the others of
python-can cannot be asked."""


class SocketCanOptions(Strict):
    """Options of interface "socketcan". ``fd`` is CAN FD, by default where the
    interface has it; the names that python-can has mean what they mean there.

    ``listen_only`` refuses to send; ``receive_buffer`` is in bytes, by default
    `triaxcal_drivers.can.socketcan.BUFFER_S` seconds of a full bus;
    ``hardware_timestamps`` takes the adapter's own where it gives any.
    """

    fd: bool | None = None
    receive_own_messages: bool = False
    local_loopback: bool = True
    listen_only: bool = False
    receive_buffer: Annotated[int | None, Field(gt=0, lt=1 << 30)] = None
    hardware_timestamps: bool = False

    @classmethod
    def of(cls, options: Mapping[str, object]) -> Self:
        """Raises ValueError with one line."""
        try:
            return validate(cls, options, b"", where="options of socketcan")
        except ProfileError as e:
            raise ValueError(str(e)) from e


class BusSettings(Strict):
    """A bus: a python-can interface and channel, and how it is driven.

    ``options`` are passed on to python-can as they are, except those of
    "socketcan", which is ours; its configuration files are not read.
    """

    interface: Annotated[str, Field(description='a python-can interface: "socketcan", "udp_multicast"…')]
    channel: Annotated[str | int, Field(description='"can0", a multicast address…')]
    bitrate: Annotated[int | None, Field(gt=0, description="bit/s")] = None
    options: Mapping[str, str | int | bool] = {}

    @model_validator(mode="after")
    def _known_options(self) -> Self:
        if self.interface == "socketcan":
            SocketCanOptions.of(self.options)
        return self

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"

    @property
    def name(self) -> str:
        """Of the physical bus, the same however it is spelt."""
        return bus_name(self.interface, self.channel, self.options)

    @property
    def classic(self) -> bool:
        """Whether no frames of CAN FD can be on it, by what is said here: a
        socket takes them where its interface has them."""
        fast = any("data" in key or "dbit" in key for key in self.options)
        return not fast and not self.options.get("fd", self.interface == "socketcan")

    @property
    def driven(self) -> str:
        """How the bus is driven, which all who are on it must agree on."""
        given = {"bitrate": self.bitrate, **self.options}
        return ", ".join(f"{key} {value}" for key, value in sorted(given.items()) if value is not None) or "no options"

    def listening(self) -> Self:
        """The same, which asks the adapter to listen only, where its interface
        can be asked and no option says otherwise."""
        return self.model_copy(update={"options": {**LISTEN_ONLY.get(self.interface, {}), **self.options}})

    def claim_to_listen(self) -> Claim | None:
        """What a process has for itself while it listens to all of it."""
        return claim_to_listen(self.interface, self.channel, self.options)


class CanBus(BusSettings):
    """Where a unit is: a bus, and its node or its source address there."""

    node_id: Annotated[
        int | None, Field(ge=1, le=127, description="of a CANopen unit, or where identifiers shift with the node")
    ] = None
    source_address: Annotated[
        Annotated[int, Field(ge=0, le=253)] | Literal["first"] | None,
        Field(description='of a unit of J1939; "first": the first that is heard is kept'),
    ] = None

    @property
    def device(self) -> str:
        if self.node_id is not None:
            return f"node {self.node_id}"
        if self.source_address is not None:
            return "the first source address" if self.source_address == "first" else f"source {self.source_address}"
        return "the device"

    def __str__(self) -> str:
        return f"{self.device} on {self.interface} {self.channel}"

    def claim(self) -> Claim:
        return claim_on_can(self.interface, self.channel, self.device, self.options)
