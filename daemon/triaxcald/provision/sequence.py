"""Carries out the profile's sequences: unlock, store, lock, reset."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import Bundle, PollStep, Profile, ReconnectStep, Step, WaitStep, WriteStep
from triaxcald.errors import StationError

Label = Literal["unlock", "store", "lock", "reset"]
POLL_S, RETRY_S = 0.02, 0.1
NO_CONTACT = (BusError, DeviceAbsent, DeviceSilent)
"""Nothing came back; unlike a refusal, it says nothing about what the device did."""


class SequenceStalled(StationError):
    """A register did not take the value that the sequence waits for."""


@dataclass(frozen=True)
class Pace:
    """How time passes: ``sleep`` for so many seconds, ``clock_s`` monotonic."""

    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
    clock_s: Callable[[], float] = time.monotonic


REAL_PACE = Pace()


async def run_sequence(device: Device, bundle: Bundle, label: Label, pace: Pace = REAL_PACE) -> None:
    """Carry out ``label``'s steps in order; none where the profile gives none.

    A device that restarts need not acknowledge the write that makes it: silence there is no error where a
    reconnect follows. Raises RegisterRefused, DeviceSilent, DeviceAbsent, BusError, SequenceStalled.
    """
    await run_steps(device, bundle, label, getattr(bundle.profile.sequences, label), pace)


async def run_steps(device: Device, bundle: Bundle, label: Label, steps: Sequence[Step], pace: Pace) -> None:
    for step, following in zip(steps, (*steps[1:], None), strict=False):
        match step:
            case WriteStep():
                try:
                    await device.write(step.write, bundle.profile.encode(step.write, step.value))
                except DeviceSilent:
                    if not isinstance(following, ReconnectStep):
                        raise
            case WaitStep():
                await pace.sleep(step.wait_s)
            case PollStep():
                await _poll(device, bundle.profile, label, step, pace)
            case ReconnectStep():
                await reconnect(device, bundle.profile, step.timeout_s, pace)


async def _poll(device: Device, profile: Profile, label: Label, step: PollStep, pace: Pace) -> None:
    deadline_s = pace.clock_s() + step.timeout_s
    while True:
        try:
            value = profile.decode(step.poll, await device.read(step.poll))
            if step.mask is not None:
                value = int(value) & step.mask
            late: Exception = SequenceStalled(
                f"{label}: register {step.poll} holds {value:g} after {step.timeout_s:g} s, expected {step.until:g}"
            )
            if value == step.until:
                return
        except DeviceSilent as e:  # a device may be too busy to answer
            late = e
        if pace.clock_s() >= deadline_s:
            raise late
        await pace.sleep(POLL_S)


async def reconnect(device: Device, profile: Profile, timeout_s: float, pace: Pace) -> None:
    """Close and open until the device answers. Raises DeviceAbsent, DeviceSilent, BusError at the deadline."""
    deadline_s = pace.clock_s() + timeout_s
    while True:
        await device.close()
        try:
            await device.open()
            if probe := _probe(profile):
                await device.read(probe)
            return
        except NO_CONTACT:
            if pace.clock_s() >= deadline_s:
                raise
        await pace.sleep(RETRY_S)


def _probe(profile: Profile) -> str | None:
    """A register by which a device shows that it is there: opening may succeed on the bus alone."""
    return profile.identity.serial_register or next(iter(profile.identity.expect), None)
