"""The events of the station for whoever listens: each is stored before it is sent, so
that its number is never given twice, and sent to every listener in the same order.
While the store fails, events are sent all the same and stored when it answers again."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Protocol

from triaxcald.errors import DaemonError

LISTENER_MOST: Final = 2_000
"""Messages that wait for one listener. One that is slower than that is let go: it
comes again with the number of the last event that it had."""
TOGETHER_MOST: Final = 200
"""Events that are stored in one transaction."""
RETRY_S: Final = 2.0
"""Time until a store that has failed is asked again."""


@dataclass(frozen=True)
class Message:
    """``kind`` is `state`, `event` or `live`. ``seq`` is the number with which a
    listener that has this message comes again, None of what has no number."""

    kind: str
    data: Mapping[str, Any]
    seq: int | None = None


class EventStore(Protocol):
    """Where events are kept. All methods block, and raise DaemonError."""

    def append(self, events: list[dict[str, Any]]) -> None:
        """The same event may come again: whether it was stored is not always known."""

    def events_after(self, seq: int, limit: int) -> list[dict[str, Any]]: ...

    def last_seq(self) -> int: ...


class TooSlow(Exception):
    """The listener has not read for too long."""


class _Listener:
    def __init__(self) -> None:
        self.messages: deque[Message] = deque()
        self.news = asyncio.Event()
        self.too_slow = False

    def tell(self, message: Message) -> None:
        if len(self.messages) >= LISTENER_MOST:
            self.too_slow = True
        else:
            self.messages.append(message)
        self.news.set()


class Stream:
    """``state`` gives the station state after the event of a number. All methods are
    called in the event loop."""

    def __init__(self, store: EventStore, state: Callable[[int], dict[str, Any]], kept: int = 10_000) -> None:
        self._store, self._state, self._kept = store, state, kept
        self._waiting: deque[Message] = deque()
        self._news = asyncio.Event()
        self._listeners: set[_Listener] = set()
        self._idle = asyncio.Event()
        self._idle.set()
        self.seq = 0
        self._closed = False
        self.trouble: str | None = None
        """Why the latest events are not stored."""
        self._unstored: deque[dict[str, Any]] = deque(maxlen=kept)
        self._retry_at_s = 0.0

    async def begin(self) -> None:
        """Go on after the last stored event. Raises DaemonError."""
        self.seq = await asyncio.to_thread(self._store.last_seq)

    def number(self) -> int:
        """The number of the next event."""
        self.seq += 1
        return self.seq

    def emit(self, event: dict[str, Any]) -> None:
        self._put(Message("event", event, int(event["seq"])))

    def changed(self) -> None:
        """The state has changed by something that is no event."""
        self._put(Message("state", self._state(self.seq), self.seq))

    def live(self, data: Mapping[str, Any]) -> None:
        """Send values that nobody needs later."""
        self._put(Message("live", data))

    def close(self) -> None:
        """End all listening."""
        self._closed = True
        for listener in self._listeners:
            listener.news.set()

    async def drained(self) -> None:
        """Wait until everything is sent."""
        await self._idle.wait()

    def _put(self, message: Message) -> None:
        self._waiting.append(message)
        self._idle.clear()
        self._news.set()

    async def run(self) -> None:
        """Store and send, until cancelled; what waits then is stored first."""
        try:
            while True:
                with suppress(TimeoutError):
                    async with asyncio.timeout(RETRY_S if self._unstored else None):
                        await self._news.wait()
                self._news.clear()
                await self._keep(())
                while self._waiting:
                    await self._forward()
                self._idle.set()
        finally:
            waiting = [dict(m.data) for m in self._waiting if m.kind == "event"]
            last = self._unstored[-1]["seq"] if self._unstored else 0
            if events := [*self._unstored, *(event for event in waiting if event["seq"] > last)]:
                with suppress(DaemonError):
                    self._store.append(events)

    async def _forward(self) -> None:
        together = [self._waiting[i] for i in range(min(len(self._waiting), TOGETHER_MOST))]
        await self._keep([dict(m.data) for m in together if m.kind == "event"])
        for message in together:
            self._waiting.popleft()
            for listener in self._listeners:
                listener.tell(message)

    async def _keep(self, events: Sequence[dict[str, Any]]) -> None:
        """Store these events and those that an earlier failure has left."""
        self._unstored.extend(events)
        if not self._unstored or asyncio.get_running_loop().time() < self._retry_at_s:
            return
        before = self.trouble
        try:
            await asyncio.to_thread(self._store.append, list(self._unstored))
            self._unstored.clear()
            self.trouble = None
        except DaemonError as e:  # the work goes on, and is in the recordings
            self.trouble = str(e)
            self._retry_at_s = asyncio.get_running_loop().time() + RETRY_S
        if (before is None) != (self.trouble is None):
            self.changed()

    async def listen(self, after: int | None = None) -> AsyncGenerator[Message]:
        """The present state; then the events behind ``after`` if they are kept, else
        those to come, until the stream is closed. Raises TooSlow."""
        listener = _Listener()
        self._listeners.add(listener)
        try:
            # Listening begins here: what is not yet sent will come by itself.
            seq = self.seq
            sent = next((m.seq - 1 for m in self._waiting if m.kind == "event" and m.seq is not None), seq)
            known = after if after is not None and 0 <= seq - after <= self._kept else None
            # A connection that breaks now is made again behind this number.
            yield Message("state", self._state(seq), seq if known is None else known)
            had = seq
            if known is not None:
                for event in await self._missed(known):
                    if event["seq"] <= sent:
                        yield Message("event", event, event["seq"])
                had = max(sent, known)
            while True:
                while listener.messages:
                    message = listener.messages.popleft()
                    if message.kind != "event" or message.seq is None or message.seq > had:
                        yield message
                if listener.too_slow:
                    raise TooSlow
                if self._closed:
                    return
                listener.news.clear()
                await listener.news.wait()
        finally:
            self._listeners.discard(listener)

    async def _missed(self, after: int) -> list[dict[str, Any]]:
        stored: list[dict[str, Any]] = []
        with suppress(DaemonError):
            stored = await asyncio.to_thread(self._store.events_after, after, self._kept)
        last = stored[-1]["seq"] if stored else after
        return [*stored, *(event for event in self._unstored if event["seq"] > last)]

    @property
    def listeners(self) -> int:
        return len(self._listeners)
