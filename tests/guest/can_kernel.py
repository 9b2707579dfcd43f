"""A Linux kernel with CAN to run tests on: a user-mode-linux guest, or the host's own kernel in a network namespace.

The guest sees the host's files, read-only, at their own paths, and one folder that both can write. It boots in seconds,
needs no privileges, and has what Debian's package user-mode-linux brings: vcan, and slcan with a real controller's
states. It runs one command and ends.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
from pathlib import Path

MODULES = Path("/usr/lib/uml/modules")
NEEDED = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan")
OPTIONAL = ("drivers/net/can/vxcan", "drivers/net/can/slcan/slcan")
MEMORY_MB = 768
PROGRAMS = {"linux.uml": "user-mode-linux", "insmod": "kmod", "ip": "iproute2", "candump": "can-utils"}
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
NOISE = ("SELinux", "mmapper_init", "Failed to initialize ubd", "sysrq:", "reboot:")


def why_not_the_guest() -> str | None:
    """Which of its programs this machine lacks; None where it has all."""
    missing = [package for program, package in PROGRAMS.items() if not shutil.which(program, path=PATH)]
    return f"no {', '.join(missing)} on this machine: apt-get install {' '.join(missing)}" if missing else None


def why_not_the_host() -> str | None:
    """Why this machine's own kernel cannot do it; None where it can."""
    if not hasattr(socket, "AF_CAN"):
        return "this system has no SocketCAN"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as e:
        return f"this kernel has no CAN: {e.strerror}"
    if not shutil.which("candump"):
        return "no can-utils on this machine"
    made = subprocess.run([*apart(), "ip", "link", "add", "type", "vcan"], capture_output=True, text=True)
    return f"no vcan here: {made.stderr.strip()}" if made.returncode else None


def apart() -> list[str]:
    """Runs a command where it may make network interfaces, which nobody else sees."""
    return ["unshare", "--net", *([] if os.geteuid() == 0 else ["--map-root-user"])]


def run_on_the_host(command: list[str], environment: dict[str, str], timeout_s: float) -> str:
    """What it printed. Raises RuntimeError where it does not end."""
    return _finished([*apart(), *command], {**os.environ, **environment}, timeout_s)


def run_in_the_guest(command: list[str], shared: Path, environment: dict[str, str], timeout_s: float) -> str:
    """What its kernel printed; what the command did is in the file ``said`` of ``shared``, the folder that it can
    write. Raises RuntimeError likewise."""
    init = shared / "init"
    init.write_text(_init_script(command, shared, environment))
    init.chmod(0o755)
    arguments = [f"mem={MEMORY_MB}M", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", f"init={init}"]
    consoles = ["con0=null,fd:1", "con=null", "quiet", f"uml_dir={shared}/", "umid=guest"]
    linux = shutil.which("linux.uml", path=PATH)
    assert linux is not None
    said = _finished([linux, *arguments, *consoles], {**os.environ, "TMPDIR": _room_for_memory(shared)}, timeout_s)
    return "\n".join(line for line in said.splitlines() if not line.startswith(NOISE))


def _room_for_memory(otherwise: Path) -> str:
    """Where the file goes that is the guest's memory. Containers often have little of the first."""
    memory = Path("/dev/shm")
    free = os.statvfs(memory).f_bavail * os.statvfs(memory).f_frsize if memory.is_dir() else 0
    return str(memory if free > 2 * MEMORY_MB << 20 else otherwise)


def _init_script(command: list[str], shared: Path, environment: dict[str, str]) -> str:
    """The first process of the guest. The shared folder is not writable at its own path, since all of the host is
    mounted read-only there, so it is mounted once more over itself."""
    linux = shutil.which("linux.uml", path=PATH)
    assert linux is not None
    release = subprocess.run([linux, "--version"], capture_output=True, text=True, check=True).stdout.strip()
    modules = MODULES / release / "kernel"
    here = shlex.quote(str(shared))
    lines = [
        "#!/bin/sh",
        f"export PATH={PATH} HOME=/run/tmp TMPDIR=/run/tmp",
        *(f"export {name}={shlex.quote(value)}" for name, value in environment.items()),
        "mount -t proc proc /proc",
        "mount -t sysfs sys /sys",
        "mount -t tmpfs tmpfs /run",
        "mkdir -p /run/tmp",
        "mkdir -p /dev/pts /dev/shm",
        "mount -t devpts devpts /dev/pts",
        "mount -t tmpfs tmpfs /dev/shm",
        f"mount -t hostfs none {here} -o {here}",
        *(f"insmod {modules}/{module}.ko || exit" for module in NEEDED),
        *(f"insmod {modules}/{module}.ko" for module in OPTIONAL),
        "ip link set lo up",
        f"{shlex.join(command)} > {here}/said 2>&1",
        "sync",
        "echo o > /proc/sysrq-trigger",
        "sleep 60",
    ]
    return "\n".join(lines) + "\n"


def _finished(command: list[str], environment: dict[str, str], timeout_s: float) -> str:
    """Its children end with it: each process of a guest is one of the host."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
    )
    try:
        return process.communicate(timeout=timeout_s)[0]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise RuntimeError(f"not finished after {timeout_s:g} s: {process.communicate()[0][-2000:]}") from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
