"""The register traffic: what was read and written, against what the recording
says was there, and is there now."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import cached_property

import triaxcal_drivers as td
from triaxcald.audit.differences import Difference, Kind
from triaxcald.audit.restart_probes import Mark, Marks, marks_in
from triaxcald.outcome import ATTACHMENT
from triaxcald.provision import registers as snapshot
from triaxcald.provision.access import Label
from triaxcald.provision.correction import AT_START
from triaxcald.provision.identity import serial_in
from triaxcald.provision.registers import RegisterImage, calibration_registers, sanity_warnings
from triaxcald.provision.restart_check import MISSED, SEQUENCES, may_probe, own_steps, writes_of
from triaxcald.provision.state import DeviceState, Evidence, Held, Observation
from triaxcald.recording.schema import REGISTERS, RegisterAccess
from triaxcald.run.write_back import REGISTERS_AFTER, REGISTERS_BEFORE

Raw = Mapping[str, bytes]


@dataclass(frozen=True)
class Snapshot:
    """All calibration registers, read one after the other up to the access
    ``at``."""

    at: int
    raw: Raw


class Traffic:
    """Register accesses in their order, read as what the line did. ``profile``
    says which registers are which; ``asked`` are the values that are to be in
    them, or were."""

    def __init__(
        self, accesses: Iterable[RegisterAccess], profile: td.Profile, asked: Collection[tuple[str, bytes]] = ()
    ) -> None:
        self.accesses = list(accesses)
        self.profile = profile
        self.names = calibration_registers(profile)
        self.asked = frozenset(asked)

    @cached_property
    def marks(self) -> Marks:
        """What was written only to show a restart."""
        return marks_in(self.accesses, self.profile, self.asked)

    @cached_property
    def writes(self) -> list[tuple[int, RegisterAccess]]:
        """Of calibration registers, those that failed too; without what was
        written only to show a restart."""
        held = enumerate(self.accesses)
        return [
            (i, a)
            for i, a in held
            if a.operation == "write" and a.register in self.names and i not in self.marks.writes
        ]

    @cached_property
    def snapshots(self) -> list[Snapshot]:
        found, part = [], dict[str, bytes]()
        for i, a in enumerate(self.accesses):
            if a.operation != "read" or a.error or a.register not in self.names:
                continue
            if a.register != self.names[len(part)]:
                part = {}
            if a.register == self.names[len(part)]:
                part[a.register] = a.raw
            if len(part) == len(self.names):
                found.append(Snapshot(i, part))
                part = {}
        return found

    @property
    def last_write(self) -> int:
        return self.writes[-1][0] if self.writes else -1

    @cached_property
    def known(self) -> Raw:
        """What was read last of each calibration register, without those that
        were written since. What was in use only to show a restart was stored
        nowhere."""
        found: dict[str, bytes] = {}
        for i, a in enumerate(self.accesses):
            if i in self.marks.writes or i in self.marks.reads:
                continue
            if a.operation == "write":
                found.pop(a.register, None)
            elif a.register in self.names and not a.error:
                found[a.register] = a.raw
        return found

    def steps(self, label: Label) -> list[int]:
        """Where a sequence of the profile was at work: its writes."""
        return self._at(writes_of(self.profile, label))

    def own(self, label: Label) -> list[int]:
        """Where a sequence was asked for, by writes that are of no other."""
        return self._at(own_steps(self.profile, label))

    def _at(self, writes: set[tuple[str, bytes]]) -> list[int]:
        held = enumerate(self.accesses)
        return [i for i, a in held if a.operation == "write" and (a.register, a.raw) in writes]

    def counts(self) -> list[bytes]:
        """What the device's counter of stores was read as."""
        name = self.profile.by_role(td.roles.WRITE_COUNTER_ROLE)
        return [a.raw for a in self.accesses if a.register == name and a.operation == "read" and not a.error]

    def silent_since(self, at: int) -> bool:
        """Whether the device went silent, as one does that loses its supply,
        and was read again."""
        missed = longest = 0
        for a in self.accesses[at + 1 :]:
            if a.operation == "read":
                missed = missed + 1 if a.unanswered else 0
                longest = max(longest, missed)
        return longest >= MISSED


class Rules(Enum):
    """What a version of this program took as evidence of a restart."""

    ACKNOWLEDGED = auto()
    """Also an acknowledgement, where no register could get a mark."""
    MARK_OR_SUPPLY = auto()
    """Only a mark that is gone, or a supply that was seen off."""


@dataclass(frozen=True)
class Said:
    """What a recording says of its registers. ``earlier`` is what an undoing
    brings back where it is not ``before``; ``image`` what the certificate asks
    for; ``told`` and ``held`` are the outcome's, None in a recording without
    one.
    """

    before: Raw | None
    earlier: Raw | None
    after: Raw | None
    image: RegisterImage | None
    told: Mapping[str, object] | None
    held: Held | None
    forced: bool
    aborted: bool
    provisioned: Sequence[str] | None
    """The registers that were written, by the event; None where there is no
    such event."""
    rules: Rules = Rules.MARK_OR_SUPPLY
    cut_short: bool = False
    """The recording ends before the run did, and the outcome tells nothing of what was
    written."""
    at_start: Raw | None = None
    """By which the device corrected the readings."""

    @property
    def old(self) -> Raw | None:
        return self.before if self.earlier is None else self.earlier

    @property
    def new(self) -> Raw:
        return self.image.raw if self.image else {}


def check(traffic: Traffic, said: Said, serial: str | None) -> list[Difference]:
    asked = {(name, raw) for some in (said.new, said.before, said.earlier) for name, raw in (some or {}).items()}
    traffic = Traffic(traffic.accesses, traffic.profile, asked)
    return [
        *([] if said.aborted else _identity(traffic, serial)),  # another unit may be why it was aborted
        *_asked_for(traffic, said),
        *_at_start(said),
        *_before(traffic, said),
        *_after(traffic, said),
        *_told(traffic, said),
        *_state(traffic, said),
    ]


def _identity(traffic: Traffic, serial: str | None) -> list[Difference]:
    """Whoever answered is the unit that is meant."""
    identity = traffic.profile.identity
    meant: dict[str, object] = dict(identity.expect)
    if identity.serial_register:
        meant[identity.serial_register] = serial
    found: dict[str, Difference] = {}
    for a in traffic.accesses:
        if a.operation == "read" and not a.error and a.register in meant:
            of = serial_in if a.register == identity.serial_register else td.Profile.raw_number
            answered: object = of(traffic.profile, a.register, a.raw)
            if answered != meant[a.register]:
                found[a.register] = Difference(REGISTERS, Kind.NOT_READ, a.register, meant[a.register], answered)
    return list(found.values())


def _asked_for(traffic: Traffic, said: Said) -> list[Difference]:
    """Every write is of the certificate's image, of what the device held
    before, or of a sequence of the profile, or is to show a restart."""
    steps = {step for label in SEQUENCES for step in writes_of(traffic.profile, label)}
    writes = [(i, a) for i, a in enumerate(traffic.accesses) if a.operation == "write"]
    written = dict.fromkeys((a.register, a.raw) for i, a in writes if i not in traffic.marks.writes)
    return [
        Difference(REGISTERS, Kind.NOT_ASKED_FOR, name, raw.hex())
        for name, raw in written
        if (name, raw) not in traffic.asked and (name, raw) not in steps
    ]


def _at_start(said: Said) -> list[Difference]:
    """What corrected the readings is what was read before the first write; an
    interrupted provisioning may have left other values."""
    if said.at_start is None or said.before is None or said.earlier is not None:
        return []
    return _unequal(AT_START, said.at_start, {name: said.before[name] for name in said.at_start if name in said.before})


def _before(traffic: Traffic, said: Said) -> list[Difference]:
    if said.before is None:
        missing = bool(traffic.writes) or said.provisioned is not None
        return [Difference(REGISTERS_BEFORE, Kind.MISSING)] if missing else []
    first = traffic.writes[0][0] if traffic.writes else len(traffic.accesses)
    read = [s.raw for s in traffic.snapshots if s.at < first]
    if not traffic.writes and any(raw == said.before for raw in read):
        return []
    return _unequal(REGISTERS_BEFORE, said.before, read[-1] if read else {})


def _after(traffic: Traffic, said: Said) -> list[Difference]:
    if said.after is None:
        return [Difference(REGISTERS_AFTER, Kind.MISSING)] if said.provisioned is not None else []
    found = [
        Difference(
            REGISTERS_AFTER, Kind.NOT_HELD, name, said.after[name].hex() if name in said.after else None, raw.hex()
        )
        for name, raw in said.new.items()
        if said.after.get(name) != raw
    ]
    if said.provisioned is None and not said.cut_short:
        found.append(Difference(REGISTERS, Kind.NOT_SHOWN, "provisioned", REGISTERS_AFTER))
    if found or any(s.raw == said.after for s in traffic.snapshots):
        return found
    return _unequal(REGISTERS_AFTER, said.after, traffic.known)


def _unequal(part: str, stored: Raw, read: Raw) -> list[Difference]:
    return [
        Difference(part, Kind.NOT_READ, name, *(of[name].hex() if name in of else None for of in (stored, read)))
        for name in dict.fromkeys([*stored, *read])
        if stored.get(name) != read.get(name)
    ]


def _told(traffic: Traffic, said: Said) -> list[Difference]:
    """What the outcome, or the event alone, says was written."""
    written = _names(said.told.get("written")) if said.told else said.provisioned
    found: list[Difference] = []

    def expect(place: str, stored: object, again: object) -> None:
        if stored != again:
            found.append(Difference(ATTACHMENT, Kind.VALUE, f"registers.{place}", stored, again))

    image = said.new
    seen = list(dict.fromkeys(a.register for _, a in traffic.writes if a.raw == image.get(a.register)))
    if written is None:
        return [] if said.cut_short else [Difference(REGISTERS, Kind.NOT_ASKED_FOR, n) for n in seen]
    # A stop may come between a request and its record; an undoing may write
    # what is old and new alike.
    cut = said.aborted and seen == list(written[:-1])
    if seen[: len(written)] != list(written) and not cut:
        found.append(Difference(REGISTERS, Kind.NOT_SHOWN, "written", list(written), seen))
    if said.provisioned is not None and list(said.provisioned) != list(written):
        found.append(Difference("/events", Kind.VALUE, "provisioned.written", list(said.provisioned), list(written)))
    if said.told and said.before is not None:
        differing = [name for name, raw in said.before.items() if name in image and image[name] != raw]
        expect("differing", said.told.get("differing"), differing)
        expect("cut_short_before", said.told.get("cut_short_before"), said.earlier is not None)
        if said.image and said.earlier is None and not said.forced:
            found += [
                Difference(ATTACHMENT, Kind.NOT_FORCED, doubt.register)
                for doubt in sanity_warnings(traffic.profile, snapshot.Snapshot(said.before), said.image)
            ]
        if not said.aborted:
            expect("written", list(written), differing)
            expect("undoing_failed", said.told.get("undoing_failed"), None)
        stores = bool(writes_of(traffic.profile, "store"))
        if said.told.get("stored") and stores and not traffic.own("store"):
            found.append(Difference(ATTACHMENT, Kind.NOT_SHOWN, "registers.stored", said.told.get("stored")))
    return found


def _names(value: object) -> list[str]:
    return list(map(str, value)) if isinstance(value, list) else []


def _state(traffic: Traffic, said: Said) -> list[Difference]:
    """Whether the traffic bears out what the device is said to hold."""
    if said.held is None:
        return []
    if said.cut_short:  # what came after it may show any state, but for one
        untouched = said.held.state is DeviceState.UNTOUCHED
        wrong = untouched and bool(traffic.writes)
        return [Difference(ATTACHMENT, Kind.NOT_SHOWN, "device_state", said.held.state.value)] if wrong else []
    shown = _SHOWN[said.held.state](traffic, said)
    proof = _PROVEN.get(said.held.evidence)
    proven = said.held.evidence in _GOES_WITH[said.held.state] and (proof is None or proof(traffic, said))
    found = [] if shown else [Difference(ATTACHMENT, Kind.NOT_SHOWN, "device_state", said.held.state.value)]
    if not proven:
        found.append(Difference(ATTACHMENT, Kind.NOT_SHOWN, "evidence", said.held.evidence.value))
    if said.rules is Rules.MARK_OR_SUPPLY:
        found += _observed(traffic, said)
    return found


def _observed(traffic: Traffic, said: Said) -> list[Difference]:
    """Observations that the traffic does not show."""
    assert said.held is not None
    shows: dict[Observation, bool] = {
        Observation.ACKNOWLEDGED: any(not traffic.accesses[i].error for i in traffic.own("store")),
        Observation.COUNTER_ADVANCED: _counted(traffic, said),
        Observation.READ_BACK: bool(traffic.snapshots),
        Observation.MARK_GONE: any(m.shows for m in traffic.marks.marks),
        Observation.SUPPLY_SWITCHED: traffic.silent_since(-1),
    }
    return [
        Difference(ATTACHMENT, Kind.NOT_SHOWN, "observed", observation.value)
        for observation in said.held.observed
        if not shows[observation]
    ]


def _new(traffic: Traffic, said: Said) -> bool:
    return bool(said.new) and traffic.known == {**traffic.known, **said.new}


def _old(traffic: Traffic, said: Said) -> bool:
    return bool(said.old) and traffic.known == {**traffic.known, **(said.old or {})}


def _mixed(traffic: Traffic, said: Said) -> bool:
    return not _new(traffic, said) and not _old(traffic, said)


_Shows = Callable[[Traffic, Said], bool]
_SHOWN: dict[DeviceState, _Shows] = {
    DeviceState.UNTOUCHED: lambda traffic, _: (
        not traffic.writes and all(m.over or m.refused for m in traffic.marks.marks)
    ),
    DeviceState.OLD: _old,
    DeviceState.NEW_VERIFIED: _new,
    DeviceState.NEW_UNVERIFIED: _new,
    DeviceState.MIXED: _mixed,
    DeviceState.UNKNOWN: lambda *_: True,  # a link that died shows nothing
}
_GOES_WITH: dict[DeviceState, tuple[Evidence, ...]] = {
    DeviceState.UNTOUCHED: (Evidence.NOTHING_WRITTEN,),
    DeviceState.OLD: (
        Evidence.NOTHING_STORED, Evidence.READ_BACK, Evidence.RESTART, Evidence.POWER_CYCLE,
    ),
    DeviceState.NEW_VERIFIED: (Evidence.RESTART, Evidence.POWER_CYCLE),
    DeviceState.NEW_UNVERIFIED: (Evidence.READ_BACK, Evidence.WRITE_COUNTER),
    DeviceState.MIXED: (Evidence.READ_BACK, Evidence.RESTART, Evidence.POWER_CYCLE),
    DeviceState.UNKNOWN: (Evidence.NO_ANSWER, Evidence.READ_BACK, Evidence.RESTART),
}  # fmt: skip


def _restarted(traffic: Traffic, said: Said) -> bool:
    """A restart after the last write, then all registers read. Where another
    value was put into a register in use before it, that value has to be gone;
    one that nobody acknowledged counts likewise."""
    if said.rules is Rules.MARK_OR_SUPPLY:
        return _shown(traffic, said)
    lasting = said.held is not None and said.held.state is DeviceState.OLD
    if not traffic.profile.sequences.reset:  # it may have lost its supply, and started from what is stored
        return lasting
    if not writes_of(traffic.profile, "reset"):  # by no register, so that no traffic could show it
        return True
    last = traffic.snapshots[-1].at if traffic.snapshots else -1
    if _offered(traffic):
        return _shown(traffic, said)
    image, old = said.new, said.before or {}
    tried = any(a.raw == old.get(a.register) != image.get(a.register) for _, a in traffic.writes)
    if _acknowledged(traffic):
        return True
    return (tried or lasting) and any(traffic.last_write < i < last for i in traffic.steps("reset"))


def _power_cycled(traffic: Traffic, said: Said) -> bool:
    return traffic.silent_since(traffic.last_write)


def _not_restarted(traffic: Traffic, said: Said) -> bool:
    """Nothing was read after a restart that showed: else it would have proven
    the registers. The earlier rules also took an acknowledgement for one."""
    if said.held is None or said.held.state is not DeviceState.NEW_UNVERIFIED:
        return True
    if said.rules is Rules.MARK_OR_SUPPLY:
        return not _shown(traffic, said)
    return not (_shown(traffic, said) if may_probe(traffic.profile) else _acknowledged(traffic))


def _offered(traffic: Traffic) -> list[Mark]:
    """What was to show a restart since the last write, and was not refused."""
    return [m for m in traffic.marks.marks if m.at[0] > traffic.last_write and not m.refused]


def _shown(traffic: Traffic, said: Said) -> bool:
    """Whether one of them was gone before all registers were read, and none is
    left in use."""
    last = traffic.snapshots[-1].at if traffic.snapshots else -1
    strict = said.rules is Rules.MARK_OR_SUPPLY
    shows = [m for m in _offered(traffic) if (m.shows if strict else m.showed_before)]
    gone = [m.gone_at for m in shows if m.gone_at is not None]
    return any(at < last for at in gone) and all(m.over for m in _offered(traffic))


def _acknowledged(traffic: Traffic) -> bool:
    last = traffic.snapshots[-1].at if traffic.snapshots else -1
    return any(not traffic.accesses[i].error for i in traffic.own("reset") if traffic.last_write < i < last)


def _counted(traffic: Traffic, said: Said) -> bool:
    return len(set(traffic.counts())) > 1


_PROVEN: dict[Evidence, _Shows] = {
    Evidence.NOTHING_STORED: lambda traffic, _: not traffic.own("store"),
    Evidence.READ_BACK: _not_restarted,
    Evidence.RESTART: _restarted,
    Evidence.POWER_CYCLE: _power_cycled,
    Evidence.WRITE_COUNTER: _counted,
}
