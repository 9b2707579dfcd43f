"""Locks on devices and ports: who has one, who is told so, and what lies in the way of their files."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.claim import Claim
from triaxcald.errors import DeviceInUse, StationError
from triaxcald.station import lock
from triaxcald.station.config import Place, load_station
from triaxcald.station.lock import FOLDER_VARIABLE, folder, locked

NODE = Claim("node 5 on socketcan can0")
HOLDING = """
import asyncio, sys
from triaxcal_drivers.claim import Claim
from triaxcald.station.lock import locked

async def hold():
    async with locked(Claim(**eval(sys.argv[1]))):
        print("held", flush=True)
        sys.stdin.read()

asyncio.run(hold())
"""


@pytest.fixture
def locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of this test's own."""
    path = tmp_path / "locks"
    path.mkdir()
    monkeypatch.setenv(FOLDER_VARIABLE, str(path))
    return path


@contextmanager
def another_process(**claim: str) -> Iterator[subprocess.Popen[str]]:
    """It holds the claim until its standard input is closed."""
    arguments = [sys.executable, "-c", HOLDING, repr(claim)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


async def taken(claim: Claim) -> None:
    async with locked(claim):
        pass


async def file_of(claim: Claim, locks: Path) -> Path:
    """The file that its lock is on."""
    before = set(locks.iterdir())
    await taken(claim)
    (path,) = set(locks.iterdir()) - before
    return path


async def test_a_second_process_is_told_who_has_the_lock_and_since_when(locks: Path) -> None:
    with another_process(device=NODE.device) as process:
        with pytest.raises(DeviceInUse) as refused:
            await taken(NODE)
        assert str(refused.value).startswith(f"{NODE.device} is in use by `-c ")
        assert f"`, pid {process.pid}, since 20" in str(refused.value)
        assert "\n" not in str(refused.value)
        await taken(Claim("node 6 on socketcan can0"))
        process.send_signal(signal.SIGKILL)
        process.wait()
        await taken(NODE)


async def test_a_serial_port_is_one_process_whichever_unit_is_on_it(locks: Path) -> None:
    with another_process(device="Modbus unit 1 on /dev/ttyUSB0", serial_port="/dev/ttyUSB0"):
        with pytest.raises(DeviceInUse, match=r"^serial port /dev/ttyUSB0 is in use by "):
            await taken(Claim("Modbus unit 2 on /dev/ttyUSB0", serial_port="/dev/ttyUSB0"))
        await taken(Claim("Modbus unit 2 on /dev/ttyUSB1", serial_port="/dev/ttyUSB1"))


async def test_units_of_one_process_share_a_port_until_the_last_of_them_is_closed(locks: Path) -> None:
    one, two = (Claim(f"Modbus unit {i} on /dev/ttyUSB0", serial_port="/dev/ttyUSB0") for i in (1, 2))
    async with locked(one):
        async with locked(two):
            with pytest.raises(DeviceInUse, match=rf"unit 1 .*, pid {os.getpid()}, which is this process, since"):
                await taken(one)
        with (locks / lock.file_name("serial port /dev/ttyUSB0")).open("rb") as file, pytest.raises(BlockingIOError):
            lock.fcntl.flock(file, lock.fcntl.LOCK_EX | lock.fcntl.LOCK_NB)
    with (locks / lock.file_name("serial port /dev/ttyUSB0")).open("rb") as file:
        lock.fcntl.flock(file, lock.fcntl.LOCK_EX | lock.fcntl.LOCK_NB)


async def test_a_lock_stays_while_the_device_is_closed_and_opened_again(locks: Path, workshop: Any) -> None:
    with workshop.serve(workshop.device()) as served:
        (place,) = load_station(workshop.station({"bus": served.bus})).places
        async with place.opened() as device:
            await device.close()
            with pytest.raises(DeviceInUse, match=r"^Modbus unit 1, TCP port \d+, host localhost is in use by "):
                await _opened(place)
            await device.open()
        await _opened(place)


async def _opened(place: Place) -> None:
    async with place.opened():
        pass


async def test_a_device_that_cannot_be_opened_is_not_held(locks: Path, workshop: Any) -> None:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        (place,) = load_station(workshop.station({"bus": {"host": "127.0.0.1", "port": bound.getsockname()[1]}})).places
    for _ in range(2):
        with pytest.raises(Exception, match="Connection refused"):
            await _opened(place)


async def test_a_name_and_the_addresses_that_it_has_are_one_host(locks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def looked_up(host: str, *_: Any, **__: Any) -> Any:
        assert host == "gateway.plant"
        return [(socket.AF_INET, 0, 0, "", (a, 0)) for a in ("10.0.0.7", "2001:DB8::7")]

    monkeypatch.setattr("socket.getaddrinfo", looked_up)
    async with locked(Claim("unit 1", host="Gateway.plant.")):
        for address in ("10.0.0.7", "2001:db8:0::7"):
            with pytest.raises(DeviceInUse):
                await taken(Claim("unit 1", host=address))
        await taken(Claim("unit 1", host="10.0.0.8"))
        await taken(Claim("unit 2", host="gateway.plant"))


async def test_a_name_that_nobody_knows_is_locked_as_it_is_spelled(
    locks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(*_: Any, **__: Any) -> Any:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr("socket.getaddrinfo", unknown)
    async with locked(Claim("unit 1", host="nowhere.plant")):
        with pytest.raises(DeviceInUse, match=r"^unit 1, host nowhere\.plant is in use"):
            await taken(Claim("unit 1", host="NOWHERE.plant"))


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"pid": "x"}', b'{"pid": 1}', b"\xff" * 9000, b"[" * 4000, b'{"pid": 1e400}']
)
async def test_a_holder_that_does_not_say_who_it_is_is_another_process(
    locks: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    monkeypatch.setattr(lock, "_PAUSE_S", 0.0)
    path = await file_of(NODE, locks)
    path.write_bytes(content)
    with path.open() as file:
        lock.fcntl.flock(file, lock.fcntl.LOCK_EX)
        with pytest.raises(DeviceInUse, match=r"is in use by another process$"):
            await taken(NODE)
    await taken(NODE)


async def test_what_a_killed_process_left_is_not_said_of_the_next_holder(
    locks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "_PAUSE_S", 0.0)
    with another_process(device=NODE.device) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
    (path,) = locks.iterdir()
    assert json.loads(path.read_text())["pid"] == process.pid
    with path.open() as file:
        lock.fcntl.flock(file, lock.fcntl.LOCK_EX)
        with pytest.raises(DeviceInUse, match=r"is in use by another process$"):
            await taken(NODE)


async def test_a_new_holder_is_given_the_time_to_say_who_it_is(locks: Path) -> None:
    path = await file_of(NODE, locks)
    with path.open("r+") as file:
        lock.fcntl.flock(file, lock.fcntl.LOCK_EX)
        waiting = asyncio.create_task(taken(NODE))
        await asyncio.sleep(0)
        file.write(json.dumps({"pid": os.getppid(), "command": "triaxcal run\x1b[2J\n", "since": "today"}))
        file.flush()
        with pytest.raises(DeviceInUse, match=rf"in use by `triaxcal run\?\[2J\?`, pid {os.getppid()}, since today$"):
            await waiting


async def test_a_port_may_have_any_name_that_a_file_has(locks: Path) -> None:
    await taken(Claim("unit 1", serial_port=os.fsdecode(b"/dev/tty\xff")))


async def test_the_files_are_for_all_users_whatever_the_umask(locks: Path) -> None:
    before = os.umask(0o077)
    try:
        path = await file_of(NODE, locks)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666


@pytest.mark.parametrize("kind", ["link", "dangling link", "hard link", "pipe", "folder"])
async def test_what_is_no_lock_file_is_neither_followed_nor_written(locks: Path, tmp_path: Path, kind: str) -> None:
    path = await file_of(NODE, locks)
    path.unlink()
    precious = tmp_path / "precious"
    precious.write_text("precious")
    if kind == "link":
        path.symlink_to(precious)
    elif kind == "dangling link":
        path.symlink_to(tmp_path / "made")
    elif kind == "hard link":
        os.link(precious, path)
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(StationError, match=rf"^{NODE.device} cannot be locked: {path}: "):
        await taken(NODE)
    assert precious.read_text() == "precious"
    assert not (tmp_path / "made").exists()


async def test_a_folder_that_is_not_there_is_named(locks: Path) -> None:
    locks.rmdir()
    with pytest.raises(StationError, match=rf"cannot be locked: {locks}/triaxcal-\w+\.lock: No such file or directory"):
        await taken(NODE)


READ_ONLY = "mount -t tmpfs -o ro,mode=1777 none "
"""In a namespace of its own, where the command that follows runs."""


def in_read_only(folder: Path, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs it where ``folder`` is a file system that is read-only, for the superuser too."""
    shell = f'{READ_ONLY}"$1" && shift && exec "$@"'
    command = ["unshare", "-rm", "sh", "-c", shell, "sh", str(folder), sys.executable, "-c", program, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, input="")
    except FileNotFoundError:
        pytest.skip("there is no unshare")
    if "unshare" in done.stderr or "mount" in done.stderr:
        pytest.skip(f"no namespace of its own: {done.stderr}")
    return done


HOLDING_IN = HOLDING.replace("import asyncio, sys", "import asyncio, sys\nfrom triaxcald.station import lock").replace(
    "asyncio.run(hold())", "lock._FOLDERS = tuple(sys.argv[2:])\nasyncio.run(hold())"
)


def test_a_read_only_folder_is_told_with_what_mends_it(locks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    claim = repr({"device": NODE.device})
    chosen = in_read_only(locks, HOLDING, claim)
    assert "Read-only file system; TRIAXCAL_LOCK_FOLDER has to name a folder" in chosen.stderr
    monkeypatch.delenv(FOLDER_VARIABLE)
    usual = in_read_only(locks, HOLDING_IN, claim, str(locks))
    assert "Read-only file system; set TRIAXCAL_LOCK_FOLDER, for every command" in usual.stderr
    assert (chosen.stdout, usual.stdout) == ("", "")


def test_who_cannot_write_to_the_folder_does_not_lock_elsewhere(
    locks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would hold the device beside another command, for which the folder is not read-only."""
    monkeypatch.delenv(FOLDER_VARIABLE)
    other = tmp_path / "other"
    other.mkdir()
    for folder_of_all in (locks, other):
        folder_of_all.chmod(0o1777)
    done = in_read_only(locks, HOLDING_IN, repr({"device": NODE.device}), str(locks), str(other))
    assert done.stdout == ""
    assert list(other.iterdir()) == []


async def test_a_file_that_is_cleaned_away_under_its_holder_is_made_anew(
    locks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between opening and locking, that is: the lock would be of a file that nobody else finds."""
    path = await file_of(NODE, locks)
    flock, removed = lock.fcntl.flock, []

    def remove_first(descriptor: int, operation: int) -> None:
        if not removed:
            removed.append(path.unlink())
        flock(descriptor, operation)

    monkeypatch.setattr(lock.fcntl, "flock", remove_first)
    async with locked(NODE):
        assert path.exists()


def test_the_folder_is_one_that_everybody_may_write(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE)
    own, everybodys = tmp_path / "own", tmp_path / "everybodys"
    own.mkdir(mode=0o755)
    everybodys.mkdir()
    everybodys.chmod(0o1777)
    monkeypatch.setattr(lock, "_FOLDERS", (str(tmp_path / "none"), str(own), str(everybodys)))
    assert folder() == everybodys


async def test_without_flock_commands_of_one_process_exclude_each_other(
    locks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "fcntl", None)
    async with locked(NODE):
        with pytest.raises(DeviceInUse):
            await taken(NODE)
    await taken(NODE)
    assert list(locks.iterdir()) == []
