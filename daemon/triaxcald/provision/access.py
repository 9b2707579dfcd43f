"""Register access: repeats the requests that may be repeated, waits for a busy
device, and records every request; and the profile's sequences: start,
unlock, store, lock, reset."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Literal, TypeVar

import triaxcal_drivers as td
from triaxcald.errors import DaemonError, StationError, TwoAnswer


@dataclass(frozen=True)
class Clock:
    """The clock of a register link: ``sleep`` takes seconds, ``now_s`` is monotonic
    [s]. A test passes a virtual one."""

    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
    now_s: Callable[[], float] = time.monotonic


SYSTEM_CLOCK = Clock()


T = TypeVar("T")
Kind = Literal["read", "write"]

RETRIES = 2
"""A lost request in a hundred then fails one request in a million."""
NO_CONTACT = (td.BusError, td.DeviceAbsent, td.DeviceSilent)
"""Errors without any answer. Unlike a refusal, they leave open whether the device
carried the request out."""


@dataclass(frozen=True)
class RegisterAccess:
    """One register request: ``raw`` as on the wire, written or read (empty if a read
    failed); ``error`` is the driver's message. ``unanswered``: no reply came, not
    even a refusal."""

    kind: Kind
    register: str
    raw: bytes
    error: str | None = None
    unanswered: bool = False


class RegisterLink:
    """A Device whose register requests are repeated where that is safe.

    Reads, and writes of calibration registers and keys, are repeated up to
    `RETRIES` times where no answer came, over a new connection where the old
    one was lost, and for `BUSY_S` where the device is busy. What a store or
    reset sequence writes is sent once. Once a kind of request has failed for
    good, no more retries are spent on that kind until one succeeds, or until
    `refresh`. ``record`` is told of every request that has ended. ``name`` is
    the device at its address, for messages.

    Once `watch` was called, an answer that no request explains raises TwoAnswer
    at the request before or after it, and at every further one until
    `tolerate`.
    """

    def __init__(
        self,
        device: td.Device,
        profile: td.Profile,
        record: Callable[[RegisterAccess], None] | None = None,
        *,
        clock: Clock = SYSTEM_CLOCK,
        name: str = "",
    ) -> None:
        steps = (*profile.sequences.store, *profile.sequences.reset)
        self.clock, self.name, self.profile = clock, name, profile
        self._device = device
        self._record = record or (lambda access: None)
        self._once = {step.write for step in steps if isinstance(step, td.WriteStep)}
        self._tired: set[Kind] = set()
        self._not_opened: str | None = None
        self._watched = False
        self._second: TwoAnswer | None = None
        self.two_answered = self.tolerant = False
        """Whether two units have answered, and whether the work continues anyway."""
        self.doubled = 0
        """Answers that came twice, byte for byte, since the last `listen`."""
        self.touched: set[str] = set()
        """Registers with an attempted write."""
        self.probed: list[str] = []
        """Registers written by the restart check, one entry a write: a probe, or the
        register's own value again."""
        self.before_probe: Callable[[], None] = lambda: None
        """Called before the restart check writes. Raises DiskError."""
        self.sent: Callable[[td.SendStep], None] = lambda step: None
        """Called after each frame of a sequence."""

    async def open(self) -> None:
        try:
            await self._device.open()
        except NO_CONTACT as e:
            self._not_opened = str(e)
            raise
        self._not_opened = None

    async def close(self) -> None:
        await self._device.close()

    def stream(self, names: Sequence[str]) -> AsyncIterator[td.RawBatch]:
        return self._device.stream(names)

    def refresh(self) -> None:
        """Allow all retries again."""
        self._tired.clear()

    def go_on_unrecorded(self) -> None:
        """Continue if a request cannot be recorded: restoring the device has
        priority."""
        record = self._record

        def lenient(access: RegisterAccess) -> None:
            with suppress(DaemonError):
                record(access)

        self._record = lenient

    def watch(self) -> None:
        """Report every extra answer from now on."""
        self._watched = True

    def tolerate(self) -> None:
        """Continue while two units answer, to restore the device."""
        self._watched, self._second = False, None
        self.tolerant = True

    async def listen(self, seconds: float) -> list[td.two_senders.ExtraAnswer]:
        """Listen for ``seconds`` of the host's clock.

        Returns the answers that belong to no request and contradict the first
        answer; counts the others in ``doubled``. A driver that cannot tell gives
        none.
        """
        listen = getattr(self._device, "listen", None)
        extra: list[td.two_senders.ExtraAnswer] = [] if listen is None else await listen(seconds)
        self.doubled += sum(e.same for e in extra)
        return [e for e in extra if not e.same]

    async def read(self, register: str) -> bytes:
        return await self._patiently("read", lambda: self._read(register))

    async def read_once(self, register: str) -> bytes:
        """Read without a repetition; the caller repeats."""
        return await self._read(register)

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        if register in self._once:
            await self._write(register, raw, timeout_s)
        else:
            await self._patiently("write", lambda: self._write(register, raw, timeout_s))

    async def send(self, step: td.SendStep) -> None:
        """Raises BusError."""
        await self._device.send(step.identifier, step.octets, extended=step.extended)  # type: ignore[attr-defined]
        self.sent(step)

    async def renew(self) -> None:
        """Open a new connection if possible."""
        with suppress(*NO_CONTACT):
            await self.close()
            await self.open()

    async def _patiently(self, kind: Kind, request: Callable[[], Awaitable[T]]) -> T:
        left, busy_since_s = RETRIES, None
        while True:
            failure: td.DriverError
            try:
                answer = await request()
            except td.DeviceBusy as e:
                failure, now_s = e, self.clock.now_s()
                busy_since_s = now_s if busy_since_s is None else busy_since_s
                patient = now_s - busy_since_s < td.BUSY_S
            except NO_CONTACT as e:
                failure, patient = e, left > 0
                left -= 1
            else:
                self._tired.discard(kind)
                return answer
            if kind in self._tired or not patient:
                self._tired.add(kind)
                raise failure
            if isinstance(failure, td.DeviceBusy):
                await self.clock.sleep(td.BUSY_PAUSE_S)
            elif not isinstance(failure, td.DeviceSilent):
                await self.renew()

    async def _require_one_answer(self) -> None:
        if not self._watched:
            return
        if self._second is None and (found := await self.listen(0.0)):
            e = found[0]
            of = f"register {e.register}" if e.register else "a request of another program"
            first = "" if e.first is None else f"{e.first.hex()}, then "
            self.two_answered = True
            self._second = TwoAnswer(f"two units answer at {self.name}: {of}: {first}{e.answer.hex()}")
        if self._second is not None:
            raise self._second

    async def _read(self, register: str) -> bytes:
        await self._require_one_answer()
        with self._failure_told("read", register, b""):
            raw = await self._device.read(register)
        self._record(RegisterAccess("read", register, raw))
        await self._require_one_answer()
        return raw

    async def _write(self, register: str, raw: bytes, timeout_s: float | None) -> None:
        await self._require_one_answer()
        self.touched.add(register)
        given = {} if timeout_s is None else {"timeout_s": timeout_s}  # a driver may know nothing of it
        with self._failure_told("write", register, raw):
            await self._device.write(register, raw, **given)
        self._record(RegisterAccess("write", register, raw))
        await self._require_one_answer()

    @contextmanager
    def _failure_told(self, kind: Kind, register: str, raw: bytes) -> Iterator[None]:
        """Replace the error "not open" of a request by the error of the failed
        opening."""
        try:
            yield
        except td.DriverError as e:
            no_contact = isinstance(e, NO_CONTACT)
            why = str(e) if self._not_opened is None or not no_contact else self._not_opened
            self._record(RegisterAccess(kind, register, raw, why, no_contact))
            if why == str(e):
                raise
            raise td.BusError(why) from e


# Carries out the profile's sequences: start, unlock, store, lock, reset.

Label = Literal["start", "unlock", "store", "lock", "reset"]
POLL_S, RETRY_S = 0.02, 0.1
RECONNECT_S = 5.0
"""Time for a device to answer again after a loss of power; after that a person has
to help."""


class SequenceStalled(StationError):
    """A register did not take the value that the sequence waits for."""


async def run_sequence(link: RegisterLink, bundle: td.Bundle, label: Label) -> bool:
    """Carry out ``label``'s steps in order; none where the profile gives none.
    Whether every write was acknowledged.

    A store may go unanswered or be answered by "busy", and so may a write by
    which the device restarts (a wait or a reconnect follows): nothing is sent
    twice, and what came of it is for a read to decide. Any other write raises.
    Raises RegisterRefused, DeviceSilent, DeviceAbsent, BusError,
    SequenceStalled.
    """
    return await run_steps(link, bundle, label, getattr(bundle.profile.sequences, label))


async def run_steps(
    link: RegisterLink, bundle: td.Bundle, label: Label, steps: Sequence[td.Step | td.SendStep]
) -> bool:
    acknowledged = True
    for step, following in zip(steps, (*steps[1:], None), strict=False):
        match step:
            case td.WriteStep():
                restarts = isinstance(following, (td.WaitStep, td.ReconnectStep)) and label == "reset"
                acknowledged &= await _written(link, bundle, step, open_ended=label == "store" or restarts)
            case td.SendStep():
                await link.send(step)
            case td.WaitStep():
                await link.clock.sleep(step.wait_s)
            case td.PollStep():
                await _poll(link, bundle.profile, label, step)
            case td.ReconnectStep():
                await reconnect(link, bundle.profile, step.timeout_s)
    return acknowledged


async def lock_quietly(link: RegisterLink, bundle: td.Bundle) -> None:
    """Lock the device if it accepts. A restart locks it too, and the stored values do
    not depend on it."""
    with suppress(td.DriverError, StationError):
        await run_sequence(link, bundle, "lock")


async def _written(link: RegisterLink, bundle: td.Bundle, step: td.WriteStep, *, open_ended: bool) -> bool:
    """Whether the write was acknowledged; with ``open_ended`` a missing
    acknowledgement is no error."""
    raw = bundle.profile.encode(step.write, step.value)
    try:
        await link.write(step.write, raw, timeout_s=step.timeout_s)
    except (*NO_CONTACT, td.DeviceBusy) as e:
        if not open_ended:
            raise
        if isinstance(e, td.BusError):
            await link.renew()
        return False
    return True


async def _poll(link: RegisterLink, profile: td.Profile, label: Label, step: td.PollStep) -> None:
    deadline_s = link.clock.now_s() + step.timeout_s
    while True:
        try:
            held = profile.decode(step.poll, await link.read_once(step.poll))
            value = held if step.mask is None or not math.isfinite(held) else int(held) & step.mask
            late: Exception = SequenceStalled(
                f"{label}: register {step.poll} holds {_shown(value)} after {step.timeout_s:g} s, "
                f"expected {_shown(step.until)}"
            )
            if value == step.until:
                return
        except (*NO_CONTACT, td.RegisterRefused) as e:  # a busy device may be silent or refuse for a while
            late = e
        if link.clock.now_s() >= deadline_s:
            raise late
        await link.clock.sleep(POLL_S)


def _shown(value: float) -> str:
    """Every digit of an integer."""
    return str(value) if isinstance(value, int) else f"{value:g}"


async def reconnect(link: RegisterLink, profile: td.Profile, timeout_s: float | None = None) -> None:
    """Close and open until the device answers, for `RECONNECT_S` where nothing
    else is said.

    One that starts may refuse for a while. At the deadline raises DeviceAbsent,
    DeviceSilent, BusError, RegisterRefused.
    """
    deadline_s = link.clock.now_s() + (RECONNECT_S if timeout_s is None else timeout_s)
    while True:
        await link.close()
        try:
            await link.open()
            if register := contact_register(profile):
                await link.read_once(register)
            return
        except (*NO_CONTACT, td.RegisterRefused):
            if link.clock.now_s() >= deadline_s:
                raise
        await link.clock.sleep(RETRY_S)


def contact_register(profile: td.Profile) -> str | None:
    """The register that proves contact with the device: opening may succeed without
    a device on the bus."""
    return profile.identity.serial_register or next(iter(profile.identity.expect), None)
