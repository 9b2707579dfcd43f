"""A server on a thread of its own, which can also answer late."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

LOOK_UP_S = 0.05
"""A thread that has nothing to do looks up so often whether it is to end, where nothing wakes it."""


class Serving(ABC):
    """A context manager that serves while it is entered. A fault of the server itself is raised on leaving."""

    def __init__(self) -> None:
        self._due: list[tuple[float, int, Callable[[], None], bool]] = []
        self._order = itertools.count()
        self._stopping = threading.Event()
        self._failure: BaseException | None = None
        self._quiet = threading.Condition()
        self._quiet_rounds = 0
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    def __enter__(self) -> Self:
        self._open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._wake()
        self._thread.join()
        self._close()
        if self._failure is not None:
            raise self._failure

    def settle(self) -> None:
        """Wait until everything sent to it is heard and answered, or it has failed."""
        with self._quiet:
            enough = self._quiet_rounds + 2  # one of them has begun only now
            self._quiet.wait_for(lambda: self._quiet_rounds >= enough or self._failure is not None)

    @staticmethod
    def now() -> float:
        return time.monotonic()

    def later(self, after_s: float, action: Callable[[], None], *, recurs: bool = False) -> None:
        """In the server's thread; at once where there is nothing to wait for. What ``recurs``, `settle` does not
        wait for."""
        if after_s <= 0.0:
            action()
        else:
            heapq.heappush(self._due, (self.now() + after_s, next(self._order), action, recurs))

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                left_s = self._due[0][0] - self.now() if self._due else LOOK_UP_S
                heard = self._hear(min(max(left_s, 0.0), LOOK_UP_S))
                while self._due and self._due[0][0] <= self.now():
                    heapq.heappop(self._due)[2]()
                if not heard and all(recurs for *_, recurs in self._due):
                    with self._quiet:
                        self._quiet_rounds += 1
                        self._quiet.notify_all()
        except BaseException as e:  # noqa: BLE001 - it goes on in the test's own thread
            with self._quiet:
                self._failure = e
                self._quiet.notify_all()

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _hear(self, patience_s: float) -> bool:
        """Wait for requests for so long at most, and answer those that came. Whether any did."""

    @abstractmethod
    def _wake(self) -> None:
        """End a `_hear` that is waiting."""
