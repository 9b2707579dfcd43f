"""Which recordings a process makes side by side; that may change meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable

from triaxcald.run.recording import AtRecording, Kept, UnitStatus
from triaxcald.station.coming_back import Patience


class Roster:
    """Each records for so many ``seconds``, for ever where None, or until it is
    given up; one that ends does not stop the others, and ``ended`` is told of
    it."""

    def __init__(
        self, seconds: float | None, patience: Patience, ended: Callable[[Kept], None] = lambda _: None
    ) -> None:
        self._seconds, self._patience, self._ended = seconds, patience, ended
        self._work: dict[str, tuple[AtRecording, asyncio.Task[Kept]]] = {}
        self._changes = 0
        self._changed = asyncio.Event()
        self._stopped = False

    def statuses(self) -> list[UnitStatus]:
        """Of the last recording of each name that is on it. From any thread."""
        return [one.status for one, _ in tuple(self._work.values())]

    def at_work(self) -> set[str]:
        return {name for name, (_, task) in self._work.items() if not task.done()}

    def ended_with(self, code: int) -> set[str]:
        """Those whose last recording ended with that exit code."""
        return {
            name
            for name, (_, task) in self._work.items()
            if task.done() and not task.cancelled() and task.result().exit_code == code
        }

    def begin(self, recordings: Iterable[AtRecording]) -> None:
        """None of a name that is at work; nothing, once all are to end."""
        if self._stopped:
            return
        for one in recordings:
            self._work[one.name] = one, asyncio.ensure_future(self._record(one))
        self._changed.set()

    async def change(self, leaving: Collection[str], beginning: Iterable[AtRecording]) -> None:
        """Those of the names ``leaving`` end as if asked to, and are on it no
        more; then the others begin, unless all are to end by then."""
        self._changes += 1
        try:
            going = [self._work[name] for name in leaving if name in self._work]
            for one, task in going:
                one.leave()
                task.cancel()
            if going:
                await asyncio.wait([task for _, task in going])
            for one, _ in going:
                del self._work[one.name]
            if not self._stopped:
                self.begin(beginning)
        finally:
            self._changes -= 1
            self._changed.set()

    async def finish(self) -> list[Kept]:
        """What those on it have come to, once none is at work. When this is
        cancelled every one of them is, again each time, and waited for; what
        was recorded is whole."""
        while True:
            pending = [task for _, task in self._work.values() if not task.done()]
            if not pending and not self._changes:
                # One that was cancelled before its first step has come to nothing.
                return [task.result() for _, task in self._work.values() if not task.cancelled()]
            self._changed.clear()
            changed = asyncio.ensure_future(self._changed.wait())
            try:
                await asyncio.wait([*pending, changed], return_when=asyncio.FIRST_COMPLETED)
            except asyncio.CancelledError:
                self._stopped = True
                for _, task in tuple(self._work.values()):  # a change may have begun some since
                    task.cancel()
            finally:
                changed.cancel()

    async def _record(self, one: AtRecording) -> Kept:
        kept = await one.run(self._seconds, self._patience)
        self._ended(kept)
        return kept
