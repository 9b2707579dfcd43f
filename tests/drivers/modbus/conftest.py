"""A device of the test's own: it hears requests and answers with bytes written by hand."""

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.profile import Bundle

PROFILE = """
format = "triaxcal.profile/1"
name = "by-hand"
driver = "modbus"
identity = { vendor = "v", product = "p", expect = { level = 10 } }
output = { unit = "counts" }
sampling = { rate_hz = 100.0, reply_timeout_s = 5.0, silence_timeout_s = 10.0 }

[streams.readings]
layout = "poll"
table = "holding"
address = 0x6B
poll_period_s = 0.001
channels = { ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" }, uz = { word = 2, type = "int16" } }

[streams.queue]
layout = "fifo"
address = 0x20
poll_period_s = 0.001
header = { count = 0, remaining = 1 }
record_start = 2
record_words = 4
record_capacity = 2
counter = { word = 3, type = "uint16" }
channels = { ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" }, uz = { word = 2, type = "int16" } }

[registers]
level = { table = "input", access = "ro", address = 8, type = "uint16" }
setting = { address = 1, type = "uint16" }
pair = { address = 1, type = "uint32" }
twisted = { address = 1, type = "uint32", word_order = "little" }
"""

Exchange = tuple[str, str | None]


class Heard(list[str]):
    """Requests as they came, in hex; ``port`` or ``path`` is where the device listens."""

    port: int
    path: str


@pytest.fixture
def bundle() -> Callable[..., Bundle]:
    """The profile above, with text replaced in it; ``hasty`` for tests that sit out a silence."""

    def make(*replaced: tuple[str, str], hasty: bool = False) -> Bundle:
        text = PROFILE
        patience = ("reply_timeout_s = 5.0, silence_timeout_s = 10.0", "reply_timeout_s = 0.2, silence_timeout_s = 0.4")
        for old, new in (*replaced, *([patience] if hasty else [])):
            assert old in text
            text = text.replace(old, new)
        return parse_bundle(text.encode(), {}, where="by-hand.toml")

    return make


@pytest.fixture
def tcp_device():
    """Context manager: a TCP server that takes the requests in turn and answers each as told; None: not at all."""

    @asynccontextmanager
    async def serve(*exchanges: Exchange) -> AsyncIterator[Heard]:
        heard = Heard()

        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            for request, reply in exchanges:
                try:
                    heard.append((await reader.readexactly(len(bytes.fromhex(request)))).hex())
                except asyncio.IncompleteReadError:
                    break
                writer.write(bytes.fromhex(reply or ""))
            await reader.read()
            writer.close()

        server = await asyncio.start_server(talk, "127.0.0.1", 0)
        heard.port = server.sockets[0].getsockname()[1]
        async with server:
            yield heard
        assert heard == [bytes.fromhex(request).hex() for request, _ in exchanges][: len(heard)]

    return serve


@pytest.fixture
def serial_device():
    """Likewise on a serial line, which is a pseudo-terminal."""

    @asynccontextmanager
    async def serve(*exchanges: Exchange) -> AsyncIterator[Heard]:
        master, slave = os.openpty()
        heard = Heard()
        heard.path = os.ttyname(slave)
        loop = asyncio.get_running_loop()
        received = b""
        script = list(exchanges)

        def readable() -> None:
            nonlocal received
            received += os.read(master, 1024)
            if script and len(received) >= len(bytes.fromhex(script[0][0])):
                _, reply = script.pop(0)
                heard.append(received.hex())
                received = b""
                os.write(master, bytes.fromhex(reply or ""))

        loop.add_reader(master, readable)
        try:
            yield heard
        finally:
            loop.remove_reader(master)
            os.close(master)
            os.close(slave)
        assert heard == [bytes.fromhex(request).hex() for request, _ in exchanges][: len(heard)]

    return serve


@pytest.fixture(scope="session")
def profile_text() -> str:
    return PROFILE
