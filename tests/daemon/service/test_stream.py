"""The events of a station: each stored before it is sent, resumed by number, ended in order."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing, asynccontextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from triaxcald.service import stream as stream_module
from triaxcald.service.database import DatabaseError
from triaxcald.service.ledger import Ledger
from triaxcald.service.stream import LISTENER_MOST, Message, Stream, TooSlow
from triaxcald.simulation.follow import ServiceEvents
from triaxcald.station.config import Station


@pytest.fixture
def ledger(make_station: Callable[..., Station], open_ledger: Callable[[Station], Ledger]) -> Ledger:
    return open_ledger(make_station())


@asynccontextmanager
async def flowing(ledger: Any) -> AsyncIterator[Stream]:
    stream = Stream(ledger, lambda seq: {"seq": seq})
    await stream.begin()
    running = asyncio.ensure_future(stream.run())
    try:
        yield stream
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


def emit(stream: Stream, count: int) -> None:
    for _ in range(count):
        number = stream.number()
        stream.emit({"seq": number, "run": None, "event": "stage"})


async def heard(stream: Stream, count: int, after: int | None = None) -> list[tuple[str, int | None]]:
    async with aclosing(stream.listen(after)) as messages:
        found: list[Message] = []
        async for message in messages:
            found.append(message)
            if len(found) == count:
                break
    return [(m.kind, m.seq) for m in found]


async def test_a_listener_gets_the_state_and_then_what_comes(ledger: Ledger) -> None:
    async with flowing(ledger) as stream:
        emit(stream, 2)
        await stream.drained()
        listening = asyncio.ensure_future(heard(stream, 4))
        while not stream.listeners:
            await asyncio.sleep(0)
        emit(stream, 2)
        stream.changed()
        assert await listening == [("state", 2), ("event", 3), ("event", 4), ("state", 4)]
        assert [e["seq"] for e in ledger.events_after(0, 10)] == [1, 2, 3, 4]


async def test_one_that_comes_again_gets_what_it_missed_once(ledger: Ledger) -> None:
    async with flowing(ledger) as stream:
        emit(stream, 5)  # some of them wait to be stored
        assert await heard(stream, 4, after=2) == [("state", 2), ("event", 3), ("event", 4), ("event", 5)]
        await stream.drained()
        assert await heard(stream, 3, after=3) == [("state", 3), ("event", 4), ("event", 5)]
        # One whose connection breaks after the state alone has missed them still.
        assert await heard(stream, 1, after=3) == [("state", 3)]


@pytest.mark.parametrize("after", [0, 99])
async def test_a_number_that_is_not_kept_gives_the_state_alone(ledger: Ledger, after: int) -> None:
    async with flowing(ledger) as stream:
        stream._kept = 3
        emit(stream, 5)
        await stream.drained()
        listening = asyncio.ensure_future(heard(stream, 2, after=after))
        while not stream.listeners:
            await asyncio.sleep(0)
        emit(stream, 1)
        assert await listening == [("state", 5), ("event", 6)]


async def test_numbers_go_on_after_a_restart(ledger: Ledger) -> None:
    async with flowing(ledger) as stream:
        emit(stream, 3)
        await stream.drained()
    async with flowing(ledger) as stream:
        assert stream.number() == 4


async def test_what_waits_at_the_end_is_stored(ledger: Ledger) -> None:
    async with flowing(ledger) as stream:
        await asyncio.sleep(0)
        emit(stream, 3)
    assert ledger.last_seq() == 3


async def test_a_listener_that_does_not_read_is_let_go(ledger: Ledger) -> None:
    async with flowing(ledger) as stream, aclosing(stream.listen()) as messages:
        await anext(messages)
        for _ in range(LISTENER_MOST + 1):
            stream.live({})
        await stream.drained()
        with pytest.raises(TooSlow):
            async for _ in messages:
                pass
    assert stream.listeners == 0


async def test_listening_ends_with_the_stream(ledger: Ledger) -> None:
    async with flowing(ledger) as stream:
        listening = asyncio.ensure_future(heard(stream, 9))
        while not stream.listeners:
            await asyncio.sleep(0)
        emit(stream, 1)
        await stream.drained()
        stream.close()
        assert await listening == [("state", 0), ("event", 1)]


class Failing:
    """A database that fails while it is told to."""

    def __init__(self) -> None:
        self.fails = True
        self.kept: list[int] = []

    def append(self, events: list[dict[str, Any]]) -> None:
        if self.fails:
            raise DatabaseError("no space")
        self.kept += [event["seq"] for event in events]

    def events_after(self, seq: int, limit: int) -> list[dict[str, Any]]:
        if self.fails:
            raise DatabaseError("no space")
        return [{"seq": kept} for kept in self.kept if kept > seq]

    def last_seq(self) -> int:
        return 7


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Failing:
    monkeypatch.setattr(stream_module, "RETRY_S", 0.01)
    return Failing()


async def test_events_go_on_while_the_database_fails(failing: Failing) -> None:
    async with flowing(failing) as stream:
        listening = asyncio.ensure_future(heard(stream, 3, after=6))
        while not stream.listeners:
            await asyncio.sleep(0)
        emit(stream, 1)
        assert await listening == [("state", 6), ("event", 8), ("state", 8)]  # the state says that it fails
        assert stream.trouble == "no space"


async def test_what_a_failing_database_did_not_take_is_stored_when_it_answers_again(failing: Failing) -> None:
    async with flowing(failing) as stream:
        emit(stream, 2)
        await stream.drained()
        emit(stream, 1)
        await stream.drained()
        assert await heard(stream, 3, after=8) == [("state", 8), ("event", 9), ("event", 10)]
        failing.fails = False  # and no further event comes
        async with aclosing(stream.listen()) as messages:
            await anext(messages)
            async with asyncio.timeout(20):
                assert (await anext(messages)).kind == "state"
        assert stream.trouble is None
        assert failing.kept == [8, 9, 10]
        emit(stream, 1)
        await stream.drained()
    assert failing.kept == [8, 9, 10, 11]


async def test_what_a_failing_database_did_not_take_is_stored_at_the_end(failing: Failing) -> None:
    async with flowing(failing) as stream:
        stream._retry_at_s = float("inf")
        emit(stream, 2)
        await stream.drained()
        failing.fails = False
    assert failing.kept == [8, 9]


class Forgetful:
    """A database whose first ``lost`` answers do not arrive, although it has taken the events."""

    def __init__(self, ledger: Ledger, lost: int) -> None:
        self.ledger, self.lost = ledger, lost

    def append(self, events: list[dict[str, Any]]) -> None:
        self.ledger.append(events)
        if self.lost:
            self.lost -= 1
            raise DatabaseError("the connection was lost")

    def events_after(self, seq: int, limit: int) -> list[dict[str, Any]]:
        return self.ledger.events_after(seq, limit)

    def last_seq(self) -> int:
        return self.ledger.last_seq()


async def test_events_whose_answer_was_lost_are_stored_once_and_block_nothing(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream_module, "RETRY_S", 0.01)
    async with flowing(Forgetful(ledger, 1)) as stream, aclosing(stream.listen()) as messages:
        await anext(messages)
        emit(stream, 2)
        async with asyncio.timeout(20):
            told = [(m.kind, m.seq) for m in [await anext(messages) for _ in range(4)]]
        assert told == [("event", 1), ("event", 2), ("state", 2), ("state", 2)]
        assert stream.trouble is None
    assert [e["seq"] for e in ledger.events_after(0, 10)] == [1, 2]


class Slow(Forgetful):
    """A database that is asked while the service ends; what it is asked first fails."""

    def __init__(self, ledger: Ledger) -> None:
        super().__init__(ledger, 0)
        self.asked, self.go_on = threading.Event(), threading.Event()

    def append(self, events: list[dict[str, Any]]) -> None:
        if not self.asked.is_set():
            self.asked.set()
            self.go_on.wait(20)
            raise DatabaseError("the connection was lost")
        super().append(events)


async def test_an_end_while_events_are_being_stored_loses_none(ledger: Ledger) -> None:
    store = Slow(ledger)
    async with flowing(store) as stream:
        emit(stream, 3)
        await asyncio.to_thread(store.asked.wait, 20)
    store.go_on.set()
    assert [e["seq"] for e in ledger.events_after(0, 10)] == [1, 2, 3]


def test_another_event_does_not_take_the_number_of_one_that_is_kept(ledger: Ledger) -> None:
    ledger.append([{"seq": 1, "event": "stage"}])
    ledger.append([{"seq": 1, "event": "stage"}, {"seq": 2, "event": "stage"}])
    with pytest.raises(DatabaseError):
        ledger.append([{"seq": 2, "event": "poses"}, {"seq": 3, "event": "poses"}])
    assert [e["seq"] for e in ledger.events_after(0, 10)] == [1, 2]


def test_a_simulated_tray_hears_each_event_once_across_a_restart_of_the_service() -> None:
    """Bytes of server-sent events as the service sends them; the second connection asks for what it missed."""
    asked: list[str] = []
    heard_lines: list[bytes] = []
    state = b'id: 4\nevent: state\ndata: {"seq": 4}\n\n'
    answers = [
        state + b'id: 5\nevent: event\ndata: {"seq": 5}\n\nevent: alive\ndata: {}\n\n',
        b'id: 6\nevent: state\ndata: {"seq": 6}\n\nid: 6\nevent: event\r\ndata: {"seq": 6}\r\n\r\n',
    ]

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(answers[min(len(asked), 2) - 1])

        def log_message(self, format: str, *args: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        events = ServiceEvents(f"http://127.0.0.1:{server.server_address[1]}")
        enough = threading.Event()

        def tell(data: bytes | None) -> None:
            assert data is not None
            heard_lines.append(data)
            if len(heard_lines) == 2:
                enough.set()

        threading.Thread(target=events.read, args=(tell,), daemon=True).start()
        assert enough.wait(30)
        server.shutdown()
    assert heard_lines[:2] == [b'{"seq": 5}\n', b'{"seq": 6}\n']
    assert asked[:2] == ["/api/1/events", "/api/1/events?after=5"]
