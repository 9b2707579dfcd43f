"""Counts answers against requests, so that an answer too many shows: two units
have one address, or another program asks the same unit. No I/O."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

KeyT = TypeVar("KeyT", bound=Hashable)

OPEN_MOST = 2
"""Requests without an answer that are remembered for each key: as many late
answers explain themselves. A lost request explains one answer too many."""
KEYS_MOST = 512
"""Keys that are remembered, and answers too many that wait to be taken. A
device has fewer registers."""


@dataclass(frozen=True)
class ExtraAnswer:
    """An answer that no request explains. ``register`` is the profile's name of
    what was asked for, empty if that is unknown; ``answer`` came too many, and
    ``first`` is what had answered the request, None if nobody had asked. Raw
    register bytes of a read, else what came on the wire."""

    register: str
    answer: bytes
    first: bytes | None

    @property
    def same(self) -> bool:
        """Whether an answer came twice, byte for byte, as a line may double it.
        Else one unit alone cannot have sent both."""
        return self.first == self.answer


@dataclass(frozen=True)
class Extra(Generic[KeyT]):
    """As `ExtraAnswer`, as it came on the wire."""

    key: KeyT
    answer: bytes
    first: bytes | None


class Answers(Generic[KeyT]):
    """Requests and answers that belong together have one key."""

    def __init__(self) -> None:
        self._open: Counter[KeyT] = Counter()
        self._last: OrderedDict[KeyT, bytes] = OrderedDict()
        self._extra: list[Extra[KeyT]] = []

    def asked(self, key: KeyT) -> None:
        self._open[key] = min(self._open[key] + 1, OPEN_MOST)

        while len(self._open) > 2 * KEYS_MOST:  # requests that nothing ever answered
            del self._open[next(iter(self._open))]

    def answered(self, key: KeyT, answer: bytes, *, final: bool = True) -> None:
        """``final``: no other answer to the same request is to come, as one may
        after "busy"."""
        if self._open[key] > 0:
            self._open[key] -= final
            self._last[key] = answer
            self._last.move_to_end(key)
            while len(self._last) > KEYS_MOST:
                old, _ = self._last.popitem(last=False)
                del self._open[old]
        elif len(self._extra) < KEYS_MOST:
            self._extra.append(Extra(key, answer, self._last.get(key)))

    def was_asked(self, key: KeyT) -> bool:
        return key in self._last or self._open[key] > 0

    def take(self) -> list[Extra[KeyT]]:
        """The answers too many since the last call."""
        taken, self._extra = self._extra, []
        return taken
