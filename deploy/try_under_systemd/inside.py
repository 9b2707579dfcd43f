"""What is seen of triaxcal-record.service where systemd has started the machine;
`run` puts this file there."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

SERVICE = "triaxcal-record"
TRIAXCAL = "/opt/triaxcal/bin/triaxcal"
KEPT, STATION = Path("/var/lib/triaxcal"), Path("/etc/triaxcal/station.toml")
HEALTH = ("127.0.0.1", 9464)
PATIENCE_S = 120.0  # the guest has one slow processor
WATCHDOG_S = 10  # a minute would only be waited for
BUS = '[[buses]]\nname = "trunk"\nbus = { interface = "socketcan", channel = "vcan0" }\n'
odd: list[str] = []


def seen(what: str, holds: bool, *shown: object) -> None:
    print("ok " if holds else "NOT", f"{time.monotonic():5.0f} s  {what}", *shown, sep="  ")
    if not holds:
        odd.append(what)


def until(what: str, reached: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not reached():
        if time.monotonic() > end_s:
            raise TimeoutError(f"{what}: not within {PATIENCE_S:g} s")
        time.sleep(0.1)


def done(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(word) for word in command], capture_output=True, text=True)


def shown(*names: str) -> list[str]:
    return [done("systemctl", "show", "--value", "-p", name, SERVICE).stdout.strip() for name in names]


def station(*parts: str) -> None:
    STATION.write_text("\n".join(['format = "triaxcal.station/1"\nname = "guest"', *parts]))


def health() -> dict[str, dict[str, Any]]:
    """Of each unit and bus; nothing where nobody answers."""
    try:
        with urllib.request.urlopen("http://{}:{}/health".format(*HEALTH), timeout=10) as answer:
            document = json.load(answer)
    except urllib.error.HTTPError as e:
        document = json.load(e)
    except OSError:
        return {}
    return {u["unit"]: u for u in document["units"]}


def recording(*names: str) -> bool:
    there = health()
    return all(n in there and there[n]["state"] == "recording" and there[n]["records"] > 20 for n in names)


def states(name: str) -> list[str]:
    return [
        s["state"] for path in KEPT.glob(f"{name}*.segments.json") for s in json.loads(path.read_text())["segments"]
    ]


def sound(name: str, why: str | None) -> bool:
    """Whether the recording is read as a whole, and what it ended by."""
    (path,) = KEPT.glob(f"{name}*.segments.json")
    info, poses = done(TRIAXCAL, "log", "info", path, "--json"), done(TRIAXCAL, "poses", path)
    return info.returncode == poses.returncode == 0 and (json.loads(info.stdout)["ended"] or {}).get("reason") == why


def simulated(serial: int) -> str:
    """A unit on Modbus TCP, which runs; gives its part of a station file."""
    bus = f'bus = {{ host = "127.0.0.1", port = {15020 + serial}, unit_id = 1 }}\n'
    device = Path(f"/run/{serial}.toml")
    device.write_text(f'format = "triaxcal.device/1"\nprofile = "triax-ref-modbus"\nserial = {serial}\n{bus}')
    subprocess.Popen([TRIAXCAL, "sim", device], cwd="/run", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return f'[[units]]\nname = "unit{serial}"\nprofile = "triax-ref-modbus"\nserial = "{serial}"\n{bus}'


def chatter() -> None:
    """Frames on a CAN bus."""
    done("modprobe", "-a", "vcan", "can-raw")
    done("ip", "link", "add", "vcan0", "up", "type", "vcan")
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as out:
        out.bind(("vcan0",))
        while True:
            out.send(struct.pack("=IB3x8s", 0x123, 8, b"12345678"))
            time.sleep(0.05)


def starts(one: str) -> None:
    station(one, BUS)
    done("systemctl", "enable", SERVICE)
    done("systemctl", "start", "--no-block", SERVICE)
    passed: list[str] = []
    until("active", lambda: passed.append(shown("ActiveState")[0]) or passed[-1] == "active")
    seen("a start becomes active", list(dict.fromkeys(passed)) == ["activating", "active"], *dict.fromkeys(passed))
    answers = socket.create_connection(HEALTH, timeout=10)
    answers.close()
    until("records", lambda: recording("unit1", "trunk"))
    seen("a unit and a CAN bus are recorded", True, shown("StatusText"))


def sandboxed() -> None:
    process = Path("/proc") / shown("MainPID")[0]
    status = dict(line.split(":\t", 1) for line in (process / "status").read_text().splitlines())
    mounts = {line.split()[1]: line.split()[3].split(",")[0] for line in (process / "mounts").read_text().splitlines()}
    owners = {path.owner() for path in [KEPT, *KEPT.iterdir()]}
    seen("all files are the service user's", owners == {"triaxcal"}, *owners)
    seen("no privileges", (status["CapEff"], status["NoNewPrivs"]) == ("0" * 16, "1"))
    writable = sorted(m for m in ("/", "/home", "/run/lock", "/tmp", str(KEPT)) if mounts.get(m) == "rw")
    seen("what it may write", writable == ["/run/lock", "/tmp", str(KEPT)], *writable)
    other = done(TRIAXCAL, "registers", STATION)
    seen("root's command finds the unit in use", other.returncode == 4 and "in use by" in other.stderr)


def reloads(one: str, two: str) -> None:
    pid, before = shown("MainPID"), health()["unit1"]
    station(one, two, BUS)
    done("systemctl", "reload", SERVICE)
    until("the new unit", lambda: recording("unit2"))
    after = health()["unit1"]
    same = (pid, before["recording"]) == (shown("MainPID"), after["recording"])
    seen("a reload adds a unit", same and after["gaps"] == before["gaps"] and after["records"] > before["records"])
    station(one, two, BUS, "nonsense = 1")
    done("systemctl", "reload", SERVICE)
    until("refused", lambda: "was not taken" in done("journalctl", "-u", SERVICE).stdout)
    seen("a reload of a bad file changes nothing", pid == shown("MainPID") and recording("unit1", "unit2", "trunk"))
    station(one, two, BUS)


def comes_back(number: signal.Signals, how_often: int) -> None:
    start_s = time.monotonic()
    os.kill(int(shown("MainPID")[0]), number)
    until("restarted", lambda: shown("NRestarts", "ActiveState") == [str(how_often), "active"])
    took_s = time.monotonic() - start_s
    until("records", lambda: recording("unit1", "unit2", "trunk"))
    kept = {name: states(name) for name in ("unit1", "unit2", "trunk")}
    expected = ["cut_short"] * how_often + ["open"]
    seen(
        f"{number.name}: up again after {took_s:.0f} s", set(map(tuple, kept.values())) == {tuple(expected)}, *expected
    )


def stops() -> None:
    done("systemctl", "stop", SERVICE)
    ended = shown("ActiveState", "Result", "ExecMainStatus")
    seen("a stop", ended == ["inactive", "success", "130"], *ended)
    last = {states(name)[-1] for name in ("unit1", "unit2", "trunk")}
    seen("its recordings are finished, and sound from the first", last == {"closed"} and sound("unit1", "signal"))


def fails(one: str) -> None:
    station(one, "nonsense = 1")
    code = done("systemctl", "start", SERVICE).returncode
    ended = shown("ActiveState", "SubState", "ExecMainStatus")
    seen("a bad file is not tried again", code == 1 and ended == ["failed", "failed", "2"], *ended)
    station(one)
    with socket.create_server(HEALTH):
        done("systemctl", "start", SERVICE)
        ended = shown("ActiveState", "SubState", "ExecMainStatus")
    seen("a port that is taken is", ended == ["activating", "auto-restart", "4"], *ended)
    until("the port is free", lambda: recording("unit1"))
    seen("and is had once it is free", done("systemctl", "stop", SERVICE).returncode == 0)


def main() -> None:
    print(done("systemctl", "--version").stdout.splitlines()[0], os.uname().release, sep=", Linux ")
    STATION.parent.mkdir()
    drop_in = Path(f"/run/systemd/system/{SERVICE}.service.d/watchdog.conf")
    drop_in.parent.mkdir(parents=True)
    drop_in.write_text(f"[Service]\nWatchdogSec={WATCHDOG_S}\n")
    done("systemctl", "daemon-reload")
    threading.Thread(target=chatter, daemon=True).start()
    one, two = simulated(1), simulated(2)
    starts(one)
    sandboxed()
    reloads(one, two)
    comes_back(signal.SIGSTOP, 1)
    seen("by the watchdog", "Failed with result 'watchdog'" in done("journalctl", "-u", SERVICE).stdout)
    comes_back(signal.SIGKILL, 2)
    stops()
    fails(one)


try:
    main()
except Exception as e:  # noqa: BLE001 - whatever it is, the journal tells more
    seen(repr(e), False)
if odd:
    print(done("journalctl", "-o", "cat", "-u", SERVICE).stdout)
print("All of it is as it should be" if not odd else f"{len(odd)} of it are not as they should be")
