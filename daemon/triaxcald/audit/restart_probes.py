"""Writes by which a restart was to show (`triaxcald.provision.restart_check`), found
again in the register traffic."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import triaxcal_drivers as td
from triaxcald.provision.restart_check import may_probe, neighbouring_values, own_steps, writes_of
from triaxcald.recording.schema import RegisterAccess


@dataclass
class Mark:
    """A register that ``held`` a value was given another one, ``put``, by the
    writes at ``at``, which may have been repeated. ``taken``: read back so
    before the restart; ``standing``: also right before it, when the device was
    locked again; ``asked``: the restart was asked for, and not refused;
    ``gone_at``: where the value was read as gone after it. ``refused``: the
    device refused each of the writes."""

    register: str
    held: bytes
    put: bytes
    at: list[int]
    refused: bool
    taken: bool = False
    standing: bool = False
    asked: bool = False
    gone_at: int | None = None
    over: bool = False
    """Gone, put back, or written over."""

    @property
    def shows(self) -> bool:
        return self.standing and self.gone_at is not None

    @property
    def showed_before(self) -> bool:
        """By the rules of versions that did not read it again once the device
        was locked."""
        return self.taken and self.gone_at is not None


@dataclass
class Marks:
    """All of them, in their order. ``writes`` are theirs, and those that put
    the value back; ``reads`` (by index) are the reads of a value while it was
    in use before the restart, which say nothing of what is stored."""

    marks: list[Mark] = field(default_factory=list)
    writes: set[int] = field(default_factory=set)
    reads: set[int] = field(default_factory=set)


def marks_in(accesses: Sequence[RegisterAccess], profile: td.Profile, asked: Collection[tuple[str, bytes]]) -> Marks:
    """``asked`` are the values that registers are to hold, or held: none of
    them is one that only shows a restart."""
    found = Marks()
    if not may_probe(profile):
        return found
    store, reset = own_steps(profile, "store"), own_steps(profile, "reset")
    lock = writes_of(profile, "lock") - writes_of(profile, "reset")
    names = {name for name, _ in asked}
    read: dict[str, bytes] = {}
    in_use: dict[str, Mark] = {}
    for i, a in enumerate(accesses):
        mark, refused = in_use.get(a.register), bool(a.error) and not a.unanswered
        if a.operation == "read":
            if not a.error and a.register in names:
                _read(found, in_use, mark, i, a)
                read[a.register] = a.raw
            elif mark is not None and not mark.asked:
                mark.standing = False
        elif a.register in names:
            if mark is not None and a.raw == mark.put and not mark.asked:
                mark.at.append(i)
                mark.refused &= refused
                found.writes.add(i)
                continue
            before = [mark.held] if mark is not None else []
            if a.register in read:
                before.append(read[a.register])
            if mark is not None:
                mark.over = True
                del in_use[a.register]
                if a.raw == mark.held:
                    found.writes.add(i)
                    continue
            held = next((raw for raw in before if _is_mark(profile, a, raw, asked)), None)
            if held is not None:  # the first mark, or that of a further attempt
                in_use[a.register] = mark = Mark(a.register, held, a.raw, [i], refused, asked=not reset)
                found.marks.append(mark)
                found.writes.add(i)
        elif (a.register, a.raw) in store:
            for mark in in_use.values():  # it was written to stay
                found.marks.remove(mark)
                found.writes -= set(mark.at)
            in_use.clear()
        elif (a.register, a.raw) in lock:
            for mark in in_use.values():
                mark.standing &= mark.asked
        elif (a.register, a.raw) in reset and not refused:
            for mark in in_use.values():
                mark.asked = True
    return found


def _read(found: Marks, in_use: dict[str, Mark], mark: Mark | None, i: int, a: RegisterAccess) -> None:
    if mark is None:
        return
    if a.raw != mark.put:
        if mark.asked:
            mark.gone_at = i
        mark.over = True
        del in_use[a.register]
    elif not mark.asked:
        mark.taken = mark.standing = True
        found.reads.add(i)


def _is_mark(profile: td.Profile, a: RegisterAccess, held: bytes, asked: Collection[tuple[str, bytes]]) -> bool:
    return (a.register, a.raw) not in asked and a.raw in neighbouring_values(profile, a.register, held)
