"""What resolves of a profile, and what a log holds by it (`triaxcal devices check`)."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.certificate import why_not_written
from triaxcald.errors import InputError
from triaxcald.imports.importing import RATE_OFF, Record, Times, in_batches, remarks
from triaxcald.imports.of_can import identifiers_shown, is_own, layouts_of
from triaxcald.imports.of_can import work_on as work_on_frames
from triaxcald.imports.of_mcap import work_on as work_on_messages
from triaxcald.imports.opening import DRIVERS, opened_log
from triaxcald.inputs import PROFILE
from triaxcald.provision.registers import role_ranges
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.bus import is_of_bus
from triaxcald.recording.reader import Contents, open_recording
from triaxcald.recording.schema import CALIBRATION
from triaxcald.schema.profile_check import (
    CalibrationOf,
    ChannelOf,
    Fault,
    FrameOf,
    LogOf,
    MessageOf,
    Problem,
    ProfileCheck,
    RegisterOf,
    RoleOf,
    SamplesOf,
    StreamOf,
    ValuesOf,
)

ROWS_MOST = 4096
"""Kinds of frames that are counted each by itself: a bus has no more, and a file of
random ones shall take no memory."""
LOST_SHARE = 0.5
"""A wrong counter, or a wrong signal of validity, loses most; a sound bus loses few."""
AT_REST_OFF = 2**0.5
"""Half way to a factor of 2, by which a wrong measuring range errs. Scale factors and
biases of data sheets come to 0.3."""


def check(bundle: td.Bundle, log: Path | None, *, node: int | None, channel: str | None) -> ProfileCheck:
    """Raises InputError, LogError, RecordingError, ProfileError, DriverMissing."""
    found = _Found()
    profile = bundle.profile
    streams, calibration = _streams(bundle), _calibration(profile, found)
    looked_at = None if log is None else _log(bundle, log, node, channel, found)
    return ProfileCheck(
        format="triaxcal.profile_check/1",
        profile=profile.name,
        title=profile.title,
        source=profile.source,
        driver=profile.driver,
        files=sorted(bundle.files),
        streams=streams,
        registers=[_register(name, r) for name, r in profile.registers.items()],
        sequences=_sequences(profile),
        calibration=calibration,
        log=looked_at,
        problems=found.problems,
        notes=found.notes,
    )


@dataclass
class _Found:
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def problem(self, code: Fault, text: str) -> None:
        self.problems.append(Problem(code=code, text=text))


# What resolves of a profile.


def _streams(bundle: td.Bundle) -> list[StreamOf]:
    """Raises ProfileError where a file does not hold what the profile names."""
    layouts = layouts_of(bundle) if bundle.profile.driver == "can" else {}
    found = []
    for name, stream in bundle.profile.streams.items():
        if name in layouts:
            channels = [ChannelOf(name=c, place=_signal(layouts[name], c)) for c in layouts[name].channels]
            messages = [MessageOf(name=m.name, identifier=_identifier(m)) for m in layouts[name].messages]
        else:
            given = _keys(stream).get("channels")
            channels = [ChannelOf(name=c, place=_in_words(of)) for c, of in given.items()] if given else []
            messages = []
        found.append(StreamOf(name=name, place=_in_words(stream), messages=messages, channels=channels))
    return found


def _signal(layout: td.can.Layout, channel: str) -> str:
    number, signal = layout.channels[channel]
    kind = "float" if signal.is_float else "signed" if signal.signed else "unsigned"
    order = "big-endian" if signal.big_endian else "little-endian"
    scaling = f"× {signal.scale:g}" + (f" + {signal.offset:g}" if signal.offset else "")
    bits = f"{kind} {signal.length} bits from {signal.start}, {order}, {scaling}"
    return f"{layout.messages[number].name}.{signal.name}: {bits}"


def _identifier(message: td.can.Message) -> str:
    key = message.identifier, int(td.RawFlag.EXTENDED_ID) if message.extended else 0
    return identifiers_shown([key]) + (" + node" if message.per_node else "")


def _keys(described: Any) -> Mapping[str, Any]:
    """Of a part of a profile, which a driver of another package may leave a dict."""
    if isinstance(described, Mapping):
        return described
    found: dict[str, Any] = described.model_dump(exclude_unset=True, exclude_none=True)
    return found


def _in_words(described: Any) -> str:
    """The keys of a part of a profile with their values, but for the parts of it
    that have names."""
    if not hasattr(described, "model_dump") and not isinstance(described, Mapping):
        return str(described)
    given = {key: value for key, value in _keys(described).items() if key not in _NAMED}
    return ", ".join(f"{key} {_value(key, value)}" for key, value in given.items())


_NAMED = ("channels", "unit", "description")


def _value(key: str, value: Any) -> str:
    if key == "address" and isinstance(value, int):
        return f"0x{value:04X}"
    if isinstance(value, Mapping):
        return "(" + ", ".join(f"{k} {_value(k, v)}" for k, v in value.items() if v is not None) + ")"
    if isinstance(value, list | tuple):
        return ", ".join(_value(key, v) for v in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _register(name: str, register: Any) -> RegisterOf:
    """Its place is what its driver adds to a register."""
    own = type(register).model_fields.keys() - td.Register.model_fields.keys()
    place = register.model_dump(exclude_none=True, include=own)
    return RegisterOf(
        name=name,
        place=", ".join(f"{key} {_value(key, value)}" for key, value in place.items()),
        type=register.type,
        access=register.access,
        unit=register.unit,
        role=register.role,
    )


def _sequences(profile: td.Profile) -> dict[str, list[str]]:
    return {
        name: [_in_words(step) for step in getattr(profile.sequences, name)]
        for name in type(profile.sequences).model_fields
        if getattr(profile.sequences, name)
    }


def _calibration(profile: td.Profile, found: _Found) -> CalibrationOf | None:
    ranges = role_ranges(profile)
    if not ranges:
        return None
    number = tc.rounding.uncertainty
    for one in ranges:
        if not one.holds_nominal:
            low, high = ("—" if x is None else f"{x:.4g}" for x in (one.least_g, one.most_g))
            found.problem(
                Fault.REGISTER_RANGE,
                f"registers.{one.register}: {one.role} can be {low} to {high} g, and is nominally {one.nominal_g:g} g; "
                "check type, scale, minimum, maximum and nominal_scale_factor",
            )
    not_written = why_not_written(profile)
    if not_written:
        found.notes.append(f"run would certify the unit and write nothing: {not_written}")
    correction = profile.correction
    if correction is None and td.CORRECTED not in profile.streams:
        found.notes.append(
            "the profile does not say whether streams.readings are corrected ([correction] readings): nothing is "
            "written over a calibration"
        )
    return CalibrationOf(
        form=None if correction is None else correction.form,
        readings=None if correction is None else correction.readings,
        not_written=not_written,
        roles=[
            RoleOf(
                role=one.role,
                name=one.register,
                least_g=number(one.least_g),
                most_g=number(one.most_g),
                resolution_g=number(one.resolution_g),
                per=one.per,
            )
            for one in ranges
        ],
    )


# What a log holds by it.


@dataclass
class _Row:
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    least: int = 1 << 30
    most: int = 0

    def note(self, time_ns: int, length: int) -> None:
        if not self.count:
            self.first_ns = self.last_ns = time_ns
        self.count += 1
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)
        self.least, self.most = min(self.least, length), max(self.most, length)

    @property
    def rate_hz(self) -> float | None:
        span_s = (self.last_ns - self.first_ns) / 1e9
        return (self.count - 1) / span_s if span_s > 0 else None


_Key = tuple[Any, ...]
_FURTHER: _Key = ("further", "", "")


class _Rows:
    """Counts frames by what they are."""

    def __init__(self) -> None:
        self.of: dict[_Key, _Row] = {}

    def note(self, key: _Key, time_ns: int | None, length: int) -> None:
        row = self.of.get(key)
        if row is None:
            row = self.of.setdefault(key if len(self.of) < ROWS_MOST else _FURTHER, _Row())
        row.note(time_ns or 0, length)


class _Source(Protocol):
    """A log of one kind, on its way into raw records."""

    kind: str
    bundle: td.Bundle
    streams: tuple[str, ...]

    @property
    def account(self) -> td.logs.Account: ...
    @property
    def timed(self) -> bool: ...
    @property
    def node(self) -> int | None: ...
    def batches(self) -> Iterator[td.RawBatch]: ...
    def streams_of(self, source: int, flags: int) -> Iterable[str]: ...
    def settle(self) -> None:
        """Raises InputError where the frames are not those of one unit."""

    def frames(self) -> Iterator[FrameOf]: ...


def _log(bundle: td.Bundle, path: Path, node: int | None, channel: str | None, found: _Found) -> LogOf:
    driver = bundle.profile.driver
    if is_own(path):
        with open_recording(path) as recording:
            if not is_of_bus(recording):
                if node is not None or channel is not None:
                    raise InputError(f"{path}: a recording of one unit, which takes neither --node nor --channel")
                return _looked_at(path, _UnitRecording(bundle, recording), found)
    if driver not in DRIVERS:
        raise InputError(f"{path}: no recording of a unit; driver '{driver}' has no other logs, expected can or mcap")
    if driver == "mcap" and node is not None:
        raise InputError("--node: of a CAN bus; the profile's driver is 'mcap'")
    with opened_log(path, driver) as log:
        source = _CanLog(log, bundle, node, channel) if driver == "can" else _MessageLog(log, bundle, channel)
        return _looked_at(path, source, found)


def _looked_at(path: Path, source: _Source, found: _Found) -> LogOf:
    streams = {name: _Stream(source.bundle, name, source.timed) for name in source.streams}
    for batch in source.batches():
        rows = zip(batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist(), strict=True)
        for time_ns, number, flags in rows:
            for name in source.streams_of(number, flags):
                streams[name].note(time_ns, number)
        for stream in streams.values():
            stream.feed(batch)
    try:
        source.settle()
    except InputError as e:
        used = any(stream.frames for stream in streams.values())
        found.problem(Fault.SEVERAL_UNITS if used else Fault.NO_FRAMES, str(e))
    for stream in streams.values():
        stream.judge(found)
    account = source.account
    detail = {
        "remarks": sorted(account.remarks),
        "times": Times(1.0).document(),  # of each stream the problems tell
        "seconds_by_log": None,
        "damaged": account.damaged,
        "damage": account.damage,
        "unread_date": account.unread_date,
    }
    found.notes += remarks(detail, 0.0)
    return LogOf(
        file=str(path),
        kind=source.kind,
        node=source.node,
        frames=sorted(source.frames(), key=lambda row: (not row.streams, -row.count, row.identifier)),
        other_records=dict(account.others),
        damaged=account.damaged,
        damage=account.damage or None,
        streams={name: stream.document() for name, stream in streams.items()},
    )


class _Stream:
    """The samples of one stream, and what is wrong with them."""

    def __init__(self, bundle: td.Bundle, name: str, timed: bool) -> None:
        self._name, self._profile, self._timed = name, bundle.profile, timed
        self._pipeline = Pipeline(bundle, name)
        self._values: dict[str, tuple[float, float]] = {}
        self._period_ns = 1e9 / bundle.profile.sampling.rate_hz
        self._times_of: dict[int, Times] = {}  # by source
        self._counts: Counter[int] = Counter()
        self._closed = False
        self.frames = 0

    @property
    def _times(self) -> Times:
        """Of the frames that come most often: those of slow channels tell less."""
        (most,) = self._counts.most_common(1) or [(0, 0)]
        return self._times_of.get(most[0], Times(self._period_ns))

    def note(self, time_ns: int, source: int) -> None:
        self.frames += 1
        self._times_of.setdefault(source, Times(self._period_ns)).note(time_ns)
        self._counts[source] += 1

    def feed(self, batch: td.RawBatch) -> None:
        block = self._pipeline.rising(batch)
        if not len(block):
            return
        columns = {f"u{axis}": block.readings[:, i] for i, axis in enumerate(td.roles.AXES)}
        for name, values in {**columns, **block.channels}.items():
            least, most = self._values.get(name, (np.inf, -np.inf))
            self._values[name] = (
                float(np.fmin(least, np.fmin.reduce(values))),
                float(np.fmax(most, np.fmax.reduce(values))),
            )

    @property
    def _lost(self) -> dict[str, int]:
        return {kind: n for kind, n in self._pipeline.counts.items() if n and kind != "samples"}

    @property
    def _rate_hz(self) -> float | None:
        counts = self._pipeline.counts
        came = counts["samples"] + counts["missing"] + counts["invalid"] + counts["not_finite"]
        return self._times.rate_hz(came) if self._timed and counts["samples"] > 1 else None

    @property
    def _constant(self) -> list[str]:
        return [name for name, (least, most) in self._values.items() if least == most] if self._samples > 1 else []

    @property
    def _samples(self) -> int:
        return self._pipeline.counts["samples"]

    def _still(self) -> list[Any]:
        if not self._closed:
            self._pipeline.close()
            self._closed = True
        return self._pipeline.held()

    def _at_rest(self) -> tuple[float | None, float | None]:
        """Median of |u| over the still poses, and over the nominal output per g."""
        means = np.array([span.mean for span in self._still()])
        if not len(means):
            return None, None
        nominal, offset = self._profile.nominal_of(self._name), self._profile.offset_of(self._name)
        in_g = None if nominal is None else float(np.median(np.linalg.norm((means - offset) / nominal, axis=1)))
        return float(np.median(np.linalg.norm(means, axis=1))), in_g

    def judge(self, found: _Found) -> None:
        if not self.frames:
            if self._name != td.READINGS:
                found.problem(Fault.NO_FRAMES, f"streams.{self._name}: nothing of it is in the log")
            return
        where, lost = f"streams.{self._name}", ", ".join(f"{n} {kind}" for kind, n in self._lost.items())
        if not self._samples:
            found.problem(Fault.NO_SAMPLES, f"{where}: no sample in {self.frames} frames: {lost or 'none is whole'}")
            return
        count = sum(n for kind, n in self._lost.items() if kind in UNUSABLE)
        if count > LOST_SHARE * (count + self._samples):
            found.problem(Fault.SAMPLES_LOST, f"{where}: {lost}, beside {self._samples} samples")
        if self._pipeline.two_senders:
            found.problem(Fault.SEVERAL_UNITS, f"{where}: two units send on it, and their samples are mixed")
        self._judge_rate(found, where)
        axes = [name for name in self._constant if name in ("ux", "uy", "uz")]
        if axes:
            found.problem(Fault.CONSTANT_READING, f"{where}: {', '.join(axes)} is the same in all samples")
        self._judge_rest(found, where)

    def _judge_rate(self, found: _Found, where: str) -> None:
        wanted, rate = self._profile.sampling.rate_hz, self._rate_hz
        stream = self._profile.streams[self._name]
        if getattr(stream, "layout", "") == "poll" and not self._pipeline.counts["missing"]:
            wanted = stream.reads_per_s(wanted)  # the newest sample at each read, and no others
        if rate is not None and not wanted / RATE_OFF < rate < wanted * RATE_OFF:
            found.problem(
                Fault.RATE, f"{where}: {rate:.4g} samples a second by the log's times, and the profile says {wanted:g}"
            )

    def _judge_rest(self, found: _Found, where: str) -> None:
        _, in_g = self._at_rest()
        if in_g is None:
            what = "no nominal scale factor" if self._still() else "no still pose"
            found.notes.append(f"{where}: {what}, so that |u| at rest cannot be compared with 1 g")
        elif not 1 / AT_REST_OFF < in_g < AT_REST_OFF:
            found.problem(
                Fault.AT_REST,
                f"{where}: |u| at rest is {in_g:.4g} times the nominal output per g; check type, order of words, scale "
                "and output.nominal_scale_factor",
            )

    def document(self) -> SamplesOf:
        number = tc.rounding.number
        at_rest, in_g = self._at_rest()
        return SamplesOf(
            samples=self._samples,
            lost=self._lost,
            seconds=cast(float, number(self._pipeline.seconds)),
            seconds_by_log=number(self._times.seconds) if self._timed else None,
            rate_hz=tc.rounding.uncertainty(self._rate_hz),
            constant=self._constant,
            channels={
                name: ValuesOf(least=number(least), most=number(most)) for name, (least, most) in self._values.items()
            },
            still_poses=len(self._still()),
            at_rest=tc.rounding.uncertainty(at_rest),
            at_rest_g=tc.rounding.uncertainty(in_g),
        )


UNUSABLE = ("missing", "incomplete", "malformed", "invalid", "not_finite", "errors")
"""Counts of samples that did not come, or not in order."""


# The kinds of logs.


class _CanLog:
    """Frames, all of which are counted, also those that are not the unit's."""

    def __init__(self, log: td.logs.Log, bundle: td.Bundle, node: int | None, channel: str | None) -> None:
        kind = log.kind
        assert isinstance(kind, td.logs.Kind)
        self.bundle, self.kind, self.streams = bundle, kind.name, tuple(bundle.profile.streams)
        self._work = work_on_frames(bundle, node=node, channel=channel)
        self._asked, self._rows, self._canopen = (node, channel), _Rows(), cast(Any, bundle.profile).canopen

        def frames(stream: BinaryIO, account: td.logs.Account) -> Iterator[td.logs.LoggedFrame]:
            for frame in kind.frames(stream, account):
                flags = frame.flags & _OF_KIND
                self._rows.note((frame.source, flags, frame.channel), frame.time_ns, len(frame.data))
                yield frame

        self._log = td.logs.Log(log.name, td.logs.Kind(kind.name, frames, kind.seeks), log.stream)

    @property
    def account(self) -> td.logs.Account:
        return self._work.account

    @property
    def timed(self) -> bool:
        return td.logs.Remark.NO_TIMES not in self.account.remarks

    @property
    def node(self) -> int | None:
        return self._work.selection.node

    def batches(self) -> Iterator[td.RawBatch]:
        return map(td.RawBatch.of, in_batches(self._work.records(self._log)))

    def streams_of(self, source: int, flags: int) -> Iterable[str]:
        return self._work.selection.streams_of(source, flags)

    def settle(self) -> None:
        self._work.selection.settle(self._log.name)

    def frames(self) -> Iterator[FrameOf]:
        for key, row in self._rows.of.items():
            source, flags, channel = key
            if key == _FURTHER:
                yield _frame("further", "data", "", row, (), None)
                continue
            error = bool(flags & td.RawFlag.ERROR)
            streams = () if error else self._work.selection.streams_of(source, flags)
            named = "—" if error else identifiers_shown([(source, flags & td.RawFlag.EXTENDED_ID)])
            use = (
                canopen_use(source)
                if self._canopen and not flags & (td.RawFlag.EXTENDED_ID | td.RawFlag.ERROR)
                else None
            )
            yield _frame(named, _kind_of(flags), channel, row, streams, use)


_OF_KIND = int(td.RawFlag.EXTENDED_ID | td.RawFlag.REMOTE | td.RawFlag.ERROR | td.RawFlag.FD)


def _kind_of(flags: int) -> str:
    if flags & td.RawFlag.ERROR:
        return "error"
    if flags & td.RawFlag.FD:
        return "fd"
    return "remote" if flags & td.RawFlag.REMOTE else "data"


_CANOPEN = {
    0x080: "emergency message",
    0x180: "TPDO1",
    0x200: "RPDO1",
    0x280: "TPDO2",
    0x300: "RPDO2",
    0x380: "TPDO3",
    0x400: "RPDO3",
    0x480: "TPDO4",
    0x500: "RPDO4",
    0x580: "SDO reply",
    0x600: "SDO request",
    0x700: "heartbeat",
}
_CANOPEN_OF_ALL = {0x000: "network management", 0x080: "SYNC", 0x100: "time stamp"}


def canopen_use(identifier: int) -> str | None:
    """What the predefined connection set of CiA 301 has the identifier for."""
    if identifier in _CANOPEN_OF_ALL:
        return _CANOPEN_OF_ALL[identifier]
    node, use = identifier & 0x7F, _CANOPEN.get(identifier & ~0x7F)
    return f"{use} of node {node}" if use and node else None


def _frame(identifier: str, kind: str, channel: str, row: _Row, streams: Iterable[str], canopen: str | None) -> FrameOf:
    return FrameOf(
        identifier=identifier,
        kind=kind,
        channel=channel,
        count=row.count,
        rate_hz=tc.rounding.uncertainty(row.rate_hz),
        bytes_least=row.least,
        bytes_most=row.most,
        streams=list(streams),
        canopen=canopen,
    )


class _MessageLog:
    """Messages of an MCAP file of others."""

    kind = td.logs.MCAP_KIND
    node = None
    timed = True

    def __init__(self, log: td.logs.Log, bundle: td.Bundle, channel: str | None) -> None:
        self._log, self._channel, self._rows = log, channel, _Rows()
        for message in td.mcap.McapFile(log.stream, td.logs.Account()).messages():
            of = message.channel
            kind = of.schema.name if of.schema else of.encoding
            self._rows.note((of.topic, kind, str(of.number)), message.log_time_ns, len(message.data))
        there = {key[0] for key in self._rows.of}
        topics = {name: stream.topic for name, stream in bundle.profile.streams.items()}
        self.streams = tuple(name for name in topics if topics[name] in there or name == td.READINGS)
        self._names = list(topics)
        self._users: dict[str, list[str]] = {}
        for name, topic in topics.items():
            self._users.setdefault(topic, []).append(name)
        self._missing = None if topics[td.READINGS] in there else topics[td.READINGS]
        if self._missing is not None:
            self.bundle, self.account, self.streams = bundle, td.logs.Account(), ()
            return
        self.bundle, self._work, _ = work_on_messages(log, bundle, channel=channel)
        self.account = self._work.account

    def batches(self) -> Iterator[td.RawBatch]:
        records: Iterator[Record] = iter(()) if self._missing is not None else self._work.records()
        return map(td.RawBatch.of, in_batches(records))

    def streams_of(self, source: int, flags: int) -> Iterable[str]:
        return (self._names[source],)

    def settle(self) -> None:
        if self._missing is not None:
            topics = sorted({key[0] for key in self._rows.of})
            raise InputError(
                f"{self._log.name}: no message on topic '{self._missing}'{td.hints.nearest(self._missing, topics)}"
            )
        self._work.channels.settle(self._log.name)

    def frames(self) -> Iterator[FrameOf]:
        for (topic, kind, number), row in self._rows.of.items():
            yield _frame(topic, kind, number, row, self._users.get(topic, ()), None)


class _UnitRecording:
    """Raw records of one unit that triaxcal recorded."""

    kind = "triaxcal"
    node = None
    timed = True

    def __init__(self, bundle: td.Bundle, recording: Contents) -> None:
        self.bundle, self._recording, self.account = bundle, recording, td.logs.Account()
        self.streams, self._rows = tuple(bundle.profile.streams), _Rows()
        self._driver = bundle.profile.driver
        made_with = _driver_of(recording)
        if made_with not in (None, self._driver):
            raise InputError(
                f"{recording.name}: of a unit of driver '{made_with}', and the profile's driver is '{self._driver}'"
            )
        self._selection = work_on_frames(bundle, node=None, channel=None).selection if self._driver == "can" else None

    def batches(self) -> Iterator[td.RawBatch]:
        for batch in self._recording.raw(CALIBRATION):
            columns = (batch.time_ns, batch.source, batch.flags, batch.length)
            for time_ns, source, flags, length in zip(*(c.tolist() for c in columns), strict=True):
                self._rows.note((source, flags & _OF_KIND, ""), time_ns, length)
            yield batch

    def streams_of(self, source: int, flags: int) -> Iterable[str]:
        if self._selection is not None:
            return self._selection.streams_of(source, flags)
        streams: Mapping[str, Any] = self.bundle.profile.streams
        if self._driver != "modbus":
            return self.streams  # whose records nobody here knows
        most = cast(Any, self.bundle.profile).max_read_words
        reads = {name: stream.reads(most) for name, stream in streams.items()}
        return [name for name, r in reads.items() if source in {read.source for read in (*r.of_sample, *r.lasting)}]

    def settle(self) -> None:
        if not any(self.streams_of(source, flags) for source, flags, _ in self._rows.of):
            raise InputError(f"{self._recording.name}: no record of the profile's streams")

    def frames(self) -> Iterator[FrameOf]:
        for (source, flags, _), row in self._rows.of.items():
            kind = _kind_of(flags) if self._driver == "can" else "error" if flags & td.RawFlag.ERROR else "reply"
            yield _frame(self._named(source, flags), kind, "", row, self.streams_of(source, flags), None)

    def _named(self, source: int, flags: int) -> str:
        if self._driver == "can":
            return identifiers_shown([(source, flags & td.RawFlag.EXTENDED_ID)])
        if self._driver == "modbus":
            return f"{'input' if source >> 16 == INPUT else 'holding'} 0x{source & 0xFFFF:04X}"
        return str(source)


def _driver_of(recording: Contents) -> str | None:
    """Of the profile that it was made with; None where that cannot be told."""
    try:
        found = tomllib.loads(recording.attachments[PROFILE].decode()).get("driver")
    except (KeyError, ValueError):
        return None
    return found if isinstance(found, str) else None


INPUT = 4
"""Function of Modbus that reads input registers."""
