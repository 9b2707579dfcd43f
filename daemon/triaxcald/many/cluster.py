"""Work on the processes of a Dask cluster, here or elsewhere: the one file that imports
dask and distributed."""

from __future__ import annotations

import logging
import os
import queue
import shutil
import signal
import tempfile
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from triaxcald.abort import at_abort
from triaxcald.errors import DISK, InputError, StationError
from triaxcald.many.sources import Source
from triaxcald.many.work import Done, Settings, Work, WrongVersion, attempt, unusable

T = TypeVar("T")
AHEAD: Final = 2
"""Recordings handed out for each thread of the cluster: the next is there when one is
through. More would be blamed for a worker that dies."""
DEATHS: Final = 1
"""On a cluster of our own: a recording whose worker dies more often is set aside."""
CONNECT_S: Final = 10.0
LOOK_S: Final = 1.0
"""Between two looks at who works."""
TERMINATE_SHARE: Final = 1.1
"""Multiple of the memory of a worker at which its nanny ends it. Work gets an error at
the limit itself; this is for what asks for memory in another way."""
_CONFIG: Final = {
    "distributed.scheduler.allowed-failures": DEATHS,
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.target": False,  # results are small: nothing to spill
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": TERMINATE_SHARE,
    "distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s",
    "distributed.scheduler.http.routes": [],  # nobody is to look on
    "distributed.worker.http.routes": [],
}


def require_dask() -> None:
    """Raises ModuleNotFoundError, which names what lacks."""
    _dask()


def _dask() -> tuple[Any, Any]:
    import dask
    import distributed

    return dask, distributed


@dataclass(frozen=True)
class Cluster:
    """A connected cluster; ``where`` is for messages, ``own`` that its workers are
    processes of this one."""

    client: Any
    where: str
    own: bool


@contextmanager
def local_cluster(jobs: int, memory: int | None) -> Iterator[Cluster]:
    """So many processes on this machine, each with at most ``memory`` bytes. Only this
    process can reach them (TLS with keys of its own). Raises OSError."""
    dask, distributed = _dask()
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_CONFIG))
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="triaxcal-", ignore_cleanup_errors=True))
        stack.enter_context(at_abort(lambda _: shutil.rmtree(folder, ignore_errors=True)))
        _start_quiet_tracker()
        cluster = _deaf_to_signals(
            lambda: distributed.LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                processes=True,
                memory_limit=memory if memory is not None else 0,  # 0: none
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                security=distributed.Security.temporary(),
                silence_logs=logging.CRITICAL + 1,
                local_directory=folder,
            )
        )
        stack.callback(_quietly, cluster.close)
        client = stack.enter_context(_closed_quietly(distributed.Client(cluster, timeout=CONNECT_S)))
        yield Cluster(client, f"{jobs} processes of this machine", True)


@contextmanager
def cluster_at(address: str) -> Iterator[Cluster]:
    """The cluster whose scheduler is at this address. Raises InputError where none
    answers."""
    dask, distributed = _dask()
    with dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s"}):
        logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)
        try:
            client = distributed.Client(address, timeout=CONNECT_S, name="triaxcal")
        except (OSError, TimeoutError, ValueError, TypeError) as e:
            said = " ".join(str(e).split()) or "no answer"
            raise InputError(f"--scheduler {address}: no Dask scheduler answers there ({said})") from e
        with _closed_quietly(client):
            yield Cluster(client, address, False)


@contextmanager
def _closed_quietly(client: Any) -> Iterator[Any]:
    try:
        yield client
    finally:
        _quietly(client.close)


def _quietly(close: Callable[[], object]) -> None:
    """What ends late or not at all is no matter once the results are there."""
    with suppress(OSError, TimeoutError, RuntimeError):
        close()


def _start_quiet_tracker() -> None:
    """Python's own process that clears up after processes that end at once, as this one
    does at a signal. It warns of what it finds, which is as it should be."""
    from multiprocessing import resource_tracker

    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore"
    try:
        resource_tracker.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


def _deaf_to_signals(make: Callable[[], T]) -> T:
    """Calls it in a thread whose children do not hear the terminal's Ctrl-C."""
    found: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        try:
            found.append(make())
        except BaseException as e:  # noqa: BLE001 - raised by who waits
            errors.append(e)

    thread = threading.Thread(target=run, daemon=True, name="cluster")
    thread.start()
    while thread.is_alive():
        thread.join(LOOK_S)
    if errors:
        raise errors[0]
    return found[0]


def results(
    cluster: Cluster,
    work: Work,
    sources: Iterable[Source],
    settings: Settings,
    waiting: Callable[[int], None] = lambda workers: None,
) -> Iterator[Done]:
    """Each recording's result as it comes. ``waiting`` is called now and then with the
    number of workers.

    A recording at which workers die is tried once more with nothing else at work: what
    dies then is its own fault, and has a row that says so. Raises StationError where
    the cluster is lost, WrongVersion, InputError where its workers lack triaxcal.
    """
    yield from _Run(cluster, work, settings, waiting).through(iter(sources))


class _Run:
    def __init__(self, cluster: Cluster, work: Work, settings: Settings, waiting: Callable[[int], None]) -> None:
        self._cluster, self._work, self._settings, self._waiting = cluster, work, settings, waiting
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._at_work: dict[str, tuple[Source, Any]] = {}
        self._suspects: deque[Source] = deque()
        self._id = uuid.uuid4().hex[:12]
        self._handed_out = 0
        self._workers = self._thread_count = 0
        self._looked_s = -LOOK_S

    def through(self, sources: Iterator[Source]) -> Iterator[Done]:
        more = True
        while more or self._at_work:
            while more and len(self._at_work) < max(AHEAD * self._threads(), 1):
                source = next(sources, None)
                more = source is not None
                if source is not None:
                    self._hand_out(source)
            if self._at_work and (done := self._next(alone=False)) is not None:
                yield done
        while self._suspects:
            self._hand_out(self._suspects.popleft())
            while self._at_work:
                if (done := self._next(alone=True)) is not None:
                    yield done

    def _threads(self) -> int:
        """Of the cluster, asked for every `LOOK_S`: workers come and go. Raises
        StationError."""
        if (now := time.monotonic()) - self._looked_s >= LOOK_S:
            self._looked_s = now
            try:
                workers = self._cluster.client.nthreads()
            except (OSError, TimeoutError) as e:
                raise self._lost() from e
            self._workers, self._thread_count = len(workers), sum(workers.values())
        return self._thread_count

    def _hand_out(self, source: Source) -> None:
        self._handed_out += 1
        key = f"triaxcal-{self._id}-{self._handed_out}"
        future = self._cluster.client.submit(attempt, self._work, source, self._settings, key=key, pure=False)
        self._at_work[key] = source, future
        future.add_done_callback(self._ended.put)

    def _next(self, *, alone: bool) -> Done | None:
        """The next result; None where there is none within `LOOK_S`, or the recording
        is tried again."""
        try:
            ended = self._ended.get(timeout=LOOK_S)
        except queue.Empty:
            self._look()
            return None
        source, future = self._at_work.pop(ended.key)
        if future.status == "finished":
            done: Done = future.result()
            return done
        return self._failed(source, future, alone)

    def _look(self) -> None:
        self._threads()
        if self._cluster.client.status not in ("running", "connecting"):
            raise self._lost()
        self._waiting(self._workers)

    def _lost(self) -> StationError:
        return StationError(f"{self._cluster.where}: the scheduler is gone; --resume goes on")

    def _failed(self, source: Source, future: Any, alone: bool) -> Done | None:
        if future.status != "error":  # cancelled or lost, with the scheduler
            raise self._lost()
        error = future.exception()
        if isinstance(error, _dask()[1].KilledWorker):
            if not alone:
                self._suspects.append(source)
                return None
            deaths = 2 * (error.allowed_failures + 1)
            said = f"{source.name}: {deaths} workers died at it, as they do where memory runs out"
            return unusable(source, said, DISK, self._settings)
        if isinstance(error, WrongVersion):
            raise WrongVersion(f"{self._cluster.where}: {error}") from error
        if isinstance(error, ImportError):
            raise InputError(
                f"{self._cluster.where}: a worker cannot load triaxcal: {error}; install this version there"
            ) from error
        if isinstance(error, RuntimeError) and "deserialization" in str(
            error
        ):  # dask's words for what it cannot import
            raise InputError(
                f"{self._cluster.where}: the scheduler cannot load triaxcal; install this version there, too"
            ) from error
        raise StationError(f"{self._cluster.where}: {source.name}: {type(error).__name__}: {error}") from error
