"""Delivers the results of runs to the receivers of the station file, by POST or as
files: each in order, each until it is taken or refused for good. No run waits for
it."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import math
import os
import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, Final

import httpx

import triaxcal_drivers as td
from triaxcald.documents import to_text
from triaxcald.errors import DaemonError, InputError
from triaxcald.files import new_file, synchronise
from triaxcald.inputs import DOCUMENT_MOST, parse_document
from triaxcald.printable import printable
from triaxcald.service.ledger import Delivery, Ledger, Waiting
from triaxcald.station.config import Receiver, Station

FIRST_S, LONGEST_S = 1.0, 300.0
"""Pauses between tries: the first, doubled each time up to the longest."""
ANSWER_S: Final = 30.0
"""Longest wait for the whole answer."""
ANSWER_MOST: Final = 4096
"""Bytes of an answer that are read."""
WISH_MOST_S: Final = 3600.0
"""Longest pause that a receiver may wish for."""
TAKEN: Final = 409
"""A receiver that has the result already says so."""
AGAIN: Final = frozenset((408, 429))
"""With every status from 500 on: the receiver may take it later."""
ERROR_MOST: Final = 300
BLOCK: Final = 1 << 20
NO_FILE: Final = frozenset(
    (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.ENXIO)
)
"""Errors by which there is no such file. All others may pass: too many files are open,
or a share is away."""
RUN: Final = re.compile(r"[0-9A-Za-z][0-9A-Za-z-]{0,63}")
"""Ids of runs, which become names of files."""


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


_pause = asyncio.sleep


class Outbox:
    """``log`` takes a line for people. Methods are called in the event loop, apart from
    `status`, which blocks."""

    def __init__(
        self, ledger: Ledger, station: Station, log: Callable[[str], None] = lambda _: None, first_s: float = FIRST_S
    ) -> None:
        self._ledger, self._station, self._log, self._first_s = ledger, station, log, first_s
        self._news: dict[str, asyncio.Event] = {}
        self._changed = asyncio.Event()
        self._putting: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
        """By receiver: a thread goes on although its delivery is cancelled."""

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
                    after_s = 0.0
                except Exception as e:  # noqa: BLE001 - a fault of ours delays the results of one receiver alone
                    self._log(f"triaxcal: deliver {receiver.name}: {type(e).__name__}: {e}")
                    after_s = 0.0
                if after_s is None:
                    pause_s = self._first_s
                    continue
                await _pause(max(pause_s, after_s))
                pause_s = min(2 * pause_s, LONGEST_S)

    async def _try(self, client: httpx.AsyncClient, receiver: Receiver, waiting: Waiting) -> float | None:
        """Deliver a result. Gives the least pause before the next try, None at the
        end. Raises DaemonError of the database."""
        try:
            if not RUN.fullmatch(waiting.run):
                raise Refused(f"'{printable(waiting.run[:40])}' is no id of a run")
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
        told = ""
        try:
            async with asyncio.timeout(ANSWER_S):
                async with client.stream("POST", receiver.url, content=data, headers=headers) as answer:
                    if answer.is_success or answer.status_code == TAKEN:
                        return
                    told = await _beginning(answer)
        except TimeoutError as e:
            raise NotNow(f"{_shown(receiver.url)} does not answer within {ANSWER_S:g} s") from e
        except (httpx.HTTPError, httpx.InvalidURL, UnicodeError) as e:
            raise NotNow(f"{_shown(receiver.url)}: {str(e) or type(e).__name__}") from e
        status = answer.status_code
        why = f"{_shown(receiver.url)} answers {status}: {printable(' '.join(told.split()))[:100]}".rstrip(": ")
        if status in AGAIN or status >= 500 or status < 400:
            raise NotNow(why, _seconds(answer.headers.get("Retry-After"), time.time()))
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
        """As a file that appears complete, and never in place of another. A folder is
        made before the first result alone: later it may be a share that is away. Raises
        NotNow, Refused; DaemonError of the database."""
        with self._putting[receiver.name]:
            self._put_alone(receiver, run, data)

    def _put_alone(self, receiver: Receiver, run: str, data: bytes) -> None:
        """Raises as `_put`."""
        assert receiver.folder is not None
        folder = self._station.path.parent / receiver.folder
        path, partial = folder / f"{run}.json", folder / f".{run}.json.part"
        try:
            if not folder.is_dir():
                if self._ledger.has_delivered(receiver.name):
                    raise NotNow(f"{folder}: there is no such folder any more")
                folder.mkdir(parents=True, exist_ok=True)
            partial.unlink(missing_ok=True)  # of a process that was killed
            with new_file(partial) as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
                _appear(partial, path)
            synchronise(folder)
        except FileExistsError as e:
            if not path.is_file() or path.read_bytes() != data:
                raise Refused(f"{path}: there is another file of that name") from e
        except OSError as e:
            raise NotNow(f"{path}: {e.strerror}") from e
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)

    def _result(self, waiting: Waiting) -> bytes:
        """The `triaxcal.result/1`, from the files of the run as they were at the first
        try: one key never has two bodies. Raises Refused where they are gone, NotNow
        where they cannot be read; DaemonError of the database."""
        if (body := self._ledger.body_of(waiting)) is None:
            body = self._made(waiting)
            self._ledger.keep_body(waiting, body)
        return body.encode()

    def _made(self, waiting: Waiting) -> str:
        """Raises as `_result`."""
        path = self._ledger.folder / waiting.outcome
        try:
            outcome = parse_document(td.files.read_whole(path, DOCUMENT_MOST), where=str(path))
            recording = outcome.get("recording")
            digest = None if recording is None else _digest(self._ledger.folder / Path(recording).name)
        except (OSError, td.files.TooLarge, InputError, ValueError) as e:
            why = f"{path}: cannot be read: {getattr(e, 'strerror', None) or e}"
            if isinstance(e, OSError) and e.errno not in NO_FILE:
                raise NotNow(why) from e
            raise Refused(why) from e
        figures = self._ledger.measurements_of(waiting.run)
        return to_text(result_of(outcome, figures, digest))


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


def _appear(partial: Path, path: Path) -> None:
    """Give the file its name. Raises FileExistsError where there is one of that name,
    OSError."""
    try:
        os.link(partial, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError(path) from None
        os.rename(partial, path)


async def _beginning(answer: httpx.Response) -> str:
    """As much of the answer as is told to people."""
    data = b""
    async for block in answer.aiter_raw():
        data += block
        if len(data) >= ANSWER_MOST:
            break
    return data[:ANSWER_MOST].decode("utf-8", "replace")


def _shown(url: str) -> str:
    """Without what may be secret in it."""
    with suppress(httpx.InvalidURL):
        return str(httpx.URL(url).copy_with(username=None, password=None, query=None, fragment=None))
    return url.partition("?")[0].rpartition("@")[2]


def _seconds(retry_after: str | None, now_s: float) -> float | None:
    """Of the header Retry-After: seconds, or a time of HTTP."""
    if retry_after is None:
        return None
    try:
        wish_s = float(retry_after)
    except ValueError:
        try:
            wish_s = parsedate_to_datetime(retry_after).timestamp() - now_s
        except (ValueError, OverflowError):
            return None
    return min(max(0.0, wish_s), WISH_MOST_S) if math.isfinite(wish_s) else None
