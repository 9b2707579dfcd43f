"""Which errors say that memory ran out, whoever raises them; and less garbage
collection for services; freed memory goes back to the system."""

from __future__ import annotations

import ctypes
import errno
import gc
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_LIBRARY_SAYS = ("failed to map segment", "cannot allocate memory", "unable to allocate")
"""What the loader of shared libraries says in an ImportError (glibc, musl)."""
_THREAD_SAYS = "can't start new thread"  # its stack could not be had
_LIBRARIES_BYTES, _THREAD_BYTES = 298 * 2**20, 48 * 2**20
"""Address space that numpy, scipy and what else `fit` loads take (versions 2.4 and
1.17, on Linux: 346 MiB with one thread, measured after the imports), and each
thread of linear algebra with its buffer and stack, of numpy and of scipy."""
_BUFFERS_BYTES = 2 * 33 * 2**20
"""OpenBLAS's buffers, of numpy and of scipy: 32 MiB each and their alignment."""
_DEPTH = 20  # of errors that others caused
_ROOM_BYTES = 32 * 2**20
"""A library that is loaded with less address space left may fail with any error:
matplotlib ends with an IndexError where an allocation inside `re` failed."""


def ran_out_of_memory(e: BaseException | None) -> bool:
    """Of the error or of one that caused it: an array that was too large, a
    system call, a library that could not be loaded, a thread without a stack."""
    for _ in range(_DEPTH):
        if e is None:
            return False
        if _says_so(e):
            return True
        e = e.__cause__ or (e.__context__ if isinstance(e, ImportError) else None)
    return False


def _says_so(e: BaseException) -> bool:
    match e:
        case MemoryError():
            return True
        case OSError():
            return e.errno == errno.ENOMEM
        case ImportError():
            return any(words in str(e).lower() for words in _LIBRARY_SAYS)
        case RuntimeError():
            return _THREAD_SAYS in str(e)
        case _:
            return False


def no_room_left() -> bool:
    """Whether a limit of the address space (``ulimit -v``) is all but used up."""
    return _limit_in_the_way(_ROOM_BYTES) is not None


def require_address_space() -> None:
    """Before the libraries are loaded, where a limit (``ulimit -v``) is set:
    OpenBLAS that finds no room for its buffers ends the process with 1, or
    tries again for a quarter of an hour. Raises MemoryError."""
    wanted = _LIBRARIES_BYTES + _THREAD_BYTES * _threads()
    if (limit := _limit_in_the_way(wanted)) is not None:
        raise MemoryError(
            f"the limit of {limit >> 20} MiB of address space (ulimit -v) leaves no room for the {wanted >> 20} MiB"
            " of the libraries"
        )


def require_room_for_buffers() -> None:
    """Where a limit (``ulimit -v``) is set, before the first product of matrices.
    Raises MemoryError."""
    if (limit := _limit_in_the_way(_BUFFERS_BYTES)) is not None:
        raise MemoryError(
            f"the limit of {limit >> 20} MiB of address space (ulimit -v) leaves no room for linear algebra"
        )


def _limit_in_the_way(size: int) -> int | None:
    """The limit of the address space in bytes, where it leaves no room for so
    many more; else None."""
    limit = _limit()
    if limit is None:
        return None
    try:
        mmap.mmap(-1, size).close()
    except OSError:
        return limit
    return None


def _limit() -> int | None:
    """Of the address space, in bytes; None where there is none."""
    try:
        import resource  # which Windows has not
    except ImportError:
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


def _threads() -> int:
    """That OpenBLAS will have."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        if (said := os.environ.get(name, "")).isdecimal() and int(said):
            return min(int(said), 64)
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 64)


# A bound for the work on one recording, so that one that is too large fails alone.

_LEAST_ROOM_BYTES = 64 * 2**20
"""Room that work always gets: a recording of ten minutes needs less."""
_GIVE_BACK_SHARE = 0.75
"""Share of the limit from which freed memory is given back first."""


@contextmanager
def bounded(limit: int | None) -> Iterator[None]:
    """Within it, this process can take memory up to about ``limit`` bytes, or at least
    64 MiB more than it has; what asks for more gets a MemoryError (Linux; elsewhere
    there is no such limit). None is no limit."""
    if limit is None or (now := _in_use()) is None:
        yield
        return
    import resource

    if now[0] > _GIVE_BACK_SHARE * limit:
        give_back()
        now = _in_use() or now
    resident, data = now
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = data + max(limit - resident, _LEAST_ROOM_BYTES)
    bounds = [b for b in (most, soft, hard) if b != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _in_use() -> tuple[int, int] | None:
    """Bytes of this process that are resident, and bytes that count towards the limit
    of its data; None where the system does not tell."""
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            held = dict(line.split(":", 1) for line in file)
        resident, data = (int(held[key].split()[0]) << 10 for key in ("VmRSS", "VmData"))
    except (OSError, ValueError, KeyError):
        return None
    return resident, data


def resident_bytes() -> int | None:
    """Memory of this process; None where the system does not tell."""
    found = _in_use()
    return None if found is None else found[0]


def out_of_memory(e: BaseException) -> str:
    """In words."""
    return f"memory ran out: {e}" if str(e) else "memory ran out"


GARBAGE_LEAST = 10_000
"""Objects more than before after which garbage is looked for. Python's 700 come
several times a second on a busy bus, hardly ever with a cycle among them."""


@contextmanager
def little_garbage() -> Iterator[None]:
    """Reduce garbage collection: never of imported modules, seldom of the rest."""
    thresholds = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(GARBAGE_LEAST, *thresholds[1:])
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


_MMAP_THRESHOLD: Final = -3  # M_MMAP_THRESHOLD of malloc.h
LARGE_BYTES: Final = 4 * 2**20
"""Arrays of a recording of half a day. Smaller blocks are so frequent that handing each
to the system takes noticeable time."""


def large_apart() -> None:
    """From now on blocks of `LARGE_BYTES` or more go back to the system once freed. By
    itself glibc raises that size up to 32 MiB as blocks are freed, and arrays of long
    recordings leave holes between others. Another C library keeps its own rule."""
    _of_c_library("mallopt", _MMAP_THRESHOLD, LARGE_BYTES)


def give_back() -> None:
    """Collect cycles, and give freed memory back to the system: the C library keeps
    what lies between blocks in use. Takes some tens of milliseconds."""
    gc.collect()
    _of_c_library("malloc_trim", 0)


def _of_c_library(name: str, *arguments: int) -> None:
    """Call a function of glibc, where it is the C library."""
    try:
        function = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another C library, Windows
        return
    function(*arguments)
