"""Delivers the results of runs to the receivers of the station file, by POST or as
files: each in order, each until it is taken or refused for good. No run waits for
it."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import httpx

import triaxcal_drivers as td
from triaxcald.documents import to_text
from triaxcald.errors import DaemonError, InputError
from triaxcald.files import write_text
from triaxcald.inputs import DOCUMENT_MOST, parse_document
from triaxcald.service.ledger import Delivery, Ledger, Waiting
from triaxcald.station.config import Receiver, Station

FIRST_S, LONGEST_S = 1.0, 300.0
"""Pauses between tries: the first, doubled each time up to the longest."""
ANSWER_S: Final = 30.0
TAKEN: Final = 409
"""A receiver that has the result already says so."""
AGAIN: Final = frozenset((408, 429))
"""With every status from 500 on: the receiver may take it later."""
ERROR_MOST: Final = 300
BLOCK: Final = 1 << 20


@dataclass(frozen=True)
class NotNow(Exception):
    """The receiver did not take the result; ``after_s`` is its own wish, None without
    one."""

    why: str
    after_s: float | None = None


@dataclass(frozen=True)
class Refused(Exception):
    """The receiver will never take the result."""

    why: str


class Outbox:
    """``log`` takes a line for people. Methods are called in the event loop, apart from
    `status`, which blocks."""

    def __init__(
        self, ledger: Ledger, station: Station, log: Callable[[str], None] = lambda _: None, first_s: float = FIRST_S
    ) -> None:
        self._ledger, self._station, self._log, self._first_s = ledger, station, log, first_s
        self._news: dict[str, asyncio.Event] = {}
        self._changed = asyncio.Event()

    def news(self) -> None:
        """Results may wait."""
        for news in self._news.values():
            news.set()

    def receive(self, station: Station) -> None:
        """The station file was read again."""
        self._station = station
        self._changed.set()

    def status(self) -> list[Delivery]:
        """The state of each receiver. Raises DaemonError."""
        return self._ledger.deliveries()

    async def run(self) -> None:
        """Deliver until cancelled."""
        while True:
            self._changed.clear()
            receivers = self._station.file.deliver
            self._news = {receiver.name: asyncio.Event() for receiver in receivers}
            workers = [asyncio.ensure_future(self._work(receiver)) for receiver in receivers]
            try:
                await self._changed.wait()
            finally:
                for worker in workers:
                    worker.cancel()
                await asyncio.gather(*workers, return_exceptions=True)

    async def _work(self, receiver: Receiver) -> None:
        news, pause_s = self._news[receiver.name], self._first_s
        async with httpx.AsyncClient(timeout=ANSWER_S, follow_redirects=False) as client:
            while True:
                try:
                    waiting = await asyncio.to_thread(self._ledger.next_delivery, receiver.name)
                    if waiting is None:
                        await news.wait()
                        news.clear()
                        continue
                    after_s = await self._try(client, receiver, waiting)
                except DaemonError as e:  # of the database; what waits is still there
                    self._log(f"triaxcal: deliver {receiver.name}: {e}")
                    after_s = pause_s
                if after_s is None:
                    pause_s = self._first_s
                    continue
                await asyncio.sleep(max(pause_s, after_s))
                pause_s = min(2 * pause_s, LONGEST_S)

    async def _try(self, client: httpx.AsyncClient, receiver: Receiver, waiting: Waiting) -> float | None:
        """Deliver a result. Gives the least pause before the next try, None at the
        end. Raises DaemonError of the database."""
        try:
            data = await asyncio.to_thread(self._result, waiting)
            if receiver.url is not None:
                await self._post(client, receiver, waiting.run, data)
            else:
                await asyncio.to_thread(self._put, receiver, waiting.run, data)
        except NotNow as e:
            if waiting.tries == 0:
                self._log(f"triaxcal: deliver {receiver.name}: {e.why}; it is tried again")
            await asyncio.to_thread(self._ledger.note_try, waiting, e.why[:ERROR_MOST])
            return e.after_s or 0.0
        except Refused as e:
            self._log(f"triaxcal: deliver {receiver.name}: run {waiting.run} is set aside: {e.why}")
            await asyncio.to_thread(self._ledger.end_delivery, waiting, e.why[:ERROR_MOST])
            return None
        await asyncio.to_thread(self._ledger.end_delivery, waiting, None)
        return None

    async def _post(self, client: httpx.AsyncClient, receiver: Receiver, run: str, data: bytes) -> None:
        """Raises NotNow, Refused."""
        assert receiver.url is not None
        headers = {"Content-Type": "application/json", "Idempotency-Key": run}
        if receiver.token_file is not None:
            headers["Authorization"] = f"Bearer {await asyncio.to_thread(self._token, receiver.token_file)}"
        try:
            answer = await client.post(receiver.url, content=data, headers=headers)
        except httpx.HTTPError as e:
            raise NotNow(f"{receiver.url}: {str(e) or type(e).__name__}") from e
        except (httpx.InvalidURL, UnicodeError) as e:
            raise NotNow(f"{receiver.url}: {e}") from e
        status = answer.status_code
        if answer.is_success or status == TAKEN:
            return
        why = f"{receiver.url} answers {status}: {' '.join(answer.text.split())[:100]}".rstrip(": ")
        if status in AGAIN or status >= 500 or status < 400:
            raise NotNow(why, _seconds(answer.headers.get("Retry-After")))
        raise Refused(why)

    def _token(self, name: str) -> str:
        """Raises NotNow: the file may be mended while results wait."""
        path = self._station.path.parent / name
        try:
            token = path.read_text("ascii").strip()
        except (OSError, UnicodeError) as e:
            raise NotNow(f"{path}: the token cannot be read: {getattr(e, 'strerror', None) or 'not ASCII'}") from e
        if not token.isprintable() or not token:
            raise NotNow(f"{path}: expected a token, one line of printable characters")
        return token

    def _put(self, receiver: Receiver, run: str, data: bytes) -> None:
        """As a file that appears complete. Raises NotNow."""
        assert receiver.folder is not None
        folder = self._station.path.parent / receiver.folder
        path = folder / f"{run}.json"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if path.exists():
                if path.read_bytes() == data:
                    return
                raise Refused(f"{path}: there is another result of that name")
            write_text(path, data.decode())
        except (OSError, InputError) as e:
            raise NotNow(str(e)) from e

    def _result(self, waiting: Waiting) -> bytes:
        """The `triaxcal.result/1`, from the files of the run: the same bytes each time.
        Raises Refused where they are gone; DaemonError of the database."""
        path = self._ledger.folder / waiting.outcome
        try:
            outcome = parse_document(td.files.read_whole(path, DOCUMENT_MOST), where=str(path))
            recording = outcome.get("recording")
            digest = None if recording is None else _digest(self._ledger.folder / Path(recording).name)
        except (OSError, td.files.TooLarge, InputError) as e:
            raise Refused(f"{path}: cannot be read: {getattr(e, 'strerror', None) or e}") from e
        figures = self._ledger.measurements_of(waiting.run)
        return to_text(result_of(outcome, figures, digest)).encode()


def result_of(
    outcome: Mapping[str, Any], figures: Sequence[Mapping[str, Any]], recording_sha256: str | None
) -> dict[str, Any]:
    """The `triaxcal.result/1` of an outcome, which is in it as it is."""
    work = outcome.get("work") or {}
    serial = outcome.get("serial")
    return {
        "format": "triaxcal.result/1",
        "run": outcome.get("run"),
        "station": outcome["station"],
        "slot": outcome["unit"],
        "work": outcome.get("work"),
        "serial": work.get("serial") if serial is None else serial,
        "attempt": work.get("attempt"),
        **{key: outcome.get(key) for key in ("started", "ended", "verdict", "code", "reason", "device_state")},
        "measurements": [dict(figure) for figure in figures],
        "recording_sha256": recording_sha256,
        "outcome": dict(outcome),
    }


def _digest(path: Path) -> str | None:
    """SHA-256 of a file; None where it is gone. Raises OSError."""
    found = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(BLOCK):
                found.update(block)
    except FileNotFoundError:
        return None
    return found.hexdigest()


def _seconds(retry_after: str | None) -> float | None:
    """Of the header Retry-After, as far as it is a number."""
    with suppress(TypeError, ValueError):
        return min(max(0.0, float(str(retry_after))), LONGEST_S)
    return None
