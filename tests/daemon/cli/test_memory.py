"""Where memory runs out: one line, exit code 5, and no file that hides another."""

from __future__ import annotations

import asyncio
import errno
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcald.cli.exit_codes import run
from triaxcald.cli.interrupt import run_interruptible
from triaxcald.errors import DiskError, RecordingError, exit_code_of
from triaxcald.memory import ran_out_of_memory
from triaxcald.recording.writer import RecordingFile, RecordingWriter
from triaxcald.run.endings import aborted
from triaxcald.run.error_reasons import reason_of, trace_of

GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
TOO_MUCH = 2**60


def caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


NO_ROOM = OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
ERRORS = [
    MemoryError(),
    MemoryError("Unable to allocate 8.0 EiB"),
    NO_ROOM,
    ImportError("libscipy_openblas.so: failed to map segment from shared object"),
    ImportError("libz.so: cannot allocate memory in static TLS block"),
    caused(ImportError("numpy could not be imported"), ImportError("a.so: failed to map segment from shared object")),
    RuntimeError("can't start new thread"),
    caused(RecordingError("a.mcap: cannot be read: Cannot allocate memory"), NO_ROOM),
]
OTHERS = [
    ImportError("cannot import name 'a'"),
    ModuleNotFoundError("No module named 'a'"),
    RuntimeError("no running event loop"),
    OSError(errno.EIO, "Input/output error"),
    RecordingError("a.mcap: not an MCAP file"),
    ValueError("memory"),
]


@pytest.mark.parametrize("error", ERRORS, ids=repr)
def test_an_error_that_says_so_is_5(error: Exception) -> None:
    assert exit_code_of(error) == 5
    assert (aborted(error, None).exit_code, trace_of(error), "\n" in reason_of(error)) == (5, None, False)


@pytest.mark.parametrize("error", OTHERS, ids=repr)
def test_another_error_is_none_of_memory(error: Exception) -> None:
    assert not ran_out_of_memory(error)


def in_a_thread() -> int:
    async def work() -> int:
        return len(await asyncio.to_thread(bytearray, TOO_MUCH))

    return run_interruptible(work())


def in_a_callback() -> int:
    """Nobody waits for it; the work goes on."""

    async def work() -> int:
        asyncio.get_running_loop().call_soon(bytearray, TOO_MUCH)
        await asyncio.sleep(0)
        return 0

    return run_interruptible(work())


@pytest.mark.parametrize(
    ("work", "code"),
    [
        (lambda: len(bytearray(TOO_MUCH)), 5),
        (lambda: len(np.ones(TOO_MUCH // 32)), 5),
        (in_a_thread, 5),
        (in_a_callback, 0),
    ],
    ids=["Python", "numpy", "thread", "callback"],
)
def test_a_command_says_it_in_one_line(work: Callable[[], int], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lambda: None, work) == code
    out, err = capsys.readouterr()
    assert (out, err.count("\n"), err.startswith("triaxcal: memory ran out")) == ("", 1, True)


def test_a_recording_whose_writer_has_no_memory_is_sound_up_to_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", metadata={})
    writer.raw("calibration", RawBatch.of([(1, 0x181, 0, b"a")]))
    writer.drain()
    monkeypatch.setattr(RecordingFile, "raw", lambda *_: bytearray(TOO_MUCH))
    writer.raw("calibration", RawBatch.of([(2, 0x181, 0, b"b")]))
    with pytest.raises(DiskError, match=r"a\.mcap: writing failed: memory ran out; sound up to 20"):
        writer.close()
    assert capsys.readouterr().err == ""


FULL = """
import mmap, resource, sys
from triaxcald.cli.exit_codes import run

def work():
    if {limited}:
        resource.setrlimit(resource.RLIMIT_AS, (600 << 20, 600 << 20))
        try:
            while True:
                held.append(mmap.mmap(-1, 16 << 20))
        except OSError:
            pass
    raise IndexError("no such group")

held = []
sys.exit(run(lambda: None, work))
"""


@pytest.mark.parametrize(("full", "code"), [(True, 5), (False, 1)])
def test_any_error_without_room_for_a_library_is_that_memory_ran_out(full: bool, code: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL.format(limited=full)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stderr, "memory ran out" in done.stderr) == (code, not full, full)


def limited(mib: int, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """A command with so much address space, and one thread of linear algebra."""
    limit = mib * 2**20
    return subprocess.run(
        [sys.executable, "-m", "triaxcald.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=180,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("mib", [60, 150, 200, 250, 290, 310, 330, 370, 450, 3000])
@pytest.mark.parametrize("command", ["fit", "audit", "poses", "log info"])
def test_a_command_with_too_little_address_space_ends_with_5(command: str, mib: int) -> None:
    """Or does its work: how much is enough depends on the libraries."""
    done = limited(mib, *command.split(), GOLDEN)
    if mib >= 3000 or done.returncode == 0:
        assert done.returncode == 0
        return
    assert done.returncode == 5, done.stderr
    assert [line for line in done.stderr.splitlines() if "memory ran out" in line], done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_of_many_recordings_none_hides_another(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(GOLDEN, tmp_path / name)
    (tmp_path / "broken.mcap").write_bytes(b"no recording")
    for mib in range(300, 700, 20):  # until the libraries are loaded, and the work has too little
        done = limited(mib, "audit", tmp_path)
        if "a.mcap: memory ran out" in done.stderr:
            break
    assert done.returncode == 5
    assert "b.mcap" in done.stderr + done.stdout
    assert "broken.mcap: not an MCAP file" in done.stderr
    assert "Traceback" not in done.stderr
