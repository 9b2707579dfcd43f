"""Runs commands one after the other, each in a process of its own, and says what each took: the whole program is
imported once and each command is a fork of it. The memory of a row is what its command takes beyond a fork that does
nothing, so that it does not depend on what else the program imports.

Reads a JSON list of [folder, words] on standard input; writes a JSON object: the seconds of processor time that the
imports took, and what came of each command.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import resource
import signal
import sys
import time
from typing import Any

DEADLINE_S = 60  # of processor time; a command that takes so long is ended by the system


PACKAGES = ("triaxcal", "triaxcal_drivers", "triaxcald")
APART = "triaxcald.service."
"""The web and its database, which no command on a file imports."""
FURTHER = ("canopen", "pyarrow.csv", "pyarrow.parquet")  # what is not imported before it is needed


def main() -> None:
    begin = time.process_time()
    for package in map(importlib.import_module, PACKAGES):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not module.name.endswith("__main__") and not module.name.startswith(APART):
                importlib.import_module(module.name)
    for name in FURTHER:
        importlib.import_module(name)
    seconds = time.process_time() - begin
    idle = _idle()
    sys.stdout.write(json.dumps({"imports": seconds, "commands": [_run(*row, idle) for row in json.load(sys.stdin)]}))


def _idle() -> int:
    """The most bytes that a fork has in memory when it does nothing."""
    child = os.fork()
    if child == 0:
        os._exit(0)
    return os.wait4(child, 0)[2].ru_maxrss * 1024


def _run(folder: str, words: list[str], idle: int) -> dict[str, Any]:
    child = os.fork()
    if child == 0:
        _be(folder, words)
    _, status, used = os.wait4(child, 0)
    with open(os.path.join(folder, ".err"), encoding="utf-8", errors="replace") as err:
        told = err.read()
    return {
        "code": os.waitstatus_to_exitcode(status),
        "told": told,
        "seconds": used.ru_utime + used.ru_stime,
        "bytes": used.ru_maxrss * 1024 - idle,
    }


def _be(folder: str, words: list[str]) -> None:
    from triaxcald.cli.commands import main as command

    code = 99
    try:
        os.chdir(folder)
        for name, descriptor in ((".out", 1), (".err", 2)):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), descriptor)
        resource.setrlimit(resource.RLIMIT_CPU, (DEADLINE_S, DEADLINE_S + 1))
        signal.alarm(5 * DEADLINE_S)
        code = command(words)
    except BaseException:  # noqa: BLE001 - what the interpreter would do, and no further
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    main()
