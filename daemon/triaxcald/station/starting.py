"""The start sequence of a device: its profile's steps before it streams."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing
from typing import Any, cast

import triaxcal_drivers as td
from triaxcald.errors import StationError
from triaxcald.provision.access import RegisterAccess, RegisterLink, run_sequence
from triaxcald.recording.schema import SENT
from triaxcald.recording.writer import RecordingWriter


def recorder(writer: RecordingWriter) -> Callable[[RegisterAccess], None]:
    """Writes the register requests that it is told of."""
    return lambda a: writer.register(a.register, a.kind, a.raw, a.error or "", unanswered=a.unanswered)


class StartingDevice:
    """A device that gets its start sequence before a stream: after it was opened, and
    after its registers were written, as a restart by command does.

    ``name`` is the device at its address, for messages. Requests and frames of the
    sequence go into the recording that ``writer`` writes.
    """

    def __init__(self, device: td.Device, bundle: td.Bundle, name: str) -> None:
        self.writer: RecordingWriter | None = None
        self._device, self._bundle, self._name = device, bundle, name
        self._started = False

    def __getattr__(self, name: str) -> Any:
        """What else the driver's device has."""
        return getattr(self._device, name)

    async def open(self) -> None:
        self._started = False
        await self._device.open()

    async def close(self) -> None:
        await self._device.close()

    async def read(self, register: str) -> bytes:
        return await self._device.read(register)

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        self._started = False
        given = {} if timeout_s is None else {"timeout_s": timeout_s}
        await self._device.write(register, raw, **given)

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[td.RawBatch, None]:
        """As of the device. Raises DeviceAbsent if a step of the sequence fails."""
        await self._start()
        async with aclosing(cast(Any, self._device.stream(names))) as stream:
            async for batch in stream:
                yield batch

    async def _start(self) -> None:
        if self._started:
            return
        link = RegisterLink(self._device, self._bundle.profile, self._record, name=self._name)
        link.sent = self._record_sent
        try:
            await run_sequence(link, self._bundle, "start")
        except (td.RegisterRefused, td.DeviceSilent, StationError) as e:
            raise td.DeviceAbsent(f"{self._name} does not start: {e}") from e
        self._started = True

    def _record(self, access: RegisterAccess) -> None:
        if self.writer is not None:
            recorder(self.writer)(access)

    def _record_sent(self, step: td.SendStep) -> None:
        if self.writer is not None:
            frame = {"identifier": step.identifier, "extended": step.extended, "data": step.octets.hex()}
            self.writer.event(SENT, frame)
