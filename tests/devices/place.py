"""Where a unit is plugged in: which unit answers there, and what becomes of requests and replies on the way. No I/O."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from tests.devices.memory import Electronics, Refused, Silent

When = float | frozenset[int]
"""Which requests something happens to: a probability, or their numbers at this place, from 1."""
Garbage = str
"""What is wrong with a reply; which there are is said by each transport's ``GARBAGE``."""


@dataclass(frozen=True)
class Trouble:
    """The defaults are a sound line. Chance comes from ``seed`` alone."""

    seed: int = 0
    lose_request: When = 0.0
    """The unit never hears it."""
    lose_reply: When = 0.0
    """The unit has done it, the master does not learn of it."""
    late: When = 0.0
    """The reply comes ``late_s`` late; later than the master waits, if so chosen."""
    late_s: float = 0.0
    duplicate: When = 0.0
    """The reply comes twice."""
    garble: When = 0.0
    """The reply comes damaged in one of the ways of ``garbage``."""
    garbage: tuple[Garbage, ...] = ("truncated",)
    busy: When = 0.0
    """Answered as busy and not done; 1.0: always."""
    busy_for_s: float = 0.0
    """From the first request on, everything is answered as busy for so long."""
    busy_code: int | None = None
    """None: Modbus exception 6, SDO abort 0x08000022. Modbus also has 5, and gateways 0x0A and 0x0B."""
    gateway: int | None = None
    """What the unit leaves unanswered, a gateway before it answers by this exception, at once."""
    brown_out: When = 0.0
    """The unit loses its power for a moment before it hears the request: RAM gone, locked."""
    drop: When = 0.0
    """The connection is reset (TCP RST) instead of a reply."""
    drop_done: bool = True
    """The unit does what was asked before the connection is dropped."""
    dead_after: int | None = None
    """After so many requests the line is dead."""
    dead_for_s: float = math.inf
    """So long after the last of them it works again."""
    restart_drops: bool = False
    """TCP: a restart of the unit resets its connections."""
    refuse_connections_s: float = 0.0
    """TCP: so long after a restart connections are refused."""


@dataclass(frozen=True)
class Reply:
    """``data`` is the transport's; ``garbage`` how it is to be damaged."""

    data: bytes
    after_s: float
    garbage: Garbage | None = None


@dataclass(frozen=True)
class Exchange:
    """What comes back on a request; ``drop``: the connection is reset, now."""

    replies: tuple[Reply, ...] = ()
    drop: bool = False


class Place:
    """A unit with a line to it. ``lock`` is held around whatever touches the unit from a thread."""

    def __init__(self, unit: Electronics, trouble: Trouble | None = None) -> None:
        self.unit = unit
        self.second: Electronics | None = None
        """Another unit with the same address, which hears every request and answers ``second_after_s`` later."""
        self.second_after_s = 0.04
        self.trouble = trouble or Trouble()
        self.requests = 0
        self.lock = threading.RLock()
        self._random = random.Random(self.trouble.seed)
        self._swaps: dict[int, Electronics] = {}
        self._seconds: dict[int, Electronics] = {}
        self._first_s = self._last_alive_s = 0.0

    def swap_at(self, request: int, other: Electronics) -> None:
        """From that request on another unit answers here."""
        self._swaps[request] = other

    def second_at(self, request: int, other: Electronics, after_s: float = 0.04) -> None:
        """From that request on another unit answers beside this one."""
        self._seconds[request] = other
        self.second_after_s = after_s

    def swap(self, other: Electronics) -> None:
        """From now on another unit answers here."""
        with self.lock:
            self.unit = other

    def exchange(
        self, now: float, carry_out: Callable[[Electronics], tuple[bytes, float]], refuse: Callable[[Refused], bytes]
    ) -> Exchange:
        """One request. ``carry_out`` does it on the unit, and gives the reply and how long that takes; ``refuse``
        makes a reply of a refusal."""
        with self.lock:
            self.requests += 1
            self.unit = self._swaps.get(self.requests, self.unit)
            self.second = self._seconds.get(self.requests, self.second)
            if self.requests == 1:
                self._first_s = self._last_alive_s = now
            exchange = self._exchange(now, carry_out, refuse)
            return replace(exchange, replies=(*exchange.replies, *self._of_the_second(now, carry_out, refuse)))

    def _exchange(
        self, now: float, carry_out: Callable[[Electronics], tuple[bytes, float]], refuse: Callable[[Refused], bytes]
    ) -> Exchange:
        t = self.trouble
        # Each draws at each request, so that one knob does not move another's chance.
        lost, unheard, late, twice, garbled, busy, brown_out, drop = map(
            self._happens,
            (t.lose_request, t.lose_reply, t.late, t.duplicate, t.garble, t.busy, t.brown_out, t.drop),
        )
        kind = t.garbage[int(self._random.random() * len(t.garbage))]
        if self._dead(now) or lost:
            return Exchange()
        if brown_out:
            self.unit.power_cycle(now)
        if drop and not t.drop_done:
            return Exchange(drop=True)
        try:
            data, after_s = self._answered(now, busy, carry_out, refuse)
        except Silent:
            if t.gateway is None or drop:
                return Exchange(drop=drop)
            data, after_s = refuse(Refused("busy", t.gateway)), 0.0
        if drop or unheard:
            return Exchange(drop=drop)
        reply = Reply(data, after_s + late * t.late_s, kind if garbled else None)
        return Exchange((reply,) * (1 + twice))

    def _of_the_second(
        self, now: float, carry_out: Callable[[Electronics], tuple[bytes, float]], refuse: Callable[[Refused], bytes]
    ) -> tuple[Reply, ...]:
        """Its line is sound."""
        if self.second is None:
            return ()
        try:
            data, after_s = carry_out(self.second) if self.second.up(now) else (None, 0.0)
        except Refused as e:
            data, after_s = refuse(e), 0.0
        except Silent:
            data, after_s = None, 0.0
        return () if data is None else (Reply(data, after_s + self.second_after_s),)

    def _answered(
        self,
        now: float,
        busy: bool,
        carry_out: Callable[[Electronics], tuple[bytes, float]],
        refuse: Callable[[Refused], bytes],
    ) -> tuple[bytes, float]:
        if not self.unit.up(now):
            raise Silent
        try:
            if busy or now < self._first_s + self.trouble.busy_for_s:
                raise Refused("busy", self.trouble.busy_code)
            return carry_out(self.unit)
        except Refused as e:
            return refuse(e), 0.0

    def _happens(self, when: When) -> bool:
        chance = self._random.random()
        return self.requests in when if isinstance(when, frozenset) else chance < when

    def _dead(self, now: float) -> bool:
        if self.trouble.dead_after is None:
            return False
        if self.requests <= self.trouble.dead_after:
            self._last_alive_s = now
            return False
        return now < self._last_alive_s + self.trouble.dead_for_s
