"""Carries out the profile's sequences: unlock, store, lock, reset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Literal

import triaxcal_drivers as td
from triaxcald.errors import StationError
from triaxcald.provision.access import NO_CONTACT, RegisterLink

Label = Literal["unlock", "store", "lock", "reset"]
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


async def run_steps(link: RegisterLink, bundle: td.Bundle, label: Label, steps: Sequence[td.Step]) -> bool:
    acknowledged = True
    for step, following in zip(steps, (*steps[1:], None), strict=False):
        match step:
            case td.WriteStep():
                restarts = isinstance(following, (td.WaitStep, td.ReconnectStep)) and label == "reset"
                acknowledged &= await _written(link, bundle, step, open_ended=label == "store" or restarts)
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
