"""Stop signals in a process of its own: one line, the right exit code, and nothing half-done, whenever they strike."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from triaxcald.cli import watcher
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import recover

INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
WAIT = "triaxcal: putting things in order, please wait; a third signal ends it at once\n"
AT_ONCE = "triaxcal: interrupted; ended at once"
START = """
import asyncio, os, signal, sys, threading, time
from pathlib import Path
from signal import SIGINT, SIGTERM, SIGHUP, raise_signal
from triaxcald.cli.signals import heed_stop_signals
heed_stop_signals()
"""
DEAF = """
from triaxcald.cli.interrupt import run_interruptible

async def deaf(strike=lambda: raise_signal(SIGTERM)):
    while True:
        try:
            strike()
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            pass
"""
RECORDING = """
from triaxcald.recording.writer import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), metadata={"run": {"name": "a"}})
writer.event("begun")
"""


def _heeding() -> None:
    """Signals that a shell ignores for what it runs in the background, or under nohup; and no terminal."""
    os.setsid()
    for number in (INT, HUP):
        signal.signal(number, signal.SIG_DFL)


def _python(code: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", START + code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=180,
        preexec_fn=_heeding,
    )


@pytest.mark.parametrize("number", [INT, TERM, HUP])
def test_where_nothing_is_to_be_put_in_order_the_first_signal_ends_the_process(number: int) -> None:
    done = _python(f"raise_signal({number:d})\nprint('still here')")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "triaxcal: interrupted\n")


def test_a_file_that_is_being_written_is_taken_away(tmp_path: Path) -> None:
    code = """
from triaxcald.files import new_file
with new_file(Path(sys.argv[1])) as f:
    f.write(b"half")
    f.flush()
    raise_signal(SIGTERM)
"""
    assert _python(code, tmp_path / "a.csv").returncode == 130
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_was_there_before_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("old")
    code = """
from triaxcald import files
files.open = lambda *_, **__: raise_signal(SIGTERM)
with files.new_file(Path(sys.argv[1])): pass
"""
    assert _python(code, path).returncode == 130
    assert path.read_text() == "old"


@pytest.mark.slow
@pytest.mark.parametrize("number", [INT, TERM])
@pytest.mark.parametrize("options", [[], ["--json"]], ids=["lines", "json"])
def test_an_audit_that_is_stopped_says_how_far_it_came(tmp_path: Path, number: int, options: list[str]) -> None:
    """The third of five files strikes; the first does not exist, the second is no recording."""
    names = ["none.mcap", "text.mcap", "strikes.mcap", "d.mcap", "e.mcap"]
    for name in names[1:]:
        (tmp_path / name).write_text("no recording")
    code = f"""
from triaxcald.audit import many
from triaxcald.cli.commands import main
true = many.audit
many.audit = lambda path, **more: raise_signal({number:d}) if path.name == "strikes.mcap" else true(path, **more)
main(["audit", *sys.argv[1:]])
"""
    done = _python(code, *options, *(tmp_path / name for name in names))
    assert (done.returncode, done.stdout) == (130, "")
    last = done.stderr.splitlines()[-1]
    assert last == "triaxcal: interrupted; 2 of 5 recordings audited: 0 agree, 2 could not be audited"


def test_a_third_signal_ends_work_that_does_not_end() -> None:
    done = _python(DEAF + "run_interruptible(deaf())")
    assert done.returncode == 130
    assert done.stderr == f"{WAIT}{AT_ONCE}\n"


def test_a_third_signal_ends_work_that_keeps_the_event_loop_from_turning() -> None:
    code = """
from triaxcald.cli.interrupt import run_interruptible

def strike():
    for number in (SIGINT, SIGTERM, SIGHUP):
        signal.pthread_kill(threading.main_thread().ident, number)

async def stuck():
    threading.Timer(0, strike).start()
    threading.Event().wait()

run_interruptible(stuck())
"""
    done = _python(code)
    assert done.returncode == 130
    assert done.stderr == f"{WAIT}{AT_ONCE}\n"


def test_a_signal_that_another_thread_gets_wakes_the_event_loop() -> None:
    """As one does that strikes just before the loop falls asleep: no system call is broken off by it."""
    code = """
from triaxcald.cli.interrupt import Interrupted, run_interruptible

async def asleep():
    threading.Timer(0.05, lambda: signal.pthread_kill(threading.get_ident(), SIGTERM)).start()
    await asyncio.Event().wait()

try:
    run_interruptible(asleep())
except Interrupted as e:
    print(e)
"""
    done = _python(code)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


def test_a_third_signal_finishes_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "rec.mcap"
    done = _python(DEAF + RECORDING + "run_interruptible(deaf())", path)
    assert done.returncode == 130
    assert done.stderr == f"{WAIT}{AT_ONCE}; {path} is finished\n"
    with Recording.open(path) as recording:
        assert recording.finished
        assert [event.kind for event in recording.events()] == ["recording_started", "begun"]


def test_a_recording_that_the_disk_holds_up_is_left_for_recovery(tmp_path: Path) -> None:
    path = tmp_path / "rec.mcap"
    code = """
from triaxcald import abort
abort.CLOSING_S = 0.05
writer.drain()
writer._jobs.put(threading.Event().wait)
run_interruptible(deaf())
"""
    done = _python(DEAF + RECORDING + code, path)
    assert done.returncode == 130
    assert done.stderr == f"{WAIT}{AT_ONCE}; {path} is not finished; triaxcal log recover mends it\n"
    assert recover(path, tmp_path / "mended.mcap").messages == 2


def test_a_third_signal_while_a_device_is_written_to_is_4_and_says_so() -> None:
    code = """
from triaxcald.abort import AbortNotice, at_abort
with at_abort(lambda _: AbortNotice("NOT restored: half is written", in_doubt=True)):
    run_interruptible(deaf())
"""
    done = _python(DEAF + code)
    assert done.returncode == 4
    assert done.stderr == f"{WAIT}{AT_ONCE}; NOT restored: half is written\n"


def test_who_does_not_read_what_is_said_holds_nothing_up() -> None:
    code = """
near, far = os.pipe()
os.dup2(far, 2)
os.set_blocking(2, False)
try:
    while os.write(2, bytes(4096)): pass
except BlockingIOError:
    os.set_blocking(2, True)
run_interruptible(deaf())
"""
    assert _python(DEAF + code).returncode == 130


def test_where_standard_error_is_closed_nothing_is_written_into_the_file_that_took_its_place(tmp_path: Path) -> None:
    path = tmp_path / "a"
    code = """
os.close(2)
sys.stderr = None  # as of an interpreter that was started so
assert os.open(sys.argv[1], os.O_CREAT | os.O_WRONLY) == 2
raise_signal(SIGTERM)
"""
    assert _python(code, path).returncode == 130
    assert path.read_bytes() == b""


@pytest.mark.slow
def test_a_thread_that_hangs_does_not_hold_up_the_end_and_what_was_said_is_out() -> None:
    code = """
from triaxcald.cli import main
main.LAST_THREADS_S = 0.05
sys.argv = ["triaxcal", "plan", "--json"]
threading.Thread(target=threading.Event().wait).start()
main.entry()
"""
    done = _python(code)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("}\n")


@pytest.mark.parametrize("number", [INT, TERM, HUP])
def test_a_signal_in_the_interpreters_own_end_changes_nothing(number: int) -> None:
    code = f"""
import atexit
from triaxcald.cli import main
atexit.register(raise_signal, {number:d})
sys.argv = ["triaxcal", "--version"]
main.entry()
"""
    done = _python(code)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("triaxcal ")


def test_what_reloads_at_a_hangup_goes_on_and_the_next_other_signal_ends_it() -> None:
    code = """
from triaxcald.cli.interrupt import Interrupted, run_interruptible

reloads = []

async def serve():
    for _ in range(2):
        raise_signal(SIGHUP)
        await asyncio.sleep(0)
    while len(reloads) < 2:
        await asyncio.sleep(0)
    raise_signal(SIGTERM)
    await asyncio.Event().wait()

try:
    run_interruptible(serve(), lambda: reloads.append(1))
except Interrupted as e:
    print(e.number, len(reloads))
"""
    done = _python(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{TERM:d} 2\n", "")


def test_on_a_terminal_a_hangup_ends_what_would_reload() -> None:
    code = """
import fcntl, pty, termios
from triaxcald.cli.interrupt import Interrupted, run_interruptible

_, terminal = pty.openpty()
fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)

async def serve():
    raise_signal(SIGHUP)
    await asyncio.Event().wait()

try:
    run_interruptible(serve(), lambda: print("reloaded"))
except Interrupted as e:
    print(e.number)
"""
    done = _python(code)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{HUP:d}\n", "")


HOLDS_THE_LOCK = """
import collections, itertools
def stuck():
    print("stuck", flush=True)
    collections.deque(itertools.repeat(0), maxlen=0)  # for ever, and no other thread of Python runs
"""
FREES_THE_LOCK = """
import hashlib
def stuck():
    print("stuck", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", 2**31 - 1)  # half an hour, and no handler of Python runs
"""
IN_A_LOOP = """
from triaxcald.cli.interrupt import run_interruptible
async def serve(): stuck()
run_interruptible(serve(){})
"""


@contextmanager
def _stuck(code: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", START + code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_heeding
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "stuck\n"
            _goes_on(process)  # it is in the call, and not on its way
            yield process
        finally:
            process.kill()


def _goes_on(process: subprocess.Popen[str]) -> None:
    begun = _processor_ticks(process)
    while _processor_ticks(process) < begun + 20:
        assert process.poll() is None


def _processor_ticks(process: subprocess.Popen[str]) -> int:
    """Of the time that it has had, of a hundredth of a second each."""
    return int(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11])


def _said(process: subprocess.Popen[str]) -> str:
    process.wait(timeout=180)
    assert process.stderr is not None
    return process.stderr.read()


@pytest.mark.slow
@pytest.mark.parametrize("where", ["stuck()", IN_A_LOOP.format("")])
@pytest.mark.parametrize("stuck", [HOLDS_THE_LOCK, FREES_THE_LOCK], ids=["with the lock", "without"])
def test_a_third_signal_ends_an_interpreter_that_does_not_return(stuck: str, where: str) -> None:
    with _stuck(stuck + where) as process:
        for number in (INT, TERM, HUP):
            process.send_signal(number)
        said = _said(process)
    assert process.returncode == -signal.SIGKILL
    assert said.count("\n") == 1
    assert "killed: a third signal" in said
    assert watcher.UNHEARD_S < 2


@pytest.mark.slow
def test_two_signals_and_what_reloads_do_not() -> None:
    with _stuck(HOLDS_THE_LOCK + IN_A_LOOP.format(", lambda: None")) as process:
        for number in (HUP, INT, TERM):
            process.send_signal(number)
            _goes_on(process)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=watcher.UNHEARD_S + 1)
        process.send_signal(HUP)
        assert "killed: a third signal" in _said(process)


CHILD = "Path(f'/proc/self/task/{os.getpid()}/children').read_text().split()"


def test_the_watcher_ends_with_its_process() -> None:
    done = _python(f"print(*{CHILD})")
    assert done.returncode == 0
    deadline = time.monotonic() + 180
    while Path(f"/proc/{int(done.stdout)}").exists():
        assert time.monotonic() < deadline


def test_without_its_watcher_a_signal_still_ends_the_work() -> None:
    code = f"""
from triaxcald.cli.interrupt import Interrupted, run_interruptible

async def asleep():
    os.kill(int({CHILD}[0]), signal.SIGKILL)
    threading.Timer(0.05, lambda: signal.pthread_kill(threading.get_ident(), SIGTERM)).start()
    await asyncio.Event().wait()

try:
    run_interruptible(asleep())
except Interrupted as e:
    print(e)
"""
    done = _python(code)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


UNRAISABLE = """
from types import SimpleNamespace
from triaxcald.abort import ignore_stop_signals
report = lambda unraisable: print(unraisable.exc_value)
sys.unraisablehook = report
ignore_stop_signals()
for error, of in ((OSError("Signal 1 ignored due to race condition"), None), (OSError("disk"), open),
                  (KeyError(7), None)):
    sys.unraisablehook(SimpleNamespace(exc_value=error, object=of))
"""


def test_a_signal_that_comes_while_signals_are_switched_off_is_not_reported() -> None:
    """CPython hands it to `sys.unraisablehook` as an error of no object."""
    assert _python(UNRAISABLE).stdout == "disk\n7\n"
