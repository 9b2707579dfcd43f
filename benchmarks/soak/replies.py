"""The way of Modbus replies from units to the master: a gateway, and a serial line.

On it replies are lost, late, foreign or garbled, and it can be cut off.
"""

from __future__ import annotations

import asyncio
import os
import struct
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

KINDS = ("lost", "late", "foreign", "garbled")
LATE_S = (0.02, 0.9)
"""Within twice the patience of the bench's profiles: what comes later still cannot be told, on a serial line, from the
reply to the next request."""
QUIET_S = 0.004
"""A reply on the line has ended when nothing follows for so long: a pseudo-terminal cuts what it carries."""
STALLED_S = 0.3
"""A unit that was stopped for so long has lost the requests that came meanwhile. Would it answer them after all, nobody
could tell the replies from those to later requests."""
LOOK_S = 0.05
HEADER, FRAME = 9, 260
"""Bytes that may be spoilt: by TCP, which has a checksum of its own, what says what the reply is; on the line all."""
STRANGER = 77
"""Address of a unit that nobody on the bench has."""


class Replies:
    """``foreign`` makes of a reply one that somebody else sent. In one that is garbled, a bit of its first ``spoilt``
    bytes is turned."""

    def __init__(self, seed: int, foreign: Callable[[bytes], bytes], spoilt: int) -> None:
        self._rng, self._foreign, self._spoilt = np.random.default_rng(seed), foreign, spoilt
        self._kind, self._share, self._until_s = "", 0.0, 0.0
        self.struck = dict.fromkeys(KINDS, 0)

    def begin(self, kind: str, share: float, seconds: float) -> None:
        self._kind, self._share = kind, share
        self._until_s = asyncio.get_running_loop().time() + seconds

    def pass_on(self, reply: bytes, send: Callable[[bytes], None]) -> None:
        loop = asyncio.get_running_loop()
        if loop.time() >= self._until_s or self._rng.random() >= self._share:
            send(reply)
            return
        self.struck[self._kind] += 1
        if self._kind == "late":
            loop.call_later(self._rng.uniform(*LATE_S), send, reply)
        elif self._kind == "garbled":
            at = int(self._rng.integers(min(len(reply), self._spoilt)))
            send(reply[:at] + bytes([reply[at] ^ 0x10]) + reply[at + 1 :])
        elif self._kind == "foreign":
            send(self._foreign(reply))
            if self._rng.random() < 0.5:  # before the true one, or in its place
                send(reply)


def foreign_on_tcp(reply: bytes) -> bytes:
    """The same under another transaction number."""
    return struct.pack(">H", (int.from_bytes(reply[:2]) + 17) % 0x10000) + reply[2:]


def foreign_on_line(reply: bytes) -> bytes:
    """The same from another address."""
    body = bytes([STRANGER]) + reply[1:-2]
    return body + _crc(body)


def _crc(data: bytes) -> bytes:
    """CRC-16 of Modbus over serial line, least significant byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


class _Cuts:
    """Of which one may begin before the one before it is over."""

    def __init__(self) -> None:
        self._until_s = 0.0

    async def over(self, seconds: float) -> bool:
        """Waits so long; whether no other goes on longer."""
        loop = asyncio.get_running_loop()
        mine_s = loop.time() + seconds
        self._until_s = max(self._until_s, mine_s)
        await asyncio.sleep(seconds)
        return self._until_s == mine_s


class Gateway:
    """Listens on ``port`` and passes on to a server on ``inner``."""

    def __init__(self, port: int, inner: int, replies: Replies) -> None:
        self._port, self._inner, self._replies = port, inner, replies
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.StreamWriter] = set()
        self._cuts = _Cuts()

    async def open(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self._port)

    async def cut(self, seconds: float) -> None:
        """Connections are broken and refused for so long."""
        self.close()
        if await self._cuts.over(seconds):
            await self.open()

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        for client in list(self._clients):
            client.transport.abort()

    async def _serve(self, requests: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        self._clients.add(client)
        replies, unit = await asyncio.open_connection("127.0.0.1", self._inner)
        back = asyncio.ensure_future(self._back(replies, client))
        try:
            with suppress(OSError):
                while data := await requests.read(4096):
                    unit.write(data)
        finally:
            back.cancel()
            unit.close()
            self._clients.discard(client)
            client.transport.abort()

    async def _back(self, replies: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        def send(reply: bytes) -> None:
            if not client.is_closing():
                client.write(reply)

        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                head = await replies.readexactly(6)
                self._replies.pass_on(head + await replies.readexactly(int.from_bytes(head[4:])), send)


class SerialCable:
    """Two pseudo-terminals: ``link`` leads to the master's end, ``far`` is the units'."""

    def __init__(self, link: Path, replies: Replies) -> None:
        self._link, self._replies = link, replies
        self._loop = asyncio.get_running_loop()
        self._far, self._far_end = _pty()
        self.far = os.ttyname(self._far_end)
        self._near: tuple[int, int] | None = None
        self._reply, self._cuts = b"", _Cuts()
        self._ended: asyncio.TimerHandle | None = None
        self._looked_s, self._deaf_until_s = self._loop.time(), 0.0
        self._loop.add_reader(self._far, self._from_units)
        self._looking = asyncio.ensure_future(self._look())

    def open(self) -> None:
        near, end = self._near = _pty()
        self._link.symlink_to(os.ttyname(end))
        self._loop.add_reader(near, self._from_master, near)

    async def cut(self, seconds: float) -> None:
        """The port is gone for so long, and then another behind the same name."""
        self._unplug()
        if await self._cuts.over(seconds):
            self.open()

    def close(self) -> None:
        self._looking.cancel()
        self._unplug()
        self._loop.remove_reader(self._far)
        os.close(self._far)
        os.close(self._far_end)

    def _unplug(self) -> None:
        if self._near is not None:
            self._link.unlink(missing_ok=True)
            self._loop.remove_reader(self._near[0])
            for end in self._near:
                os.close(end)
            self._near = None

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            self._deaf()

    def _deaf(self) -> bool:
        """Whether what is on the line is from before a stop, or was sent during one."""
        now_s = self._loop.time()
        if now_s - self._looked_s > STALLED_S:
            self._deaf_until_s = now_s + LOOK_S
        self._looked_s = now_s
        return now_s < self._deaf_until_s

    def _from_master(self, near: int) -> None:
        request = os.read(near, 4096)
        if not self._deaf():
            with suppress(BlockingIOError):
                os.write(self._far, request)

    def _from_units(self) -> None:
        self._reply += os.read(self._far, 4096)
        if self._ended is not None:
            self._ended.cancel()
        self._ended = self._loop.call_later(QUIET_S, self._whole)

    def _whole(self) -> None:
        reply, self._reply = self._reply, b""
        if not self._deaf():
            self._replies.pass_on(reply, self._send)

    def _send(self, reply: bytes) -> None:
        if self._near is not None:
            with suppress(BlockingIOError):
                os.write(self._near[0], reply)


def _pty() -> tuple[int, int]:
    """A pseudo-terminal: our end, and the one to be opened, which has to stay open here for ours to be readable."""
    near, end = os.openpty()
    tty.setraw(end)
    os.set_blocking(near, False)
    return near, end
