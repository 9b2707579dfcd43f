"""A CAN bus of this process: opened, one adapter for all units on it, and for who
listens to all of it.

Most adapters can be opened once, and a socket for each unit would hand every
frame of the bus to each of them. So the units share one `CanLine`: one thread
receives, and passes each frame to those who listen to its identifier. Frames go
from that thread to asyncio through a bounded queue, in batches, with what was
lost counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
from collections import deque
from collections.abc import AsyncGenerator, Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import NamedTuple, TypeVar, cast
from weakref import WeakKeyDictionary

from triaxcal_drivers.can.adapter import Adapter, ErrorClass, Frame, Identifier, error_frame
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Gap, RawBatch, RawFlag
from triaxcal_drivers.stall_clock import StallTolerantClock

T = TypeVar("T")


def open_bus(settings: BusSettings) -> Adapter:
    """Blocking; SocketCAN and multicast by sockets of our own, all else by
    python-can.
    Raises BusError."""
    if settings.interface == "socketcan" and sys.platform == "linux":
        from triaxcal_drivers.can.socketcan import open_socketcan  # what it imports is Linux' own

        return open_socketcan(str(settings.channel), settings.options, settings.bitrate)
    if settings.interface == "udp_multicast" and sys.platform == "linux" and find_spec("msgpack"):
        from triaxcal_drivers.can.udp_multicast import OPTIONS, UdpMulticast

        if OPTIONS.issuperset(settings.options):
            return UdpMulticast(settings)
    from triaxcal_drivers.can.python_can import PythonCan  # python-can takes a tenth of a second to load

    return PythonCan(settings)


async def opened(opening: Callable[[], T], closing: Callable[[T], object]) -> T:
    """Result of ``opening`` in a thread, which closes it again if nobody waits for it
    any more. Raises the errors of ``opening``."""
    given_up = threading.Event()

    def open_unless_given_up() -> T:
        made = opening()
        if given_up.is_set():
            closing(made)
        return made

    try:
        return await asyncio.to_thread(open_unless_given_up)
    except asyncio.CancelledError:
        given_up.set()
        raise


SYNC = 0x080  # identifier of the SYNC object (CiA 301)
BATCH_FRAMES, BATCH_S = 256, 0.2
CAPACITY = 1 << 16
"""Frames of a unit that wait for the event loop: a whole minute of the fastest
one."""
OVERRUN = "this program did not keep up with the bus"
OVERFLOW = "the receive buffer of the bus overflowed; frames of all its units count"
CONTROLLER_OVERFLOW = "the receive buffer of the CAN controller overflowed, which counts no frames"
# Plain numbers: an operation on an enumeration takes longer than all else that is
# done to a frame.
_ERROR, _EXTENDED, _LOST_BEFORE = int(RawFlag.ERROR), int(RawFlag.EXTENDED_ID), int(RawFlag.LOST_BEFORE)


class _Loss(NamedTuple):
    """``frames`` is None where nobody counted them."""

    frames: int | None
    cause: str

    def and_before(self, earlier: _Loss | None) -> _Loss:
        before = 0 if earlier is None else earlier.frames
        return self._replace(frames=None if self.frames is None or before is None else before + self.frames)


class _Every(frozenset[Identifier]):
    """All identifiers that there are."""

    def __contains__(self, _: object) -> bool:
        return True


class Matching(frozenset[Identifier]):
    """Identifiers that a rule takes, too many to list."""

    def __new__(cls, rule: Callable[[Identifier], bool]) -> Matching:
        made = super().__new__(cls)
        made._rule = rule
        return made

    _rule: Callable[[Identifier], bool]

    def __contains__(self, identifier: object) -> bool:
        return self._rule(cast(Identifier, identifier))


class FrameQueue:
    """Takes the frames of the given identifiers, and error frames, while a
    stream is open.

    When asyncio does not keep up, ``capacity`` bounds what is held: further
    frames are dropped and counted in ``dropped``. The frame after a loss, here
    or on the bus, carries RawFlag.LOST_BEFORE.
    """

    def __init__(self, clock: StallTolerantClock, *, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self._clock = clock
        self._capacity = capacity
        self._lock = threading.Lock()
        self._frames: deque[tuple[Frame, _Loss | None]] = deque()  # and what was lost just before
        self._identifiers: frozenset[Identifier] | None = None
        self._loss: _Loss | None = None
        self._failure: Exception | None = None
        self._some, self._enough = asyncio.Event(), asyncio.Event()
        self._last_ns: int | None = None
        self._at_loss = False  # the next frame waits already, for a batch of its own
        self._flows = False  # the last batch had frames: nobody waits for the first of the next

    @property
    def identifiers(self) -> frozenset[Identifier] | None:
        """None for all, or for more than an adapter can be asked for."""
        if isinstance(self._identifiers, _Every | Matching):
            return None
        return self._identifiers or frozenset()

    def open(self, identifiers: Collection[Identifier] | None) -> object:
        """Take these from now on, None for all; returns what `close` wants."""
        with self._lock:
            self._frames.clear()
            self._loss, self._failure, self._last_ns = None, None, None
            self._flows = self._at_loss = False
            if identifiers is None or isinstance(identifiers, Matching):
                opened: frozenset[Identifier] = _Every() if identifiers is None else identifiers
            else:
                opened = frozenset(identifiers)
            self._identifiers = opened
        self._some.clear()
        self._enough.clear()
        return opened

    def close(self, opened: object) -> bool:
        """Whether it was the stream that is open; nothing happens where another
        has been opened since."""
        with self._lock:
            if self._identifiers is opened:
                self._identifiers = None
                return True
        return False

    def put(self, frames: Sequence[Frame], socketcan_errors: bool = True) -> None:
        """Take received frames. Error frames are decoded if they are SocketCAN's. Runs
        in the receive thread."""
        wanted = self._identifiers
        if wanted is None or self._failure is not None:
            return
        with self._lock:
            before = len(self._frames)
            for frame in frames:
                if frame.lost:
                    self._lose(_Loss(frame.lost, OVERFLOW))
                if frame.flags & _ERROR:
                    self._keep(frame)
                    if (
                        socketcan_errors
                        and ErrorClass.RECEIVE_OVERFLOW in error_frame(frame.source, frame.data).classes
                    ):
                        self._lose(_Loss(None, CONTROLLER_OVERFLOW))
                elif (frame.source, frame.flags & _EXTENDED != 0) in wanted:
                    self._keep(frame)
            waiting = len(self._frames)
        if waiting > before == 0 and not self._flows:
            self._tell(self._some)
        if waiting >= BATCH_FRAMES > before:
            self._tell(self._enough)

    def _keep(self, frame: Frame) -> None:
        if len(self._frames) >= self._capacity:
            self.dropped += 1
            self._lose(_Loss(1, OVERRUN))
            return
        loss, self._loss = self._loss, None
        if loss is not None:
            frame = frame._replace(flags=frame.flags | _LOST_BEFORE)
        self._frames.append((frame, loss))

    def _lose(self, loss: _Loss) -> None:
        self._loss = loss.and_before(self._loss)

    def fail(self, failure: Exception) -> None:
        """Take a failure of receiving. Runs in the receive thread."""
        self._failure = failure
        self._tell(self._some)
        self._tell(self._enough)

    def _tell(self, event: asyncio.Event) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended, and nobody is left to be told
            self._clock.loop.call_soon_threadsafe(event.set)

    async def batch(self, timeout_s: float) -> RawBatch | None:
        """The next frames: up to 256, or those of 0.2 s, and none beyond the
        next loss. None when nothing comes for ``timeout_s`` of the clock.

        Raises BusError when receiving has failed.
        """
        flowed, self._flows = self._flows, False
        if flowed and not self._at_loss:  # so that one batch after the other is one wake-up each
            await self._gathered(min(BATCH_S, timeout_s))
        with self._lock:  # whoever puts some in from now on tells
            nothing = not self._frames
        if nothing:
            try:
                async with self._clock.timeout(timeout_s):
                    await self._some.wait()
            except TimeoutError:
                if not self._frames:
                    return None
            if not self._frames and self._failure is not None:
                raise BusError(str(self._failure)) from self._failure
            await self._gathered(BATCH_S)
        elif not flowed:
            await self._gathered(BATCH_S)
        self._flows = True
        with self._lock:
            taken = self._take()
            left = len(self._frames)
            self._at_loss = left > 0 and self._frames[0][1] is not None
        if left == 0 and self._failure is None:
            self._some.clear()
        if left < BATCH_FRAMES:
            self._enough.clear()
        return self._batch(taken)

    async def _gathered(self, seconds: float) -> None:
        """A whole batch, or so long; no longer where receiving has failed."""
        if self._failure is None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._enough.wait()

    def _take(self) -> list[tuple[Frame, _Loss | None]]:
        taken: list[tuple[Frame, _Loss | None]] = []
        while self._frames and len(taken) < BATCH_FRAMES and not (taken and self._frames[0][1]):
            taken.append(self._frames.popleft())
        return taken

    def _batch(self, taken: Sequence[tuple[Frame, _Loss | None]]) -> RawBatch:
        batch = RawBatch.of([frame[:4] for frame, _ in taken])
        if taken:
            first, loss = taken[0]
            if loss is not None:
                from_ns = first.time_ns if self._last_ns is None else self._last_ns
                batch = replace(batch, gap=Gap(from_ns, first.time_ns, loss.cause, loss.frames))
            self._last_ns = taken[-1][0].time_ns
        return batch


_SENT, _NO_DATA = int(RawFlag.SENT), int(RawFlag.ERROR | RawFlag.REMOTE)

POLL_S = 0.1
"""Period in which the receive thread checks for the closing."""
JOIN_S = 2.0
"""Time to wait for a driver that hangs in a call; then the bus is opened anew without
it."""
MUTE_S = 5.0
"""A bus on which nobody was heard for so long is opened anew when a unit on it
is: an adapter may hang without an error. Ten times the slowest heartbeat that
is usual on a bus in use."""


class CanLine:
    """A shared CAN line; `join` gives it. ``clock`` measures its time-outs,
    ``openings`` counts its openings."""

    def __init__(self, settings: BusSettings) -> None:
        self.settings = settings
        self.name = f"{settings.interface} {settings.channel}"
        self.users = self.openings = 0
        self.clock = StallTolerantClock(asyncio.get_running_loop())
        self._opening = asyncio.Lock()
        self._adapter: Adapter | None = None
        self._thread: threading.Thread | None = None
        self._heard_s = 0.0
        self._queues: list[FrameQueue] = []
        self._listeners: dict[Identifier, Callable[[Frame], None]] = {}
        self._failure: BusError | None = None
        self._syncs: dict[object, float] = {}  # periods [s] of those who want SYNC
        self._syncing: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Open the line, unless it is open and receives frames. Raises BusError."""
        async with self._opening:
            if self._adapter is not None and self.clock.now_s() - self._heard_s < MUTE_S:
                return
            try:
                await self._close()
                adapter = await opened(lambda: open_bus(self.settings), Adapter.close)
            except BaseException as e:  # who listened to the one before waits for nothing
                self._fail(e if isinstance(e, BusError) else BusError(f"{self.name} is not open"))
                raise
            self.openings += 1
            self._adapter, self._failure, self._heard_s = adapter, None, self.clock.now_s()
            self._filter()
            self._thread = threading.Thread(target=self._receive, args=(adapter,), name=self.name, daemon=True)
            self._thread.start()

    async def close(self) -> None:
        """Close the line; the time-outs of all who still wait expire."""
        self.clock.close()
        async with self._opening:
            await self._close()

    async def _close(self) -> None:
        adapter, self._adapter = self._adapter, None
        thread, self._thread = self._thread, None

        def close() -> None:
            if thread is not None:
                thread.join(JOIN_S)
            if adapter is not None:
                adapter.close()

        if adapter is not None:
            await asyncio.to_thread(close)

    def check(self) -> None:
        """Raises BusError where receiving has failed."""
        if self._failure is not None:
            raise BusError(str(self._failure)) from self._failure

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """Blocking. Raises BusError."""
        adapter = self._adapter
        if adapter is None:
            self.check()
            raise BusError(f"{self.name} is not open")
        sent_ns = HOST.now_ns()
        adapter.send(identifier, data, extended=extended)
        if not adapter.echoes:
            frame = Frame(sent_ns, identifier, RawFlag.SENT | (RawFlag.EXTENDED_ID if extended else 0), data)
            for queue in self._queues:
                if queue.identifiers is None:
                    queue.put([frame])

    def sync(self, period_s: float) -> object:
        """Have SYNC sent (CiA 301) every ``period_s``; returns what `unsync` wants. All
        units on the line hear it, so one sequence serves them, at the shortest period
        of any."""
        wanted = object()
        self._syncs[wanted] = period_s
        if self._syncing is None:
            self._syncing = asyncio.create_task(self._send_syncs())
        return wanted

    def unsync(self, wanted: object) -> None:
        self._syncs.pop(wanted, None)
        if not self._syncs and self._syncing is not None:
            self._syncing.cancel()
            self._syncing = None

    async def _send_syncs(self) -> None:
        loop = asyncio.get_running_loop()
        next_s = loop.time()
        while True:
            with suppress(BusError):  # the streams tell
                await asyncio.to_thread(self.send, SYNC, b"")
            next_s = max(next_s + min(self._syncs.values(), default=1.0), loop.time())
            await asyncio.sleep(next_s - loop.time())

    def hear(self, queue: FrameQueue) -> None:
        """``queue`` gets the frames that it has been opened for."""
        self._queues = [*(q for q in self._queues if q is not queue), queue]
        if self._failure is not None:  # before it was among them
            queue.fail(self._failure)
        self._filter()

    def unhear(self, queue: FrameQueue) -> None:
        self._queues = [q for q in self._queues if q is not queue]
        self._filter()

    def listen(self, identifier: int, listener: Callable[[Frame], None]) -> None:
        """``listener`` is called in the receive thread; one for each
        identifier."""
        self._listeners = {**self._listeners, (identifier, False): listener}
        self._filter()

    def ignore(self, identifier: int) -> None:
        self._listeners = {key: heard for key, heard in self._listeners.items() if key != (identifier, False)}
        self._filter()

    def _filter(self) -> None:
        if self._adapter is not None:
            heard = [queue.identifiers for queue in self._queues]
            units = [identifiers for identifiers in heard if identifiers is not None]
            wanted = set(self._listeners).union(*units) if len(units) == len(heard) else None
            with suppress(BusError):  # the receive thread finds out
                self._adapter.only(wanted)

    def _fail(self, failure: BusError) -> None:
        self._failure = failure
        for queue in self._queues:
            queue.fail(failure)

    def _receive(self, adapter: Adapter) -> None:
        """Receive in a thread of its own, until the adapter is closed or fails."""
        while self._adapter is adapter:
            try:
                frames = adapter.receive(POLL_S)
            except BusError as e:
                if self._adapter is adapter:
                    if missed := adapter.missed():  # which no frame will tell of any more
                        lost = "1 frame before it was" if missed == 1 else f"{missed} frames before it were"
                        e = BusError(f"{e}; {lost} lost")
                    self._adapter = None
                    self._fail(e)
                    adapter.close()
                return
            if frames:
                if not all(frame.flags & _SENT for frame in frames):
                    self._heard_s = self.clock.now_s()
                HOST.steps_ns()
                if HOST.stepped:
                    frames = [frame._replace(time_ns=HOST.steady_ns(frame.time_ns)) for frame in frames]
                for queue in self._queues:
                    queue.put(frames, adapter.socketcan_errors)
                listeners = self._listeners
                for frame in frames if listeners else ():
                    listener = listeners.get((frame.source, frame.flags & _EXTENDED != 0))
                    if listener is not None and not frame.flags & _NO_DATA:
                        listener(frame)


_lines: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, CanLine]] = WeakKeyDictionary()
"""The buses that this process has open, by event loop and name."""


async def join(settings: BusSettings) -> CanLine:
    """The bus there, opened where it is not; to be given back by `leave`.

    Raises BusError where it cannot be opened, or where others have it with
    other settings.
    """
    lines = _lines.setdefault(asyncio.get_running_loop(), {})
    line = lines.get(settings.name)
    if line is None:
        line = lines[settings.name] = CanLine(settings)
    elif settings.driven != line.settings.driven:
        raise BusError(
            f"{line.name}: another unit has it with {line.settings.driven}; this one asks for {settings.driven}"
        )
    line.users += 1
    try:
        await line.open()
    except BaseException:
        await leave(line)
        raise
    return line


async def leave(line: CanLine) -> None:
    """Closes the bus once nobody uses it any more."""
    line.users -= 1
    if line.users == 0:
        lines = _lines.get(line.clock.loop, {})
        for name in [name for name, known in lines.items() if known is line]:
            del lines[name]
        await line.close()


LOOK_S = 0.2
"""A quiet bus is told of so often: who counts seconds is no later by more."""
LISTENER_CAPACITY = 1 << 17
"""Frames that wait for the event loop: over ten seconds of a full bus at
1 Mbit/s, as in the receive buffer before them."""
REOPENED = f"the adapter was closed and opened anew, as nobody was heard for {MUTE_S:g} s"


@dataclass(frozen=True)
class _Connection:
    line: CanLine
    frames: FrameQueue
    openings: int  # of the line, by then


class BusListener:
    """Listens to a bus, which it may share with units of this process, and
    sends nothing.

    Nobody has to send on a bus: silence is no fault of it. Frames that this
    program sends are among those that it gives, with RawFlag.SENT.
    """

    def __init__(self, settings: BusSettings) -> None:
        self._settings = settings
        self._connection: _Connection | None = None
        self._first: RawBatch | None = None  # which `settled` has seen

    async def open(self) -> None:
        """Open the bus; the stream has the frames from now on. Raises BusError."""
        await self.close()
        line = await join(self._settings)
        frames = FrameQueue(line.clock, capacity=LISTENER_CAPACITY)
        frames.open(None)
        self._connection = _Connection(line, frames, line.openings)
        line.hear(frames)

    async def close(self) -> None:
        connection, self._connection, self._first = self._connection, None, None
        if connection is not None:
            connection.line.unhear(connection.frames)
            connection.frames.fail(BusError(f"{self._settings} is closed"))
            await leave(connection.line)

    def _connected(self) -> _Connection:
        if self._connection is None:
            raise BusError(f"{self._settings} is not open")
        return self._connection

    async def settled(self, timeout_s: float) -> None:
        """Waits for a frame, or for so long without a failure: an adapter may
        open and fail at once. Raises BusError."""
        self._first = await self._connected().frames.batch(timeout_s)

    async def stream(self) -> AsyncGenerator[RawBatch, None]:
        """All frames and error frames since it was opened, until the iterator is
        closed; where none come, a batch without any every `LOOK_S`.

        Raises BusError.
        """
        connection = self._connected()
        line, frames = connection.line, connection.frames
        openings, last_ns = connection.openings, None
        while True:
            batch, self._first = self._first, None
            if batch is None:
                batch = await frames.batch(LOOK_S)
            if batch is None:
                now_ns, look = HOST.now_ns(), RawBatch.of([])
                if line.openings != openings:
                    look = look.after(Gap(now_ns if last_ns is None else last_ns, now_ns, REOPENED))
                openings, last_ns = line.openings, now_ns
                yield look
                continue
            if not batch:
                continue
            if line.openings != openings and batch.gap is None:
                first_ns = int(batch.time_ns[0])
                batch = batch.after(Gap(first_ns if last_ns is None else last_ns, first_ns, REOPENED))
            openings, last_ns = line.openings, int(batch.time_ns[-1])
            yield batch
